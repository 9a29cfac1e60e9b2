"""What a report says about the mixture of `fbf` with a shaper (`pipeline.caution`)."""

from __future__ import annotations

from stillpath.models.machine import Machine
from stillpath.models.typed_in import stated_hz
from stillpath.pipeline.caution import Mixture
from stillpath.pipeline.error_range import unseen_friction_mm
from stillpath.pipeline.measuring.reference_shaper import BestShaper

__all__ = ["prediction_note", "stated_note"]


def stated_note(machine: Machine, shaper: BestShaper) -> str | None:
    """Return a warning on what a typed-in resonance is good for; None if both are measured."""
    typed = [axis.upper() for axis in ("x", "y") if stated_hz(machine.axes[axis]) is not None]
    if not typed:
        return None
    return (
        f"{' and '.join(typed)}: only the resonance was typed in, so what is compensated moves as "
        f"through the shaper {shaper.label}, which a firmware with input shaping does by itself. A "
        "better command needs a measurement (docs/identification.md). The figures are guesses for "
        "machines that ring there."
    )


def prediction_note(machine: Machine, choice: Mixture) -> str:
    """Return a note on the plants behind the predictions, and how far they differ."""
    measured = []
    for axis, plants in sorted(machine.axes.items()):
        about = plants.provenance
        day = f" of {about.measured_on}" if about and about.measured_on else ""
        what = about.kind if about else "plants"
        measured.append(f"{len(plants.weighted_members())} ({axis.upper()}: {what}{day})")
    return (
        f"Figures are predicted with the central plants of {' and '.join(measured)} that "
        "explain the measurement. On a test motion (delays between the axes left out), the contour "
        f"error of every plant is at most {choice.worst_to_none:.2f} of that without compensation; "
        f"it is {choice.mean:.2f} of the shaper's on average ({choice.worst:.2f} for the worst "
        f"plant).{_friction_unseen(machine)}"
    )


def _friction_unseen(machine: Machine) -> str:
    unseen_um = {
        axis.upper(): 1e3 * (unseen_mm + (plants.friction_mm or 0.0))
        for axis, plants in sorted(machine.axes.items())
        if (unseen_mm := unseen_friction_mm(plants))
    }
    held = " and ".join(f"{um:.0f} µm ({axis})" for axis, um in unseen_um.items())
    if not held:
        return ""
    return (
        " Resonance tables do not show dry friction. The figures for guides that rub assume 1.5 N "
        f"per kg of moving mass, which holds an axis back by {held}; more is possible. Raw logs "
        "show friction, and then it is compensated (docs/identification.md)."
    )
