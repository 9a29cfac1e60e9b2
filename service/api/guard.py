"""Keeps foreign web pages out of a service that trusts its computer.

A browser on the same computer can be made to send requests here by any page it shows. Two checks
stop that: the Host header must name this computer (against DNS rebinding), and a request that
changes something must not come from another origin.
"""

from __future__ import annotations

from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from service.api.problems import problem_response
from service.jobs.problems import problem
from service.settings import is_loopback

__all__ = ["Guard"]

_SAFE = ("GET", "HEAD", "OPTIONS")


class Guard:
    """ASGI middleware with the two checks.

    Parameters
    ----------
    app : ASGI application
    allow_remote : bool
        The service is meant for other computers too: any Host is right.
    """

    def __init__(self, app: ASGIApp, *, allow_remote: bool) -> None:
        self._app = app
        self._allow_remote = allow_remote

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:  # noqa: D102 - ASGI
        if scope["type"] == "http":
            headers = Headers(scope=scope)
            host = headers.get("host", "")
            refused = self._refusal(scope["method"], host, headers.get("origin"))
            if refused is not None:
                answer = problem_response(problem(403, "Refused", refused))
                await answer(scope, receive, send)
                return
        await self._app(scope, receive, send)

    def _refusal(self, method: str, host: str, origin: str | None) -> str | None:
        name = urlsplit(f"//{host}").hostname or ""
        if not self._allow_remote and not is_loopback(name):
            return (
                f"The Host header names {name!r}, but this service answers for its own computer "
                "only. Call it as localhost, or start it with --allow-remote."
            )
        if method in _SAFE or origin is None or urlsplit(origin).netloc == host:
            return None
        return f"The request comes from another site ({origin}). Use this service's own page."
