"""Messages on wrong options and settings, by the names that the user gave them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from stillpath.models.complaints import complaint

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pydantic import ValidationError

__all__ = ["wrong_option", "wrong_setting"]

_ALSO_OPTIONS = ("data_dir", "scheduler", "workers")
"""Settings that `serve` and `worker` take as options too."""
_SECRETS = ("database_url", "first_key", "webhook_secret")


def wrong_option(error: ValidationError, called: Mapping[str, str] | None = None) -> str:
    """Return the first complaint about options, as the command line calls them.

    Parameters
    ----------
    called : mapping, optional
        Field to option, where one is not called like the other.
    """
    first = error.errors(include_url=False)[0]
    if not first["loc"]:
        return complaint(first, repeat=False)
    field = str(first["loc"][0])
    option = (called or {}).get(field, field).replace("_", "-")
    return f"--{option}: {complaint(first)}"


def wrong_setting(error: ValidationError) -> str:
    """Return the first complaint about `service.settings.Settings`, by the variable's name.

    A secret is not repeated.
    """
    first = error.errors(include_url=False)[0]
    if not first["loc"]:
        return complaint(first, repeat=False)
    field = str(first["loc"][0])
    option = f" (--{field.replace('_', '-')})" if field in _ALSO_OPTIONS else ""
    said = complaint(first, repeat=field not in _SECRETS)
    return f"STILLPATH_{field.upper()}{option}: {said}"
