"""The HTTP service: jobs in, files and reports out."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from stillpath.service.api.app import create_app

__all__ = ["create_app"]


def __getattr__(name: str) -> Any:
    """Import the application when it is asked for: clients need only what goes over the wire."""
    if name == "create_app":
        from stillpath.service.api.app import create_app

        return create_app
    raise AttributeError(name)
