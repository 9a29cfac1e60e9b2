"""Choose shaper and accelerations on excerpts from all over a file.

Every shaper type of the firmware is tuned for the plants of the set, to the frequencies that
minimise the worst member's error, with walls weighted as much as everything else. With each, every
feature gets the highest acceleration of a ladder that keeps it within its bound. The shaper is
chosen that brings the walls within their bounds, and of those the one that prints fastest.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache

import numpy as np

from stillpath.compensation.defaults import DT_S
from stillpath.gcode.firmware.base import Adviser
from stillpath.gcode.pacing import FirstLayer
from stillpath.gcode.slicers.features import feature_of
from stillpath.models.machine import Machine
from stillpath.models.operating import OperatingGrid
from stillpath.models.schedule import OperatingPoint
from stillpath.models.shaping import AxisShaper, Shaping
from stillpath.pipeline.advising.advice import (
    KEPT_FEATURES,
    Advice,
    Bound,
    is_visible,
    wanted_accel,
)
from stillpath.pipeline.advising.trials import Trial
from stillpath.pipeline.measuring.reference_shaper import FREQUENCIES_HZ, descend
from stillpath.pipeline.measuring.set_errors import machine_numbers
from stillpath.pipeline.pacing.excerpts import FileExcerpts

__all__ = ["AsSliced", "Choice", "choose", "ladder"]

DAMPING = 0.1
_LOW_MM_S2, _RATIO = 500.0, 1.2
_LOWEST_MM_S2, _LOW_RATIO = 100.0, 1.5
"""Walls go below `_LOW_MM_S2` only if nothing else brings them within their bound."""
_AIM = 0.95
"""Share of a bound that the excerpts may use."""
_POINTS, _MEMBERS = 1000, 5
"""Points and members used to tune frequencies; the final choice uses all members."""
_COARSE = 6
_TOGETHER = [(-3, -3), (-1, -1), (1, 1), (3, 3)]
_EITHER = [*((k, 0) for k in (-3, -1, 1, 3)), *((0, k) for k in (-3, -1, 1, 3))]
_EITHER += [(-2, -2), (-2, 2), (2, -2), (2, 2)]
"""Steps of the frequencies of X and Y, if they must be the same and if not."""
_TUNED_LEVELS = 5
_MENDING_ROUNDS = 4
_UNLIKE = 2.0
"""Largest ratio, either way, assumed between errors in the excerpts and in the whole file."""
_SAME_TIME, _ROUNDING = 0.002, 1.001
LEVEL_STEP = 0.02

ShareCallback = Callable[[float], None]


@dataclass(slots=True)
class Choice:
    """What was chosen for a file; corrected where the whole file exceeds a bound.

    Attributes
    ----------
    rungs : list of float
        Accelerations [mm/s^2], rising.
    rung : dict
        Feature id to the index of its rung; None: as in the file.
    visible : set of int
        Features that may be made slower than the file has them.
    own_mm_s2 : dict
        Feature id to the highest acceleration that the file gives it.
    helpless : set of int
        Visible features that no acceleration brings within their bounds: they get the fastest of
        the accelerations with about the least error.
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
        """Slow down features that exceed their bounds; return whether any could be slowed.

        Parameters
        ----------
        over : mapping
            Feature id to the ratio of its error to its bound.
        """
        return bool(sum([self._slower(f, 1.0 / ratio) for f, ratio in over.items()]))

    def withdrawn(self) -> bool:
        """Withdraw all advice; return whether there was any."""
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
            self.helpless.add(feature)
            return False
        self.rung[feature] = found
        return True


@dataclass(frozen=True, slots=True)
class AsSliced:
    """A file as sliced, before anything is advised.

    Attributes
    ----------
    shaping : Shaping
        The printer's shaper.
    errors_um : mapping
        Error of every feature in the whole file.
    levels : sequence of (layer, OperatingPoint)
        Operating points and the layers at which they begin; several if plants follow a schedule.
    """

    names: Sequence[str]
    shaping: Shaping
    errors_um: Mapping[int, float]
    levels: Sequence[tuple[int, OperatingPoint]]


def choose(
    excerpts: FileExcerpts,
    sliced: AsSliced,
    machine: Machine,
    adviser: Adviser,
    budget_um: float | None,
    progress: ShareCallback = lambda _share: None,
    *,
    shaped: bool = True,
) -> Choice:
    """Choose shapers and accelerations for a file.

    Parameters
    ----------
    budget_um : float, optional
        Error allowed to every feature; None: its error as sliced.
    progress : callable, optional
        Receives the share that is done.
    shaped : bool
        Whether a shaper may be advised.
    """
    members = machine_numbers(machine, DT_S)
    as_sliced = Trial(excerpts, {}, machine, adviser, DT_S, members)
    features = [f for f in as_sliced.features if _free(f, sliced.names)]
    visible = {f for f in features if is_visible(sliced.names[f] if f >= 0 else "")}
    was = {f: max(um, 1e-3) for f, um in as_sliced.errors(sliced.shaping).items()}
    limits = _Limits(
        {f: _bound_um(was[f], sliced.errors_um.get(f, was[f]), budget_um) for f in features},
        has_budget=budget_um is not None,
    )
    choice = Choice(
        ladder(adviser.highest_mm_s2, machine),
        dict.fromkeys(features),
        visible,
        _own_mm_s2(excerpts, adviser),
    )
    if not features:
        return choice
    kinds = adviser.shapers if shaped else ()
    candidates = _candidates(excerpts, machine, adviser, kinds, sliced, visible, progress)
    points = [one.point for one in excerpts.excerpts]
    by_point = [_by_point(c, points, sliced.levels, machine) for c in candidates]

    def trial_of(bounds: dict[int, Bound]) -> Trial:
        return Trial(excerpts, bounds, machine, adviser, DT_S, members) if bounds else as_sliced

    every = _try_rungs(trial_of, by_point, limits, choice, progress)
    number, choice.rung = _best(every, limits, choice)
    choice.helpless = {f for f in visible if not limits.reaching(every[number], f)}
    choice.shapers = candidates[number].table(sliced.levels)
    for _ in range(_MENDING_ROUNDS):
        um = trial_of(choice.bounds()).errors(by_point[number])
        over = {f: limits.ratio(um[f], f, k) for f, k in choice.rung.items()}
        if not choice.mended({f: ratio for f, ratio in over.items() if ratio > 1.0}):
            break
    return choice


def _try_rungs(
    trial_of: Callable[[dict[int, Bound]], Trial],
    by_point: Sequence[Mapping[OperatingPoint, Shaping] | Shaping],
    limits: _Limits,
    choice: Choice,
    progress: ShareCallback,
) -> list[_Found]:
    """Try every shaper on the normal rungs, then lower ones until visible features pass."""
    results = [_Found() for _ in by_point]

    def try_rung(rung: int | None) -> None:
        bounds: dict[int, Bound] = {}
        if rung is not None:
            accel = choice.rungs[rung]
            bounds = {f: _bound(accel, visible=f in choice.visible) for f in choice.rung}
        trial = trial_of(bounds)
        for found, shapings in zip(results, by_point, strict=True):
            found.add(rung, trial.errors(shapings), trial.seconds)
        progress(0.5 + 0.5 * len(results[0].um) / (1 + len(choice.rungs)))

    normal = [k for k, accel in enumerate(choice.rungs) if accel >= _LOW_MM_S2]
    for rung in (None, *normal):
        try_rung(rung)
    for rung in reversed(range(len(choice.rungs) - len(normal))):
        if any(all(limits.fair(found, f) for f in choice.visible) for found in results):
            break
        try_rung(rung)
    return results


def ladder(highest_mm_s2: float, machine: Machine) -> list[float]:
    """Return accelerations to choose from, rising to the highest that the machine is set up for."""
    rungs = [min(highest_mm_s2, machine.command.accel_mm_s2)]
    while True:
        ratio = _RATIO if rungs[-1] >= _LOW_MM_S2 * _RATIO else _LOW_RATIO
        lower = 10.0 * math.floor(rungs[-1] / ratio / 10.0)
        if lower < _LOWEST_MM_S2:
            return rungs[::-1]
        rungs.append(lower)


@dataclass(frozen=True, slots=True)
class _Found:
    """Results of trials with one shaper: by rung (None: as in the file), by feature."""

    um: dict[int | None, dict[int, float]] = field(default_factory=dict)
    seconds: dict[int | None, dict[int, float]] = field(default_factory=dict)

    def add(self, rung: int | None, um: dict[int, float], seconds: dict[int, float]) -> None:
        self.um[rung], self.seconds[rung] = um, seconds

    def error(self, feature: int, rung: int | None) -> float:
        return self.um[rung].get(feature, math.inf)

    def time_s(self, feature: int, rung: int | None) -> float:
        return self.seconds[rung].get(feature, 0.0)


@dataclass(frozen=True, slots=True)
class _Limits:
    """Errors allowed to features in the excerpts."""

    bound_um: dict[int, float]
    has_budget: bool

    def ratio(self, error_um: float, feature: int, rung: int | None) -> float:
        """Return the ratio of an error to its limit, which lies a margin below the bound.

        Without a budget, the file's own accelerations need no margin.
        """
        margin = _AIM if self.has_budget or rung is not None else 1.0
        return error_um / (_ROUNDING * margin * self.bound_um[feature])

    def reaching(self, found: _Found, feature: int) -> list[int | None]:
        """Return the rungs within the bound itself."""
        return [k for k in found.um if found.error(feature, k) <= self.bound_um[feature]]

    def fair(self, found: _Found, feature: int) -> list[int | None]:
        """Return the rungs within the limit."""
        return [k for k in found.um if self.ratio(found.error(feature, k), feature, k) <= 1.0]


def _best(
    results: Sequence[_Found], limits: _Limits, choice: Choice
) -> tuple[int, dict[int, int | None]]:
    """Return the index of the best shaper, and the rung of every feature with it."""
    ranked = []
    for number, found in enumerate(results):
        rungs = {
            f: _quickest(found, f, limits, choice.rungs, visible=f in choice.visible)
            for f in choice.rung
        }
        ratios = [limits.ratio(found.error(f, k), f, k) for f, k in rungs.items()]
        missed = sum(ratio > 1.0 for ratio in ratios)
        seconds = sum(found.time_s(f, k) for f, k in rungs.items())
        ranked.append((missed, seconds, max(ratios), number, rungs))
    least = min(r[0] for r in ranked)
    eligible = [r for r in ranked if r[0] == least]
    quickest = min(r[1] for r in eligible)
    close = [r for r in eligible if r[1] <= quickest * (1.0 + _SAME_TIME)]
    return min(close, key=lambda r: (r[2], r[3]))[3:]


@dataclass(frozen=True, slots=True)
class _Candidate:
    """A shaper for each level; `ours` is False for the printer's previous setting."""

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
    excerpts: FileExcerpts,
    machine: Machine,
    adviser: Adviser,
    kinds: Sequence[str],
    sliced: AsSliced,
    visible: set[int],
    progress: ShareCallback,
) -> list[_Candidate]:
    """Return every type of shaper at its best frequencies, and the previous setting."""
    levels = sliced.levels
    count = len(levels)
    made = [_Candidate([sliced.shaping] * count, ours=False)]
    members = machine_numbers(machine, DT_S)
    few = [members[0], *members[1 :: max(1, -(-(len(members) - 1) // _MEMBERS))]]
    tuned = np.unique(np.linspace(0, count - 1, min(count, _TUNED_LEVELS)).round().astype(int))
    logs: dict[str, list[tuple[float, float]]] = {kind: [] for kind in kinds}
    for n, level in enumerate(tuned.tolist() if kinds else []):
        point = levels[level][1] if count > 1 else None
        trial = Trial(excerpts, {}, machine, adviser, DT_S, few, point=point)
        at = trial.points(_POINTS, sorted(visible))
        for m, kind in enumerate(kinds):
            start = logs[kind][-1] if logs[kind] else None
            i, j = _tuned(trial, kind, at, len(few), start, same=adviser.same_for_both)
            logs[kind].append((i, j))
            progress(0.5 * (n + (m + 1) / len(kinds)) / len(tuned))
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
    """Return the frequency indices of X and Y that minimise the worst member's error."""

    @cache
    def response(member: int, axis: int, number: int) -> np.ndarray:
        return trial.axis_response(member, axis, kind, float(FREQUENCIES_HZ[number]), at)

    @cache
    def rms(i: int, j: int) -> float:
        return trial.rms([(response(k, 0, i), response(k, 1, j)) for k in range(members)], at)

    coarse = range(0, len(FREQUENCIES_HZ), _COARSE)
    if start is not None:
        i, j = int(start[0]), int(start[1])
    elif same:
        i = j = min(coarse, key=lambda k: rms(k, k))
    else:
        i = j = (len(FREQUENCIES_HZ) - 1) // 2
        for _ in range(2):
            i = min(coarse, key=lambda k: rms(k, j))
            j = min(coarse, key=lambda k: rms(i, k))
    return descend(rms, (i, j), _TOGETHER if same else _EITHER)


def _by_point(
    candidate: _Candidate,
    points: Sequence[OperatingPoint],
    levels: Sequence[tuple[int, OperatingPoint]],
    machine: Machine,
) -> Mapping[OperatingPoint, Shaping] | Shaping:
    """Return the shaper at every excerpt's operating point."""
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


def _quickest(
    found: _Found,
    feature: int,
    limits: _Limits,
    rungs: Sequence[float],
    *,
    visible: bool,
) -> int | None:
    """Return the fastest rung within the limit.

    If there is none: the file's own; for visible features the fastest within the bound, or else
    of those with about the least error, low rungs excluded.
    """

    def key(rung: int | None) -> tuple[float, int]:
        return round(found.time_s(feature, rung), 4), -1 if rung is None else rung

    eligible = limits.fair(found, feature)
    if not eligible and not visible:
        return None
    eligible = eligible or limits.reaching(found, feature)
    if not eligible:
        normal = [k for k in found.um if k is None or rungs[k] >= _LOW_MM_S2]
        least = min(found.error(feature, k) for k in normal)
        eligible = [k for k in normal if found.error(feature, k) <= 1.05 * least]
    return min(eligible, key=key)


def _own_mm_s2(excerpts: FileExcerpts, adviser: Adviser) -> dict[int, float]:
    own: dict[int, float] = {}
    for one in excerpts.excerpts:
        moves, limits = one.piece.moves, one.piece.limits
        wanted, file = wanted_accel(moves, limits, Advice(), adviser)
        for feature in np.unique(moves.feature[~np.isnan(wanted)]).tolist():
            rows = (moves.feature == feature) & ~np.isnan(wanted)
            own[feature] = max(own.get(feature, 0.0), float(np.max(file[rows])))
    return own


def _bound_um(excerpts_um: float, whole_um: float, budget_um: float | None) -> float:
    """Return a feature's bound for the excerpts, whose errors differ from the whole file's."""
    if budget_um is None:
        return excerpts_um
    ratio = excerpts_um / max(whole_um, 1e-3)
    return budget_um * min(max(ratio, 1.0 / _UNLIKE), _UNLIKE)


def _bound(accel_mm_s2: float, *, visible: bool) -> Bound:
    return Bound(accel_mm_s2, accel_mm_s2 if visible else math.inf)


def _free(feature: int, names: Sequence[str]) -> bool:
    return feature_of(names[feature] if feature >= 0 else "") not in KEPT_FEATURES
