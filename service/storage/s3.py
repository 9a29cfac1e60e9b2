"""Files of jobs in a bucket of S3 or a compatible server: MinIO, Ceph, Garage."""

from __future__ import annotations

import contextlib
import errno
import tempfile
import uuid
from collections.abc import Iterator, Mapping
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import parse_qs, urlsplit

from stillpath.service.storage.base import Stat, StorageError
from stillpath.service.storage.keys import check_key, check_prefix
from stillpath.service.storage.leftovers import delete_leftovers

if TYPE_CHECKING:
    from obstore.store import S3Store

__all__ = ["S3Storage"]

_CHUNK_BYTES = 1 << 20
_PART_BYTES = 8 << 20
_PARTS_AT_ONCE = 4
_CONNECT_S, _REQUEST_S, _RETRY_S = 5.0, 60.0, 8.0
_FETCHED = "fetched-"
_PARAMETERS = ("endpoint", "region")


class S3Storage:
    """A `service.storage.base.Storage` in a bucket.

    Credentials, region and endpoint come from the environment as everywhere: ``AWS_ACCESS_KEY_ID``,
    ``AWS_SECRET_ACCESS_KEY``, ``AWS_REGION``, ``AWS_ENDPOINT_URL``, or the instance's role.

    Parameters
    ----------
    url : str
        ``s3://bucket/prefix?endpoint=http://host:9000&region=eu-1``; prefix and query may be left
        out.
    scratch : Path
        Folder for copies of files that a program wants to read.

    Raises
    ------
    ValueError
        If the address is not such a one.
    """

    def __init__(self, url: str, scratch: Path) -> None:
        self._url = url.split("?")[0]
        self._scratch = scratch
        self._store = _open(url)
        delete_leftovers(scratch, f"{_FETCHED}*")

    def put(self, key: str, file: Path) -> None:
        """Upload a local file and delete it here; see `Storage.put`.

        A large file is uploaded in parts, which are invisible until the last one has arrived.
        """
        import obstore

        check_key(key)
        with self._explained(key):
            obstore.put(
                self._store,
                key,
                file,
                use_multipart=file.stat().st_size > _PART_BYTES,
                chunk_size=_PART_BYTES,
                max_concurrency=_PARTS_AT_ONCE,
            )
        file.unlink()

    def put_all(self, files: Mapping[str, Path]) -> None:
        """Upload local files; see `Storage.put_all`."""
        for key, file in files.items():
            self.put(key, file)

    @contextlib.contextmanager
    def local(self, key: str) -> Iterator[Path]:
        """Give a copy; see `Storage.local`."""
        size = self.stat(key).size_bytes
        self._scratch.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=self._scratch, prefix=_FETCHED) as folder:
            # Programs derive the type of a file from its name.
            copy = Path(folder) / key.rsplit("/", 1)[-1]
            with copy.open("wb") as file:
                for chunk in self.read(key, 0, size):
                    file.write(chunk)
            yield copy

    def stat(self, key: str) -> Stat:
        """Return what is known of a file; see `Storage.stat`."""
        import obstore

        check_key(key)
        with self._explained(key):
            found = obstore.head(self._store, key)
        return Stat(key, found["size"], found["last_modified"].timestamp())

    def read(self, key: str, start: int, stop: int) -> Iterator[bytes]:
        """Yield the bytes from `start` up to `stop`; see `Storage.read`.

        In requests of some MB each, so that a slow reader does not run into a time limit.
        """
        import obstore

        stop = min(stop, self.stat(key).size_bytes)
        for begin in range(start, stop, _PART_BYTES):
            end = min(begin + _PART_BYTES, stop)
            with self._explained(key):
                part = memoryview(obstore.get_range(self._store, key, start=begin, end=end))
            for place in range(0, len(part), _CHUNK_BYTES):
                yield bytes(part[place : place + _CHUNK_BYTES])

    def list(self, prefix: str) -> Iterator[Stat]:
        """Yield the files below `prefix`; see `Storage.list`."""
        import obstore

        check_prefix(prefix)
        with self._explained(prefix):
            for page in obstore.list(self._store, prefix=prefix):
                for found in page:
                    yield Stat(found["path"], found["size"], found["last_modified"].timestamp())

    def delete(self, prefix: str) -> None:
        """Delete the files below `prefix`; see `Storage.delete`."""
        import obstore

        keys = [found.key for found in self.list(prefix)]
        if keys:
            with self._explained(prefix), contextlib.suppress(FileNotFoundError):
                obstore.delete(self._store, keys)

    def room(self) -> None:
        """Return None: a bucket does not say; see `Storage.room`."""

    def takes(self, more_bytes: int) -> bool:  # noqa: ARG002
        """Return True: only the upload tells; see `Storage.takes`."""
        return True

    def check(self) -> None:
        """Write an empty file and delete it; see `Storage.check`."""
        import obstore

        key = f"check/{uuid.uuid4().hex}"
        with self._explained(key):
            obstore.put(self._store, key, b"", use_multipart=False)
            obstore.delete(self._store, key)

    @contextlib.contextmanager
    def _explained(self, key: str) -> Iterator[None]:
        from obstore.exceptions import BaseError, NotFoundError

        try:
            yield
        except (NotFoundError, FileNotFoundError) as error:
            if "NoSuchBucket" in str(error):
                raise self._trouble(error) from error
            raise FileNotFoundError(
                errno.ENOENT, "there is no such file in the storage", key
            ) from error
        except BaseError as error:
            raise self._trouble(error) from error

    def _trouble(self, error: Exception) -> StorageError:
        said = " ".join(str(error).split()).partition(" Debug source")[0][:400]
        return StorageError(
            errno.EIO, f"the storage does not answer as it should: {said}", self._url
        )


def _open(url: str) -> S3Store:
    from obstore.store import S3Store

    parts = urlsplit(url)
    given = parse_qs(parts.query)
    unknown = sorted(set(given) - set(_PARAMETERS))
    if parts.scheme != "s3" or not parts.netloc or unknown:
        raise ValueError(
            f"{url!r} is not the address of a bucket: s3://bucket/prefix, with ?endpoint= and "
            "&region= where they are not in AWS_ENDPOINT_URL and AWS_REGION"
        )
    chosen = {name: values[0] for name, values in given.items()}
    return S3Store(
        parts.netloc,
        prefix=parts.path.strip("/") or None,
        **chosen,  # type: ignore[arg-type]
        client_options={
            "allow_http": True,
            "connect_timeout": timedelta(seconds=_CONNECT_S),
            "timeout": timedelta(seconds=_REQUEST_S),
        },
        retry_config={"max_retries": 5, "retry_timeout": timedelta(seconds=_RETRY_S)},
    )
