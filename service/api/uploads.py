"""An upload goes from the socket to the disk, hashed on its way; memory holds one chunk."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import AsyncGenerator, Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from anyio import to_thread
from fastapi import Request
from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header

from service.api.limits import COUNTED
from service.api.problems import Problem

if TYPE_CHECKING:
    from python_multipart.multipart import MultipartCallbacks

__all__ = ["Upload", "limited_body", "receive_document", "receive_upload", "safe_name"]

_WRITE_BYTES = 1 << 20
_DEFAULT_NAME = "upload.gcode"
_MOST_FIELDS = 32
_LONGEST_FIELD_BYTES = 4096
_LONGEST_NAME_BYTES = 180
"""Of a file's name; with what a result's name has more it stays below the usual 255."""
_SUFFIX = re.compile(r"(\.gcode)?\.[A-Za-z0-9]{1,10}$", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Upload:
    """What arrived.

    Attributes
    ----------
    name : str
        As its sender called the file, made safe.
    size_bytes : int
    sha256 : str
    fields : mapping
        The form's other parts.
    """

    name: str
    size_bytes: int
    sha256: str
    fields: Mapping[str, str]


async def receive_upload(request: Request, target: Path, *, max_bytes: int) -> Upload:
    """Write the body of a request, raw or multipart/form-data, to `target`.

    Parameters
    ----------
    request : Request
        For multipart, the first part with a file name counts; other files are ignored.
    target : Path
        Is left incomplete when an error is raised; the caller deletes it. Nothing is synced:
        what stores the file for good does that.
    max_bytes : int
        Largest body.

    Raises
    ------
    Problem
        413 if the body is too large, 422 if it is empty or broken.
    """
    declared = request.headers.get("content-length", "")
    if declared.isdecimal() and int(declared) > max_bytes:
        raise _too_large(max_bytes)
    kind, parameters = parse_options_header(request.headers.get("content-type"))
    fields: dict[str, str] = {}
    with target.open("wb") as file:
        sink = _Sink(file)
        if kind == b"multipart/form-data":
            form = await _receive_form(request, sink, parameters.get(b"boundary"), max_bytes)
            name, fields = form.name or "", form.fields
        else:
            name = request.query_params.get("name", "")
            async for chunk in limited_body(request, max_bytes):
                await sink.write(chunk)
        await sink.flush()
    if sink.size_bytes == 0:
        raise Problem(
            422,
            "The file is empty",
            "The file has no content: slice or copy it again. The G-code is the body of the "
            "request (curl --data-binary @part.gcode), or a form's file.",
        )
    return Upload(safe_name(name), sink.size_bytes, sink.digest.hexdigest(), fields)


async def receive_document(request: Request, *, max_bytes: int) -> bytes:
    """Return the body of a request that is to be read as a whole.

    Raises
    ------
    Problem
        413 if the body is too large.
    """
    return b"".join([chunk async for chunk in limited_body(request, max_bytes)])


def safe_name(name: str) -> str:
    """Return a file name without folders, control characters or surprises."""
    base = re.split(r"[/\\]", name)[-1]
    base = re.sub(r"[^\w .()+-]", "_", base).strip(" .")
    # File systems count bytes; printers tell the kind of a file by its suffix.
    suffix = _SUFFIX.search(base)
    end = suffix[0] if suffix else ""
    stem = base.removesuffix(end).encode()[: _LONGEST_NAME_BYTES - len(end)]
    return f"{stem.decode(errors='ignore')}{end}".strip(" .") or _DEFAULT_NAME


@dataclass(slots=True)
class _Sink:
    """Collects small chunks; hashes and writes large ones, in a thread: the disk may be slow."""

    file: BinaryIO
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


async def _receive_form(
    request: Request, sink: _Sink, boundary: bytes | None, max_bytes: int
) -> _Form:
    if not boundary:
        raise _broken_form("the Content-Type names no boundary")
    form = _Form(sink.take)
    try:
        parser = MultipartParser(boundary, form.callbacks())
        async for chunk in limited_body(request, max_bytes):
            parser.write(chunk)
            await sink.drain()
        parser.finalize()
    except FormParserError as error:
        raise _broken_form(str(error)) from error
    if not form.is_whole:
        raise _broken_form("it ends before its last boundary")
    if form.name is None:
        raise _broken_form("no part has a file name")
    return form


class _Form:
    """Callbacks of the multipart parser: passes the first file's data on, keeps short fields."""

    def __init__(self, take: Callable[[bytes], None]) -> None:
        self.name: str | None = None
        self.fields: dict[str, str] = {}
        self.is_whole = False
        self._take = take
        self._in_file = False
        self._headers: dict[bytes, bytes] = {}
        self._field = b""
        self._value = b""
        self._text_name: str | None = None
        self._text = b""

    def callbacks(self) -> MultipartCallbacks:
        return {
            "on_part_begin": self._part_begin,
            "on_header_field": self._header_field,
            "on_header_value": self._header_value,
            "on_header_end": self._header_end,
            "on_headers_finished": self._headers_finished,
            "on_part_data": self._part_data,
            "on_part_end": self._part_end,
            "on_end": self._end,
        }

    def _part_begin(self) -> None:
        self._headers = {}

    def _header_field(self, data: bytes, start: int, end: int) -> None:
        self._field += data[start:end]

    def _header_value(self, data: bytes, start: int, end: int) -> None:
        self._value += data[start:end]

    def _header_end(self) -> None:
        self._headers[self._field.lower()] = self._value
        self._field = self._value = b""

    def _headers_finished(self) -> None:
        _, parameters = parse_options_header(self._headers.get(b"content-disposition"))
        name = parameters.get(b"filename")
        self._in_file = name is not None and self.name is None
        if self._in_file and name is not None:
            self.name = name.decode("utf-8", "replace")
        elif name is None and len(self.fields) < _MOST_FIELDS:
            self._text_name = parameters.get(b"name", b"").decode("utf-8", "replace")

    def _part_data(self, data: bytes, start: int, end: int) -> None:
        if self._in_file:
            self._take(data[start:end])
        elif self._text_name is not None:
            self._text += data[start:end]
            if len(self._text) > _LONGEST_FIELD_BYTES:
                raise _broken_form(f"a field is longer than {_LONGEST_FIELD_BYTES} bytes")

    def _part_end(self) -> None:
        if self._text_name is not None:
            self.fields[self._text_name] = self._text.decode("utf-8", "replace")
        self._in_file = False
        self._text_name, self._text = None, b""

    def _end(self) -> None:
        self.is_whole = True


def _too_large(max_bytes: int) -> Problem:
    return Problem(
        413,
        "File too large",
        f"The upload is larger than {max_bytes} bytes, the limit of this service (of files: "
        "STILLPATH_MAX_UPLOAD_BYTES).",
        headers={"Connection": "close"},
    )


def _broken_form(why: str) -> Problem:
    return Problem(422, "Broken form", f"The multipart/form-data body cannot be read: {why}.")
