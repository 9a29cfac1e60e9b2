"""What a ring test measured of each axis, so that plants can be identified from it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stillpath.applications.proof.ring_log import AxisLog, misplaced, place, read_axis, unusable
from stillpath.applications.proof.ring_motion import RATE_HZ, RingMotion, ring_motion
from stillpath.applications.proof.ring_test import AXES, Axis
from stillpath.models.errors import ModelError
from stillpath.models.identification.types import AccelerationLog, StopsLog
from stillpath.models.machine import Machine
from stillpath.models.runs import runs

__all__ = ["stops_of"]

_SHORTEST_S = 0.5
_FEWEST_STOPS = 4
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
        If the file cannot be read, or a log shows no axis of it.
    """
    motion = ring_motion(content, name, machine)
    predicted = np.stack([motion.predicted(axis, machine.axes[axis].nominal) for axis in AXES])
    return [_stops_in(log, motion, predicted) for log in logs]


def _stops_in(log: AccelerationLog, motion: RingMotion, predicted: np.ndarray) -> list[StopsLog]:
    signal, found = place(log, predicted)
    if reason := misplaced(log.source, found):
        raise ModelError(f"{reason}; give the logs of this ring test, and its machine")
    stops, reasons = [], []
    for row, axis in zip(predicted, AXES, strict=True):
        felt = read_axis(log, signal, found, motion, row, axis)
        reason = unusable(log.source, felt, axis) or _too_few(log.source, felt, axis)
        if reason or felt is None:
            reasons.append(reason)
        else:
            stops.append(_stops(log, felt, motion, axis))
    if not stops:
        raise ModelError("; ".join(reasons))
    return stops


def _too_few(name: str, felt: AxisLog | None, axis: Axis) -> str:
    seen = 0 if felt is None else len([stop for stop in felt.seen if not stop.compensated])
    if seen >= _FEWEST_STOPS:
        return ""
    return (
        f"{name} shows {seen} stops of {axis.upper()} as planned, and {_FEWEST_STOPS} are needed: "
        "log the whole file"
    )


def _stops(log: AccelerationLog, felt: AxisLog, motion: RingMotion, axis: Axis) -> StopsLog:
    planned = motion.planned_mm[AXES.index(axis)]
    parts = [
        (max(first - _LEAD, 0), end)
        for first, end in runs(motion.about[axis])
        if end - first >= _SHORTEST_S * RATE_HZ
    ]
    return StopsLog(
        RATE_HZ,
        planned,
        felt.measured,
        tuple((first, end) for first, end in parts if felt.inside[first:end].all()),
        axis,
        log.source,
        log.notes,
    )
