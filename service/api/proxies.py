"""The client address behind proxies; only trusted proxies are believed."""

from __future__ import annotations

import ipaddress
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from starlette.datastructures import Headers

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Receive, Scope, Send

__all__ = ["Proxies"]

Address = ipaddress.IPv4Address | ipaddress.IPv6Address


class Proxies:
    """ASGI middleware that puts the caller's own address, scheme and host in the proxy's place.

    Of `X-Forwarded-For` the last address counts that is not a trusted proxy's: whatever stands
    before it, the caller may have written himself.

    Parameters
    ----------
    app : ASGI application
    trusted : sequence of str
        Addresses or networks (`service.settings.Settings.trusted_proxies`).
    """

    def __init__(self, app: ASGIApp, *, trusted: Sequence[str] = ()) -> None:
        self._app = app
        self._trusted = [ipaddress.ip_network(one, strict=False) for one in trusted]

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:  # noqa: D102 - ASGI
        if scope["type"] == "http" and scope.get("client") and self._trusted:
            peer = _address(scope["client"][0])
            if peer is not None and self._trusts(peer):
                scope = self._without_proxies(scope, peer)
        await self._app(scope, receive, send)

    def _without_proxies(self, scope: Scope, peer: Address) -> Scope:
        headers = Headers(scope=scope)
        changed: dict[str, Any] = {"client": (str(self._caller(headers, peer)), 0)}
        scheme = _last(headers.getlist("x-forwarded-proto"))
        if scheme in ("http", "https"):
            changed["scheme"] = scheme
        host = _last(headers.getlist("x-forwarded-host"))
        if host:
            others = [pair for pair in scope["headers"] if pair[0] != b"host"]
            changed["headers"] = [*others, (b"host", host.encode("latin-1", "replace"))]
        return {**scope, **changed}

    def _caller(self, headers: Headers, peer: Address) -> Address:
        said = ",".join(headers.getlist("x-forwarded-for")).split(",")
        caller = peer
        for text in reversed(said):
            found = _address(text.strip())
            if found is None:
                break
            caller = found
            if not self._trusts(found):
                break
        return caller

    def _trusts(self, address: Address) -> bool:
        return any(address in network for network in self._trusted)


def _address(text: str) -> Address | None:
    """Return an address, which proxies write with or without a port."""
    if text.startswith("["):
        text = text[1:].partition("]")[0]
    elif text.count(":") == 1:
        text = text.partition(":")[0]
    try:
        found = ipaddress.ip_address(text)
    except ValueError:
        return None
    return getattr(found, "ipv4_mapped", None) or found


def _last(values: Sequence[str]) -> str:
    return ",".join(values).rpartition(",")[2].strip()
