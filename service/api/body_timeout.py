"""Timeouts for stalled request bodies, so that senders cannot block upload slots."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import TYPE_CHECKING

from starlette.exceptions import HTTPException

if TYPE_CHECKING:
    from starlette.types import Message, Receive, Scope

__all__ = ["BODY_TIMEOUT", "LEAST_BYTES", "QUIET_S", "BodyTimeout", "body_timeout_of"]

BODY_TIMEOUT = "stillpath.body_timeout"
"""Key of the ASGI scope: the `BodyTimeout` of the request."""

QUIET_S = 30.0
LEAST_BYTES = 1024
"""Least number of bytes in that time: single bytes must not suffice to hold a slot."""
_YIELDS_AFTER_S = 5.0
_DISCARDS_S = 60.0


class BodyTimeout:
    """Receives the body of one request with a timeout.

    Parameters
    ----------
    receive : ASGI receive
    quiet_s : float
        How long the next `LEAST_BYTES` may take.
    """

    def __init__(self, receive: Receive, *, quiet_s: float = QUIET_S) -> None:
        self._receive = receive
        self._quiet_s = quiet_s
        self._bytes = 0
        # Waiting for these bytes only: the service's own writing time does not count.
        self._waited_s = 0.0
        self._since = 0.0
        self._waiting: asyncio.Timeout | None = None
        self._has_yielded = False
        self._whole = False

    async def receive(self) -> Message:
        """Return the next message within the time limit.

        Raises
        ------
        HTTPException
            408, if fewer than `LEAST_BYTES` came within the limit.
        """
        if self._whole:  # only a disconnect can follow
            return await self._receive()
        self._since = asyncio.get_running_loop().time()
        try:
            async with asyncio.timeout(self._quiet_s - self._waited_s) as self._waiting:
                message = await self._receive()
        except TimeoutError:
            raise self._too_quiet() from None
        finally:
            self._waited_s = self.quiet_s
            self._waiting = None
        self._whole = message["type"] != "http.request" or not message.get("more_body", False)
        self._bytes += len(message.get("body", b""))
        if self._bytes >= LEAST_BYTES:
            self._waited_s, self._bytes = 0.0, 0
        return message

    async def discard(self) -> None:
        """Read what is left for a minute at most: who still sends may not hear an answer.

        Closing a connection with unread bytes resets it, and the answer is lost with it.
        """
        with suppress(TimeoutError, HTTPException):
            async with asyncio.timeout(_DISCARDS_S):
                while not self._whole:
                    await self.receive()

    @property
    def is_whole(self) -> bool:
        """Whether all has come, or its sender is gone."""
        return self._whole

    @property
    def quiet_s(self) -> float:
        """Time spent waiting for the sender; 0 if not waiting at the moment."""
        if self._waiting is None:
            return 0.0
        return self._waited_s + asyncio.get_running_loop().time() - self._since

    def yield_slot(self) -> bool:
        """End the request if its sender has been quiet for some seconds, as another is waiting."""
        waiting = self._waiting
        if waiting is None or waiting.expired() or self.quiet_s < _YIELDS_AFTER_S:
            return False
        self._has_yielded = True
        waiting.reschedule(asyncio.get_running_loop().time())
        return True

    def _too_quiet(self) -> HTTPException:
        if self._has_yielded:
            why = (
                f"Fewer than {LEAST_BYTES} bytes of this upload came within {_YIELDS_AFTER_S:g} s, "
                "and its slot was given to another one. "
            )
        else:
            why = f"Fewer than {LEAST_BYTES} bytes of the body came within {self._quiet_s:g} s. "
        return HTTPException(
            408, f"{why}Send it again over a better connection.", headers={"Connection": "close"}
        )


def body_timeout_of(scope: Scope) -> BodyTimeout | None:
    """Return the timeout that the body of a request passes, if any."""
    found = scope.get(BODY_TIMEOUT)
    return found if isinstance(found, BodyTimeout) else None
