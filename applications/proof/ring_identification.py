"""What a ring test measured of each axis, so that plants can be identified from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from stillpath.applications.proof.ring_log import AxisLog, misplaced, place, read_axis, unusable
from stillpath.applications.proof.ring_motion import RATE_HZ, RingMotion, ring_motion
from stillpath.applications.proof.ring_test import AXES, Axis
from stillpath.models.arrays import Array
from stillpath.models.errors import ModelError
from stillpath.models.identification.types import AccelerationLog, StopsLog
from stillpath.models.machine import Machine
from stillpath.models.runs import runs

__all__ = ["stops_of"]

_SHORTEST_S = 0.5
_FEWEST_STOPS = 8
_GAINS, _CORRELATED = (0.4, 2.5), 0.5
"""Of a sensor on what moves, with plants that may be far off."""
_LEAD = round(0.06 * RATE_HZ)
"""Time by which a compensated move begins before its line. Until then the axis creeps."""


def stops_of(
    content: bytes, name: str, logs: Sequence[AccelerationLog], machine: Machine
) -> list[list[StopsLog]]:
    """Return the stops of each axis that each log shows.

    Parameters
    ----------
    content, name : bytes, str
        The ring test as it was printed, and its name for messages.
    logs : sequence of AccelerationLog
        Each may hold one axis or both.
    machine : Machine
        With the limits under which it was printed. Its plants only tell where in the test a log
        belongs, from 2 to 22 Hz.

    Raises
    ------
    GcodeError, ModelError
        If the file cannot be read, a log is not of it, or none shows an axis.
    """
    motion = ring_motion(content, name, machine)
    predicted = np.stack([motion.predicted(axis, machine.axes[axis].nominal) for axis in AXES])
    read = [_read(log, motion, predicted) for log in logs]
    unknown = [
        f"{axis.upper()} is not measured, its plants stay: "
        f"{'; '.join(one.reasons[axis] for one in read)}"
        for axis in AXES
        if not any(axis in one.felt for one in read)
    ]
    if len(unknown) == len(AXES):
        raise ModelError("; ".join(unknown))
    return [
        [_stops(log, felt, motion, axis, unknown) for axis, felt in one.felt.items()]
        for log, one in zip(logs, read, strict=True)
    ]


@dataclass(slots=True)
class _Read:
    """The axes of a log, and why it says nothing of others."""

    felt: dict[Axis, AxisLog] = field(default_factory=dict)
    reasons: dict[Axis, str] = field(default_factory=dict)


def _read(log: AccelerationLog, motion: RingMotion, predicted: Array) -> _Read:
    signal, found = place(log, predicted)
    if reason := misplaced(log.source, found):
        raise ModelError(f"{reason}; give the logs of this ring test, and its machine")
    read = _Read()
    for row, axis in zip(predicted, AXES, strict=True):
        felt = read_axis(log, signal, found, motion, row, axis)
        # How well the motion follows is judged with the plants that will be found, not with these.
        reason = unusable(log.source, felt, axis, gains=_GAINS, correlated=_CORRELATED)
        if felt is not None and not reason:
            reason = _too_few(log, felt, motion, axis)
        if felt is None or reason:
            read.reasons[axis] = reason
        else:
            read.felt[axis] = felt
    return read


def _too_few(log: AccelerationLog, felt: AxisLog, motion: RingMotion, axis: Axis) -> str:
    if felt.within >= _FEWEST_STOPS and _whole_parts(felt, motion, axis):
        return ""
    return (
        f"{log.source} shows {felt.within} stops of {axis.upper()}, and {_FEWEST_STOPS} are "
        "needed: log the whole file"
    )


def _stops(
    log: AccelerationLog, felt: AxisLog, motion: RingMotion, axis: Axis, notes: Sequence[str]
) -> StopsLog:
    return StopsLog(
        RATE_HZ,
        motion.planned_mm[AXES.index(axis)],
        felt.measured,
        _whole_parts(felt, motion, axis),
        axis,
        log.source,
        (*log.notes, *notes),
    )


def _whole_parts(felt: AxisLog, motion: RingMotion, axis: Axis) -> tuple[tuple[int, int], ...]:
    """Return the parts of an axis that are in the log from their beginning to their end."""
    parts = [
        (max(first - _LEAD, 0), end)
        for first, end in runs(motion.about[axis])
        if end - first >= _SHORTEST_S * RATE_HZ
    ]
    return tuple((first, end) for first, end in parts if felt.inside[first:end].all())
