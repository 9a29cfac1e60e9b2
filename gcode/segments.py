"""Fit few straight constant-speed segments to a sampled command within a tolerance.

One pass over X, Y, Z and E together: a funnel of admissible slopes starts at the end of the last
segment and narrows with every sample; when it closes, the segment ends. The tolerance across the
path, which is visible on the part, is tighter than along it. Within the funnel the end point is
chosen by noise shaping: the error of a fit with some 200 corners per second lies right at a
machine's resonances, and is moved to frequencies at which the machine does not respond.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode._segment_kernels import (
    LONGEST,
    Answers,
    Bounds,
    fit_stretch,
    path_directions,
    rest_errors,
)
from stillpath.gcode.timeline import Timeline
from stillpath.models.modal import modal_form
from stillpath.models.plants import DiscretePlant

__all__ = ["ErrorFilter", "Segments", "across_tolerance_mm", "fit_segments"]

ALONG_SHARE = 0.8
LOOSE_MM = 0.3e-3
FULL_GAIN = 5.0
BEYOND_MODEL = 0.5
"""Added to a machine's response to an error. A model ends with its band, a machine does not: all of
the error would otherwise be moved to frequencies at which the machine is unknown."""
Z_TOLERANCE_MM = 1e-3
E_TOLERANCE_MM = 3e-4
"""Uneven filament means steps of the extruder's speed, for which firmwares brake."""
END_SPEED_MM_S = 8.0
"""Lowest speed at the end of a stretch before a Z move, which would start as slowly."""
END_EXCESS_MM = 1.5e-3
SHORTEST_S = 0.5e-3
"""Samples nearer than this to the start of a stretch are not ends of segments."""


@dataclass(frozen=True, slots=True)
class Segments:
    """Straight constant-speed pieces of a command.

    Attributes
    ----------
    end_s : ndarray, shape (n,)
        When each segment ends.
    end_mm : ndarray, shape (4, n)
        Where it ends.
    group : ndarray of int64, shape (n,)
        The timeline's group it belongs to.
    error_filter : ErrorFilter, optional
        The machine's response to errors, for later changes of the ends.
    """

    end_s: NDArray[np.float64]
    end_mm: NDArray[np.float64]
    group: NDArray[np.int64]
    error_filter: ErrorFilter | None = None

    def __len__(self) -> int:
        return len(self.end_s)

    @property
    def final(self) -> NDArray[np.bool_]:
        """Which segments end their stretch, shape (n,)."""
        return np.append(self.group[1:] != self.group[:-1], True)

    def stretches(self) -> Iterator[tuple[int, slice]]:
        """Yield the group and the rows of every stretch, in order."""
        if len(self):
            for first, stop in pairwise([0, *(np.flatnonzero(self.final) + 1).tolist()]):
                yield int(self.group[first]), slice(first, stop)


class ErrorFilter:
    """The machine's response to an error of the fit, for X and Y.

    Parameters
    ----------
    plants : sequence of DiscretePlant
        Plants of X and Y at the sampling time of the fit. A plant whose modes are too close for
        partial fractions is assumed to respond equally at all frequencies.

    Notes
    -----
    `share` is the share of the tolerance that is used: all of it up to a resonance of `FULL_GAIN`.
    The response to an error e is direct e + sum of Re(weight x) with x <- pole x + e. `answers` is
    for the kernel; sums of products of responses are geometric series.
    """

    def __init__(self, plants: Sequence[DiscretePlant]) -> None:
        forms = [modal_form(plant) for plant in plants]
        # Without the rows of zeros that fill up a modal form.
        rows = [np.zeros((0, 4)) if f is None else f[np.any(f != 0.0, axis=1)] for f in forms]
        order, axes = max(1, *(len(form) for form in rows)), len(plants)
        pole, weight = np.zeros((2, axes, order), complex)
        direct = np.ones(axes)
        for i, (plant, form) in enumerate(zip(plants, rows, strict=True)):
            pole[i, : len(form)] = form[:, 0] + 1j * form[:, 1]
            weight[i, : len(form)] = form[:, 2] + 1j * form[:, 3]
            if len(form) or plant.order == 0:
                direct[i] = plant.d
        self.pole, self.weight, self.direct = pole, weight, direct
        tables = [_tables(*axis) for axis in zip(pole, weight, direct + BEYOND_MODEL, strict=True)]
        self.answers = Answers(pole, *(np.stack(table) for table in zip(*tables, strict=True)))
        self.share = float(np.clip(FULL_GAIN / _peak_gain(pole, weight, direct), 0.5, 1.0))


def across_tolerance_mm(tolerance_mm: float) -> float:
    """Tolerance across the path: half of it, but no finer than it takes, 1 um up to 5 um."""
    return max(0.2 * tolerance_mm, min(0.5 * tolerance_mm, 1e-3))


def fit_segments(
    timeline: Timeline,
    command_mm: NDArray[np.float64],
    tolerance_mm: float,
    error_filter: ErrorFilter,
    *,
    step_mm_s: float = np.inf,
    grid_mm: float = 1e-3,
    ends: NDArray[np.bool_] | None = None,
) -> Segments:
    """Fit the stretches of a piece.

    Parameters
    ----------
    timeline : Timeline
        Groups and their times.
    command_mm : ndarray, shape (4, n)
        Command on the timeline's grid: x y compensated, z e as planned.
    tolerance_mm : float
        Largest distance in X Y between command and fit.
    error_filter : ErrorFilter
        The machine's response to the error.
    step_mm_s : float
        Segments are cut short where the speed of an axis would step by more.
    grid_mm : float
        X and Y of all vertices but the last of a stretch are multiples of this.
    ends : ndarray of bool, shape (n,), optional
        Samples at which a segment must end.
    """
    # A vertex on a coarse grid (whole motor steps) is up to half a grid step off.
    slack_mm = max(0.5 * (grid_mm - tolerance_mm), 0.0)
    bounds = Bounds(
        along_mm=ALONG_SHARE * error_filter.share * tolerance_mm + slack_mm,
        across_mm=error_filter.share * across_tolerance_mm(tolerance_mm) + slack_mm,
        loose_mm=LOOSE_MM,
        z_mm=Z_TOLERANCE_MM,
        e_mm=E_TOLERANCE_MM,
        step_mm_s=step_mm_s,
    )
    samples = command_mm.shape[1]
    ends = np.zeros(samples, np.bool_) if ends is None else ends
    fit = _Fit(timeline, command_mm, error_filter, bounds, grid_mm, ends)
    for i, group in enumerate(timeline.groups):
        if group.rest:
            fit.rest(timeline.end_s[i] - timeline.start_s[i])
            continue
        start_s = timeline.end_s[i - 1] if i else 0.0
        last = round(timeline.end_s[i] / timeline.dt_s)
        if i == len(timeline.groups) - 1:
            last = samples - 1
        first = min(int(np.ceil((start_s + SHORTEST_S) / timeline.dt_s)), last)
        fit.stretch(i, start_s, first, last, tolerance_mm + END_EXCESS_MM)
    return fit.segments()


class _Fit:
    """The segments of a piece so far, and the machine's errors at their end."""

    def __init__(
        self,
        timeline: Timeline,
        command_mm: NDArray[np.float64],
        error_filter: ErrorFilter,
        bounds: Bounds,
        grid_mm: float,
        ends: NDArray[np.bool_],
    ) -> None:
        self._timeline, self._command_mm, self._bounds = timeline, command_mm, bounds
        self._filter, self._grid_mm, self._ends = error_filter, grid_mm, ends
        capacity = command_mm.shape[1] + len(timeline.groups)
        self._end_s, self._end_mm = np.empty(capacity), np.empty((4, capacity))
        self._groups = np.empty(capacity, dtype=np.int64)
        self._direction = np.empty((2, command_mm.shape[1]))
        path_directions(timeline.position_mm[:2], self._direction)
        self._states = np.zeros_like(error_filter.answers.pole)
        self._errors = np.empty(LONGEST)
        self._count = 0

    def rest(self, duration_s: float) -> None:
        """Let errors decay."""
        samples = round(duration_s / self._timeline.dt_s)
        rest_errors(self._filter.answers.pole, self._states, samples)

    def stretch(self, i: int, start_s: float, first: int, last: int, crawl_mm: float) -> None:
        """Fit group i, which begins at `start_s`, with ends at samples `first` to `last`.

        Before a Z move the last segment may miss the command by `crawl_mm`.
        """
        timeline, command_mm, count = self._timeline, self._command_mm, self._count
        before = int(np.floor(start_s / timeline.dt_s + 1e-6))
        # Z and E moved in the rest before; X and Y stand where the command left them.
        begin = np.concatenate([command_mm[:2, before], timeline.group_start_mm[i, 2:]])
        n = fit_stretch(
            command_mm,
            self._direction,
            self._bounds,
            self._grid_mm,
            timeline.dt_s,
            start_s,
            first,
            last,
            begin,
            bool(np.all(command_mm[2, first : last + 1] == begin[2])),
            self._ends,
            self._filter.answers,
            self._states,
            self._errors,
            count,
            self._end_s,
            self._end_mm,
        )
        if timeline.groups[i].before_z:
            end_s, end_mm = self._end_s[count:], self._end_mm[:, count:]
            n = _merge_crawl(end_s, end_mm, n, command_mm, timeline.dt_s, crawl_mm)
        self._groups[count : count + n] = i
        self._count += n

    def segments(self) -> Segments:
        """Return the fitted segments."""
        end_s, end_mm, groups = (
            a[..., : self._count] for a in (self._end_s, self._end_mm, self._groups)
        )
        return Segments(end_s.copy(), end_mm.copy(), groups.copy(), self._filter)


def _merge_crawl(
    end_s: NDArray[np.float64],
    end_mm: NDArray[np.float64],
    n: int,
    command_mm: NDArray[np.float64],
    dt_s: float,
    allowed_mm: float,
) -> int:
    """Drop vertices before a slow end, as far as the command allows; returns the new count."""
    last = n - 1
    keep = n
    while keep > 2:
        begin_s, begin = end_s[keep - 2], end_mm[:2, keep - 2]
        way = np.hypot(*(end_mm[:2, last] - begin))
        if way >= END_SPEED_MM_S * (end_s[last] - begin_s):
            break
        begin_s, begin = end_s[keep - 3], end_mm[:2, keep - 3]
        k = np.arange(round(begin_s / dt_s), round(end_s[last] / dt_s) + 1)
        share = (k * dt_s - begin_s) / (end_s[last] - begin_s)
        line = begin[:, None] + share * (end_mm[:2, last] - begin)[:, None]
        if np.max(np.hypot(*(line - command_mm[:2, k]))) > allowed_mm:
            break
        keep -= 1
    end_s[keep - 1] = end_s[last]
    end_mm[:, keep - 1] = end_mm[:, last]
    return keep


def _peak_gain(
    pole: NDArray[np.complex128], weight: NDArray[np.complex128], direct: NDArray[np.float64]
) -> float:
    """Return the largest gain of an axis below a quarter of the sampling rate."""
    z = np.exp(1j * np.linspace(0.0, 0.5 * np.pi, 2001))[:, None]
    pole, weight = pole[:, None], weight[:, None]
    sums = weight / (z - pole) + weight.conj() / (z - pole.conj())
    return float(np.max(np.abs(direct[:, None] + 0.5 * sums.sum(axis=2))))


def _tables(
    pole: NDArray[np.complex128], weight: NDArray[np.complex128], direct: np.float64
) -> list[NDArray[Any]]:
    """`power`, `head`, `echo`, `lift` and `norm` of one axis (`Answers`)."""
    lag = np.arange(2 * LONGEST)
    power = pole ** lag[:, None]
    # Summed products of two responses: a geometric series for every pair of poles.
    series = (
        weight / (1.0 - np.outer(pole, pole)),
        weight.conj() / (1.0 - np.outer(pole, pole.conj())),
    )
    pairs = 0.5 * np.sum(series, axis=(0, 2))
    impulse = np.append(direct, (power[:-1] @ weight).real)
    correlation = (power @ (weight * pairs)).real + direct * impulse
    # Errors that rise over m samples and fall over the next ones, a row for every m.
    count = np.arange(LONGEST + 1)[:, None]
    triangle = np.maximum(np.minimum(lag + 1, 2 * count - lag - 1), 0) / np.maximum(count, 1)
    echo = triangle @ correlation[np.abs(lag[:, None] - lag)]
    lift = np.zeros((LONGEST + 1, len(pole)), complex)
    lift[1:] = np.cumsum(np.cumsum(power[:LONGEST], axis=0), axis=0) / count[1:]
    return [
        power[: LONGEST + 1],
        (triangle @ power) * weight * (direct + pole * pairs),
        echo[:, :LONGEST],
        lift,
        np.sum(triangle * echo, axis=1),
    ]
