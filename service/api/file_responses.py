"""Responses with stored files: ranges, entity tags, HEAD; memory use is one chunk."""

from __future__ import annotations

import hashlib
import re
import threading
from collections import OrderedDict
from collections.abc import AsyncIterator, Iterator
from urllib.parse import quote

from fastapi import Request
from starlette.concurrency import iterate_in_threadpool, run_in_threadpool
from starlette.responses import Response, StreamingResponse

from stillpath.service.api.problems import Problem
from stillpath.service.jobs.state import Job
from stillpath.service.storage.base import Stat, Storage

__all__ = [
    "HEADERS",
    "MEDIA",
    "RANGES",
    "Verified",
    "damaged",
    "matches",
    "stored",
    "stored_result",
]

_VERIFIED_KEPT = 4096
_RANGE = re.compile(r"bytes=(\d{1,18})?-(\d{1,18})?")

MEDIA = {".csv": "text/csv", ".npz": "application/octet-stream", ".json": "application/json"}
"""Kinds of answers, by the suffix of their file names."""

HEADERS = {
    "ETag": {"schema": {"type": "string"}, "description": "Identifies the content."},
    "Accept-Ranges": {"schema": {"type": "string"}},
}
"""OpenAPI entries for the headers of a stored file."""

RANGES: dict[int | str, dict[str, str]] = {
    206: {"description": "The part that `Range` names"},
    304: {"description": "Not Modified: `If-None-Match` names this content"},
}
"""OpenAPI entries for the other answers a stored file can give."""


class Verified:
    """Compares results with the SHA-256 in their rows, again only where size or time have changed.

    Before anything is sent: that covers parts of files, and clients that look at no digest.
    """

    def __init__(self, storage: Storage) -> None:
        self._storage = storage
        self._kept: OrderedDict[Stat, str] = OrderedDict()
        self._lock = threading.Lock()

    def check(self, job: Job) -> None:
        """Raise `Problem` 404 if a job's result is gone or damaged."""
        found = _found(self._storage, job.result)
        if found.size_bytes != job.result_bytes:
            raise damaged(job.result, f"{found.size_bytes} bytes instead of {job.result_bytes}")
        with self._lock:
            digest = self._kept.get(found)
        if digest is None:
            hashing = hashlib.sha256()
            for chunk in self._storage.read(job.result, 0, found.size_bytes):
                hashing.update(chunk)
            digest = hashing.hexdigest()
        if digest != job.result_sha256:
            raise damaged(job.result, f"the SHA-256 {digest} instead of {job.result_sha256}")
        with self._lock:
            self._kept[found] = digest
            self._kept.move_to_end(found)
            while len(self._kept) > _VERIFIED_KEPT:
                self._kept.popitem(last=False)


async def stored_result(request: Request, job: Job, media_type: str) -> Response:
    """Return the answer with a job's result, if it is what the worker stored; see `stored`."""
    state = request.app.state
    await run_in_threadpool(state.verified.check, job)
    return await stored(
        request,
        state.storage,
        job.result,
        media_type=media_type,
        etag=job.result_sha256,
        filename=job.result_name,
    )


async def stored(
    request: Request,
    storage: Storage,
    key: str,
    *,
    media_type: str,
    etag: str | None = None,
    filename: str | None = None,
    span: tuple[int, int] | None = None,
) -> Response:
    """Return the answer with a stored file.

    Parameters
    ----------
    request : Request
        Its method and the headers Range, If-Range and If-None-Match are obeyed. Several ranges at
        once are answered with the whole, as RFC 9110 allows.
    etag : str, optional
        Without quotes; by default of size and time.
    filename : str, optional
        Under which a browser saves it.
    span : (int, int), optional
        First byte, and the one after the last, of what counts as the file.

    Raises
    ------
    Problem
        404 if the file is gone or damaged, 416 if it has no such range.
    """
    found = await run_in_threadpool(_found, storage, key)
    first, past = span or (0, found.size_bytes)
    if not 0 <= first <= past <= found.size_bytes:
        raise damaged(key, f"{found.size_bytes} bytes, and its index goes up to {past}")
    tag = f'"{etag or f"{found.size_bytes:x}-{int(found.modified_at * 1e6):x}"}"'
    headers = {"ETag": tag, "Accept-Ranges": "bytes"}
    if filename is not None:
        headers["Content-Disposition"] = _disposition(filename)
    if matches(request.headers.get("if-none-match"), tag):
        return Response(status_code=304, headers=headers)
    size = past - first
    part = _range(request, tag, size)
    status = 200
    if part is not None:
        status = 206
        start, stop = part
        headers["Content-Range"] = f"bytes {start}-{stop - 1}/{size}"
        first, past = first + start, first + stop
    headers["Content-Length"] = str(past - first)
    if request.method == "HEAD" or first == past:
        return Response(status_code=status, headers=headers, media_type=media_type)
    chunks = _closing(storage.read(key, first, past))
    return StreamingResponse(chunks, status_code=status, headers=headers, media_type=media_type)


def damaged(key: str, what: str) -> Problem:
    """Return the problem of a file in the storage that is not what was stored; `what` it has."""
    detail = (
        f"{key} in the storage has {what}. Check the storage's disk, delete the job, and submit it "
        "again."
    )
    return Problem(404, "The file is damaged", detail)


def _found(storage: Storage, key: str) -> Stat:
    try:
        return storage.stat(key)
    except FileNotFoundError:
        name = key.rsplit("/", 1)[-1]
        detail = f"{name} is no longer in the storage. Delete the job, and submit it again."
        raise Problem(404, "The file is gone", detail) from None


def matches(header: str | None, tag: str) -> bool:
    """Return whether a list of entity tags (RFC 9110, 13.1) holds `tag`."""
    if header is None:
        return False
    tags = [each.strip().removeprefix("W/") for each in header.split(",")]
    return "*" in tags or tag in tags


def _range(request: Request, tag: str, size: int) -> tuple[int, int] | None:
    """Return the part that is asked for, as first byte and the one after the last."""
    # Only GET knows ranges (RFC 9110, 14.2).
    asked = request.headers.get("range") if request.method == "GET" else None
    condition = request.headers.get("if-range")
    if asked is None or (condition is not None and condition != tag):
        return None
    found = _RANGE.fullmatch(asked.replace(" ", ""))
    start_text, last_text = found.groups() if found else (None, None)
    if start_text is None and last_text is None:
        return None  # another unit: ignore the header
    if start_text is None:
        start, stop = max(size - int(last_text or 0), 0), size
    else:
        start = int(start_text)
        stop = size if last_text is None else min(int(last_text) + 1, size)
        if last_text is not None and int(last_text) < start:
            return None
    if start >= size or start == stop:
        raise Problem(
            416,
            "No such range",
            f"The file has {size} bytes; {asked[:80]} lies outside.",
            headers={"Content-Range": f"bytes */{size}"},
        )
    return start, stop


async def _closing(chunks: Iterator[bytes]) -> AsyncIterator[bytes]:
    """Yield the chunks, and close the file even if the caller disconnects."""
    try:
        async for chunk in iterate_in_threadpool(chunks):
            yield chunk
    finally:
        close = getattr(chunks, "close", None)
        if close is not None:
            close()


def _disposition(filename: str) -> str:
    quoted = quote(filename)
    if quoted == filename:
        return f'attachment; filename="{filename}"'
    return f"attachment; filename*=UTF-8''{quoted}"
