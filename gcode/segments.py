"""Fit few straight constant-speed segments to a sampled command within a tolerance.

One pass over X, Y, Z and E together chooses when segments end: a funnel of admissible slopes starts
at the end of the last segment and narrows with every sample; when it closes, the segment ends. The
tolerance across the path, which is visible on the part, is tighter than along it. Then the ends of
each stretch are moved such that the machine responds least to the error, by least squares: that
halves its response to as many segments, because an error around 200 Hz remains and slower ones
vanish.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode._least_squares_kernels import (
    Weight,
    line_errors,
    normal_equations,
    solve,
    together,
)
from stillpath.gcode._segment_kernels import Bounds, choose_ends, path_directions
from stillpath.gcode.timeline import Timeline
from stillpath.models.modal import modal_form
from stillpath.models.plants import DiscretePlant

__all__ = ["ErrorFilter", "Segments", "fit_segments"]

ALONG_SHARE, ACROSS_SHARE = 0.8, 0.5
"""Shares of the tolerance along the path and across it."""
LOOSE_SHARE = 0.15
"""By how much more an end may miss the command, so that it need not be moved to reach it."""
FULL_GAIN = 5.0
"""Gain of a resonance up to which all of the tolerance is used."""
BEYOND_MODEL = 0.5
"""Added to the response of the model. Above the model's band the machine's response is unknown;
without this term the fit would move all error there."""
Z_TOLERANCE_MM = 1e-3
E_TOLERANCE_MM = 3e-4
"""Uneven filament means steps of the extruder's speed, for which firmwares brake."""
END_SPEED_MM_S = 8.0
"""Lowest speed at the end of a stretch before a Z move, which would start as slowly."""
END_EXCESS_MM = 1.5e-3
SHORTEST_S = 0.5e-3
"""Samples nearer than this to the start of a stretch are not ends of segments."""
_LAGS = 32
"""Samples over which errors count together. A machine's memory is longer, but taken whole it halves
the machine's response no further."""


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
    tolerance_mm : float
        What they may differ from the command by.
    """

    end_s: NDArray[np.float64]
    end_mm: NDArray[np.float64]
    group: NDArray[np.int64]
    error_filter: ErrorFilter | None = None
    tolerance_mm: float = 0.0

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
    The response to an error e is direct e + sum of Re(weight x) with x <- pole x + e. `cost` says
    how errors count: by the energy of that response.
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
        forms_of = zip(pole, weight, direct + BEYOND_MODEL, strict=True)
        self.cost = weighing(np.stack([_correlation(*form) for form in forms_of], axis=1))
        self.share = float(np.clip(FULL_GAIN / _peak_gain(pole, weight, direct), 0.5, 1.0))


def fit_segments(
    timeline: Timeline,
    command_mm: NDArray[np.float64],
    tolerance_mm: float,
    error_filter: ErrorFilter,
    *,
    step_mm_s: float = np.inf,
    feed_step_mm_s: float = np.inf,
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
        Largest distance in X Y between command and fit, before its ends are moved.
    error_filter : ErrorFilter
        The machine's response to the error.
    step_mm_s : float
        Segments are cut short where the speed of an axis would step by more.
    feed_step_mm_s : float
        The same for the extruder, at one speed along the path.
    grid_mm : float
        X and Y of all vertices but the last of a stretch are multiples of this.
    ends : ndarray of bool, shape (n,), optional
        Samples at which a segment must end.
    """
    used_mm = error_filter.share * tolerance_mm
    bounds = Bounds(
        along_mm=ALONG_SHARE * used_mm,
        across_mm=ACROSS_SHARE * used_mm,
        loose_mm=LOOSE_SHARE * used_mm,
        z_mm=Z_TOLERANCE_MM,
        e_mm=E_TOLERANCE_MM,
        step_mm_s=step_mm_s,
        feed_step_mm_s=feed_step_mm_s,
    )
    samples = command_mm.shape[1]
    ends = np.zeros(samples, np.bool_) if ends is None else ends
    fit = _Fit(timeline, command_mm, error_filter, bounds, grid_mm, ends)
    for i, group in enumerate(timeline.groups):
        if group.rest:
            continue
        start_s = timeline.end_s[i - 1] if i else 0.0
        last = round(timeline.end_s[i] / timeline.dt_s)
        if i == len(timeline.groups) - 1:
            last = samples - 1
        first = min(int(np.ceil((start_s + SHORTEST_S) / timeline.dt_s)), last)
        fit.stretch(i, start_s, first, last, tolerance_mm + END_EXCESS_MM)
    return replace(fit.segments(), tolerance_mm=tolerance_mm)


class _Fit:
    """The segments of a piece so far."""

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
        samples = command_mm.shape[1]
        capacity = samples + len(timeline.groups)
        self._sample, self._groups = np.empty((2, capacity), np.int64)
        self._end_mm = np.empty((4, capacity))
        self._direction = np.empty((2, samples))
        path_directions(timeline.position_mm[:2], self._direction)
        self._count = 0

    def stretch(self, i: int, start_s: float, first: int, last: int, crawl_mm: float) -> None:
        """Fit group i, which begins at `start_s`, with ends at samples `first` to `last`.

        Before a Z move the last segment may miss the command by `crawl_mm`.
        """
        timeline, command_mm, count = self._timeline, self._command_mm, self._count
        before = int(np.floor(start_s / timeline.dt_s + 1e-6))
        # Z and E moved in the rest before; X and Y stand where the command left them.
        begin = np.concatenate([command_mm[:2, before], timeline.group_start_mm[i, 2:]])
        n = choose_ends(
            command_mm,
            self._direction,
            self._bounds,
            timeline.dt_s,
            start_s,
            first,
            last,
            begin,
            bool(np.all(command_mm[2, first : last + 1] == begin[2])),
            self._ends,
            count,
            self._sample,
            self._end_mm,
        )
        sample, end_mm = self._sample[count:], self._end_mm[:, count:]
        if timeline.groups[i].before_z:
            n = _merge_crawl(sample, end_mm, n, command_mm, timeline.dt_s, crawl_mm)
        self._settle(np.append(before, sample[:n]), begin, end_mm[:, :n])
        self._groups[count : count + n] = i
        self._count += n

    def _settle(
        self, knot: NDArray[np.int64], begin: NDArray[np.float64], end_mm: NDArray[np.float64]
    ) -> None:
        """Move all ends (4, n) but the last, in place, to where the machine responds least."""
        inner = knot[1:-1]
        if len(inner) == 0:
            return
        place, cost = self._command_mm[:2, knot], self._filter.cost
        first, felt = np.empty(len(inner), np.int64), np.empty((2, knot[-1] - knot[0] + 1))
        for axis, error in enumerate(felt):
            line_errors(self._command_mm[axis], knot, error)
            # As they count, with those before and after.
            error[:] = np.convolve(error, cost.correlation[:, axis])[_LAGS - 1 : 1 - _LAGS]
        rows = np.empty((len(inner), together(knot, _LAGS, first) + 1, 2))
        shift = np.empty((len(inner), 2))
        normal_equations(knot, first, cost, felt, rows, shift)
        if not solve(first, rows, shift):
            raise np.linalg.LinAlgError("the ends of segments have no least squares")
        end_mm[:2, :-1] = self._grid_mm * np.round((place[:, 1:-1] + shift.T) / self._grid_mm)
        end_mm[3, :-1] += _filament(place, np.append(begin[3], end_mm[3]), shift.T)

    def segments(self) -> Segments:
        """Return the fitted segments."""
        rows = slice(self._count)
        end_s = self._timeline.dt_s * self._sample[rows]
        return Segments(
            end_s, self._end_mm[:, rows].copy(), self._groups[rows].copy(), self._filter
        )


def _filament(
    place: NDArray[np.float64], e: NDArray[np.float64], shift: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Filament that inner ends of segments take along, so that its amount per mm stays.

    Firmwares brake where it changes. `place` (2, n) and `e` (n,) are those of all ends with the
    beginning, `shift` (2, n - 2) says how far the inner ones move.
    """
    step = np.diff(place, axis=1)
    length = np.maximum(np.hypot(*step), 1e-9)
    per_mm = np.diff(e) / length
    before, after = per_mm[:-1], per_mm[1:]
    # Where a line begins or ends, or filament turns back, none.
    least = np.where(before * after > 0.0, np.minimum(np.abs(before), np.abs(after)), 0.0)
    along = np.sum(shift * step[:, 1:], axis=0) / length[1:]
    return np.asarray(np.sign(after) * least * along)


def _merge_crawl(
    sample: NDArray[np.int64],
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
        way = np.hypot(*(end_mm[:2, last] - end_mm[:2, keep - 2]))
        if way >= END_SPEED_MM_S * dt_s * (sample[last] - sample[keep - 2]):
            break
        begin = end_mm[:2, keep - 3]
        k = np.arange(sample[keep - 3], sample[last] + 1)
        share = (k - k[0]) / (k[-1] - k[0])
        line = begin[:, None] + share * (end_mm[:2, last] - begin)[:, None]
        if np.max(np.hypot(*(line - command_mm[:2, k]))) > allowed_mm:
            break
        keep -= 1
    sample[keep - 1] = sample[last]
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


def _correlation(
    pole: NDArray[np.complex128], weight: NDArray[np.complex128], direct: np.float64
) -> NDArray[np.float64]:
    """Return how errors of an axis count together, by the lag between them, shape (lags,)."""
    lag = np.arange(_LAGS)
    power = pole ** lag[:, None]
    # Summed products of two responses: a geometric series for every pair of poles.
    series = (
        weight / (1.0 - np.outer(pole, pole)),
        weight.conj() / (1.0 - np.outer(pole, pole.conj())),
    )
    pairs = 0.5 * np.sum(series, axis=(0, 2))
    impulse = np.append(direct, (power[:-1] @ weight).real)
    correlation = (power @ (weight * pairs)).real + direct * impulse
    # A triangle's spectrum is nowhere negative, nor is that of its product with a correlation.
    return np.asarray(correlation * (1.0 - lag / _LAGS))


def weighing(correlation: NDArray[np.float64]) -> Weight:
    """Return the weight of errors with this correlation, shape (lags, 2), and its moments."""
    lags = len(correlation)
    bend, moment = np.zeros((2, lags + 3, 2))
    bend[1] = 0.5 * correlation[0]
    for k in range(1, lags + 2):
        bend[k + 1] = 2.0 * bend[k] - bend[k - 1] + (correlation[k] if k < lags else 0.0)
        moment[k + 1] = 2.0 * moment[k] - moment[k - 1] + bend[k]
    both_sides = np.concatenate([correlation[:0:-1], correlation])
    return Weight(both_sides, moment[: lags + 2], bend[lags : lags + 2].copy())
