"""Stillpath: print compensation for G-code.

``compensate``, ``simulate``, ``plan``, ``identify``, ``design``, ``load_machine``, ``Machine``,
``Client`` and the errors ``GcodeError``, ``ModelError`` and ``DesignError`` are the public
interface (`stillpath.library`); everything else may change from one version to the next. The layers
of the package lie in the checkout's root. Here are links to them, so that all of it has one import
name.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from stillpath.version import __version__

if TYPE_CHECKING:
    from stillpath.library import (
        Client,
        DesignError,
        GcodeError,
        Machine,
        ModelError,
        compensate,
        design,
        identify,
        load_machine,
        plan,
        simulate,
    )

__all__ = [
    "Client",
    "DesignError",
    "GcodeError",
    "Machine",
    "ModelError",
    "__version__",
    "compensate",
    "design",
    "identify",
    "load_machine",
    "plan",
    "simulate",
]


def __getattr__(name: str) -> Any:
    """Load the library when it is first asked for: commands begin without it."""
    if name not in __all__:
        raise AttributeError(f"module 'stillpath' has no attribute {name!r}")
    from stillpath import library

    return getattr(library, name)
