"""Choose shaper and accelerations on samples from all over a file.

Every type of shaper that the firmware has is tuned for the plants of the set: the frequencies at
which the worst member errs least, where the walls count for as much as everything else. With each,
every feature gets the highest acceleration of a ladder at which it stays within its bound. The
shaper wins that brings the walls within their bounds, and then prints fastest.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from gcode.firmware.base import Adviser
from gcode.quickening import FirstLayer
from gcode.slicers.features import feature_of
from models.machine import Machine
from models.operating import OperatingGrid
from models.schedule import OperatingPoint
from models.shaping import AxisShaper, Shaping
from service.pipeline.advising.advice import (
    KEPT_FEATURES,
    Advice,
    Bound,
    is_visible,
    wanted_accel,
)
from service.pipeline.advising.trials import Trial, members_of
from service.pipeline.compensating import DT_S
from service.pipeline.samples import FileSamples
from service.pipeline.yardstick import FREQUENCIES_HZ

__all__ = ["Choice", "choose", "ladder"]

DAMPING = 0.1
_LOWEST_MM_S2 = 500.0
_RATIO = 1.2
_AIM = 0.95
"""Part of a bound that the samples may use."""
_POINTS, _MEMBERS = 1000, 5
"""What frequencies are tuned with; all members decide in the end."""
_COARSE = 6
_TUNED_LEVELS = 5
_MENDING_ROUNDS = 4
_SAME_TIME = 0.002
LEVEL_STEP = 0.02

Told = Callable[[float], None]


@dataclass(slots=True)
class Choice:
    """What was chosen for a file, to be mended where the whole file shows that it must.

    Attributes
    ----------
    rungs : list of float
        Accelerations [mm/s^2], rising.
    rung : dict
        Feature id to the number of its rung; None: as the file has it.
    visible : set of int
        Features that may be made slower than the file has them.
    own_mm_s2 : dict
        Feature id to the highest acceleration that the file gives it.
    helpless : set of int
        Features of these that no acceleration brings within their bounds, in the samples: they
        get the quickest of those with about the least error, and no slower.
    shapers : list of (layer, Shaping)
    """

    rungs: list[float]
    rung: dict[int, int | None]
    visible: set[int]
    own_mm_s2: dict[int, float]
    helpless: set[int] = field(default_factory=set)
    shapers: list[tuple[int, Shaping]] = field(default_factory=list)

    def bounds(self) -> dict[int, Bound]:
        """Return the bounds of accelerations by feature."""
        return {
            f: _bound(self.rungs[k], visible=f in self.visible)
            for f, k in self.rung.items()
            if k is not None
        }

    def advice(self, first_layer: FirstLayer) -> Advice:
        """Return what to write."""
        return Advice(self.bounds(), self.shapers, first_layer)

    def mended(self, over: Mapping[int, float]) -> bool:
        """Slow features down whose errors exceed their bounds by a ratio; return if any could be.

        Parameters
        ----------
        over : mapping
            Feature id to the ratio.
        """
        return bool(sum([self._slower(f, 1.0 / ratio) for f, ratio in over.items()]))

    def withdrawn(self) -> bool:
        """Leave everything as the file has it; return whether anything was advised."""
        advised = bool(self.shapers) or any(k is not None for k in self.rung.values())
        self.shapers, self.rung = [], dict.fromkeys(self.rung)
        return advised

    def _slower(self, feature: int, ratio: float) -> bool:
        if feature in self.helpless:
            return False
        now = self.rung.get(feature)
        own = self.own_mm_s2.get(feature, 0.0)
        if now is None and feature not in self.visible:
            return False
        accel = own if now is None else self.rungs[now]
        lower = [k for k, rung in enumerate(self.rungs) if rung < accel and rung <= ratio * accel]
        found = lower[-1] if lower else 0
        if feature not in self.visible:
            self.rung[feature] = found if lower and self.rungs[found] > own else None
            return True
        if self.rungs[found] >= accel:
            return False
        self.rung[feature] = found
        return True


def choose(
    samples: FileSamples,
    names: Sequence[str],
    machine: Machine,
    adviser: Adviser,
    before: Shaping,
    budget_um: float | None,
    levels: Sequence[tuple[int, OperatingPoint]],
    told: Told = lambda _share: None,
) -> Choice:
    """Choose for a file.

    Parameters
    ----------
    samples : FileSamples
    names : sequence of str
        Of the features.
    machine : Machine
    adviser : Adviser
    before : Shaping
        What the printer would shape with.
    budget_um : float, optional
        What every feature may err; None: what it erred before.
    levels : sequence of (layer, OperatingPoint)
        Where the machine is from which layer on; more than one where plants follow a schedule.
    told : callable, optional
        Is given the share that is done.
    """
    members = members_of(machine, DT_S)
    as_sliced = Trial(samples, {}, machine, adviser, DT_S, members)
    features = [f for f in as_sliced.features if _free(f, names)]
    visible = {f for f in features if is_visible(names[f] if f >= 0 else "")}
    was = as_sliced.errors(before)
    limit = {f: _AIM * (max(was[f], 1e-3) if budget_um is None else budget_um) for f in features}
    choice = Choice(
        ladder(adviser.highest_mm_s2, machine),
        dict.fromkeys(features),
        visible,
        _own_mm_s2(samples, adviser),
    )
    if not features:
        return choice
    candidates = _candidates(samples, machine, adviser, before, levels, visible, told)
    points = [sample.point for sample in samples.samples]
    by_point = [_by_point(c, points, levels, machine) for c in candidates]
    found: list[list[tuple[dict[int, float], dict[int, float]]]] = [[] for _ in candidates]
    for k, accel in enumerate([None, *choice.rungs]):
        trial = as_sliced
        if accel is not None:
            bounds = {f: _bound(accel, visible=f in visible) for f in features}
            trial = Trial(samples, bounds, machine, adviser, DT_S, members)
        for one, shapings in zip(found, by_point, strict=True):
            one.append((trial.errors(shapings), trial.seconds))
        told(0.5 + 0.5 * k / len(choice.rungs))
    ranked = []
    for number, one in enumerate(found):
        rung = {f: _highest(one, f, limit[f], visible=f in visible) for f in features}
        at = {f: one[0 if k is None else k + 1] for f, k in rung.items()}
        missed = sum(at[f][0][f] > limit[f] * 1.001 for f in features)
        seconds = sum(at[f][1].get(f, 0.0) for f in features)
        error = max(at[f][0][f] / limit[f] for f in features)
        helpless = {
            f for f in visible if all(e.get(f, math.inf) > limit[f] * 1.001 for e, _ in one)
        }
        ranked.append((missed, seconds, error, number, rung, helpless))
    least = min(r[0] for r in ranked)
    fair = [r for r in ranked if r[0] == least]
    quickest = min(r[1] for r in fair)
    close = [r for r in fair if r[1] <= quickest * (1.0 + _SAME_TIME)]
    _, _, _, number, choice.rung, choice.helpless = min(close, key=lambda r: (r[2], r[3]))
    choice.shapers = candidates[number].table(levels)
    for _ in range(_MENDING_ROUNDS):
        trial = Trial(samples, choice.bounds(), machine, adviser, DT_S, members)
        errors = trial.errors(by_point[number])
        over = {f: errors[f] / limit[f] for f in features if errors[f] > limit[f]}
        if not choice.mended(over):
            break
    return choice


def ladder(highest_mm_s2: float, machine: Machine) -> list[float]:
    """Return accelerations to choose from, rising to the highest that the machine is set up for."""
    top = min(highest_mm_s2, machine.command.accel_mm_s2)
    count = max(math.ceil(math.log(top / _LOWEST_MM_S2) / math.log(_RATIO)), 0) if top > 0 else 0
    rungs = {10.0 * math.floor(top * _RATIO**-k / 10.0) for k in range(1, count + 1)}
    return sorted({r for r in rungs if r >= _LOWEST_MM_S2} | {top})


@dataclass(frozen=True, slots=True)
class _Candidate:
    """A shaper for each level (one for all where it is not ours)."""

    shapings: list[Shaping]
    ours: bool

    def table(self, levels: Sequence[tuple[int, OperatingPoint]]) -> list[tuple[int, Shaping]]:
        if not self.ours:
            return []
        rows: list[tuple[int, Shaping]] = []
        for (layer, _), shaping in zip(levels, self.shapings, strict=True):
            if not rows or rows[-1][1] != shaping:
                rows.append((layer, shaping))
        return rows


def _candidates(
    samples: FileSamples,
    machine: Machine,
    adviser: Adviser,
    before: Shaping,
    levels: Sequence[tuple[int, OperatingPoint]],
    visible: set[int],
    told: Told,
) -> list[_Candidate]:
    """Return every type of shaper at its best frequencies, and what there was before."""
    count = len(levels)
    made = [_Candidate([before] * count, ours=False)]
    members = members_of(machine, DT_S)
    few = [members[0], *members[1 :: max(1, -(-(len(members) - 1) // _MEMBERS))]]
    tuned = np.unique(np.linspace(0, count - 1, min(count, _TUNED_LEVELS)).round().astype(int))
    logs: dict[str, list[tuple[float, float]]] = {kind: [] for kind in adviser.shapers}
    for n, level in enumerate(tuned.tolist()):
        point = levels[level][1] if count > 1 else None
        trial = Trial(samples, {}, machine, adviser, DT_S, few, point=point)
        at = trial.points(_POINTS, sorted(visible))
        for m, kind in enumerate(adviser.shapers):
            start = logs[kind][-1] if logs[kind] else None
            i, j = _tuned(trial, kind, at, len(few), start, same=adviser.same_for_both)
            logs[kind].append((i, j))
            told(0.5 * (n + (m + 1) / len(adviser.shapers)) / len(tuned))
    for kind, found in logs.items():
        axes = []
        for column in (0, 1):
            index = np.interp(np.arange(count), tuned, [pair[column] for pair in found])
            f_hz = FREQUENCIES_HZ[0] * (FREQUENCIES_HZ[1] / FREQUENCIES_HZ[0]) ** np.round(index)
            axes.append([AxisShaper(kind, round(float(f), 1), DAMPING) for f in f_hz])
        made.append(_Candidate([Shaping(x, y) for x, y in zip(*axes, strict=True)], ours=True))
    return made


def _tuned(
    trial: Trial,
    kind: str,
    at: np.ndarray,
    members: int,
    start: tuple[float, float] | None,
    *,
    same: bool,
) -> tuple[int, int]:
    """Return the numbers of the frequencies of X and Y at which the worst member errs least."""
    answers: dict[tuple[int, int, int], np.ndarray] = {}
    known: dict[tuple[int, int], float] = {}
    top = len(FREQUENCIES_HZ) - 1

    def answer(member: int, axis: int, number: int) -> np.ndarray:
        key = (member, axis, number)
        if key not in answers:
            f_hz = float(FREQUENCIES_HZ[number])
            answers[key] = trial.axis_answer(member, axis, kind, f_hz, at)
        return answers[key]

    def rms(i: int, j: int) -> float:
        if (i, j) not in known:
            motions = [(answer(k, 0, i), answer(k, 1, j)) for k in range(members)]
            known[i, j] = trial.rms(motions, at)
        return known[i, j]

    coarse = range(0, top + 1, _COARSE)
    if start is not None:
        i, j = int(start[0]), int(start[1])
    elif same:
        i = j = min(coarse, key=lambda k: rms(k, k))
    else:
        i = j = top // 2
        for _ in range(2):
            i = min(coarse, key=lambda k: rms(k, j))
            j = min(coarse, key=lambda k: rms(i, k))
    while True:
        steps = [-3, -1, 1, 3]
        if same:
            around = [(i + a, i + a) for a in steps]
        else:
            around = [(i + a, j) for a in steps] + [(i, j + a) for a in steps]
            around += [(i + a, j + b) for a in (-2, 2) for b in (-2, 2)]
        around = [(a, b) for a, b in around if 0 <= a <= top and 0 <= b <= top]
        a, b = min(around, key=lambda pair: (rms(*pair), pair))
        if rms(a, b) >= rms(i, j):
            return i, j
        i, j = a, b


def _by_point(
    candidate: _Candidate,
    points: Sequence[OperatingPoint],
    levels: Sequence[tuple[int, OperatingPoint]],
    machine: Machine,
) -> Mapping[OperatingPoint, Shaping] | Shaping:
    """Return the shaper of every sample's point."""
    if len(levels) == 1:
        return candidate.shapings[0]
    grid = OperatingGrid(machine, step=LEVEL_STEP, blend_step=LEVEL_STEP)
    known = {grid.level(point): n for n, (_, point) in enumerate(levels)}
    heights = np.array([(p.mass_kg, p.z_mm) for _, p in levels])
    out = {}
    for point in points:
        number = known.get(grid.level(point))
        if number is None:
            scale = np.maximum(np.ptp(heights, axis=0), 1e-9)
            away = (heights - (point.mass_kg, point.z_mm)) / scale
            number = int(np.argmin(np.sum(away**2, axis=1)))
        out[point] = candidate.shapings[number]
    return out


def _highest(
    found: Sequence[tuple[dict[int, float], dict[int, float]]],
    feature: int,
    limit_um: float,
    *,
    visible: bool,
) -> int | None:
    """Return the rung with the least time within the limit; with the least error if there is none.

    None: the file's own.
    """
    own_s = found[0][1].get(feature, 0.0)
    best: tuple[float, int] | None = None
    for k, (errors, seconds) in enumerate(found):
        if errors.get(feature, math.inf) <= limit_um:
            key = (round(seconds.get(feature, own_s), 4), k)
            best = key if best is None else min(best, key)
    if best is not None:
        return best[1] - 1 if best[1] else None
    if not visible:
        return None
    least = min(errors.get(feature, math.inf) for errors, _ in found)
    near = [
        k for k, (errors, _) in enumerate(found) if errors.get(feature, math.inf) <= 1.05 * least
    ]
    k = min(near, key=lambda n: (round(found[n][1].get(feature, own_s), 4), n))
    return k - 1 if k else None


def _own_mm_s2(samples: FileSamples, adviser: Adviser) -> dict[int, float]:
    own: dict[int, float] = {}
    for sample in samples.samples:
        moves, limits = sample.piece.moves, sample.piece.limits
        wanted, file = wanted_accel(moves, limits, Advice(), adviser)
        for feature in np.unique(moves.feature[~np.isnan(wanted)]).tolist():
            rows = (moves.feature == feature) & ~np.isnan(wanted)
            own[feature] = max(own.get(feature, 0.0), float(np.max(file[rows])))
    return own


def _bound(accel_mm_s2: float, *, visible: bool) -> Bound:
    return Bound(accel_mm_s2, accel_mm_s2 if visible else math.inf)


def _free(feature: int, names: Sequence[str]) -> bool:
    return feature_of(names[feature] if feature >= 0 else "") not in KEPT_FEATURES
