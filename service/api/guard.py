"""Keep foreign web pages out, and restrict what our own pages may do in browsers.

A browser can be made to send requests here by any page it shows. Where callers need no key, three
checks stop that: the Host header must name this computer (against DNS rebinding), a request that
changes something must not come from another origin, and other sites may link here but load nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from stillpath.service.api.body_timeout import BODY_TIMEOUT, BodyTimeout
from stillpath.service.api.limits import limited_receive, unreadable
from stillpath.service.api.problems import Problem, problem_response
from stillpath.service.settings import Settings, is_loopback

__all__ = ["Guard", "hosts_of"]

_SAFE = ("GET", "HEAD", "OPTIONS")
# What asks for these by itself, a load balancer for instance, names the host as it likes.
_HEALTH = ("/healthz", "/readyz")
_FORWARDED = ("forwarded", "x-forwarded-for", "x-real-ip")
# For pages without a policy of their own: their own script and style, and nothing from anywhere.
_PAGE_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:; "
    "form-action 'none'; base-uri 'none'; frame-ancestors 'self'"
)
_OTHER_POLICY = "default-src 'none'; frame-ancestors 'none'; sandbox"
_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "SAMEORIGIN",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    # Kept by the browser of whoever asked, and asked about again each time.
    "Cache-Control": "private, no-cache",
}


def hosts_of(settings: Settings, keys_required: bool) -> Sequence[str]:
    """Return the names in the Host header that are answered besides those of this computer.

    With keys any name will do, unless names are set: a page of somebody else has no key.
    """
    if keys_required and not settings.allowed_hosts:
        return ("*",)
    return tuple(settings.allowed_hosts)


class Guard:
    """ASGI middleware with the checks and the headers.

    Parameters
    ----------
    app : ASGI application
    allowed_hosts : sequence of str
        From `hosts_of`.
    trusts_all : bool
        Callers need no key. Forwarded requests are then refused: a proxy on this computer would
        give everybody local access.
    """

    def __init__(
        self, app: ASGIApp, *, allowed_hosts: Sequence[str] = (), trusts_all: bool = True
    ) -> None:
        self._app = app
        self._hosts = frozenset(host.lower() for host in allowed_hosts)
        self._trusts_all = trusts_all

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:  # noqa: D102 - ASGI
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        received = limited_receive(scope, receive)
        body: BodyTimeout = scope[BODY_TIMEOUT]

        async def sent(message: Message) -> None:
            if message["type"] == "http.response.start":
                _complete(MutableHeaders(scope=message))
            elif not message.get("more_body") and _has_body(scope) and not body.is_whole:
                # Who stops sending at an error reads it now, others when they have sent all.
                await send({**message, "more_body": True})
                await body.discard()
                message = {"type": "http.response.body"}
            await send(message)

        refused = unreadable(scope) or self._refusal(scope)
        if refused is None:
            await self._app(scope, received, sent)
        else:
            answer = problem_response(refused.document, refused.headers)
            await answer(scope, received, sent)

    def _refusal(self, scope: Scope) -> Problem | None:
        headers = Headers(scope=scope)
        host = headers.get("host", "")
        why = None
        if scope["path"] not in _HEALTH:
            why = self._wrong_host(host)
        why = why or self._passed_on(headers) or _foreign(scope["method"], host, headers)
        return None if why is None else Problem(403, "Request refused", why)

    def _wrong_host(self, host: str) -> str | None:
        try:
            name = (urlsplit(f"//{host}").hostname or "").lower()
        except ValueError:
            name = ""
        if "*" in self._hosts or name in self._hosts or is_loopback(name):
            return None
        return (
            f"The Host header names {name[:80]!r}, which this service does not answer to. Call it "
            "as localhost, or add the name to STILLPATH_ALLOWED_HOSTS."
        )

    def _passed_on(self, headers: Headers) -> str | None:
        if self._trusts_all and any(name in headers for name in _FORWARDED):
            return (
                "A proxy passed this request on, but this service asks nobody for a key. Set "
                "STILLPATH_KEYS=true behind a proxy."
            )
        return None


def _has_body(scope: Scope) -> bool:
    headers = Headers(scope=scope)
    return headers.get("content-length", "0") != "0" or "transfer-encoding" in headers


def _foreign(method: str, host: str, headers: Headers) -> str | None:
    origin = headers.get("origin")
    # Browsers say where a request comes from, and what for; no page can say so in their place.
    site, mode = headers.get("sec-fetch-site"), headers.get("sec-fetch-mode")
    if method not in _SAFE:
        # A proxy may have left the port out of the Host header, or put one in.
        if origin is None or site == "same-origin" or _origin_host(origin) == host.lower():
            return None
        return (
            f"The request comes from another site ({origin[:80]}) than {host[:80]}. Use this "
            "service's own page; a proxy must pass the Host header on as it came, with the port."
        )
    # A "resource isolation policy".
    if site == "cross-site" and mode != "navigate":
        return "Another site's page tries to load this. Open it by itself."
    return None


def _origin_host(origin: str) -> str:
    try:
        return urlsplit(origin).netloc.lower()
    except ValueError:
        return ""


def _complete(headers: MutableHeaders) -> None:
    is_page = headers.get("content-type", "").startswith("text/html")
    headers.setdefault("Content-Security-Policy", _PAGE_POLICY if is_page else _OTHER_POLICY)
    for name, value in _HEADERS.items():
        headers.setdefault(name, value)
