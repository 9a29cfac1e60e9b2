"""Plain words for wrong values: what a value must be, and what it was."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from stillpath.models.firmware import FIRMWARE_KINDS

if TYPE_CHECKING:
    from pydantic import ValidationError

__all__ = ["complaint", "explain"]

_SHOWN = 80
"""Longest part of a wrong value that a message repeats."""

_MUST = {
    "greater_than": "must be more than {gt}{unit}",
    "greater_than_equal": "must be at least {ge}{unit}",
    "less_than": "must be less than {lt}{unit}",
    "less_than_equal": "must be at most {le}{unit}",
    "finite_number": "must be a finite number",
    "float_type": "must be a number",
    "float_parsing": "must be a number",
    "int_type": "must be a whole number",
    "int_parsing": "must be a whole number",
    "int_from_float": "must be a whole number",
    "bool_type": "must be true or false",
    "bool_parsing": "must be true or false",
    "string_type": "must be text",
    "string_too_short": "must have at least {min_length} characters",
    "string_too_long": "must have at most {max_length} characters",
    "too_short": "must have at least {min_length} entries",
    "too_long": "must have at most {max_length} entries",
    "date_from_datetime_parsing": "must be a day like 2026-03-02",
    "date_parsing": "must be a day like 2026-03-02",
    "dict_type": "must be a JSON object",
    "model_type": "must be a JSON object",
    "model_attributes_type": "must be a JSON object, sent as application/json",
    "union_tag_invalid": "{discriminator} is '{tag}', and must be one of {expected_tags}",
    "union_tag_not_found": "must have a {discriminator}",
    "missing": "is missing",
    "extra_forbidden": "is not known here",
}
"""Kind of error to words; the names in braces are those of the error's context."""
_UNITS = {
    "_mm_s2": "mm/s²",
    "_mm_s": "mm/s",
    "_mm": "mm",
    "_um": "µm",
    "_hz": "Hz",
    "_bytes": "bytes",
    "_days": "days",
    "_s": "s",
}
"""Suffix of a name to its unit; longer suffixes first."""


def complaint(entry: Mapping[str, Any], *, repeat: bool = True) -> str:
    """Return one of a `ValidationError`'s `errors()` as what the value must be, and what it was.

    Parameters
    ----------
    entry : mapping
    repeat : bool
        Whether the value is repeated; not if it may be a secret.

    Returns
    -------
    str
        To be put after the name of the field: ``must be at least 0.5 µm (given: -1)``.
    """
    context = {name: _number(value) for name, value in entry.get("ctx", {}).items()}
    kind = str(entry.get("type", ""))
    if kind in _MUST:
        words = _MUST[kind].format(unit=_unit(entry.get("loc", ())), **context)
    elif kind in ("literal_error", "enum"):
        words = f"must be {context['expected']}".replace("'", "")
    else:
        words = str(entry.get("msg", "cannot be used")).removeprefix("Value error, ")
        words = re.sub(r"^\w+ should\b", "must", words)
    given = entry.get("input")
    if not repeat or kind == "missing" or isinstance(given, dict | list | tuple | bytes):
        return words
    text = _number(given) if isinstance(given, float) else repr(given)
    return f"{words} (given: {text if len(text) <= _SHOWN else f'{text[:_SHOWN]}...'})"


def explain(error: ValidationError) -> str:
    """Return the first complaint about a document in one line, with the number of further ones."""
    complaints = error.errors(include_url=False)
    # Other branches of a union complain too; the deepest complaint is the relevant one.
    first = max(complaints, key=lambda c: len(c["loc"]))
    place = list(first["loc"])
    if place[:1] == ["firmware"] and place[1:2] and place[1] in FIRMWARE_KINDS:
        # The kind chooses the schema and is no part of the document's path.
        del place[1]
    where = ".".join(str(part) for part in place) or "document"
    more = f"; {len(complaints) - 1} more" if len(complaints) > 1 else ""
    return f"{where}: {complaint(first)}{more}"


def _unit(place: tuple[int | str, ...]) -> str:
    """Return the unit that the last name of a place says, after a blank."""
    name = next((str(part) for part in reversed(place) if isinstance(part, str)), "")
    return next((f" {unit}" for end, unit in _UNITS.items() if name.endswith(end)), "")


def _number(value: object) -> str:
    """Return a number with at most twelve digits, and the text of any other value."""
    return f"{value:.12g}" if isinstance(value, float) else str(value)
