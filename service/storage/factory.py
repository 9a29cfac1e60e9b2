"""Create the storage named in the settings."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import url2pathname

from stillpath.service.settings import Settings
from stillpath.service.storage.base import Storage
from stillpath.service.storage.local import LocalStorage
from stillpath.service.storage.s3 import S3Storage

__all__ = ["open_storage"]


def open_storage(settings: Settings) -> Storage:
    """Return the storage that the settings name; by default the folder of data.

    Raises
    ------
    ValueError
        If `storage_url` is neither ``s3://..`` nor ``file:///..``.
    StorageError
        If the folder cannot be made. S3 is not asked; see `Storage.check`.
    """
    if settings.storage_url is None:
        return LocalStorage(settings.data_dir)
    parts = urlsplit(settings.storage_url)
    match parts.scheme:
        case "s3":
            return S3Storage(settings.storage_url, settings.data_dir / "scratch")
        case "file" if parts.netloc in ("", "localhost"):
            return LocalStorage(Path(url2pathname(parts.path)))
    raise ValueError(
        f"STILLPATH_STORAGE_URL: {settings.storage_url!r} is neither s3://bucket/prefix nor "
        "file:///folder"
    )
