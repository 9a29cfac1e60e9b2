"""Trials of some seconds of a print with other accelerations and other shapers.

Shaper and plant are both linear, so they commute: each plant's response to the plan is computed
once, and the response to a shaped plan is a few shifted copies of it, needed only at the points
that are measured. Dry friction and ripple do not commute. With them that is for the search of
frequencies only, and errors are those of the shaped plan.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode.firmware.base import Adviser
from stillpath.gcode.plan import plan_moves
from stillpath.gcode.sampler import sample_phases
from stillpath.gcode.types import Phases
from stillpath.models.arrays import Array, Ints
from stillpath.models.machine import Machine
from stillpath.models.schedule import OperatingPoint
from stillpath.models.shaping import AxisShaper, Shaping
from stillpath.pipeline.advising.advice import Advice, Bound, wanted_accel
from stillpath.pipeline.measuring.reference_shaper import shaped_at, spread
from stillpath.pipeline.pacing.excerpts import Excerpt, FileExcerpts
from stillpath.pipeline.shaping import shaped
from stillpath.simulation.machine_response import MachineStream
from stillpath.simulation.measures import PathDistances

__all__ = ["Trial"]

_REST_S = 0.15
_POINTS = 600
"""Points measured for each feature."""


@dataclass(frozen=True, slots=True)
class _Motion:
    """The motion of all excerpts, concatenated with rests between them."""

    path_mm: Array
    feature: NDArray[np.int32]
    """-2 where nothing is printed."""
    bounds: list[tuple[int, int, OperatingPoint]]
    """Range [first, last) of each excerpt, and its operating point."""
    seconds: dict[int, float]
    """Duration of each feature; -2: everything else."""


class Trial:
    """One way to move, ready to be measured under any shaper.

    Parameters
    ----------
    bounds : mapping
        Feature id to the bounds of its acceleration.
    members : sequence
        Of `pipeline.measuring.set_errors.machine_numbers`.
    point : OperatingPoint, optional
        Operating point; None: that of each excerpt.

    Attributes
    ----------
    seconds : dict
        Time of each feature; -2: everything else.
    total_s : float
    """

    def __init__(
        self,
        excerpts: FileExcerpts,
        bounds: Mapping[int, Bound],
        machine: Machine,
        adviser: Adviser,
        dt_s: float,
        members: Sequence[int | None],
        *,
        point: OperatingPoint | None = None,
    ) -> None:
        advice = Advice(bounds, first_layer=excerpts.first_layer)
        motion = _motion(excerpts.excerpts, advice, machine, adviser, dt_s)
        self._dt_s = dt_s
        self._path = motion.path_mm
        self._bounds = [(a, b, p if point is None else point) for a, b, p in motion.bounds]
        self.seconds = motion.seconds
        self.total_s = sum(motion.seconds.values())
        self._distance = PathDistances(self._path, dt_s)
        self._machine, self._members = machine, members
        self._commutes = not (machine.ripple or any(machine.friction_mm))
        self._index = {
            f: spread(np.flatnonzero(motion.feature == f).astype(np.int64), _POINTS)
            for f in np.unique(motion.feature).tolist()
            if f >= -1
        }
        every = [i for i in self._index.values() if len(i)]
        self._at = np.unique(np.concatenate(every)) if every else np.zeros(0, np.int64)

    @property
    def features(self) -> list[int]:
        """Ids of the printed features."""
        return list(self._index)

    def errors(self, shapings: Mapping[OperatingPoint, Shaping] | Shaping) -> dict[int, float]:
        """Return the worst member's rms contour error [um] of every feature.

        Parameters
        ----------
        shapings : Shaping, or mapping of it
            One for all operating points, or one for each.
        """
        at = self._at
        error = self._distances(shapings, at)
        found = {}
        for feature, index in self._index.items():
            rows = error[:, np.searchsorted(at, index)]
            mean = np.sqrt(np.mean(rows**2, axis=1))
            found[feature] = 1e3 * float(np.max(mean))
        return found

    def _distances(self, shapings: Mapping[OperatingPoint, Shaping] | Shaping, at: Ints) -> Array:
        """Return contour errors [mm] at chosen samples, shape (members, len(at))."""
        out = np.empty((len(self._members), len(at)))
        if not self._commutes:
            for row, response in zip(out, self._responses_to(self._command(shapings)), strict=True):
                row[:] = self._distance.at(response[:, at], at)
            return out
        for row, response in zip(out, self._responses, strict=True):
            y = np.empty((2, len(at)))
            if isinstance(shapings, Shaping):
                self._shape(response, shapings, at, y)
            else:
                for first, last, point in self._bounds:
                    part = slice(*np.searchsorted(at, (first, last)).tolist())
                    self._shape(response, shapings[point], at[part], y[:, part])
            row[:] = self._distance.at(y, at)
        return out

    def points(self, count: int, chosen: Sequence[int]) -> Ints:
        """Return sample indices, half from the chosen features and half from the others."""
        halves = [
            [i for f, i in self._index.items() if (f in chosen) is one] for one in (True, False)
        ]
        found = []
        for half in halves:
            if half:
                every = np.unique(np.concatenate(half))
                step = max(1, -(-len(every) * len([h for h in halves if h]) // count))
                found.append(every[::step])
        return np.unique(np.concatenate(found)) if found else np.zeros(0, np.int64)

    def axis_response(self, member: int, axis: int, kind: str, f_hz: float, at: Ints) -> Array:
        """Return one member's positions of one axis at chosen samples, under one shaper."""
        pulses = AxisShaper(kind, f_hz).pulses()
        return shaped_at(self._responses[member][axis], self._dt_s, pulses, at)

    def rms(self, positions: Sequence[tuple[Array, Array]], at: Ints) -> float:
        """Return the rms contour error [mm] of the worst of several motions."""
        worst = 0.0
        for x, y in positions:
            error = self._distance.at(np.stack([x, y]), at)
            worst = max(worst, float(error @ error))
        return float(np.sqrt(worst / max(len(at), 1)))

    def _command(self, shapings: Mapping[OperatingPoint, Shaping] | Shaping) -> Array:
        """Return the shaped plan; every excerpt of it begins and ends at rest."""
        parts = [np.zeros((2, 0))]
        for first, last, point in self._bounds:
            shaping = shapings if isinstance(shapings, Shaping) else shapings[point]
            parts.append(shaped(self._path[:, first:last], shaping, self._dt_s))
        return np.concatenate(parts, axis=1)

    @cached_property
    def _responses(self) -> list[Array]:
        return list(self._responses_to(self._path))

    def _responses_to(self, command_mm: Array) -> Iterator[Array]:
        """Yield every member's positions; ripple and guides are the same for all of them."""
        received_mm = MachineStream(self._machine, self._dt_s).received_mm(command_mm)
        for member in self._members:
            yield self._response(member, received_mm)

    def _response(self, member: int | None, received_mm: Array) -> Array:
        parts = [np.zeros((2, 0))]
        stream: MachineStream | None = None
        for first, last, point in self._bounds:
            if stream is None:
                stream = MachineStream(self._machine, self._dt_s, point, member=member)
            stream.operate_at(point)
            parts.append(stream.respond(received_mm[:, first:last], self._path[:, first:last]))
        return np.concatenate(parts, axis=1)

    def _shape(self, response: Array, shaping: Shaping, at: Ints, out: Array) -> None:
        for axis, shaper in enumerate((shaping.x, shaping.y)):
            out[axis] = shaped_at(response[axis], self._dt_s, shaper.pulses(), at)


def _motion(
    excerpts: Sequence[Excerpt], advice: Advice, machine: Machine, adviser: Adviser, dt_s: float
) -> _Motion:
    paths: list[Array] = []
    features: list[NDArray[np.int32]] = []
    bounds: list[tuple[int, int, OperatingPoint]] = []
    seconds: dict[int, float] = {}
    end, stands_at = 0, np.zeros(2)
    pad = round(_REST_S / dt_s)
    for excerpt in excerpts:
        phases = _planned(excerpt, advice, machine, adviser)
        if len(phases) == 0:
            continue
        numbers = phases.move_index - phases.move_index[0]
        feature = np.where(phases.prints, excerpt.piece.moves.feature[numbers], -2).astype(np.int32)
        duration = phases.lasts_s
        for one in np.unique(feature).tolist():
            seconds[one] = seconds.get(one, 0.0) + float(np.sum(duration[feature == one]))
        total_s = float(phases.t_s[-1] + duration[-1] - phases.t_s[0])
        position, row = sample_phases(phases, (float(phases.t_s[0]), dt_s, round(total_s / dt_s)))
        if position.shape[1] == 0:
            continue
        # Contour errors do not depend on position; joining the excerpts excites no vibration.
        path = position[:2] - position[:2, :1] + stands_at[:, None]
        stands_at = path[:, -1]
        paths.append(np.pad(path, ((0, 0), (pad, pad)), mode="edge"))
        features.append(np.pad(feature[row], pad, constant_values=-2))
        first, end = end, end + paths[-1].shape[1]
        bounds.append((first, end, excerpt.point))
    if not paths:
        return _Motion(np.zeros((2, 0)), np.zeros(0, np.int32), [], seconds)
    return _Motion(np.concatenate(paths, axis=1), np.concatenate(features), bounds, seconds)


def _planned(excerpt: Excerpt, advice: Advice, machine: Machine, adviser: Adviser) -> Phases:
    """Plan an excerpt with the advised accelerations."""
    piece = excerpt.piece
    moves = piece.moves
    wanted, file = wanted_accel(moves, piece.limits, advice, adviser)
    changed = np.flatnonzero(~np.isnan(wanted) & (wanted != file))
    if not len(changed):
        return piece.phases
    pairs = list(zip(moves.limits_id[changed].tolist(), wanted[changed].tolist(), strict=True))
    numbers = {pair: len(piece.limits) + n for n, pair in enumerate(dict.fromkeys(pairs))}
    limits = [*piece.limits, *(adviser.with_accel(piece.limits[k], a) for k, a in numbers)]
    limits_id = moves.limits_id.copy()
    limits_id[changed] = [numbers[pair] for pair in pairs]
    return plan_moves(replace(moves, limits_id=limits_id), limits, machine)
