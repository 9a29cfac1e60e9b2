"""Predict the range in which a contour error lies, over everything that explains a measurement.

Plants of a set differ in what they do to a command; so do known friction and the delay of one axis
against the other. Dry friction, which resonance tables cannot show at all, is stated separately.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from stillpath.models.arrays import Array
from stillpath.models.friction import BEND_MM, DryFriction, held_back_mm
from stillpath.models.machine import Machine
from stillpath.models.plant_specs import PlantSetSpec
from stillpath.models.plants import DiscretePlant, plant_set
from stillpath.models.typed_in import stated_hz
from stillpath.pipeline.result import Channel
from stillpath.simulation.response import response

__all__ = [
    "ErrorRange",
    "error_ranges",
    "nominal_response",
    "phase_unseen",
    "side_by_side",
    "unseen_friction_mm",
]

Pair: TypeAlias = tuple[DiscretePlant, DiscretePlant]

_FRICTION_UNSURE, _WHEELS_UNSURE = 0.35, 1.0
"""Relative error of identified friction: its size is typically 10 % off on virtual printers, rarely
25 %, and how it builds up when the motion reverses is a guess. Wheels roll on their bent rims for
10 to 90 um, more than the `models.friction.BEND_MM` that is assumed: where friction holds an axis
that far, up to half of it is not found."""
_FRICTION_UNSEEN_MM_S2 = 1500.0
"""Dry friction over moving mass that tables may hide: .4 N on .25 kg of rails, 1.5 N on a bed."""
_LAG_UNSURE_S, _LAG_UNKNOWN_S = 1.5e-4, 4e-4
"""Unknown delay of X against Y: alignment sets both to 0, but viscous guides may delay one; clocks
of logs tell some of it (`models.identification.clocks`), those of ring tests are not compared. Of
virtual bed slingers one axis follows up to 0.38 ms later, of CoreXY, whose axes hang on the same
motors, hardly."""


@dataclass(frozen=True, slots=True)
class ErrorRange:
    """Contour errors with one command on some motion, over all that may be true.

    Attributes
    ----------
    reference_um : float
        Error of the nominal plants, rms.
    low, high : float
        Least and largest ratio of the members' error (delays included) to it.
    friction_um : float
        What friction that the measurement cannot show adds at most, in quadrature.
    unsure_um : float
        What the uncertainty of known friction adds at most, in quadrature.
    """

    reference_um: float
    low: float
    high: float
    friction_um: float = 0.0
    unsure_um: float = 0.0

    def around_um(self, predicted_um: float) -> tuple[float, float]:
        """Return the range around the prediction for a print, without unseen friction.

        What friction adds depends on where a path turns and hardly on its speed: it is added as it
        was found on the motion that was tried.

        Parameters
        ----------
        predicted_um : float
            Contour error of the nominal plants on the print, rms.
        """
        return self.low * predicted_um, math.hypot(self.high * predicted_um, self.unsure_um)

    def applied_to(self, channel: Channel) -> Channel:
        """Return a channel with its range, and with how far friction may exceed it."""
        low_um, high_um = self.around_um(channel.judged_rms_um)
        rubbing_um = math.hypot(high_um, self.friction_um) if self.friction_um else None
        ranges = {
            "contour_range_um": (low_um, high_um),
            "contour_friction_um": self.unsure_um,
            "contour_rubbing_um": rubbing_um,
        }
        return channel.model_copy(update=ranges)


def unseen_friction_mm(axis: PlantSetSpec) -> float:
    """Return how far friction that was not measured may hold an axis back; 0 if it was.

    This comes on top of what is assumed.
    """
    if not phase_unseen(axis) or (axis.friction_mm is not None and not axis.friction_assumed):
        return 0.0
    return held_back_mm(axis, _FRICTION_UNSEEN_MM_S2) - (axis.friction_mm or 0.0)


def nominal_response(machine: Machine, command: Array, dt_s: float) -> Array:
    """Return the response of the nominal plants, dry friction included: both (2, n) in mm."""
    pair = [plant_set(machine.axes[axis], dt_s).nominal for axis in ("x", "y")]
    return response(pair, DryFriction(machine.friction_mm, dt_s).received_mm(command))


def _lag_unsure_s(machine: Machine) -> float:
    """Return the delay of one axis against the other that the members do not have already."""
    axes = machine.axes.values()
    if any(map(phase_unseen, axes)):
        return 0.0  # such sets include delays
    kinds = {axis.provenance.kind for axis in axes if axis.provenance is not None}
    untold = "ring test" in kinds and machine.kinematics == "cartesian"
    return _LAG_UNKNOWN_S if untold else _LAG_UNSURE_S


def error_ranges(
    machine: Machine,
    commands: Mapping[str, Sequence[Array]],
    rms: Callable[[Sequence[Array]], float],
    dt_s: float,
) -> dict[str, ErrorRange]:
    """Return the ranges of the errors of commands, by name.

    Parameters
    ----------
    commands : mapping of str to sequence of ndarray, shape (2, n)
        Stretches of motion, each from a standstill.
    rms : callable
        Maps the positions of the stretches, (2, n) each, to their rms error.
    """
    x, y = (plant_set(machine.axes[axis], dt_s) for axis in ("x", "y"))
    pairs = side_by_side(x.members, y.members)
    lag_s = _lag_unsure_s(machine)
    lags = np.where(np.arange(len(pairs)) % 2, 1.0, -1.0) * lag_s / dt_s
    known_mm = np.array(machine.friction_mm)
    unseen_mm = [unseen_friction_mm(machine.axes[axis]) for axis in ("x", "y")]
    assumed = [machine.axes[axis].friction_assumed for axis in ("x", "y")]
    unsure_mm = np.where(assumed, 1.0, _FRICTION_UNSURE) * known_mm
    wheels = np.minimum(known_mm / BEND_MM, 1.0) * (_WHEELS_UNSURE - _FRICTION_UNSURE)
    more_mm = known_mm + np.where(assumed, unsure_mm, (_FRICTION_UNSURE + wheels) * known_mm)

    def range_of(stretches: Sequence[Array]) -> ErrorRange:
        def received_mm(held_mm: Array, *, creeps: bool = True) -> list[Array]:
            step_s = dt_s if creeps else 0.0
            return [DryFriction(held_mm.tolist(), step_s).received_mm(one) for one in stretches]

        def error_mm(pair: Pair, received: Sequence[Array], lag: float = 0.0) -> float:
            return rms([_delayed(response(pair, one), lag) for one in received])

        def rubbed(held_mm: Array, *, creeps: bool = True) -> float:
            return error_mm((x.nominal, y.nominal), received_mm(held_mm, creeps=creeps))

        received = received_mm(known_mm)
        error = max(error_mm((x.nominal, y.nominal), received), 1e-12)
        errors = [error_mm(pair, received, lag) for pair, lag in zip(pairs, lags, strict=True)]
        less, more = rubbed(known_mm - unsure_mm), rubbed(more_mm)
        bent = rubbed(known_mm, creeps=False)
        return ErrorRange(
            1e3 * error,
            min(error, less, *errors) / error,
            max(error, *errors) / error,
            friction_um=1e3 * _added(error, rubbed(known_mm + unseen_mm)),
            unsure_um=1e3 * math.hypot(_added(error, max(less, more)), _added(error, bent)),
        )

    return {name: range_of(command) for name, command in commands.items()}


def _added(error: float, rubbed: float) -> float:
    """Return what makes this error that one, in quadrature."""
    return math.sqrt(max(0.0, rubbed**2 - error**2))


def _delayed(y: Array, samples: float) -> Array:
    """Return a motion (2, n) with X delayed by `samples`; if negative, Y is delayed instead."""
    if samples == 0.0:
        return y
    row = 0 if samples > 0.0 else 1
    delayed = y.copy()
    at = np.arange(y.shape[1], dtype=float)
    delayed[row] = np.interp(at - abs(samples), at, y[row])
    return delayed


def phase_unseen(axis: PlantSetSpec) -> bool:
    """Return whether the phase of an axis is unmeasured."""
    about = axis.provenance
    return about is None or about.magnitude_only or stated_hz(axis) is not None


def side_by_side(x: Sequence[DiscretePlant], y: Sequence[DiscretePlant]) -> list[Pair]:
    """Return pairs of members; the shorter list repeats."""
    return [(x[j % len(x)], y[j % len(y)]) for j in range(max(len(x), len(y)))]
