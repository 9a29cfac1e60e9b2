"""Mask keys and secrets in log messages."""

from __future__ import annotations

import re
from collections.abc import Mapping, MutableMapping
from typing import Any

__all__ = ["mask", "mask_secrets"]

_HIDDEN = "***"
_NAMES = re.compile(
    r"authorization|api[_-]?key|secret|password|passwd|token|cookie|signature", re.IGNORECASE
)
_PATTERNS = (
    # Keys of this service.
    (re.compile(r"sp_[A-Za-z0-9_-]{16,}"), f"sp_{_HIDDEN}"),
    # Authorization and X-Api-Key as somebody may quote them.
    (
        re.compile(
            r"((?:proxy-)?authorization|x-api-key)(['\"]?\s*[:=,]\s*(?:b?['\"])?)"
            r"(?:(?:bearer|basic|digest)\s+)?[^\s'\",;)]+",
            re.IGNORECASE,
        ),
        rf"\1\2{_HIDDEN}",
    ),
    (re.compile(r"\b(bearer|basic)\s+[A-Za-z0-9._~+/=-]{8,}", re.IGNORECASE), rf"\1 {_HIDDEN}"),
    # Who logs in by a URL, and what a URL asks with.
    (re.compile(r"\b([a-z][a-z0-9+.-]*://)[^\s/@'\"]+@", re.IGNORECASE), rf"\1{_HIDDEN}@"),
    (
        re.compile(
            r"([?&;](?:[\w-]*(?:key|secret|password|token|signature|sig)[\w-]*)=)[^&\s'\"#]+",
            re.IGNORECASE,
        ),
        rf"\1{_HIDDEN}",
    ),
)


def mask(text: str) -> str:
    """Return a text without the keys, passwords and tokens that it shows."""
    for pattern, instead in _PATTERNS:
        text = pattern.sub(instead, text)
    return text


def mask_secrets(_: object, __: str, event: MutableMapping[str, Any]) -> MutableMapping[str, Any]:
    """Mask every value of a log event; a processor of structlog, the last but the renderer."""
    for name, value in event.items():
        event[name] = _masked(name, value)
    return event


def _masked(name: str, value: Any) -> Any:
    match value:
        case str():
            return _HIDDEN if _NAMES.search(name) and value else mask(value)
        case bytes():
            return _masked(name, value.decode("utf-8", "replace"))
        case Mapping():
            return {key: _masked(str(key), inner) for key, inner in value.items()}
        case list() | tuple() | set() | frozenset():
            return [_masked(name, inner) for inner in value]
        case None | bool() | int() | float():
            return value
        case BaseException():
            return mask(repr(value))
        case _:
            return mask(str(value))
