"""An upload goes from the socket to the disk, hashed on its way; memory holds one chunk."""

from __future__ import annotations

import hashlib
import os
import re
import unicodedata
from collections.abc import AsyncGenerator, Callable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from anyio import to_thread
from fastapi import Request

from stillpath.service.api.forms import broken_form, is_form, read_form
from stillpath.service.api.limits import COUNTED
from stillpath.service.api.problems import Problem
from stillpath.service.jobs.problems import FILE_EMPTY, FILE_TOO_LARGE
from stillpath.service.storage.disk import Disk

__all__ = [
    "Received",
    "Upload",
    "limited_body",
    "receive_document",
    "receive_files",
    "receive_upload",
    "safe_name",
]

_WRITE_BYTES = 1 << 20
_DEFAULT_NAME = "upload.gcode"
_LONGEST_NAME_BYTES = 180
"""Longest file name; what the result's name adds still fits the usual 255 bytes."""
_SUFFIX = re.compile(r"(\.gcode)?\.[A-Za-z0-9]{1,10}$", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Upload:
    """What arrived.

    Attributes
    ----------
    name : str
        The sender's name for the file, made safe.
    fields : mapping
        The form's other parts.
    """

    name: str
    size_bytes: int
    sha256: str
    fields: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class Received:
    """A file of a form: what its sender called it, and where it is now."""

    label: str
    path: Path
    size_bytes: int
    sha256: str


async def receive_upload(request: Request, target: Path, *, max_bytes: int, disk: Disk) -> Upload:
    """Write the body of a request, raw or multipart/form-data, to `target`.

    Parameters
    ----------
    request : Request
        For multipart, one part has a file name.
    target : Path
        Is left incomplete when an error is raised; the caller deletes it. Nothing is synced:
        what stores the file for good does that.
    disk : Disk
        The disk that holds `target`.

    Raises
    ------
    Problem
        408 if its sender stops sending, 413 if the body is too large, 422 if it is empty or broken.
    NoRoom
    """
    # The result is stored too, and is at least as large as the upload.
    disk.check_ever(2 * _check_declared(request, max_bytes, disk))
    fields: dict[str, str] = {}
    with target.open("wb") as file:
        sink = _Sink(file, disk)
        if is_form(request):
            names: list[str] = []

            def begin(name: str) -> Callable[[bytes], None]:
                if names:
                    raise broken_form("a job has one file; send each with a request of its own")
                names.append(name)
                return sink.take

            body = limited_body(request, max_bytes)
            fields = await read_form(request, body, begin, sink.drain)
            if not names:
                raise broken_form("no part has a file name")
            name = names[0]
        else:
            name = request.query_params.get("name", "")
            async for chunk in limited_body(request, max_bytes):
                await sink.write(chunk)
        await sink.flush()
    if sink.size_bytes == 0:
        raise Problem(
            422,
            FILE_EMPTY,
            "The file has no content: slice or copy it again. The G-code is the body of the "
            "request (curl --data-binary @part.gcode), or a form's file.",
        )
    return Upload(safe_name(name), sink.size_bytes, sink.digest.hexdigest(), fields)


async def receive_files(
    request: Request, folder: Path, *, max_bytes: int, max_files: int, disk: Disk
) -> list[Received]:
    """Write the files of a form into a folder.

    Parameters
    ----------
    folder : Path
        Is left as it is when an error is raised; the caller deletes it.
    max_bytes : int
        Limit for all files together.
    disk : Disk
        The disk that holds `folder`.

    Raises
    ------
    Problem
        408 if its sender stops sending, 413 if the body is too large, 422 if it is broken.
    NoRoom
    """
    _check_declared(request, max_bytes, disk)
    found: list[tuple[str, Path]] = []
    sinks: list[_Sink] = []
    with ExitStack() as files:

        def begin(name: str) -> Callable[[bytes], None]:
            if len(found) >= max_files:
                raise broken_form(f"it has more than {max_files} files, the limit")
            path = folder / f"{len(found)}"
            found.append((name, path))
            sinks.append(_Sink(files.enter_context(path.open("wb")), disk))
            return sinks[-1].take

        async def drain() -> None:
            for sink in sinks[-1:]:
                await sink.drain()

        await read_form(request, limited_body(request, max_bytes), begin, drain)
        for sink in sinks:
            await sink.flush()
    return [
        Received(label, path, sink.size_bytes, sink.digest.hexdigest())
        for (label, path), sink in zip(found, sinks, strict=True)
    ]


async def receive_document(request: Request, *, max_bytes: int) -> bytes:
    """Return the body of a request that is to be read as a whole.

    Raises
    ------
    Problem
        413 if the body is too large.
    """
    return b"".join([chunk async for chunk in limited_body(request, max_bytes)])


def safe_name(name: str, also: str = "") -> str:
    """Return a file name without folders, control characters or surprises.

    Parameters
    ----------
    also : str
        Other characters that it may have.
    """
    base = re.split(r"[/\\]", unicodedata.normalize("NFC", name))[-1]  # macOS takes letters apart
    base = re.sub(rf"[^\w .()+{re.escape(also)}-]", "_", base).strip(" .")
    # File systems count bytes; printers tell the kind of a file by its suffix.
    suffix = _SUFFIX.search(base)
    end = suffix[0] if suffix else ""
    stem = base.removesuffix(end).encode()[: _LONGEST_NAME_BYTES - len(end)]
    return f"{stem.decode(errors='ignore')}{end}".strip(" .") or _DEFAULT_NAME


@dataclass(slots=True)
class _Sink:
    """Collects small chunks; hashes and writes large ones, in a thread: the disk may be slow."""

    file: BinaryIO
    disk: Disk
    size_bytes: int = 0
    digest: hashlib._Hash = field(default_factory=hashlib.sha256)
    _chunks: list[bytes] = field(default_factory=list)
    _waiting_bytes: int = 0

    def take(self, chunk: bytes) -> None:
        self._chunks.append(chunk)
        self._waiting_bytes += len(chunk)
        self.size_bytes += len(chunk)

    async def write(self, chunk: bytes) -> None:
        self.take(chunk)
        await self.drain()

    async def drain(self) -> None:
        if self._waiting_bytes >= _WRITE_BYTES:
            await self.flush()

    async def flush(self) -> None:
        await to_thread.run_sync(self._flush)

    def _flush(self) -> None:
        collected = b"".join(self._chunks)
        # Others may have written since the upload began.
        self.disk.check(len(collected))
        self._chunks.clear()
        self._waiting_bytes = 0
        self.digest.update(collected)
        start = self.file.tell()
        self.file.write(collected)
        self.file.flush()
        if hasattr(os, "posix_fadvise"):
            # Begins to write it to the disk, so that little is left to wait for at the end. Some
            # file systems take no advice.
            with suppress(OSError):
                os.posix_fadvise(self.file.fileno(), start, len(collected), os.POSIX_FADV_DONTNEED)


async def limited_body(request: Request, max_bytes: int) -> AsyncGenerator[bytes, None]:
    """Yield the body of a request; raise `Problem` 413 when it grows too large."""
    request.scope[COUNTED] = True
    size = 0
    async for chunk in request.stream():
        size += len(chunk)
        if size > max_bytes:
            raise _too_large(max_bytes)
        yield chunk


def _check_declared(request: Request, max_bytes: int, disk: Disk) -> int:
    """Refuse by what the headers say, before anything is read; return the declared size."""
    declared = request.headers.get("content-length", "")
    size = int(declared) if declared.isdecimal() else 0
    if size > max_bytes:
        raise _too_large(max_bytes)
    disk.check(size)
    return size


def _too_large(max_bytes: int) -> Problem:
    return Problem(
        413,
        FILE_TOO_LARGE,
        f"The upload is larger than {max_bytes} bytes ({max_bytes / 1e6:.3g} MB), the most that is "
        "taken here: is it the right file? For sliced files, whoever runs the service can raise "
        "STILLPATH_MAX_UPLOAD_BYTES.",
        headers={"Connection": "close"},
    )
