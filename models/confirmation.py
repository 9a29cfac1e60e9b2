"""The verdict of a ring test on the machine's plants; stored in the machine's document."""

from __future__ import annotations

import hashlib
import json
from datetime import date
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field

from stillpath.models.document import Document, NonNegative
from stillpath.models.plant_specs import PlantSetSpec
from stillpath.models.provenance import SourceFile

if TYPE_CHECKING:
    from stillpath.models.machine import Machine

__all__ = ["Confirmation", "confirmation_text", "plants_digest", "rounded_um"]

Digest = Annotated[str, Field(pattern=r"^[0-9a-f]{12}$")]


class Confirmation(Document):
    """Predicted and measured vibration of one axis after stops, as compensated.

    Attributes
    ----------
    predicted_um : (float, float)
        Least and largest of the plants of the set, rms over the stops.
    measured_um, scatter_um : float
        The same measured, the noise floor taken off, with its standard error from repeats.
    uncompensated_um : float
        Measured after the same stops as planned.
    ratio : float
        `measured_um` over `uncompensated_um`.
    sources : tuple of SourceFile
        The logs.
    machine, revision : str
        Name and revision of the machine that was tested: a copy under another name was not.
    plants : str
        Digest of the plants that were tested (`plants_digest`): of others nothing was said.
    """

    tested_on: date
    verdict: Literal["confirmed", "not confirmed"]
    predicted_um: tuple[NonNegative, NonNegative]
    measured_um: NonNegative
    scatter_um: NonNegative
    uncompensated_um: NonNegative
    ratio: NonNegative
    sources: tuple[SourceFile, ...]
    machine: str
    revision: Digest
    plants: Digest

    def stale(self, plants: PlantSetSpec) -> bool:
        """Whether the plants have changed since."""
        return self.plants != plants_digest(plants)


def plants_digest(plants: PlantSetSpec) -> str:
    """Return the first 12 hex digits of the SHA-256 of nominal plant and members."""
    content = plants.model_dump(mode="json", include={"nominal", "members"})
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def confirmation_text(machine: Machine) -> str:
    """Say in one line what ring tests have said of a machine's plants as they are now."""
    told = {axis: _axis_text(machine, axis) for axis in ("x", "y")}
    if len(set(told.values())) == 1:
        return told["x"]
    return "; ".join(f"{axis.upper()} {text}" for axis, text in told.items())


def _axis_text(machine: Machine, axis: Literal["x", "y"]) -> str:
    found = machine.confirmations.get(axis)
    if found is None or found.machine != machine.name:
        return "never confirmed on this machine"
    if found.stale(machine.axes[axis]):
        return (
            f"never confirmed with the plants it has now ({found.verdict} on {found.tested_on} "
            f"with those of model {found.revision})"
        )
    low, high = found.predicted_um
    return (
        f"{found.verdict} on {found.tested_on}: predicted {rounded_um(low)} to "
        f"{rounded_um(high)} µm, measured {rounded_um(found.measured_um)} µm"
    )


def rounded_um(value: float, digits: int = 2) -> str:
    """Return micrometres rounded to significant digits, never with an exponent of ten."""
    text = f"{value:.{digits}g}"
    return f"{value:.0f}" if "e+" in text else text
