"""How well commands hold when the machine is not the one that was measured.

Every machine comes with a set of plants (its members). A command is designed once and every member
answers it; the firmware's shapers get the same chance, tuned on the very same members and motion by
the very figure that they are compared in. Commands are judged before they become G-code, in one
piece without rests; all plants are sampled with the hold that is exact for such commands.
"""

from __future__ import annotations

import argparse
import itertools
import os
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from inputs import find_input, plain_copy, shared_folder
from numpy.typing import NDArray
from readback import DT_S, Own, read_motion

from stillpath.compensation.base import DesignError
from stillpath.compensation.registry import compensator
from stillpath.compensation.shapers import SHAPERS, shape_xy, shaper_pulses
from stillpath.models.arrays import Array
from stillpath.models.machine import Machine
from stillpath.models.plants import Mode, ModesSpec, ParametricMembers, PlantSetSpec, plant_set
from stillpath.models.reference_motion import reference_motion
from stillpath.models.store import load_machine
from stillpath.pipeline.measuring.reference_shaper import FREQUENCIES_HZ, descend, shaped_at
from stillpath.simulation.measures import PathDistances, tracking_error
from stillpath.simulation.response import response

Figure = Callable[[Array], float]

GOLDEN = Path(__file__).parents[1] / "examples" / "machines" / "klipper-golden.json"
DT = 1e-3
FILES = ("ps_voron_klipper_ringing", "cura_ender3_gear24")
METHODS = ("off", "ensemble/1", "ensemble", "minimax")
"""Settings of `robust`, and of `along` after a slash where it is not the default."""
_STAND_S = 0.2
_STRIDE, _COARSE_POINTS, _FINE_POINTS = 2, 800, 3000
_COARSE_STEP = 8
_ZETA = 0.1
_FIGURES: dict[str, Figure] = {
    "worst": lambda rms: float(rms.max()),
    "mean": lambda rms: float(rms.mean()),
}


@dataclass(frozen=True, slots=True)
class Case:
    """A machine, what its set is called, and what must be reached.

    `worst`, `mean` and `tracking` are the largest ratios to the best shaper's figure.
    """

    machine: Machine
    label: str
    worst: float
    mean: float
    tracking: float


@dataclass(frozen=True, slots=True)
class Path2:
    """A planned motion at 1 kHz, standing still at both ends."""

    name: str
    position_mm: Array
    extruding: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Errors:
    """Rms errors [um] of every member while extruding."""

    contour: Array
    tracking: Array


def main() -> None:
    parser = argparse.ArgumentParser(description="Commands on plants that were not measured.")
    parser.add_argument("files", nargs="*", help="motions beside the figures: paths, corpus names")
    parser.add_argument("--methods", nargs="+", default=list(METHODS), help="settings of `robust`")
    parser.add_argument(
        "--settings", nargs="*", default=[], metavar="KEY=VALUE", help="passed to the compensator"
    )
    parser.add_argument("--machines", nargs="*", default=[], help="only those named so")
    parser.add_argument("--seconds", type=float, default=40.0, help="of each file")
    parser.add_argument("--shared", type=Path, help="default: $STILLPATH_SHARED or ../shared")
    given = parser.parse_args()

    shared = shared_folder(given.shared)
    files = given.files or (FILES if shared is not None else ())
    settings = dict(_setting(text) for text in given.settings)
    motions = [_figures(), *(_motion(name, shared, given.seconds) for name in files)]
    cases = [case for case in all_cases() if not given.machines or case.label in given.machines]
    began, skipped = time.process_time(), set()
    missed: dict[str, dict[str, list[str]]] = {}
    _print_head()
    for case, motion in itertools.product(cases, motions):
        trial = Trial(case.machine, motion)
        shapers = {name: tune(trial, figure) for name, figure in _FIGURES.items()}
        for method in given.methods:
            try:
                robust, _, along = method.partition("/")
                chosen = {"robust": robust} | ({"along": float(along)} if along else {})
                command, cpu_s = designed(case.machine, motion, chosen | settings)
            except (TypeError, DesignError) as error:
                skipped.add(f"{case.label} {method}: {error}")
                continue
            misses = _print_row(case, motion, method, trial, command, shapers, cpu_s)
            row = missed.setdefault(case.label, {}).setdefault(method, [])
            row += [f"{name} on {motion.name}" for name in misses]
    for line in sorted(skipped):
        print(f"left out: {line}")
    print("\nmethods that meet every limit on all motions, or the nearest one and what it misses:")
    for label, methods in missed.items():
        good = [method for method, misses in methods.items() if not misses]
        nearest = min(methods, key=lambda method: len(methods[method]))
        text = ", ".join(good) if good else f"{nearest}: {'; '.join(methods[nearest])}"
        print(f"  {label:14}{'PASS' if good else 'MISS'}  {text}")
    print(f"{(time.process_time() - began) / 60:.1f} CPU min")
    sys.exit(any(all(methods.values()) for methods in missed.values()))


def all_cases() -> list[Case]:
    """All machines: one mode with wide sets, two resonances on each axis, one with a zero."""
    cases = []
    for f_hz in (45.0, 30.0, 70.0):
        for spread, worst, tracking in ((0.2, 0.65, 1 / 2), (0.1, 1.0, 1 / 3)):
            spec = ModesSpec(modes=(Mode(f_hz=f_hz, zeta=0.05),))
            label = f"{f_hz:g}Hz+-{100 * spread:g}%"
            cases.append(Case(_machine(spec, spread), label, worst, 0.9, tracking))
    two = (Mode(f_hz=45.0, zeta=0.05, gain=0.7), Mode(f_hz=72.0, zeta=0.05, gain=0.3))
    for spread, worst, tracking in ((0.2, 0.65, 1 / 2), (0.1, 1.0, 1 / 3)):
        label = f"45+72Hz+-{100 * spread:g}%"
        cases.append(Case(_machine(ModesSpec(modes=two), spread), label, worst, 0.9, tracking))
    cases.append(Case(load_machine("taz6-x"), "taz6-x", 1.0, 0.9, 1 / 3))
    return cases


def _machine(nominal: ModesSpec, spread: float) -> Machine:
    """Return a machine with the same plant on both axes and five members of scaled frequency."""
    scale = tuple(1.0 + spread * share for share in (-1.0, -0.5, 0.0, 0.5, 1.0))
    axis = PlantSetSpec(nominal=nominal, members=ParametricMembers(frequency_scale=scale))
    return load_machine(GOLDEN).model_copy(update={"axes": {"x": axis, "y": axis}})


def _figures() -> Path2:
    return _standing("figures", *reference_motion(DT))


def _motion(name: str, shared: Path | None, seconds: float) -> Path2:
    """Plan the longest section of a file and take its first part, up to where it moves slowest."""
    with tempfile.TemporaryDirectory(prefix="stillpath-robustness-") as folder:
        file = plain_copy(find_input(name, shared), Path(folder))
        motion = read_motion(file, load_machine(GOLDEN))
    section = max(Own.sections(motion), key=lambda s: s.samples)
    position, extruding = section.path(0, min(section.samples, round(seconds / DT_S)))
    every = round(DT / DT_S)
    position, extruding = position[:, ::every].copy(), extruding[::every].copy()
    # Cut where the motion nearly stands: what follows is a stand, and a step in speed would count.
    late = max(1, position.shape[1] - 2000)
    speed = np.hypot(*np.diff(position[:, late:]))
    end = late + int(np.argmin(speed)) + 1
    return _standing(Path(name).stem, position[:, :end], extruding[:end])


def _standing(name: str, position: Array, extruding: NDArray[np.bool_]) -> Path2:
    pad = round(_STAND_S / DT)
    return Path2(name, np.pad(position, ((0, 0), (pad, pad)), mode="edge"), np.pad(extruding, pad))


def designed(machine: Machine, motion: Path2, settings: dict[str, object]) -> tuple[Array, float]:
    """Return the command of a motion and the CPU time of making it, the design included."""
    began = time.process_time()
    made = compensator("fbf", machine, DT, **settings)
    made.reset(motion.position_mm[:, 0])
    rests = np.zeros((0, 2), np.int64)
    command = made.compensate(motion.position_mm, motion.extruding, rests)
    return command, time.process_time() - began


class Trial:
    """One motion on all members of a machine, for any command and any shaper."""

    def __init__(self, machine: Machine, motion: Path2) -> None:
        sets = [plant_set(machine.axes[axis], DT).members for axis in ("x", "y")]
        self.members = list(zip(*sets, strict=True))
        self._motion = motion
        self._index = np.flatnonzero(motion.extruding)[::_STRIDE].astype(np.int64)
        # A shaper and a plant commute: shaped answers are delayed copies of these.
        self._answers = [response(pair, motion.position_mm) for pair in self.members]

    def errors(self, command: Array) -> Errors:
        """Measure every member's answer to a command, shape (2, n)."""
        path, use = self._motion.position_mm, self._motion.extruding
        contour, tracking = [], []
        for pair in self.members:
            y = response(pair, command)
            contour.append(_rms(PathDistances(path, DT).at(y[:, self._index], self._index)))
            tracking.append(_rms(tracking_error(path, y)[use]))
        return Errors(1e3 * np.array(contour), 1e3 * np.array(tracking))

    def shaped(self, kind: str, i: int, j: int) -> Array:
        """Return the command of a shaper with frequency number i on X and j on Y."""
        pulses = [shaper_pulses(kind, float(FREQUENCIES_HZ[k]), _ZETA) for k in (i, j)]
        return shape_xy(self._motion.position_mm, DT, pulses)

    def shaper_rms(self, kind: str, points: int) -> Callable[[int, int], Array]:
        """Return a function of two frequency numbers: contour rms [um], about `points` points."""
        index = self._index[:: max(1, len(self._index) // points)]
        path = self._motion.position_mm

        @cache
        def axis(number: int, k: int) -> list[Array]:
            pulses = shaper_pulses(kind, float(FREQUENCIES_HZ[k]), _ZETA)
            return [shaped_at(y[number], DT, pulses, index) for y in self._answers]

        @cache
        def rms(i: int, j: int) -> Array:
            pairs = zip(axis(0, i), axis(1, j), strict=True)
            distances = PathDistances(path, DT)
            return 1e3 * np.array([_rms(distances.at(np.stack(p), index)) for p in pairs])

        return rms


def tune(trial: Trial, figure: Figure) -> tuple[str, int, int]:
    """Find the shaper and its two frequencies (2 % grid) that make a figure of the set smallest."""
    return min(_tuned(trial, figure, kind) for kind in SHAPERS)[1:]


def _tuned(trial: Trial, figure: Figure, kind: str) -> tuple[float, str, int, int]:
    coarse, fine = (trial.shaper_rms(kind, n) for n in (_COARSE_POINTS, _FINE_POINTS))
    # A coarse grid of pairs, and all pairs of equal frequencies.
    size = len(FREQUENCIES_HZ)
    grid = range(0, size, _COARSE_STEP)
    starts = [*itertools.product(grid, grid), *((i, i) for i in range(size))]
    start = min(starts, key=lambda pair: (figure(coarse(*pair)), pair))
    steps = list(itertools.product((-3, -1, 0, 1, 3), (-3, -1, 0, 1, 3)))
    i, j = descend(lambda i, j: figure(fine(i, j)), start, steps)
    return figure(fine(i, j)), kind, i, j


def _print_head() -> None:
    print("rms while extruding, worst and mean member, um; ratios to the best shaper, tuned for")
    print(
        "the worst and for the mean member's contour error (tracking: mean member of the latter);"
    )
    print("bend: rms second difference of the command over that of the plan, and its peak in mm/s2")
    print(
        f"{'set':14}{'motion':26}{'robust':12}{'contour':>12} {'shaper':>12} "
        f"{'worst':>6} {'limit':>5} {'mean':>6} {'limit':>5} {'tracking':>13} {'ratio':>6} "
        f"{'limit':>5} {'bend':>11} {'CPU s':>6}  verdict"
    )


def _print_row(
    case: Case,
    motion: Path2,
    method: str,
    trial: Trial,
    command: Array,
    shapers: dict[str, tuple[str, int, int]],
    cpu_s: float,
) -> list[str]:
    ours = trial.errors(command)
    worst, mean = (trial.errors(trial.shaped(*shapers[name])) for name in ("worst", "mean"))
    ratios = (
        float(ours.contour.max() / worst.contour.max()),
        float(ours.contour.mean() / mean.contour.mean()),
        float(ours.tracking.mean() / mean.tracking.mean()),
    )
    limits = (case.worst, case.mean, case.tracking)
    names = ("worst", "mean", "tracking")
    misses = [n for n, r, most in zip(names, ratios, limits, strict=True) if not r <= most]
    bend, planned = np.diff(command, 2), np.diff(motion.position_mm, 2)
    bend_ratio = _rms(bend) / _rms(planned)
    peak = float(np.abs(bend).max()) / DT**2
    print(
        f"{case.label:14}{motion.name[:25]:26}{method:12}"
        f"{ours.contour.max():6.2f}/{ours.contour.mean():<5.2f} "
        f"{worst.contour.max():6.2f}/{mean.contour.mean():<5.2f} "
        f"{ratios[0]:6.3f} {limits[0]:5.2f} {ratios[1]:6.3f} {limits[1]:5.2f} "
        f"{ours.tracking.mean():6.2f}/{mean.tracking.mean():<6.2f} "
        f"{ratios[2]:6.3f} {limits[2]:5.2f} {bend_ratio:5.2f}/{peak:<6.0f}{cpu_s:6.1f}  "
        f"{'PASS' if not misses else 'MISS ' + ', '.join(misses)}",
        flush=True,
    )
    return misses


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _setting(text: str) -> tuple[str, object]:
    """Split key=value; numbers and truth values become what they look like."""
    key, found, value = text.partition("=")
    if not found:
        sys.exit(f"--settings {text}: key=value expected")
    if value.lower() in ("true", "false"):
        return key, value.lower() == "true"
    for kind in (int, float):
        try:
            return key, kind(value)
        except ValueError:
            continue
    return key, value


if __name__ == "__main__":
    for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(_name, "1")
    main()
