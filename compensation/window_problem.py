"""Keep a window within the machine's bounds, and prepare windows with rests for the kernels.

During a rest [a, b) only E or Z moves and X and Y must stand still. The increments are fixed there:
the one at a stops the command, the others are zero, and the remaining ones are found by weighted
least squares with a small penalty on acceleration, under the constraint that the command stands
exactly on the path. The weight is low inside the rest (nothing is printed) and normal after it,
otherwise the command would drift away (docs/method.md; solved in `_window_kernels`).

If the solution exceeds the machine's bounds, the same problem is solved as a quadratic programme
(DAQP, a dual active-set method).
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import daqp
import numpy as np

from stillpath.compensation._window_kernels import (
    Functions,
    Tied,
    command_of,
    constraints_at,
    extremes,
)
from stillpath.compensation.base import DesignError
from stillpath.compensation.lifted_window import Condensed
from stillpath.compensation.preview import PreviewDesign, running_gram
from stillpath.models.arrays import Array

__all__ = [
    "EFFORT_PRICE",
    "TRAVEL_SLACK_MM",
    "Bounds",
    "Extremes",
    "functions_of",
    "refusing_singular",
    "within_bounds",
]

EFFORT_PRICE = 0.5
"""Weight of squared increments (mm/sample^2)^2 relative to squared error mm^2 at rests."""
TRAVEL_SLACK_MM = 1e-6
_TRAVEL_SCALE_MM = 0.1
_MARGIN = 1e-5
"""The solver keeps bounds to 1e-6 of their scale."""
_EQUAL = 5
"""DAQP's flag for an equality."""


@dataclass(frozen=True, slots=True)
class Bounds:
    """Bounds of the command of an axis, in mm and samples.

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

    def at_most(self, accel: float, speed: float) -> Bounds:
        """Return the bounds with at most this acceleration and speed."""
        return replace(self, accel=min(self.accel, accel), speed=min(self.speed, speed))

    def table(self) -> Array:
        """Return lowest and highest increment, step and position, margins and scales, (3, 4)."""
        return np.array(
            [
                [-self.accel, self.accel, _MARGIN * self.accel, self.accel],
                [-self.speed, self.speed, _MARGIN * self.speed, self.speed],
                [self.low_mm, self.high_mm, 0.0, _TRAVEL_SCALE_MM],
            ]
        )

    def limits(self) -> Array:
        """Return the limits with a tolerance for rounding: accel, speed, low, high."""
        room = 1.0 + 1e-9
        travel = self.low_mm - TRAVEL_SLACK_MM, self.high_mm + TRAVEL_SLACK_MM
        return np.array([room * self.accel, room * self.speed, *travel])

    def kept(self, reached: Extremes) -> bool:
        """Return whether acceleration, speed and travel are within the bounds."""
        accel, speed, low, high = self.limits()
        return bool(
            reached.accel <= accel
            and reached.speed <= speed
            and reached.low_mm >= low
            and reached.high_mm <= high
        )


class Extremes(NamedTuple):
    """Extremes of a command in mm and samples (see `Bounds`), and its mean squared increment."""

    accel: float
    speed: float
    low_mm: float
    high_mm: float
    mean_square: float

    @classmethod
    def of(cls, command: Array, last: float, previous: float, *, stops: bool = False) -> Extremes:
        """Measure a command that follows two samples and, with `stops`, stops after its end."""
        return cls(*extremes(command, last, previous, stops))


@contextlib.contextmanager
def refusing_singular() -> Iterator[None]:
    """Turn a singular window problem into a DesignError."""
    try:
        yield
    except np.linalg.LinAlgError as error:
        raise DesignError(f"the window problem at a rest is singular ({error})") from error


def functions_of(
    design: PreviewDesign, *, at_rests: bool, part: Condensed | None = None
) -> Functions:
    """Return the functions of a design, or of its reduced form, for windows solved singly."""
    lifted = design.lifted
    price = max(EFFORT_PRICE, design.price) if at_rests else design.price
    functions = Functions(
        design.basis,
        design.summed,
        design.efforts,
        design.filtered,
        design.grams,
        lifted.from_state,
        lifted.reach,
        np.ascontiguousarray(lifted.integrated[:, :, 0]),
        price,
    )
    if part is None:
        return functions
    filtered = design.filtered[: part.components]
    return functions._replace(
        filtered=filtered,
        grams=running_gram(filtered),
        free=np.ascontiguousarray(part.from_state),
        reach=np.ascontiguousarray(part.reach),
        stop=functions.stop[: part.components],
    )


def within_bounds(
    functions: Functions, tied: Tied, z: Array, path_mm: Array, bounds: Bounds
) -> Array:
    """Return the command of a window that keeps its bounds, if possible.

    Parameters
    ----------
    tied : Tied
        Its solution without bounds, which exceeds them. In the coordinates w = L' c, normal = L L',
        the cost is |w - wish|^2: well conditioned even where a rest leaves few samples.
    z : ndarray, shape (nz,)
        Member states and the last two commands.
    path_mm : ndarray, shape (window,)
        Planned positions, on which the command stands in the rests.
    bounds : Bounds
        Kept if possible; the caller checks.
    """
    command, rows, low, high = tied.command, tied.pinned, tied.values, tied.values
    last, previous = float(z[-2]), float(z[-1])
    taken = np.zeros((3, len(path_mm)), bool)
    table, one = bounds.table(), np.eye(len(tied.wish))
    while True:
        # Add constraints where the command exceeds its bounds, and repeat for the new command.
        more = constraints_at(
            command,
            tied.fixed,
            last,
            previous,
            table,
            tied.factor,
            functions.summed,
            tied.moving,
            tied.ends,
            taken,
        )
        if len(more[0]) == 0:
            return command
        rows, low, high = map(np.concatenate, zip((rows, low, high), more, strict=True))
        kinds = np.zeros(len(rows), np.int32)
        kinds[: len(tied.values)] = _EQUAL
        found, _, flag, _ = daqp.solve(one, -tied.wish, rows, high, low, kinds)
        if flag <= 0:
            # Infeasible; the caller notices and uses a gentler design.
            return tied.command
        command = command_of(
            tied.factor, found, functions.basis, tied.moving, last, previous, path_mm
        )
        if bounds.kept(Extremes.of(command, last, previous)):
            return command
