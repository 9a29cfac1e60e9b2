"""A machine that was not measured yet: what is stated of it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from stillpath.models.errors import ModelError
from stillpath.models.typed_in import typed_in

__all__ = ["StatedMachine", "put_fields", "stated_axis"]

_DEFAULT_HZ = 50.0
_DEFAULT_ZETA = 0.07
_RESONANCES_HZ, _DAMPING = (1.0, 500.0), (1e-3, 1.0)


@dataclass(frozen=True, slots=True)
class StatedMachine:
    """What is known of a machine before it is measured.

    Attributes
    ----------
    title : str
        Empty: the name.
    f_hz : (float, float)
        Resonances of X and Y; None: unknown.
    zeta : float
        Damping ratio of both.
    """

    name: str
    title: str = ""
    f_hz: tuple[float | None, float | None] = (None, None)
    zeta: float = _DEFAULT_ZETA


def stated_axis(f_hz: float, zeta: float) -> dict[str, Any]:
    """Return an unmeasured axis of one resonance; without a frequency (0), of 50 Hz.

    Raises
    ------
    ModelError
        For a resonance or a damping ratio that no axis has.
    """
    for what, value, (least, most), unit in (
        ("resonance", f_hz or _DEFAULT_HZ, _RESONANCES_HZ, " Hz"),
        ("damping ratio", zeta, _DAMPING, ""),
    ):
        if not least <= value <= most:
            raise ModelError(
                f"a {what} of {value:g}{unit} was stated; it must be {least:g} to {most:g}{unit}: "
                "give the one of the axis (--fx, --fy, --zeta, or the configuration's shaper)"
            )
    return typed_in(f_hz or _DEFAULT_HZ, zeta).model_dump(mode="json", exclude_none=True)


def put_fields(section: dict[str, Any], fields: Sequence[str]) -> None:
    """Put ``FIELD=VALUE`` into a firmware section; a dot leads into a part of it.

    Raises
    ------
    ModelError
        If it is not that.
    """
    for field in fields:
        place, equals, value = field.partition("=")
        if not (place and equals and value):
            raise ModelError(f"--set {field!r}: give FIELD=VALUE, like min_steps_per_segment=1")
        *parts, last = place.strip().split(".")
        inner = section
        for part in parts:
            inner = inner.setdefault(part, {})
            if not isinstance(inner, dict):
                raise ModelError(f"--set {field!r}: {part} has no fields")
        if isinstance(inner.get(last), str):
            inner[last] = value.strip()  # a version like 2.0 is no number
            continue
        try:
            inner[last] = json.loads(value)
        except ValueError:
            inner[last] = value.strip()
