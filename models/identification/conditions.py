"""Conditions of a measurement: a label, a position, a weight on the bed."""

from __future__ import annotations

import re
from dataclasses import dataclass

from stillpath.models.errors import ModelError
from stillpath.models.schedule import COORDINATES, Coordinate

__all__ = ["Condition"]

_WEIGHT = re.compile(r"\+(\d+(?:\.\d+)?|\.\d+)\s*(kg|g)")
_PLACE = re.compile(r"([xyz])=(-?\d+(?:\.\d+)?)")


@dataclass(frozen=True, slots=True)
class Condition:
    """How the conditions of a measurement differ from the nominal ones.

    Attributes
    ----------
    label : str
        Measurements with the same label are repeats; weights and places have one spelling.
    position_mm : tuple of (coordinate, mm)
        Where the nozzle was; empty if it does not matter.
    added_kg : float
        Known weight on the bed.
    """

    label: str = ""
    position_mm: tuple[tuple[Coordinate, float], ...] = ()
    added_kg: float = 0.0

    @classmethod
    def parse(cls, text: str) -> Condition:
        """Read "+0.5kg" or "+500g" (a weight), "z=150" or "x=50,y=100" (a place), else a label.

        Raises
        ------
        ModelError
            If the text looks like a weight or a place and is none.
        """
        text = text.strip()
        weight = _WEIGHT.fullmatch(text)
        if weight is not None:
            kg = float(weight[1]) * (1.0 if weight[2] == "kg" else 1e-3)
            if kg == 0.0:
                raise ModelError(
                    f"condition {text!r}: a weight of 0 kg changes nothing; leave it out"
                )
            return cls(f"+{kg:g}kg", added_kg=kg)
        if _WEIGHT.fullmatch(f"+{text}"):
            raise ModelError(
                f"condition {text!r}: a weight is written with its sign, +{text}; if none is "
                "meant, take another label"
            )
        if text.startswith("+") or "=" in text:
            place = _place(text)
            return cls(",".join(f"{axis}={at:g}" for axis, at in place), position_mm=place)
        return cls(text)


def _place(text: str) -> tuple[tuple[Coordinate, float], ...]:
    parts = [_PLACE.fullmatch(part.strip()) for part in text.split(",")]
    found = {part[1]: float(part[2]) for part in parts if part is not None}
    if len(found) < len(parts):
        raise ModelError(
            f"condition {text!r} is neither a weight (+0.5kg, +500g) nor a place (z=150, or "
            "x=50,y=100 in mm); a label has no = and does not begin with +"
        )
    return tuple((axis, found[axis]) for axis in COORDINATES if axis in found)
