"""Make a filtered command stand still where the machine must not move.

A filter spreads every motion over its length, but a rest (retraction, Z hop) allows none. The
command is blended onto the plan before the rest and back to the filter's output after it, by the
cubic in their difference that matches position and speed at both ends.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from stillpath.models.arrays import Array

__all__ = ["stand_still"]


def stand_still(u_mm: Array, y_d_mm: Array, rests: NDArray[np.int64], blend: int) -> Array:
    """Return `u_mm` standing at the plan's position in the rests and at both ends.

    Parameters
    ----------
    u_mm, y_d_mm : ndarray, shape (2, n)
        Filter output and plan; the plan stands still in the rests.
    rests : ndarray of int64, shape (k, 2)
        Sample ranges [a, b). The sample before `a` also belongs to the rest, as the plan already
        stands there; a rest shorter than a sample may be over right after it.
    blend : int
        Samples of a transition; at most half the distance to the next rest.
    """
    n = u_mm.shape[1]
    out = u_mm.copy()
    if n == 0:
        return out
    still = [(max(int(a) - 1, 0), min(int(b), n)) for a, b in rests if b > a]
    spans = _joined([(0, 1), *still, (n - 1, n)])
    # Every correction is computed from the filter's output, independently of the others.
    for (_, begin), (end, _) in pairwise(spans):
        gap = end - begin
        length = min(blend, max(gap // 2, 1))
        _lead(out[:, begin - 1 : begin + length], u_mm, y_d_mm, begin - 1, 1)
        _lead(out[:, end - length + 1 : end + 1][:, ::-1], u_mm, y_d_mm, end, -1)
    for a, b in spans:
        out[:, a:b] = y_d_mm[:, a, None]
    return out


def _joined(spans: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Merge overlapping spans, but not touching ones: the plan may move between these."""
    joined: list[tuple[int, int]] = []
    for a, b in sorted(spans):
        if joined and a < joined[-1][1]:
            joined[-1] = (joined[-1][0], max(b, joined[-1][1]))
        else:
            joined.append((a, b))
    return joined


def _lead(part: Array, u: Array, y_d: Array, rest: int, step: int) -> None:
    """Subtract the fading deviation from `part`, a view of the command next to a rest.

    `rest` is the sample at the edge of the rest, `step` the direction away from it.
    """
    length = part.shape[1] - 1
    if length < 1:
        return
    n = u.shape[1]
    deviation = u[:, rest] - y_d[:, rest]
    beside = min(max(rest + step, 0), n - 1)
    slope = u[:, beside] - y_d[:, beside] - deviation
    x = np.arange(part.shape[1]) / length
    value = (1 + 2 * x) * (1 - x) ** 2
    rise = x * (1 - x) ** 2 * length
    part -= deviation[:, None] * value + slope[:, None] * rise
