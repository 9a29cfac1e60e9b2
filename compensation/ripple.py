"""Compensation of ripple by a table over position, on top of any other compensator.

The correction depends on where ripple enters (reference: repetitive compensation of print files):

``input``
    y = G (u + delta(u)). With r the command of the other compensator, u solves u + delta(u) = r,
    at any speed and without a plant.
``output``
    y = G u + d(s(t)). The command is r - G^-1 d along the planned path, which needs the plant.

A wave of wavenumber k is a vibration of k v / 2 pi Hz at the speed v. Its correction fades out with
zero phase where its acceleration would exceed a budget, and towards the Nyquist frequency: on fast
travel the machine cannot follow, and nothing is printed. The budget is the largest of a ladder
whose command keeps the machine's limits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import firwin

from stillpath.compensation.base import Compensator, DesignError, Memoryless
from stillpath.compensation.inversion import Inversion, invert
from stillpath.compensation.overlay import Overlay
from stillpath.compensation.rests import stand_still
from stillpath.models.arrays import Array
from stillpath.models.machine import Machine
from stillpath.models.plants import DiscretePlant, plant_set
from stillpath.models.ripple import MachineRipple, RippleTable

__all__ = [
    "PassThrough",
    "RippleCompensator",
    "input_command",
    "output_command",
    "wave_shares",
]

_STEPS = (1.0, 0.5, 0.25, 0.125, 0.0625, 0.03125)
"""Acceleration allowed to a wave, as shares of the machine's limit, tried in turn."""
_BAND = (0.30, 0.45)
"""A wave fades out between these frequencies (times the sampling time)."""
_CUTOFF = 0.2
"""Cut-off of the output side's low-pass (times the sampling time), ~ the root of the budget."""
_BLEND_S = 0.02
_MOST_STEPS, _CLOSE_MM = 20, 1e-12
_SLOWEST_ZERO = 0.97
"""Zeros of the plant beyond this radius are not cancelled: their inverse rings."""
_EXTRA_TERMS = 3


def input_command(wanted_mm: Array, table: RippleTable, share: Array | None = None) -> Array:
    """Return u with u + delta(u) = wanted, sample by sample.

    Parameters
    ----------
    wanted_mm : ndarray, shape (n,)
    share : ndarray, shape (len(table), n), optional
        Share of every wave; see `wave_shares`.

    Raises
    ------
    DesignError
        If the ripple is too steep for any command to cancel it.
    """
    if table.steepest >= 1.0:
        raise DesignError(
            f"the ripple's slope reaches {table.steepest:.3g} mm per mm (limit 1): the motor would "
            "have to turn back to move on; check amplitudes and pitches"
        )
    u = wanted_mm.copy()
    for _ in range(_MOST_STEPS):
        step = (u + table.deviation_mm(u, share) - wanted_mm) / (1.0 + table.slope(u, share))
        u -= step
        if np.max(np.abs(step), initial=0.0) < _CLOSE_MM:
            break
    return u


def output_command(
    path_mm: Array,
    table: RippleTable,
    inverse: Inversion,
    share: Array | None = None,
    fir: Array | None = None,
) -> Array:
    """Return -G^-1 d(s) along a path, shape (n,); see `input_command`.

    Speed steps at corners of the path would make -G^-1 respond with a spike: `fir`, symmetric of
    odd length, removes what lies above the waves.
    """
    return -inverse.apply(table.deviation_mm(path_mm, share), fir)


def wave_shares(
    path_mm: Array,
    table: RippleTable,
    dt_s: float,
    budget_mm_s2: float = math.inf,
    plant: DiscretePlant | None = None,
) -> Array:
    """Return the share of every wave at every sample, shape (len(table), n).

    1 at rest; slightly more where linear interpolation between samples attenuates the wave.

    Parameters
    ----------
    path_mm : ndarray, shape (n,)
        Motion of the axis; its speed determines the waves' frequencies.
    budget_mm_s2 : float
        Largest acceleration amplitude of the correction of one wave.
    plant : DiscretePlant, optional
        Plant to be inverted (output side).
    """
    speed = np.abs(np.gradient(path_mm)) / dt_s if len(path_mm) > 1 else np.zeros(len(path_mm))
    shares = np.empty((len(table), len(path_mm)))
    low, high = _BAND
    for k, (number, c) in enumerate(zip(table.wavenumber, table.coefficient_mm, strict=True)):
        f_hz = number * speed / (2 * math.pi)
        effort = abs(c) * (number * speed) ** 2
        fade = np.clip((f_hz * dt_s - low) / (high - low), 0.0, 1.0)
        shares[k] = 0.5 * (1 + np.cos(np.pi * fade))
        if plant is not None:
            effort /= _gain(plant, f_hz)
        else:
            # Linear interpolation between samples attenuates a wave by sinc^2; an inverse of the
            # plant already includes that.
            shares[k] /= np.sinc(np.minimum(f_hz * dt_s, 0.5)) ** 2
        shares[k] *= np.minimum(1.0, budget_mm_s2 / np.maximum(effort, 1e-12))
    return shares


class PassThrough(Memoryless):
    """The plan as the command."""

    name = "none"

    def compensate(
        self,
        y_d_mm: Array,
        extruding: NDArray[np.bool_],  # noqa: ARG002
        rests: NDArray[np.int64],  # noqa: ARG002
    ) -> Array:
        """See `compensation.base.Compensator.compensate`."""
        return y_d_mm.copy()


@dataclass(frozen=True, slots=True)
class _Output:
    table: RippleTable
    plant: DiscretePlant
    inverse: Inversion


class RippleCompensator(Overlay):
    """Compensate the ripple of a machine on top of another compensator.

    In rests, and at the ends of a piece, the command stands on the plan; the correction fades out
    and in within `_BLEND_S` before and after.

    Parameters
    ----------
    inner : Compensator
        Compensates vibration: its command is what the axes should receive.
    machine : Machine
        With its ripple.

    Raises
    ------
    DesignError
        If there is no ripple, homing is so uncertain that the table would do harm, or a plant has
        no inverse.
    """

    def __init__(self, inner: Compensator, machine: Machine, dt_s: float) -> None:
        self.name = f"{inner.name}+ripple"
        super().__init__(inner, machine, dt_s)
        _check(machine)
        self._ripple = MachineRipple(machine.kinematics, machine.ripple)
        plants = [("x", machine.axes["x"]), ("y", machine.axes["y"])]
        self._outputs = [
            _inverted(axis, plant_set(spec, dt_s).nominal, table) if len(table) else None
            for (axis, spec), table in zip(plants, self._ripple.outputs, strict=True)
        ]
        self._blend = max(2, round(_BLEND_S / dt_s))
        self._most_mm_s2 = self.budget_mm_s2 = machine.command.accel_mm_s2
        """Budget for a wave's acceleration in the last piece."""

    @property
    def keeps_ripple(self) -> bool:
        """Whether the last piece keeps its ripple, as the limits leave no room to compensate it."""
        return self.budget_mm_s2 == 0.0

    def compensate(
        self, y_d_mm: Array, extruding: NDArray[np.bool_], rests: NDArray[np.int64]
    ) -> Array:
        """See `compensation.base.Compensator.compensate`."""
        wanted = self._inner.compensate(y_d_mm, extruding, rests)
        for step in _STEPS:
            self.budget_mm_s2 = step * self._most_mm_s2
            u = self._undone(wanted, y_d_mm)
            u = wanted + stand_still(u - wanted, np.zeros_like(u), rests, self._blend)
            u = self._within_travel(wanted, u)
            if not self._bounds.beyond(u, wanted).any():
                return u
        self.budget_mm_s2 = 0.0
        return wanted

    def _undone(self, wanted: Array, y_d: Array) -> Array:
        aim = wanted.copy()
        room = self.budget_mm_s2 / self._most_mm_s2
        fir = _lowpass(_CUTOFF * math.sqrt(room))
        for row, output in enumerate(self._outputs):
            if output is not None:
                share = wave_shares(
                    y_d[row], output.table, self._dt_s, self.budget_mm_s2, output.plant
                )
                aim[row] += output_command(y_d[row], output.table, output.inverse, share, fir)
        motors = self._ripple.to_motors @ aim
        for row, table in enumerate(self._ripple.inputs):
            if len(table):
                share = wave_shares(motors[row], table, self._dt_s, self.budget_mm_s2)
                motors[row] = input_command(motors[row], table, share)
        return np.asarray(np.linalg.solve(self._ripple.to_motors, motors))


def _check(machine: Machine) -> None:
    if not machine.ripple:
        raise DesignError(
            f"machine {machine.name}: no ripple is known; learn it from passes, or leave out "
            "+ripple"
        )
    for axis, ripple in machine.ripple.items():
        loose_mm = ripple.homing_repeatability_mm
        for table in (ripple.table("input"), ripple.table("output")):
            left = table.residual_share(loose_mm)
            if left >= 1.0:
                raise DesignError(
                    f"axis {axis}: homing repeats only within {loose_mm:g} mm, so a table would "
                    f"leave {left:.0%} of the ripple (limit 100 %): it would do harm; home more "
                    "exactly (endstop phase) or leave out +ripple"
                )


def _inverted(axis: str, plant: DiscretePlant, table: RippleTable) -> _Output:
    try:
        inverse = invert("ebzpetc", plant, _EXTRA_TERMS, cancel_below=_SLOWEST_ZERO, unit_dc=True)
    except DesignError as error:
        raise DesignError(f"axis {axis}, output ripple: {error}") from None
    return _Output(table, plant, inverse)


def _lowpass(cutoff: float) -> Array:
    """Return a zero-phase low-pass, flat up to 0.8 of its cutoff (in sampling rates)."""
    return np.asarray(firwin(2 * math.ceil(4.0 / cutoff) + 1, 2.0 * cutoff))


def _gain(plant: DiscretePlant, f_hz: Array) -> Array:
    """Return |G| at many frequencies, interpolated from a grid."""
    grid = np.linspace(0.0, 0.5 / plant.dt_s, 513)
    return np.interp(f_hz, grid, np.maximum(np.abs(plant.frequency_response(grid)), 1e-6))
