"""Check addresses that the service contacts, so that it cannot be sent into private networks.

An address is checked when a job is submitted, and again before sending: then the name is resolved
once, and the connection goes to exactly the address that was checked.
"""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

from stillpath.service.settings import Settings, is_loopback

__all__ = ["Target", "TargetRefused", "Unresolved", "addresses_of", "check_webhook", "read_url"]

_PORTS = {"http": 80, "https": 443}
_LONGEST = 2000
# Where clouds hand out the secrets of the computer, beside the link-local address.
_METADATA = frozenset(
    ipaddress.ip_address(address)
    for address in ("100.100.100.200", "168.63.129.16", "192.0.0.192", "fd00:ec2::254")
)
# IPv4 in disguise.
_NAT64 = ipaddress.IPv6Network("64:ff9b::/96")

_Address = ipaddress.IPv4Address | ipaddress.IPv6Address


class TargetRefused(ValueError):
    """The service does not send there; trying again will not help."""


class Unresolved(OSError):
    """The name stands for no address, now."""


@dataclass(frozen=True, slots=True)
class Target:
    """A validated address.

    Attributes
    ----------
    scheme : str
        ``http`` or ``https``.
    host : str
        In lower case, IPv6 without brackets.
    path : str
        With the query; begins with ``/``.
    """

    scheme: str
    host: str
    port: int
    path: str

    @property
    def authority(self) -> str:
        """The value of the Host header."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return host if self.port == _PORTS[self.scheme] else f"{host}:{self.port}"

    def __str__(self) -> str:
        """Return the address without its path, which may hold a secret."""
        return f"{self.scheme}://{self.authority}"


def read_url(url: str) -> Target:
    """Return the parts of an address.

    Raises
    ------
    TargetRefused
        If it is not plainly ``http`` or ``https``, a host, perhaps a port, and a path.
    """
    if len(url) > _LONGEST or not url.isascii() or any(c <= " " or c in '\\<>"\x7f' for c in url):
        raise TargetRefused(
            f"the address must be at most {_LONGEST} ASCII characters without spaces or backslashes"
        )
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError as error:
        raise TargetRefused(f"the address cannot be read: {error}") from None
    if parts.scheme not in _PORTS:
        raise TargetRefused(f"the address begins with {parts.scheme!r}; give https://HOST/...")
    if "@" in parts.netloc:
        raise TargetRefused("the address holds a user name or password; give it without")
    if parts.fragment:
        raise TargetRefused("the address has a fragment (#...), which is never sent")
    host = (parts.hostname or "").rstrip(".")
    if not host or "%" in host or port == 0:
        raise TargetRefused("the address names no host; give https://HOST/...")
    path = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
    return Target(parts.scheme, host, port or _PORTS[parts.scheme], path)


def check_webhook(url: str, settings: Settings) -> Target:
    """Return the target of a webhook if webhooks may be sent there.

    Raises
    ------
    TargetRefused
    """
    if settings.webhook_secret is None:
        raise TargetRefused(
            "this service sends no webhooks: it has nothing to sign them with "
            "(STILLPATH_WEBHOOK_SECRET)"
        )
    target = read_url(url)
    if not any(_allows(entry, target) for entry in settings.webhook_targets):
        raise TargetRefused(
            f"webhooks may not be sent to {target}; the service's admin lists the hosts that they "
            "may be sent to (STILLPATH_WEBHOOK_TARGETS)"
        )
    return target


def addresses_of(
    target: Target,
    *,
    loopback: bool = False,
    resolve: Callable[..., Sequence[Any]] = socket.getaddrinfo,
) -> list[str]:
    """Return the addresses that a target's name stands for and that may be connected to.

    Parameters
    ----------
    loopback : bool
        Whether this computer may be one of them; it may always if the target says so by name.
    resolve : callable
        `socket.getaddrinfo`, or what tests put in its place.

    Raises
    ------
    Unresolved
        If the name is unknown.
    TargetRefused
        If it stands for nothing but addresses that nothing is ever sent to: of links, of cloud
        metadata, of groups, or, unless allowed, of this computer.
    """
    try:
        found = resolve(target.host, target.port, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError) as error:
        raise Unresolved(f"{target.host} stands for no address: {error}") from None
    local = loopback or is_loopback(target.host)
    allowed = [entry[4][0] for entry in found if _may_connect(str(entry[4][0]), local)]
    if not allowed:
        raise TargetRefused(
            f"{target.host} stands for an address that nothing is sent to: this computer, a link, "
            "a group of computers, or a cloud's metadata"
        )
    return list(dict.fromkeys(allowed))


def _allows(entry: str, target: Target) -> bool:
    """Return whether a line of the settings allows a target.

    ``host`` and ``host:port`` are https, or http on this computer; ``http://host:port`` is http.
    """
    scheme, _, rest = entry.rpartition("://")
    try:
        listed = read_url(f"{scheme or target.scheme}://{rest}")
    except TargetRefused:
        return False
    if not scheme and target.scheme == "http" and not is_loopback(listed.host):
        return False
    return (listed.scheme, listed.host, listed.port) == (target.scheme, target.host, target.port)


def _may_connect(text: str, loopback: bool) -> bool:
    address = _plain(ipaddress.ip_address(text.partition("%")[0]))
    if address.is_loopback:
        return loopback
    return not (
        address in _METADATA
        or address.is_link_local
        or address.is_multicast
        or address.is_unspecified
        or address.is_reserved
        or address == ipaddress.ip_address("255.255.255.255")
    )


def _plain(address: _Address) -> _Address:
    """Return the IPv4 address that an IPv6 address stands for, or the address itself."""
    if isinstance(address, ipaddress.IPv4Address):
        return address
    if address in _NAT64:
        return ipaddress.IPv4Address(int(address) & 0xFFFFFFFF)
    return address.ipv4_mapped or address.sixtofour or address
