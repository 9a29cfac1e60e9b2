"""Create the storage named in the settings."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import url2pathname

from stillpath.pipeline.files import replacing
from stillpath.service.settings import Settings
from stillpath.service.storage.base import Storage, StorageError
from stillpath.service.storage.local import LocalStorage
from stillpath.service.storage.s3 import S3Storage

__all__ = ["open_storage"]

_KNOWN = ".storage"
"""File in the data directory with the folder elsewhere that the service has filled."""


def open_storage(settings: Settings) -> Storage:
    """Return the storage that the settings name; by default the folder of data.

    Raises
    ------
    ValueError
        If `storage_url` is neither ``s3://..`` nor ``file:///..``.
    StorageError
        If the folder cannot be made at the first start. Later it must be there, because it may lie
        on a disk that is away; neither it nor S3 is asked; see `Storage.check`.
    """
    if settings.storage_url is None:
        return LocalStorage(settings.data_dir)
    parts = urlsplit(settings.storage_url)
    match parts.scheme:
        case "s3":
            return S3Storage(settings.storage_url, settings.data_dir / "scratch")
        case "file" if parts.netloc in ("", "localhost") and parts.path.startswith("/"):
            return _in_folder(Path(url2pathname(parts.path)), settings.data_dir)
    raise ValueError(
        f"STILLPATH_STORAGE_URL: {settings.storage_url!r} is neither s3://bucket/prefix nor "
        "file:///folder"
    )


def _in_folder(root: Path, data_dir: Path) -> LocalStorage:
    """Open a storage in a folder, which is made at the first start only."""
    known = data_dir / _KNOWN
    try:
        if known.exists() and known.read_text("utf-8") == f"{root}\n":
            return LocalStorage(root, make=False)
        storage = LocalStorage(root)
        data_dir.mkdir(mode=0o700, parents=True, exist_ok=True)
        with replacing(known, mode=0o600) as file:
            file.write_text(f"{root}\n", "utf-8")
    except OSError as error:
        why = f"{error.strerror} (STILLPATH_STORAGE_URL; make the folder, or name another)"
        raise StorageError(error.errno, why, error.filename) from error
    return storage
