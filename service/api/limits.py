"""Limits per caller: requests, simultaneous uploads, sizes of requests."""

from __future__ import annotations

import math
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from starlette.datastructures import Headers
from starlette.exceptions import HTTPException

from stillpath.service.api.body_timeout import BODY_TIMEOUT, BodyTimeout
from stillpath.service.api.problems import Problem

if TYPE_CHECKING:
    from starlette.types import Message, Receive, Scope

    from stillpath.service.security.callers import Caller

__all__ = ["COUNTED", "CallerLimits", "limited_receive", "name_of", "unreadable"]

COUNTED = "stillpath.body_counted"
"""Key in the ASGI scope, set by routes that count the bytes of their body themselves."""

_MOST_UPLOADS = 32
_MOST_BUCKETS = 10_000
_LONGEST_URL_BYTES = 8 << 10
_LARGEST_HEADERS_BYTES = 32 << 10
_MOST_HEADERS = 100
_LARGEST_DOCUMENT_BYTES = 4 << 20


class CallerLimits:
    """Counts what callers ask of this process.

    Requests are counted by a token bucket for each key, or for each address without a valid key;
    it holds a minute's worth, so that a burst passes and a stream does not.

    Parameters
    ----------
    uploads : int
        Uploads that one caller may have in progress.
    clock : callable
        Monotonic seconds.
    """

    def __init__(
        self,
        requests_per_minute: int,
        *,
        uploads: int = _MOST_UPLOADS,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._size = float(requests_per_minute)
        self._per_s = requests_per_minute / 60.0
        self._uploads = uploads
        self._clock = clock
        self._lock = threading.Lock()
        # What is left, and when that was; a missing bucket counts as full.
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()
        # Only touched within the event loop.
        self._uploading: dict[str, list[BodyTimeout | None]] = {}

    def take(self, who: str) -> None:
        """Count one request.

        Parameters
        ----------
        who : str
            From `name_of`.

        Raises
        ------
        Problem
            429, if there were too many.
        """
        now = self._clock()
        with self._lock:
            left, at = self._buckets.pop(who, (self._size, now))
            left = min(self._size, left + (now - at) * self._per_s)
            granted = left >= 1.0
            self._buckets[who] = (left - 1.0 if granted else left, now)
            if len(self._buckets) > _MOST_BUCKETS:
                self._buckets.popitem(last=False)
        if not granted:
            wait_s = math.ceil((1.0 - left) / self._per_s)
            raise Problem(
                429,
                "Too many requests",
                f"More than {self._size:.0f} requests in a minute (STILLPATH_REQUESTS_PER_MINUTE). "
                f"Try again in {wait_s} s; to watch a job, use its events, which do not count.",
                headers={"Retry-After": str(wait_s)},
            )

    @contextmanager
    def uploading(self, caller: Caller, body: BodyTimeout | None = None) -> Iterator[None]:
        """Hold one of the caller's slots for uploads; within the event loop.

        If all are taken, one whose sender has fallen silent is freed for this one.

        Parameters
        ----------
        body : BodyTimeout, optional
            With the sender of this upload.

        Raises
        ------
        Problem
            429, if all are taken.
        """
        slots = self._uploading.setdefault(name_of(caller), [])
        if len(slots) >= self._uploads:
            silent = max((one for one in slots if one), key=lambda one: one.quiet_s, default=None)
            if silent is None or not silent.yield_slot():
                raise Problem(
                    429,
                    "Too many uploads at once",
                    f"You have {len(slots)} uploads in progress, which is the limit. Wait for "
                    "one to end.",
                    headers={"Retry-After": "5", "Connection": "close"},
                )
            slots.remove(silent)
        slots.append(body)
        try:
            yield
        finally:
            if body in slots:
                slots.remove(body)
            if not slots and self._uploading.get(name_of(caller)) is slots:
                del self._uploading[name_of(caller)]


def name_of(caller: Caller) -> str:
    """Return by which name a caller's requests are counted: the key's, or the address's."""
    return f"key {caller.key_id}" if caller.key_id is not None else caller.network


def unreadable(scope: Scope) -> Problem | None:
    """Return what is wrong with a request's first lines: their size, or an encoded body."""
    url_bytes = len(scope.get("raw_path") or b"") + len(scope.get("query_string", b""))
    if url_bytes > _LONGEST_URL_BYTES:
        return Problem(
            414,
            "URL too long",
            f"The URL has {url_bytes} bytes; the limit is {_LONGEST_URL_BYTES}.",
        )
    headers = scope["headers"]
    size_bytes = sum(len(name) + len(value) for name, value in headers)
    if size_bytes > _LARGEST_HEADERS_BYTES or len(headers) > _MOST_HEADERS:
        return Problem(
            431,
            "Headers too large",
            f"The request has {len(headers)} headers of {size_bytes} bytes together; the limits "
            f"are {_MOST_HEADERS} and {_LARGEST_HEADERS_BYTES}.",
        )
    encoding = Headers(scope=scope).get("content-encoding", "identity")
    if encoding.strip().lower() not in ("", "identity"):
        return Problem(
            415,
            "Encoded body",
            f"The body comes with Content-Encoding {encoding[:80]!r}, which is not decoded here: "
            "send it as it is.",
            headers={"Accept-Encoding": "identity", "Connection": "close"},
        )
    return None


def limited_receive(scope: Scope, receive: Receive) -> Receive:
    """Return `receive` with limits of time, and of size for bodies that are read as one document.

    A route that streams its body sets `COUNTED` in the scope, and has a limit of size of its own.
    """
    size_bytes = 0
    body = scope[BODY_TIMEOUT] = BodyTimeout(receive)

    async def received() -> Message:
        nonlocal size_bytes
        message = await body.receive()
        if message["type"] == "http.request" and not scope.get(COUNTED):
            size_bytes += len(message.get("body", b""))
            if size_bytes > _LARGEST_DOCUMENT_BYTES:
                raise HTTPException(
                    413,
                    f"The document is larger than {_LARGEST_DOCUMENT_BYTES} bytes, the limit.",
                    headers={"Connection": "close"},
                )
        return message

    return received
