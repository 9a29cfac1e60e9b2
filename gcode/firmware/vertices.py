"""Place the vertices of a stream on whole steps: which ones, where and when.

`_vertex_kernels.py` describes the method.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode._segment_kernels import path_directions
from stillpath.gcode.firmware._vertex_kernels import (
    MOST_PLACES,
    Places,
    Response,
    Rules,
    choose_vertices,
    list_places,
)
from stillpath.gcode.segments import ErrorFilter, Segments
from stillpath.gcode.timeline import Timeline

__all__ = ["Lattice", "steps_within", "vertices_on_steps"]

_FILAMENT_MM = 0.01
"""Filament error that counts as much as a step of X."""
_OFTEN_S, _FINE_MM = 4e-3, 2.5e-3
"""Largest spacing of vertices on straight lines, so that errors average out, up to this tolerance;
above it they are farther apart in proportion."""


@dataclass(frozen=True, slots=True)
class Lattice:
    """Grid of a machine's vertices, and constraints on its moves.

    Attributes
    ----------
    per_mm : ndarray, shape (4,)
        Steps per mm of X Y Z E.
    low, high : ndarray of int64, shape (2,)
        First and last step of X and Y.
    least : int
        Fewest steps of a move.
    corexy : bool
        The motors are A = X + Y and B = X - Y.
    speed_step_mm_s : float
        Largest step of a motor's speed.
    spare_steps : float
        Steps within a segment that rounding may add to that.
    accel_mm_s2 : float
        Largest acceleration that moves ask for.
    moves_per_s : float
        Rate at which moves arrive.
    fast_mm_s, fast_accel_mm_s2 : float
        Moves with a motor speed above `fast_mm_s` should need no more than `fast_accel_mm_s2`.
    """

    per_mm: NDArray[np.float64]
    low: NDArray[np.int64]
    high: NDArray[np.int64]
    least: int
    corexy: bool
    speed_step_mm_s: float
    spare_steps: float
    accel_mm_s2: float
    moves_per_s: float
    fast_mm_s: float = np.inf
    fast_accel_mm_s2: float = np.inf

    def rules(self, dt_s: float) -> Rules:
        """Return the constraints on moves in steps and samples."""
        scale, step, step2 = self.per_mm, self.per_mm[0] * dt_s, self.per_mm[0] * dt_s**2
        accel, gentle = self.accel_mm_s2, self.fast_accel_mm_s2
        return Rules(
            least=self.least,
            unit=scale[0] / scale[:2],
            step=self.speed_step_mm_s * scale[:2] * dt_s,
            spare=self.spare_steps,
            bend=np.array([accel * step2, gentle * step2, self.fast_mm_s * step]),
            corexy=self.corexy,
        )


def steps_within(
    travel_mm: Sequence[tuple[float, float]], per_mm: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the first and the last step of X and Y within their travel.

    Parameters
    ----------
    travel_mm : sequence of (float, float)
        Least and largest X, and Y.
    per_mm : ndarray, shape (2 or more,)
    """
    low_mm, high_mm = np.transpose(travel_mm)
    # With a margin for rounding.
    low, high = low_mm * per_mm[:2] - 1e-6, high_mm * per_mm[:2] + 1e-6
    return np.ceil(low).astype(np.int64), np.floor(high).astype(np.int64)


def vertices_on_steps(lattice: Lattice, timeline: Timeline, segments: Segments) -> Segments:
    """Choose vertices in whole steps of X and Y near those of a fit.

    Parameters
    ----------
    segments : Segments
        At least one, fitted much finer than the steps. Where they have no `error_filter`, all
        errors count alike.

    Returns
    -------
    Segments
        The last vertex of a stretch stays where it is. All moves have `lattice.least` steps, but
        for a stretch where there is no such choice: its vertices are rounded.
    """
    response = _response_of(segments.error_filter)
    direction = np.empty((2, timeline.position_mm.shape[1]))
    path_directions(timeline.position_mm[:2], direction)
    often_s = _OFTEN_S * max(1.0, segments.tolerance_mm / _FINE_MM)
    often_s = max(often_s, 2.0 / lattice.moves_per_s)
    end_s, end_mm, groups = [], [], []
    for group, rows in segments.stretches():
        at_s = np.append(timeline.start_s[group], segments.end_s[rows])
        at_mm = np.vstack([timeline.group_start_mm[group], segments.end_mm[:, rows].T])
        at_s, at_mm = _often(lattice, at_s, at_mm, often_s)
        at_s, at_mm = _chosen(lattice, timeline.dt_s, at_s, at_mm, response, direction)
        end_s.append(at_s[1:])
        end_mm.append(at_mm[1:])
        groups.append(np.full(len(at_s) - 1, group, np.int64))
    return replace(
        segments,
        end_s=np.concatenate(end_s),
        end_mm=np.concatenate(end_mm).T.copy(),
        group=np.concatenate(groups),
    )


def _response_of(errors: ErrorFilter | None) -> Response:
    pole, weight, direct = np.zeros((2, 1), complex), np.zeros((2, 1), complex), np.ones(2)
    if errors is not None:
        pole, weight, direct = errors.pole, errors.weight, errors.direct
    # The sum over k of Re(w_a p_a^k x_a) Re(w_b p_b^k x_b) is half of
    # Re(x_a (plain_ab x_b + crossed_ab conj x_b)), with x = 1 and x = i for the two parts.
    energy = []
    for p, w in zip(pole, weight, strict=True):
        plain = 0.5 * np.outer(w, w) / (1.0 - np.outer(p, p))
        crossed = 0.5 * np.outer(w, w.conj()) / (1.0 - np.outer(p, p.conj()))
        unit = np.kron(np.eye(len(p)), [1.0, 1j])
        form = (unit.T @ (plain @ unit + crossed @ unit.conj())).real
        energy.append(0.5 * (form + form.T))
    return Response(_parts(pole), _parts(weight), np.asarray(direct), np.stack(energy))


def _parts(values: NDArray[np.complex128]) -> NDArray[np.float64]:
    return np.ascontiguousarray(values, dtype=complex).view(np.float64)


@dataclass(frozen=True, slots=True)
class _Stretch:
    """A stretch near its start, in samples and steps: sums of squares of large numbers lose digits.

    Attributes
    ----------
    origin : ndarray of int64, shape (2,)
        The step of X and Y that others are counted from.
    first : float
        The sample that others are counted from.
    at : ndarray, shape (n,)
        When the vertices are.
    steps : ndarray, shape (n, 3)
        Where they are: X, Y, and filament as it counts.
    z : ndarray of int64, shape (n,)
    command : ndarray, shape (samples, 3)
        The fit at every sample, as `steps`.
    """

    origin: NDArray[np.int64]
    first: float
    at: NDArray[np.float64]
    steps: NDArray[np.float64]
    z: NDArray[np.int64]
    command: NDArray[np.float64]

    @classmethod
    def of(
        cls,
        per_mm: NDArray[np.float64],
        dt_s: float,
        at_s: NDArray[np.float64],
        at_mm: NDArray[np.float64],
    ) -> _Stretch:
        origin = np.round(at_mm[0, :2] * per_mm[:2]).astype(np.int64)
        near_mm = at_mm - np.array([*(origin / per_mm[:2]), 0.0, at_mm[0, 3]])
        steps = np.column_stack([near_mm[:, :2] * per_mm[:2], near_mm[:, 3] / _FILAMENT_MM])
        first = np.floor(at_s[0] / dt_s)
        at = at_s / dt_s - first
        k = np.arange(int(np.ceil(at[-1])) + 2, dtype=np.float64)
        return cls(
            origin=origin,
            first=first,
            at=at,
            steps=steps,
            z=np.round(at_mm[:, 2] * per_mm[2]).astype(np.int64),
            command=np.column_stack([np.interp(k, at, row) for row in steps.T]),
        )

    @property
    def samples(self) -> NDArray[np.int64]:
        """Number of every sample on the timeline."""
        return np.arange(len(self.command)) + int(self.first)


def _chosen(
    lattice: Lattice,
    dt_s: float,
    at_s: NDArray[np.float64],
    at_mm: NDArray[np.float64],
    response: Response,
    direction: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Vertices of one stretch and its start, times (n,) and places (n, 4)."""
    near, scale, n = _Stretch.of(lattice.per_mm, dt_s, at_s, at_mm), lattice.per_mm, len(at_s)
    heading = direction[:, np.minimum(near.samples, direction.shape[1] - 1)].T.copy()
    places = Places(
        place=np.zeros((n, MOST_PLACES, 2), np.int64),
        at=np.zeros((n, MOST_PLACES)),
        counts=np.zeros(n, np.int64),
        slow=np.zeros(n, np.bool_),
    )
    list_places(
        near.at,
        near.steps[:, :2].copy(),
        near.command,
        near.z,
        lattice.least,
        lattice.corexy,
        lattice.low - near.origin,
        lattice.high - near.origin,
        places,
    )
    chosen = np.zeros(n, np.int64)
    rules = lattice.rules(dt_s)
    if not choose_vertices(places, near.z, near.command, heading, rules, response, chosen):
        at_mm[1:-1, :2] = np.round(at_mm[1:-1, :2] * scale[:2]) / scale[:2]
        return at_s, at_mm
    keep = np.flatnonzero(chosen >= 0)
    which = chosen[keep]
    at_kept = places.at[keep, which]
    kept_mm = np.column_stack([np.interp(at_kept, near.at, row) for row in at_mm.T])
    kept_mm[:, :2] = (places.place[keep, which] + near.origin) / scale[:2]
    kept_mm[[0, -1]] = at_mm[[0, -1]]
    kept_s = (at_kept + near.first) * dt_s
    kept_s[[0, -1]] = at_s[[0, -1]]
    return kept_s, kept_mm


def _often(
    lattice: Lattice, at_s: NDArray[np.float64], at_mm: NDArray[np.float64], often_s: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Put vertices between those of a fit, where both they and the lines have room for them."""
    way = np.abs(np.diff(at_mm, axis=0)) * lattice.per_mm
    hops = way[:, 0] + way[:, 1] if lattice.corexy else np.maximum(way[:, 0], way[:, 1])
    parts = np.ceil(np.minimum(np.diff(at_s) / often_s - 1e-9, hops / (2.0 * lattice.least)))
    parts = np.maximum(parts, 1.0).astype(np.int64)
    index = np.arange(len(at_s), dtype=np.float64)
    before = np.repeat(index[:-1], parts)
    part = np.arange(len(before)) - np.repeat(np.cumsum(parts) - parts, parts)
    finer = np.append(before + part / np.repeat(parts, parts), index[-1])
    return (
        np.interp(finer, index, at_s),
        np.column_stack([np.interp(finer, index, row) for row in at_mm.T]),
    )
