"""Tune the best of the firmware's own shapers for a machine: the reference to beat.

Definition: types zv, mzv, ei, 2hump_ei, 3hump_ei with damping 0.1; one frequency an axis on a
2 % grid from 20 to 200 Hz; the type and pair that minimise the rms contour error over extruding
motion on the nominal plant.

Shaper and plant are both linear and share the sampling grid, so they commute: the plant's response
to the plan is computed once, and a shaped response is a few shifted copies of it, needed only at
the points that are measured. A coarse grid on few points finds the valleys, a descent on the full
grid with more points finds their minima, and all points decide between the best.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillpath.compensation.shapers import SHAPERS, shape_xy, shaper_pulses
from stillpath.models.arrays import Array, Ints
from stillpath.models.machine import Machine
from stillpath.models.plants import DiscretePlant, discretise
from stillpath.models.reference_motion import reference_limits, reference_motion_of
from stillpath.models.typed_in import stated_hz
from stillpath.pipeline.files import kept
from stillpath.simulation.measures import PathDistances, Tally, contour_error, tracking_error
from stillpath.simulation.response import response

__all__ = [
    "FREQUENCIES_HZ",
    "BestShaper",
    "cached_shaper",
    "descend",
    "evaluate_shaper",
    "shaped_at",
    "spread",
    "tune_each",
    "tune_shaper",
    "tuning_digest",
]

_ZETA = 0.1
_VERSION = 3
"""Part of the cache's file name; increased when the definition changes."""
_SHIPPED, _SHIPPED_US = Path(__file__).with_name("reference_shapers.json"), 1000
_COARSE = 4
_COARSE_POINTS, _FINE_POINTS, _FINAL_POINTS = 1500, 8000, 60_000
_AROUND = [(a, b) for k in (1, 3) for a, b in itertools.product((-k, 0, k), (-k, 0, k))]
"""Steps of the descent on the full grid."""
_STARTS, _FINALISTS, _FINALISTS_EACH = 4, 6, 2
_REST_S = 0.12
"""Longer than the longest shaper, 3hump_ei at 20 Hz: 0.1 s."""

FREQUENCIES_HZ: Array = np.array([20.0 * 1.02**k for k in range(117)])
"""The 2 % grid, 117 frequencies."""


@dataclass(frozen=True, slots=True)
class BestShaper:
    """A firmware shaper for both axes and its contour error.

    `contour_rms_um` and `tracking_rms_um` are of extruding motion on the nominal plant.
    """

    type: str
    fx_hz: float
    fy_hz: float
    zeta: float
    contour_rms_um: float
    tracking_rms_um: float

    @property
    def pulses(self) -> list[tuple[Array, Array]]:
        """Return weights and delays [s] of the pulses, for X and for Y."""
        return [shaper_pulses(self.type, f_hz, self.zeta) for f_hz in (self.fx_hz, self.fy_hz)]

    @property
    def label(self) -> str:
        """Type and frequencies as shown to users."""
        return f"{self.type} {self.fx_hz:.1f} / {self.fy_hz:.1f} Hz"


def tune_shaper(
    machine: Machine, y_d_mm: Array, dt_s: float, extruding: NDArray[np.bool_]
) -> BestShaper:
    """Find the best shaper for a motion.

    Parameters
    ----------
    y_d_mm : ndarray, shape (2, n)
        Planned motion, at rest at its start.
    extruding : ndarray of bool, shape (n,)
        All motion counts if nothing extrudes.
    """
    trial = _Trial(machine, y_d_mm, dt_s, extruding)
    finalists: list[tuple[float, str, int, int]] = []
    for kind in SHAPERS:
        finalists += [(value, kind, i, j) for value, i, j in _floors(trial, kind)]
        trial.forget()
    _, i, j, kind = min(
        (*_descend(trial, kind, (i, j), _FINAL_POINTS), kind)
        for _, kind, i, j in sorted(finalists)[:_FINALISTS]
    )
    return evaluate_shaper(
        machine, y_d_mm, dt_s, extruding, kind, float(FREQUENCIES_HZ[i]), float(FREQUENCIES_HZ[j])
    )


def tune_each(
    machine: Machine,
    y_d_mm: Array,
    dt_s: float,
    extruding: NDArray[np.bool_],
    kinds: Iterable[str] = SHAPERS,
) -> dict[str, BestShaper]:
    """Find the best frequencies of each type of shaper separately; see `tune_shaper`."""
    trial = _Trial(machine, y_d_mm, dt_s, extruding)
    best = {}
    for kind in kinds:
        _, i, j = min(
            _descend(trial, kind, (i, j), _FINAL_POINTS)
            for _, i, j in sorted(_floors(trial, kind))[:_FINALISTS_EACH]
        )
        trial.forget()
        fx_hz, fy_hz = float(FREQUENCIES_HZ[i]), float(FREQUENCIES_HZ[j])
        best[kind] = evaluate_shaper(machine, y_d_mm, dt_s, extruding, kind, fx_hz, fy_hz)
    return best


def evaluate_shaper(
    machine: Machine,
    y_d_mm: Array,
    dt_s: float,
    extruding: NDArray[np.bool_],
    kind: str,
    fx_hz: float,
    fy_hz: float,
) -> BestShaper:
    """Measure one shaper with all points, the way every other motion is measured."""
    use = extruding if extruding.any() else np.ones(len(extruding), bool)
    y_d_mm, use = _with_rests(y_d_mm, use, dt_s)
    pulses = [shaper_pulses(kind, f_hz, _ZETA) for f_hz in (fx_hz, fy_hz)]
    u = shape_xy(y_d_mm, dt_s, pulses)
    y = response(_plants(machine, dt_s), u)
    contour, tracking = Tally(), Tally()
    contour.add(contour_error(y_d_mm, y, dt_s, stride=2), use[::2])
    tracking.add(tracking_error(y_d_mm, y), use)
    return BestShaper(kind, fx_hz, fy_hz, _ZETA, 1e3 * contour.rms, 1e3 * tracking.rms)


def cached_shaper(machine: Machine, directory: Path, dt_s: float = 1e-3) -> BestShaper:
    """Return the best shaper on the reference motion; it is tuned once per set of inputs.

    Where only a resonance was typed in, the shaper is at its frequency: of the type stated in
    printer.cfg, else ZV.

    The result is cached as a JSON file in `directory`; an unreadable file is made again. Results
    for the built-in machines come with the program.
    """
    stated = [stated_hz(machine.axes[axis]) for axis in ("x", "y")]
    if any(stated):
        return _stated_shaper(machine, stated, directory, dt_s)
    return _tuned_shaper(machine, directory, dt_s)


def _stated_shaper(
    machine: Machine, stated: list[float | None], directory: Path, dt_s: float
) -> BestShaper:
    kind, f_hz = _configured_type(machine), stated
    if not all(stated):
        tuned = _tuned_shaper(machine, directory, dt_s)
        kind = tuned.type
        f_hz = [given or f for given, f in zip(stated, (tuned.fx_hz, tuned.fy_hz), strict=True)]
    y_d, extruding = reference_motion_of(machine, dt_s)
    fx_hz, fy_hz = (float(f or 0.0) for f in f_hz)
    return evaluate_shaper(machine, y_d, dt_s, extruding, kind, fx_hz, fy_hz)


def _configured_type(machine: Machine) -> str:
    """Return the type of shaper that the printer's own configuration states for both axes."""
    own = machine.firmware.shaper if machine.firmware.kind == "klipper" else None
    if own is None or own.type_x != own.type_y or min(own.freq_x_hz, own.freq_y_hz) == 0.0:
        return "zv"
    return own.type_x if own.type_x in SHAPERS else "zv"


def _tuned_shaper(machine: Machine, directory: Path, dt_s: float) -> BestShaper:
    basis = tuning_digest(machine)
    if round(dt_s * 1e6) == _SHIPPED_US and basis in _shipped():
        return _shipped()[basis]
    path = directory / f"shaper-{basis}-{round(dt_s * 1e6)}us-v{_VERSION}.json"

    def tuned() -> BestShaper:
        y_d, extruding = reference_motion_of(machine, dt_s)
        return tune_shaper(machine, y_d, dt_s, extruding)

    return kept(path, _read, tuned)


def _read(document: dict[str, Any]) -> BestShaper:
    shaper = BestShaper(**document)
    if shaper.type not in SHAPERS or min(shaper.fx_hz, shaper.fy_hz) <= 0:
        raise ValueError("no shaper with frequencies")
    return shaper


def tuning_digest(machine: Machine) -> str:
    """Return 12 hex digits that change with the nominal plants and the reference motion only."""
    plants = {axis: machine.axes[axis].nominal.model_dump(mode="json") for axis in ("x", "y")}
    document = json.dumps([plants, reference_limits(machine)], sort_keys=True)
    return hashlib.sha256(document.encode()).hexdigest()[:12]


@cache
def _shipped() -> dict[str, BestShaper]:
    """Return the shapers of built-in machines, by digest (`benchmarks/reference_shapers.py`)."""
    found = json.loads(_SHIPPED.read_text(encoding="utf-8"))
    if found["version"] != _VERSION:
        return {}
    return {row["digest"]: BestShaper(**row["shaper"]) for row in found["machines"].values()}


class _Trial:
    """One motion on one machine, ready to be measured under any shaper at any points."""

    def __init__(
        self, machine: Machine, y_d_mm: Array, dt_s: float, extruding: NDArray[np.bool_]
    ) -> None:
        use = extruding if extruding.any() else np.ones(len(extruding), bool)
        self._y_d, use = _with_rests(y_d_mm, use, dt_s)
        self._dt_s = dt_s
        self._distances = PathDistances(self._y_d, dt_s)
        self._response = response(_plants(machine, dt_s), self._y_d)
        self._chosen = np.flatnonzero(use).astype(np.int64)
        self._points: dict[int, Ints] = {}
        self._shaped: dict[tuple[int, str, int, int], Array] = {}
        self._known: dict[tuple[int, str, int, int], float] = {}

    def rms(self, kind: str, i: int, j: int, count: int) -> float:
        """Return the rms contour error [mm] with frequency index i on X and j on Y.

        It is measured at about `count` points spread over the extruding samples.
        """
        if count not in self._points:
            self._points[count] = spread(self._chosen, count)
        key = (count, kind, i, j)
        if key not in self._known:
            y = np.stack([self._axis(0, kind, i, count), self._axis(1, kind, j, count)])
            error = self._distances.at(y, self._points[count])
            self._known[key] = float(np.sqrt(error @ error / len(error)))
        return self._known[key]

    def forget(self) -> None:
        """Drop the shaped responses (they are large and of one shaper type)."""
        self._shaped.clear()

    def _axis(self, axis: int, kind: str, number: int, count: int) -> Array:
        key = (count, kind, axis, number)
        if key not in self._shaped:
            pulses = shaper_pulses(kind, float(FREQUENCIES_HZ[number]), _ZETA)
            points = self._points[count]
            self._shaped[key] = shaped_at(self._response[axis], self._dt_s, pulses, points)
        return self._shaped[key]


def spread(samples: Ints, count: int) -> Ints:
    """Return about `count` of the samples: one per cell, at random so as not to alias."""
    step = max(1, len(samples) // count)
    offset = np.random.default_rng(1).integers(0, step, len(samples) // step)
    return np.asarray(samples[np.arange(len(offset)) * step + offset])


def shaped_at(unshaped: Array, dt_s: float, pulses: tuple[Array, Array], index: Ints) -> Array:
    """Return `shape(unshaped)[index]`: the response of a plant to a shaped command.

    Parameters
    ----------
    unshaped : ndarray, shape (n,)
        Response of the plant to the plan.
    index : ndarray of int64, shape (m,)
    """
    weights, delays = pulses
    shift = float(weights @ delays)
    last = len(unshaped) - 1
    out = np.zeros(len(index))
    for weight, delay in zip(weights, delays, strict=True):
        late = (delay - shift) / dt_s
        whole = math.floor(late)
        part = late - whole
        out += weight * (1 - part) * unshaped[np.clip(index - whole, 0, last)]
        out += weight * part * unshaped[np.clip(index - whole - 1, 0, last)]
    return out


def _floors(trial: _Trial, kind: str) -> set[tuple[float, int, int]]:
    """Return the minima of the deepest valleys of one type: rms on many points, frequencies."""
    grid = range(0, len(FREQUENCIES_HZ), _COARSE)
    rough = sorted((trial.rms(kind, i, j, _COARSE_POINTS), i, j) for i in grid for j in grid)
    starts: list[tuple[int, int]] = []
    for _, i, j in rough:
        if all(max(abs(i - a), abs(j - b)) > 2 * _COARSE for a, b in starts):
            starts.append((i, j))
        if len(starts) == _STARTS:
            break
    return {_descend(trial, kind, start, _FINE_POINTS) for start in starts}


def _descend(
    trial: _Trial, kind: str, start: tuple[int, int], count: int
) -> tuple[float, int, int]:
    i, j = descend(lambda i, j: trial.rms(kind, i, j, count), start, _AROUND)
    return trial.rms(kind, i, j, count), i, j


def descend(
    cost: Callable[[int, int], float], start: tuple[int, int], steps: Sequence[tuple[int, int]]
) -> tuple[int, int]:
    """Return indices of `FREQUENCIES_HZ`, of X and Y, from which no step lowers the cost."""
    top = len(FREQUENCIES_HZ) - 1
    i, j = start
    while True:
        around = [(i + a, j + b) for a, b in steps if 0 <= i + a <= top and 0 <= j + b <= top]
        best = min(around, key=lambda pair: (cost(*pair), pair))
        if cost(*best) >= cost(i, j):
            return i, j
        i, j = best


def _with_rests(
    y_d_mm: Array, use: NDArray[np.bool_], dt_s: float
) -> tuple[Array, NDArray[np.bool_]]:
    """Pad with standstill: a centred shaper begins early and ends late."""
    pad = 2 * round(_REST_S / dt_s / 2)
    return np.pad(y_d_mm, ((0, 0), (pad, pad)), mode="edge"), np.pad(use, pad)


def _plants(machine: Machine, dt_s: float) -> list[DiscretePlant]:
    return [discretise(machine.axes[axis].nominal, dt_s) for axis in ("x", "y")]
