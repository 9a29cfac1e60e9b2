"""Speed and acceleration at which a machine's ringing is visible on a wall."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from stillpath.models.errors import ModelError
from stillpath.models.machine import Machine
from stillpath.models.plants import PlantSpec, continuous

__all__ = ["AXES", "Axis", "Drive", "RingingMode", "bands", "drive", "ringing_mode"]

Axis: TypeAlias = Literal["x", "y"]
AXES: tuple[Axis, Axis] = ("x", "y")

_WAVE_MM = (2.0, 6.0)
"""Ripples of this length show best on a wall."""
_WAVE_WANTED_MM = 3.5
_LARGEST_UM = 150.0
"""More is not more informative, and the compensator may find no command."""
_DAMPED = 0.25
"""Damping ratio above which ringing is not visible."""
_LOWEST_MM_S, _LOWEST_MM_S2 = 25.0, 300.0


@dataclass(frozen=True, slots=True)
class RingingMode:
    """The mode of an axis that rings most after a change of acceleration.

    Attributes
    ----------
    pole : complex
        rad/s, upper half plane.
    um_per_mm_s2 : float
        Amplitude after a step of acceleration: for a single mode 1e3 / w^2.
    """

    pole: complex
    um_per_mm_s2: float

    @property
    def f_hz(self) -> float:
        """Undamped frequency."""
        return abs(self.pole) / (2 * math.pi)

    @property
    def zeta(self) -> float:
        """Damping ratio."""
        return -self.pole.real / abs(self.pole)

    def ringing_um(self, speed_mm_s: float, accel_mm_s2: float) -> float:
        """Return the amplitude after a stop from a speed, at the end of the braking.

        Braking is two opposite steps of acceleration v / a apart; their ringing adds up, or
        cancels where v / a is a whole number of periods.
        """
        first = np.exp(self.pole * speed_mm_s / accel_mm_s2)
        return float(self.um_per_mm_s2 * accel_mm_s2 * abs(1.0 - first))


@dataclass(frozen=True, slots=True)
class Drive:
    """Speed and acceleration of walls, and the uncompensated ringing of one mode."""

    speed_mm_s: float
    accel_mm_s2: float
    ringing_um: float


def ringing_mode(spec: PlantSpec) -> RingingMode:
    """Return the mode that rings most, counting how long it lasts.

    Partial fractions of G: the answer to a step of acceleration holds 2 |r / p^3| of the mode
    with pole p and residue r.

    Raises
    ------
    ModelError
        If nothing in the plant oscillates.
    """
    plant = continuous(spec)
    poles, vectors = np.linalg.eig(plant.a.astype(complex))
    residues = (plant.c @ vectors) * np.linalg.solve(vectors, plant.b.astype(complex))
    rings = poles.imag > 0
    if not rings.any():
        raise ModelError("an axis of this machine has no resonance: there is no ringing to show")
    amplitude = 2e3 * np.abs(residues[rings] / poles[rings] ** 3)
    zeta = -poles[rings].real / np.abs(poles[rings])
    weight = amplitude * np.exp(-2 * math.pi * zeta)
    seen = zeta <= max(_DAMPED, float(zeta.min()))
    best = int(np.argmax(np.where(seen, weight, 0.0)))
    return RingingMode(complex(poles[rings][best]), float(amplitude[best]))


def drive(machine: Machine, flow_mm_s: float, run_mm: float) -> Drive:
    """Choose speed and acceleration, of X and Y alike, so that both ring visibly.

    Parameters
    ----------
    flow_mm_s : float
        Fastest speed of the hotend.
    run_mm : float
        Length within which to accelerate and brake.

    Raises
    ------
    ModelError
        If they ring too much at every speed.
    """
    best: tuple[tuple[float, ...], Drive] | None = None
    modes = [ringing_mode(machine.axes[axis].nominal) for axis in AXES]
    for accel in _accelerations(machine, AXES, modes):
        fastest = _fastest(machine, AXES, flow_mm_s, run_mm, accel)
        for speed in np.arange(_LOWEST_MM_S, fastest + 1e-6, 2.5):
            rings = [mode.ringing_um(speed, accel) for mode in modes]
            least = min(min(rings), _LARGEST_UM)
            if max(rings) > 2 * _LARGEST_UM:
                continue
            score = (least * _legible(speed, modes), speed)
            if best is None or score > best[0]:
                best = score, Drive(float(speed), float(accel), least)
    if best is None:
        raise ModelError(
            f"no speed from {_LOWEST_MM_S:g} mm/s on rings less than {2 * _LARGEST_UM:g} µm on "
            "this machine: is the model right?"
        )
    return best[1]


def bands(machine: Machine, axis: Axis, flow_mm_s: float, run_mm: float, count: int) -> list[Drive]:
    """Return speeds and accelerations that rise from band to band, each with maximal ringing."""
    mode = ringing_mode(machine.axes[axis].nominal)
    top = _accelerations(machine, (axis,), [mode])[-1]
    accels = _rounded(np.geomspace(max(top / count, min(_LOWEST_MM_S2, top)), top, count))
    slowest, fastest = (
        _fastest(machine, (axis,), flow_mm_s, run_mm, accel) for accel in (accels[0], top)
    )
    edges = np.linspace(0.5 * slowest, fastest, count + 1)
    out = []
    for accel, low, high in zip(accels, edges[:-1], edges[1:], strict=True):
        # A speed within the band's range at which the acceleration steps do not cancel.
        speeds = np.linspace(low, high, 21)[1:]
        rings = [mode.ringing_um(v, accel) for v in speeds]
        k = int(np.argmax(rings))
        out.append(Drive(round(float(speeds[k]), 1), float(accel), rings[k]))
    return out


def _accelerations(
    machine: Machine, axes: tuple[Axis, ...], modes: Sequence[RingingMode]
) -> list[float]:
    """Return rising accelerations up to the axes' own, or up to the largest useful ringing."""
    largest = min(machine.firmware.allowance(axis).accel_mm_s2 for axis in axes)
    useful = min(_LARGEST_UM / mode.um_per_mm_s2 for mode in modes)
    top = min(largest, max(useful, _LOWEST_MM_S2))
    return _rounded(np.linspace(0.4 * top, top, 13))


def _rounded(accels: np.ndarray) -> list[float]:
    step = 50.0 if accels[0] < 2000.0 else 100.0
    return [float(a) if a < step else float(step * math.floor(a / step + 1e-9)) for a in accels]


def _fastest(
    machine: Machine, axes: tuple[Axis, ...], flow_mm_s: float, run_mm: float, accel: float
) -> float:
    machine_mm_s = min(machine.firmware.allowance(axis).speed_mm_s for axis in axes)
    within = math.sqrt(0.8 * run_mm * accel)
    fastest = min(flow_mm_s, machine_mm_s, within)
    if fastest < _LOWEST_MM_S:
        raise ModelError(
            f"walls can be printed at {fastest:.1f} mm/s at most (hotend {flow_mm_s:.1f}, machine "
            f"{machine_mm_s:g}, its acceleration {within:.0f}); ringing shows from "
            f"{_LOWEST_MM_S:g} mm/s on: raise --max-flow, take a finer nozzle, or correct the "
            "machine's limits"
        )
    return fastest


def _legible(speed_mm_s: float, modes: Sequence[RingingMode]) -> float:
    """Return, from 0 to 1, how well ripples of this length show on a wall."""
    worst = 1.0
    for mode in modes:
        wave = speed_mm_s / mode.f_hz
        outside = max(_WAVE_MM[0] / wave, wave / _WAVE_MM[1], 1.0)
        off = abs(math.log(wave / _WAVE_WANTED_MM))
        worst = min(worst, (1.0 - 0.15 * min(off, 1.0)) / outside**2)
    return worst
