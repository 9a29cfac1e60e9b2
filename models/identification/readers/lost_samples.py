"""Samples that a sensor lost without a gap in the log's time, found in its stamps and put right."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stillpath.models.arrays import Array
from stillpath.models.notes import WarningNote

__all__ = ["Restored", "restored"]

_BLOCK_S, _SETTLED_S, _STRETCHED_S = 0.1, 10.0, 3.0
"""Klipper's batches, the time until stamps are right again after a loss, and that in which most of
it is made up."""
_LEAST_S, _FASTER, _ONSET = 1.2e-3, 1e-3, 0.3
"""Least time that is looked for, by how much stamps are stretched then, and the share of the
largest stretch with which it begins."""
_CLEAR = 6.0
"""Ratio of what was lost to what stamps wander elsewhere."""
_GAP = 1.5


class Restored(NamedTuple):
    """Times of samples, shape (n,), and notes."""

    time_s: Array
    notes: tuple[str, ...]


def restored(time_s: Array) -> Restored:
    """Put the times right of samples behind others that the sensor lost.

    Klipper counts samples and fits their number to the clock over some seconds (ClockSyncRegression
    in klippy/extras/bulk_sensor.py, 2026-08, adxl345.py since 2021-08). Of samples that are lost
    where a FIFO overflows it knows nothing: the next ones have stamps that are too early by all
    that is missing, and stretched until they come back, within some 3 s. A test sweeps through
    resonances meanwhile, so the phase there would be wrong.

    Parameters
    ----------
    time_s : ndarray, shape (n,)
        Rising, without gaps.
    """
    settled = round(_SETTLED_S / _BLOCK_S)
    blocks = _blocks(time_s)
    count = len(blocks.late_s) - 1
    places = _places(blocks) if count >= 3 * settled else []
    if not places:
        return Restored(time_s, ())
    size = blocks.size
    regular_s = np.concatenate([[0.0], np.cumsum(blocks.gaps_s + blocks.usual_s / size)])
    out, left = time_s.copy(), []
    notes: list[str] = []
    for first, following in zip(places, [*places[1:], count], strict=True):
        at_s = float(time_s[size * first] - time_s[0])
        last = first + settled
        if last > following:
            left.append(at_s)
            continue
        lost = float(blocks.late_s[last] - blocks.late_s[first]) / blocks.usual_s * size
        begins, stops = size * first + size // 2, size * last
        behind = slice(begins + 1, stops)
        out[behind] = time_s[stops] - (regular_s[stops] - regular_s[behind])
        notes.append(
            f"the sensor lost some {lost:.0f} samples {at_s:.0f} s after the beginning of the log: "
            "the times of those behind them were put right"
        )
    if left:
        text = (
            f"the sensor lost samples at {len(left)} places, first {left[0]:.0f} s after "
            "the beginning of the log, and lost some again or ended too soon to put the times of "
            "those behind them right, so frequencies and damping may be wrong; measure again with "
            "less load on the sensor's board, or a lower rate of the sensor"
        )
        notes.append(WarningNote(text))
    return Restored(out, tuple(notes))


class _Blocks(NamedTuple):
    """Blocks of `size` samples, which usually take `usual_s`.

    `late_s` is by how much each begins, and the last one ends, later than if all took that. Gaps
    (n - 1,) are left out of it.
    """

    size: int
    usual_s: float
    late_s: Array
    gaps_s: Array


def _blocks(time_s: Array) -> _Blocks:
    steps_s = np.diff(time_s)
    interval_s = float(time_s[-1] - time_s[0]) / len(steps_s)
    # A sample that Klipper itself left out has left a gap: the stamps around it are right.
    gaps_s = np.where(steps_s > _GAP * interval_s, steps_s - interval_s, 0.0)
    size = max(1, round(_BLOCK_S / interval_s))
    count = len(steps_s) // size
    spans_s = (steps_s - gaps_s)[: count * size].reshape(count, size).sum(axis=1)
    usual_s = float(np.median(spans_s)) if count else _BLOCK_S
    return _Blocks(size, usual_s, np.concatenate([[0.0], np.cumsum(spans_s - usual_s)]), gaps_s)


def _places(blocks: _Blocks) -> list[int]:
    """Return the blocks in which samples were lost: where stamps begin to be stretched."""
    late_s = blocks.late_s
    faster = np.diff(late_s) / blocks.usual_s
    stretched = round(_STRETCHED_S / _BLOCK_S)
    wander_s = float(np.median(np.abs(np.diff(late_s)))) * math.sqrt(stretched)
    least_s = max(_LEAST_S, _CLEAR * wander_s)
    places: list[int] = []
    block = 0
    while block < len(faster):
        soon = slice(block, block + stretched)
        gained_s = late_s[min(soon.stop, len(faster))] - late_s[block]
        if faster[block] >= max(_FASTER, _ONSET * faster[soon].max()) and gained_s >= least_s:
            places.append(block)
            block += stretched
        else:
            block += 1
    return places
