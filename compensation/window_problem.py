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
from itertools import pairwise
from typing import NamedTuple

import daqp
import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import dsyrk
from scipy.linalg.lapack import dgesv, dpotrf, dtrtrs

from compensation._window_kernels import extremes, segment_states, tied_command, tied_response
from compensation.base import DesignError
from compensation.preview import PreviewDesign

__all__ = ["EFFORT_PRICE", "TRAVEL_SLACK_MM", "Bounds", "Extremes", "solve_window"]

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

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

    def kept(self, reached: Extremes) -> tuple[bool, bool, bool]:
        """Whether acceleration, speed and travel are kept."""
        slack = 1.0 + 1e-9
        return (
            reached.accel <= slack * self.accel,
            reached.speed <= slack * self.speed,
            reached.low_mm >= self.low_mm - TRAVEL_SLACK_MM
            and reached.high_mm <= self.high_mm + TRAVEL_SLACK_MM,
        )


class Extremes(NamedTuple):
    """What a command asks for, in mm and samples: see `Bounds`; and its mean squared increment."""

    accel: float
    speed: float
    low_mm: float
    high_mm: float
    mean_square: float

    @classmethod
    def of(cls, command: Array, last: float, previous: float, *, stops: bool = False) -> Extremes:
        """Look at a command that follows two others, and whether it stops behind its end."""
        return cls(*extremes(command, last, previous, stops))


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
    edges = [0, *(edge for span in spans for edge in span), window]
    moving = np.array(edges, dtype=np.int64).reshape(-1, 2)
    normal, right, ends = _normal_equations(design, z, targets_mm, weight, moving)
    pins = [a - 1 for a, _ in spans if a > 0]
    rows = ends[len(spans) - len(pins) :]
    values = path_mm[pins] - tied_command(np.zeros(window), moving, last, previous)[pins]

    # In the coordinates w = L' c, normal = L L', the cost is |w - free|^2: well conditioned even
    # where a rest leaves few samples. LAPACK itself: the wrappers' checks would take as long.
    factor, flaw = dpotrf(normal, lower=1, overwrite_a=1)
    if flaw:
        raise DesignError(f"the window problem at a rest is singular (LAPACK dpotrf: {flaw})")
    found = free = dtrtrs(factor, right, lower=1)[0]
    pinned = np.ascontiguousarray(dtrtrs(factor, rows.T, lower=1)[0].T)
    if pins:
        # The nearest w for which the command stands on the path in the rests.
        *_, pull, flaw = dgesv(pinned @ pinned.T, pinned @ free - values)
        if flaw:
            raise DesignError(f"rests contradict each other in a window (LAPACK dgesv: {flaw})")
        found = free - pull @ pinned

    def command_of(found: Array) -> Array:
        increments = design.basis @ dtrtrs(factor, found, lower=1, trans=1)[0]
        return tied_command(increments, moving, last, previous)

    command = command_of(found)
    broken = _broken(bounds, z, command)
    while any(broken):
        # Only the kinds of bounds that are broken: most windows know one.
        rows, low, high = _constraints(bounds, z, design.basis, moving, broken)
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
        command = command_of(found)
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
    design: PreviewDesign, z: Array, targets_mm: Array, weight: Array, moving: Ints
) -> tuple[Array, Array, Array]:
    """Weighted least squares with a price on increments, as a quadratic form.

    Returns
    -------
    normal : ndarray, shape (n, n)
        Its lower half.
    right : ndarray, shape (n,)
    ends : ndarray, shape (rests, n)
        Where the functions' commands stand in each rest.
    """
    lifted = design.lifted
    resting = len(moving) > 1
    price = max(EFFORT_PRICE, design.price) if resting else design.price
    # Outside the rests the increments are the untied ones, so their effort is known. The price of
    # the untied functions keeps the matrix definite when a rest leaves few samples. BLAS wants
    # columns one behind the other: here the transpose of a symmetric matrix.
    normal = ((2.0 if resting else 1.0) * price * design.effort).T
    right = np.zeros(design.n)
    begun = np.empty((len(moving), lifted.states, design.n))
    stopped = np.empty_like(begun)
    segment_states(design.summed, lifted.reach, moving, begun, stopped)
    speed, first = float(z[-2] - z[-1]), int(moving[0, 1])
    if resting:
        steps = stopped[:-1, -2] - stopped[:-1, -1]
        normal = dsyrk(price, steps.T, 1.0, normal, lower=1, overwrite_c=1)
        right -= price * speed * steps[0]
    for (_, a), (b, _) in pairwise(moving.tolist()):
        normal = dsyrk(-price, design.basis[a:b].T, 1.0, normal, lower=1, overwrite_c=1)
    for target, free, integrated, filtered in zip(
        targets_mm, lifted.from_state, lifted.integrated, design.filtered, strict=True
    ):
        error = target - free @ z
        if resting:
            # The increment that stops the motion from before.
            error += speed * integrated[:, first]
        response = tied_response(filtered, free, moving, begun, stopped, weight, error, right)
        normal = dsyrk(1.0, response.T, 1.0, normal, lower=1, overwrite_c=1)
    return normal, right, np.cumsum(stopped[:-1, -2], axis=0)


def _broken(bounds: Bounds, z: Array, command: Array) -> list[bool]:
    return [not kept for kept in bounds.kept(Extremes.of(command, z[-2], z[-1]))]


def _constraints(
    bounds: Bounds, z: Array, basis: Array, moving: Ints, which: list[bool]
) -> tuple[Array, Array, Array]:
    """Rows, lower and upper ends of the bounds on the coefficients."""
    last, step = float(z[-2]), float(z[-2] - z[-1])
    accel, speed = (1.0 - _MARGIN) * bounds.accel, (1.0 - _MARGIN) * bounds.speed
    tied, offset = basis.copy(), np.zeros(len(basis))
    for (s, a), (b, _) in pairwise(moving.tolist()):
        tied[a:b] = 0.0
        tied[a] = -basis[s:a].sum(axis=0)
        offset[a] = -step if s == 0 else 0.0
    line = np.arange(1.0, len(basis) + 1.0) * step
    kinds = [
        (offset, -accel, accel, accel),
        (step + np.cumsum(offset), -speed, speed, speed),
        (
            last + line + np.cumsum(np.cumsum(offset)),
            bounds.low_mm,
            bounds.high_mm,
            _TRAVEL_SCALE_MM,
        ),
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
