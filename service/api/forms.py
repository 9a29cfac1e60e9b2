"""Streaming parser of forms (multipart/form-data): files are passed on, short fields kept."""

from __future__ import annotations

import re
from collections.abc import AsyncIterable, Awaitable, Callable
from typing import TYPE_CHECKING
from urllib.parse import unquote_to_bytes

from fastapi import Request
from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header

from stillpath.service.api.problems import Problem

if TYPE_CHECKING:
    from python_multipart.multipart import MultipartCallbacks

__all__ = ["broken_form", "is_form", "read_form"]

_MOST_FIELDS = 32
_LONGEST_FIELD_BYTES = 4096

# .NET (PowerShell) and older urllib3 write names beyond ASCII so, and without it nothing that can
# be used; RFC 7578, 4.2, does not want it, and the parser leaves it out.
_EXTENDED_NAME = re.compile(rb";[ \t]*filename\*[ \t]*=[ \t]*utf-8'[^']*'([^;\s]+)", re.IGNORECASE)

Take = Callable[[bytes], None]


def is_form(request: Request) -> bool:
    """Whether the body of a request is a form."""
    kind, _ = parse_options_header(request.headers.get("content-type"))
    return kind == b"multipart/form-data"


async def read_form(
    request: Request,
    body: AsyncIterable[bytes],
    begin: Callable[[str], Take],
    drain: Callable[[], Awaitable[None]],
) -> dict[str, str]:
    """Read a form; return its fields that are no files.

    Parameters
    ----------
    body : async iterable
        Its chunks.
    begin : callable
        Called with the name of each file; returns a consumer of its bytes.
    drain : callable
        Awaited after each chunk, to write what was consumed.

    Raises
    ------
    Problem
        422 if it is broken.
    """
    _, parameters = parse_options_header(request.headers.get("content-type"))
    boundary = parameters.get(b"boundary")
    if not boundary:
        raise broken_form("the Content-Type names no boundary")
    form = _Form(begin)
    try:
        parser = MultipartParser(boundary, form.callbacks())
        async for chunk in body:
            parser.write(chunk)
            await drain()
        parser.finalize()
    except FormParserError as error:
        raise broken_form(str(error)) from error
    if not form.is_whole:
        raise broken_form("it ends before its last boundary")
    return form.fields


def broken_form(why: str) -> Problem:
    """Return the problem of a form that cannot be read."""
    return Problem(422, "Invalid form", f"The multipart/form-data body cannot be read: {why}.")


class _Form:
    """Callbacks of the multipart parser."""

    def __init__(self, begin: Callable[[str], Take]) -> None:
        self.fields: dict[str, str] = {}
        self.is_whole = False
        self._begin = begin
        self._take: Take | None = None
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
        disposition = self._headers.get(b"content-disposition", b"")
        _, parameters = parse_options_header(disposition)
        name = parameters.get(b"filename")
        extended = _EXTENDED_NAME.search(disposition)
        if extended is not None:
            name = unquote_to_bytes(extended[1])
        if name is not None:
            self._take = self._begin(name.decode("utf-8", "replace"))
        elif len(self.fields) < _MOST_FIELDS:
            self._text_name = parameters.get(b"name", b"").decode("utf-8", "replace")

    def _part_data(self, data: bytes, start: int, end: int) -> None:
        if self._take is not None:
            self._take(data[start:end])
        elif self._text_name is not None:
            self._text += data[start:end]
            if len(self._text) > _LONGEST_FIELD_BYTES:
                raise broken_form(f"a field is longer than {_LONGEST_FIELD_BYTES} bytes")

    def _part_end(self) -> None:
        if self._text_name is not None:
            self.fields[self._text_name] = self._text.decode("utf-8", "replace")
        self._take = None
        self._text_name, self._text = None, b""

    def _end(self) -> None:
        self.is_whole = True
