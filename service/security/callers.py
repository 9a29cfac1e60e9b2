"""The caller of a request, and what it may do."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass
from enum import StrEnum

__all__ = ["LOCAL", "Caller", "Scope"]


class Scope(StrEnum):
    """What a key allows. `ADMIN` includes the others, and what belongs to other owners."""

    READ = "read"
    SUBMIT = "submit"
    ADMIN = "admin"


@dataclass(frozen=True, slots=True)
class Caller:
    """Whoever makes a request.

    Attributes
    ----------
    owner : str
        Whose jobs they are.
    key_id : str or None
        None: on this computer, without a key.
    remote : str or None
        Address of the other side.
    """

    owner: str
    scopes: frozenset[Scope]
    key_id: str | None = None
    remote: str | None = None

    def may(self, scope: Scope) -> bool:
        """Return whether the caller has a scope."""
        return scope in self.scopes or Scope.ADMIN in self.scopes

    @property
    def sees(self) -> str | None:
        """Owner whose jobs the caller sees; None: everybody's."""
        return None if Scope.ADMIN in self.scopes else self.owner

    @property
    def network(self) -> str:
        """The address; of IPv6 the network, because one computer has all of it."""
        try:
            address = ipaddress.ip_address(self.remote or "")
        except ValueError:
            return self.remote or "unknown"
        if isinstance(address, ipaddress.IPv6Address):
            mapped = address.ipv4_mapped
            if mapped is not None:
                return str(mapped)
            return str(ipaddress.ip_network((address, 64), strict=False))
        return str(address)


LOCAL = Caller("local", frozenset(Scope))
"""Whoever calls without a key, where that is allowed."""
