"""One window solved by itself: with rests, and within bounds.

Over a rest [a, b) only E or Z moves and X and Y must stand still. The increments are tied down
there: the one at a stops the command, the others are zero, and the remaining functions are solved
for by weighted least squares with a small price on acceleration, under the constraint that the
command stands exactly on the path. The weight is low inside the rest (nothing is printed) and back
to normal after it, otherwise the command would wander off (docs/method.md).

Where the solution would leave the machine's bounds, the same problem is solved as a quadratic
programme (DAQP, a dual active-set method).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import daqp
import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf, dtrtrs

from compensation.base import DesignError
from compensation.preview import PreviewDesign

__all__ = ["EFFORT_PRICE", "TRAVEL_SLACK_MM", "Bounds", "solve_window"]

Array = NDArray[np.float64]

EFFORT_PRICE = 0.5
"""Price of squared increments (mm/sample^2)^2 against squared error mm^2 at rests."""
TRAVEL_SLACK_MM = 1e-6
_TRAVEL_SCALE_MM = 0.1
_MARGIN = 1e-5
"""The solver keeps bounds to 1e-6 of their scale."""
_EQUAL = 5
"""DAQP's mark of an equality."""


@dataclass(frozen=True, slots=True)
class Bounds:
    """What the command of an axis must keep, in mm and samples.

    Attributes
    ----------
    accel, speed : float
        Largest second and first difference, mm/sample^2 and mm/sample.
    low_mm, high_mm : float
        Travel.
    """

    accel: float
    speed: float
    low_mm: float
    high_mm: float

    def seen_from(self, origin_mm: float) -> Bounds:
        """Return the bounds for positions relative to an origin."""
        return replace(self, low_mm=self.low_mm - origin_mm, high_mm=self.high_mm - origin_mm)

    def kept(self, increments: Array, steps: Array, position_mm: Array) -> list[bool]:
        """Whether acceleration, speed and travel are kept."""
        slack = 1.0 + 1e-9
        return [
            bool(np.max(np.abs(increments), initial=0.0) <= slack * self.accel),
            bool(np.max(np.abs(steps), initial=0.0) <= slack * self.speed),
            bool(
                np.min(position_mm) >= self.low_mm - TRAVEL_SLACK_MM
                and np.max(position_mm) <= self.high_mm + TRAVEL_SLACK_MM
            ),
        ]


def solve_window(
    design: PreviewDesign,
    z: Array,
    path_mm: Array,
    targets_mm: Array,
    weight: Array,
    rests: NDArray[np.int64],
    bounds: Bounds,
) -> Array:
    """Command of one window that stands still over the given rests.

    Parameters
    ----------
    design : PreviewDesign
        Gains and lifted plants of the axis.
    z : ndarray, shape (nz,)
        Member states and the last two commands.
    path_mm : ndarray, shape (window,)
        Planned positions, on which the command stands in the rests.
    targets_mm : ndarray, shape (components, window)
        What each component of the set shall do: `lifted.target` times the path, or nearly.
    weight : ndarray, shape (window,)
        Weight of the errors.
    rests : ndarray of int64, shape (k, 2)
        Ranges [a, b) of samples, relative to the window, in which u(i) = u(i - 1) = path(i - 1).
    bounds : Bounds
        Kept where that is possible; the caller checks.

    Returns
    -------
    ndarray, shape (window,)
    """
    last, previous = float(z[-2]), float(z[-1])
    window = len(path_mm)
    spans = [(max(int(a), 0), min(int(b), window)) for a, b in rests]
    tied, offset = _tie_down(design.basis, last - previous, spans)
    normal, right = _normal_equations(design, z, targets_mm, weight, spans, tied, offset)
    fixed = last + np.arange(1.0, window + 1.0) * (last - previous) + _twice_summed(offset)
    pins = [a - 1 for a, _ in spans if a > 0]

    # In the coordinates w = L' c, normal = L L', the cost is |w - free|^2: well conditioned even
    # where a rest leaves few samples. LAPACK itself: the wrappers' checks would take as long.
    factor, flaw = dpotrf(normal, lower=1)
    if flaw:
        raise DesignError(f"the window problem at a rest is singular (LAPACK dpotrf: {flaw})")
    free = dtrtrs(factor, right, lower=1)[0]
    # Rows of the double running sum of `tied`, which as a whole would take longer than the rest.
    reach = np.maximum(np.array(pins, float)[:, None] + 1.0 - np.arange(window), 0.0)
    rows, values = reach @ tied, path_mm[pins] - fixed[pins]
    pinned = np.ascontiguousarray(dtrtrs(factor, rows.T, lower=1)[0].T)

    try:
        found = free - pinned.T @ np.linalg.solve(pinned @ pinned.T, pinned @ free - values)
    except np.linalg.LinAlgError as error:
        raise DesignError(f"rests contradict each other in a window: {error}") from error
    command = fixed + _twice_summed(tied @ dtrtrs(factor, found, lower=1, trans=1)[0])
    broken = _broken(bounds, z, command)
    while any(broken):
        # Only the kinds of bounds that are broken: most windows know one.
        rows, low, high = _constraints(bounds, z, tied, offset, fixed, broken)
        found, _, flag, _ = daqp.solve(
            np.eye(len(free)),
            -free,
            np.concatenate([pinned, dtrtrs(factor, rows.T, lower=1)[0].T]),
            np.concatenate([values, high]),
            np.concatenate([values, low]),
            np.array([_EQUAL] * len(pins) + [0] * len(rows), dtype=np.int32),
        )
        if flag <= 0:
            break  # no command keeps them; the caller sees that and takes a gentler design
        command = fixed + _twice_summed(tied @ dtrtrs(factor, found, lower=1, trans=1)[0])
        also = [a and not b for a, b in zip(_broken(bounds, z, command), broken, strict=True)]
        if not any(also):
            break
        broken = [a or b for a, b in zip(broken, also, strict=True)]
    command[pins] = path_mm[pins]
    for a, b in rests:
        # Rounding must not move a resting axis.
        command[max(a, 0) : b] = last if a <= 0 else command[a - 1]
    return np.asarray(command)


def _normal_equations(
    design: PreviewDesign,
    z: Array,
    targets_mm: Array,
    weight: Array,
    spans: list[tuple[int, int]],
    tied: Array,
    offset: Array,
) -> tuple[Array, Array]:
    """Weighted least squares with a price on increments, as a quadratic form."""
    lifted = design.lifted
    squared = (weight * weight)[:, None]
    price = max(EFFORT_PRICE, design.price) if spans else design.price
    # Outside the rests the increments are the untied ones, so their effort is known. The price of
    # the untied functions keeps the matrix definite when a rest leaves few samples.
    normal = (2.0 if spans else 1.0) * price * design.effort
    for a, b in spans:
        normal = normal - price * (design.basis[a:b].T @ design.basis[a:b])
        normal += price * np.outer(tied[a], tied[a])
    right = -price * (offset @ tied)
    moved = offset.any()
    for target, free, integrated, filtered in zip(
        targets_mm, lifted.from_state, lifted.integrated, design.filtered, strict=True
    ):
        error = target - free @ z
        if moved:
            error -= integrated @ offset
        response = filtered
        if spans:
            response = filtered.copy()
            for a, b in spans:
                # The plant is causal: what is tied at a shows from a on.
                response[a:] += integrated[a:, a:b] @ (tied[a:b] - design.basis[a:b])
        weighted = response * squared
        normal = normal + weighted.T @ response
        right = right + error @ weighted
    return normal, right


def _broken(bounds: Bounds, z: Array, command: Array) -> list[bool]:
    whole = np.concatenate([[z[-1], z[-2]], command])
    return [not kept for kept in bounds.kept(np.diff(whole, 2), np.diff(whole[1:]), command)]


def _constraints(
    bounds: Bounds,
    z: Array,
    tied: Array,
    offset: Array,
    fixed: Array,
    which: list[bool],
) -> tuple[Array, Array, Array]:
    """Rows, lower and upper ends of the bounds on the coefficients."""
    step = float(z[-2] - z[-1])
    accel, speed = (1.0 - _MARGIN) * bounds.accel, (1.0 - _MARGIN) * bounds.speed
    kinds = [
        (offset, -accel, accel, accel),
        (step + np.cumsum(offset), -speed, speed, speed),
        (fixed, bounds.low_mm, bounds.high_mm, _TRAVEL_SCALE_MM),
    ]
    rows, lows, highs = [], [], []
    for times, ((at, low, high, scale), wanted) in enumerate(zip(kinds, which, strict=True)):
        if wanted:
            functions = tied
            for _ in range(times):
                functions = np.cumsum(functions, axis=0)
            free = np.any(functions != 0.0, axis=1)  # increments in a rest are not
            rows.append(functions[free] / scale)
            lows.append((low - at[free]) / scale)
            highs.append((high - at[free]) / scale)
    return np.concatenate(rows), np.concatenate(lows), np.concatenate(highs)


def _tie_down(basis: Array, speed: float, spans: list[tuple[int, int]]) -> tuple[Array, Array]:
    """Basis and fixed increments that obey the rests."""
    offset = np.zeros(len(basis))
    if not spans:
        return basis, offset
    tied = basis.copy()
    moving = 0
    for a, b in spans:
        tied[a] = -basis[moving:a].sum(axis=0)
        tied[a + 1 : b] = 0.0
        if moving == 0:
            offset[a] = -speed
        moving = b
    return tied, offset


def _twice_summed(increments: Array) -> Array:
    return np.cumsum(np.cumsum(increments, axis=0), axis=0)
