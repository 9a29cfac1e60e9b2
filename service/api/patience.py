"""Timeouts for request bodies that stall: senders cannot hold places, or others up."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from starlette.exceptions import HTTPException

if TYPE_CHECKING:
    from starlette.types import Message, Receive, Scope

__all__ = ["LEAST_BYTES", "PATIENCE", "QUIET_S", "Patience", "patience_of"]

PATIENCE = "stillpath.patience"
"""Key of the ASGI scope: the `Patience` with the sender of the body."""

QUIET_S = 30.0
LEAST_BYTES = 1024
"""So many must come in that time: else a byte now and then would do to hold a place."""
_YIELDS_AFTER_S = 5.0


class Patience:
    """Waits for the body of one request.

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
        # For these bytes: what the service itself takes to write them down is not the sender's.
        self._waited_s = 0.0
        self._since = 0.0
        self._waiting: asyncio.Timeout | None = None
        self._has_yielded = False
        self._whole = False

    async def receive(self) -> Message:
        """Return the next message, whose sender may not take longer than he is allowed to.

        Raises
        ------
        HTTPException
            408, if he does.
        """
        if self._whole:  # what comes now is that he hangs up
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

    @property
    def quiet_s(self) -> float:
        """How long the sender has been waited for; 0 if he is not waited for at the moment."""
        if self._waiting is None:
            return 0.0
        return self._waited_s + asyncio.get_running_loop().time() - self._since

    def yield_place(self) -> bool:
        """End the request if its sender has been quiet for some seconds: somebody else is there."""
        waiting = self._waiting
        if waiting is None or waiting.expired() or self.quiet_s < _YIELDS_AFTER_S:
            return False
        self._has_yielded = True
        waiting.reschedule(asyncio.get_running_loop().time())
        return True

    def _too_quiet(self) -> HTTPException:
        if self._has_yielded:
            why = (
                f"For {_YIELDS_AFTER_S:g} s or longer less than {LEAST_BYTES} bytes of this upload "
                "came, and its place was given to another one. "
            )
        else:
            why = (
                f"Within {self._quiet_s:g} s less than {LEAST_BYTES} bytes of the body came, the "
                "least that is waited for. "
            )
        return HTTPException(
            408, f"{why}Send it again over a better connection.", headers={"Connection": "close"}
        )


def patience_of(scope: Scope) -> Patience | None:
    """Return the patience with the sender of a request, if its body passes one."""
    found = scope.get(PATIENCE)
    return found if isinstance(found, Patience) else None
