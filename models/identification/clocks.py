"""Which axis follows its command later than the other, by the clocks of Klipper's logs.

A log begins with the first move of the test (klippy/extras/adxl345.py and resonance_tester.py,
2026-08-07), so it says how late the axis followed. That includes the sensor's own delay, which is
that of both axes; the rest comes from guides that damp motion, and would shear corners where it
differs between the axes. Alignment cannot see it: it places every start where slow motion is on
time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stillpath.models.arrays import Array
from stillpath.models.identification.excitation import regenerate
from stillpath.models.identification.prompt import delayed
from stillpath.models.identification.types import (
    AccelerationLog,
    Axis,
    AxisIdentification,
    Excitation,
    FrequencyResponse,
)
from stillpath.models.plants import ParametricMembers, PlantSetSpec, PlantSpec, frequency_response

__all__ = ["Lateness", "lateness", "timed"]

_BAND, _LOWEST_HZ = (0.5, 1.6), 8.0
"""Frequencies over that of the strongest response at which phases are compared. Friction delays
slower motion, and noise hides faster."""
_AGREE_S = 0.5e-3
"""Largest distance of a log from the median of its axis: alignment may miss by a whole swing."""
_MOST_APART_S = 1.5e-3
"""Largest plausible difference between the axes."""
_STOP_S = 0.03
"""Longest braking after the test, which is in the log too."""
_TOLD_S = 0.05e-3


@dataclass(frozen=True, slots=True)
class Lateness:
    """How late an axis follows in a log.

    Attributes
    ----------
    late_s : float
        Against a test that begins with the log. The sensor's delay is in it.
    whole : bool
        Whether the log has the length of the test, so that it does begin with it.
    """

    late_s: float
    whole: bool


def lateness(
    log: AccelerationLog,
    test: Excitation,
    started_s: float,
    response: FrequencyResponse,
    plant: PlantSpec,
) -> Lateness:
    """Return how late an axis follows, against a plant that does not delay slow motion.

    Parameters
    ----------
    started_s : float
        Start of the test, on the clock of the log, to which `response` refers.
    """
    interval_s = float(np.median(np.diff(log.time_s)))
    # The first sample lies anywhere within an interval after the start.
    began_s = float(log.time_s[0]) - 0.5 * interval_s
    beyond_s = float(log.time_s[-1] - log.time_s[0]) - regenerate(test).duration_s
    whole = -2.0 * interval_s <= beyond_s <= _STOP_S
    return Lateness(started_s - began_s + _lag_s(response, plant), whole)


def timed(
    found: Mapping[Axis, AxisIdentification], late: Mapping[Axis, Sequence[Lateness]]
) -> dict[Axis, AxisIdentification]:
    """Delay the plants of the axis that follows later, if the logs tell which.

    Logs must agree within an axis. They may begin before the test, all alike, if there are two of
    each axis.
    """
    known = {axis: _agreeing(late.get(axis, ())) for axis in ("x", "y")}
    if not all(known.values()) or not all(
        len(logs) > 1 or logs[0].whole for logs in known.values()
    ):
        return dict(found)
    x_s, y_s = (float(np.mean([one.late_s for one in known[axis]])) for axis in ("x", "y"))
    later_s = abs(y_s - x_s)
    if later_s > _MOST_APART_S:
        return dict(found)
    later: Axis = "y" if y_s > x_s else "x"
    one = found[later]
    notes = one.notes
    if later_s >= _TOLD_S:
        other = "X" if later == "y" else "Y"
        note = f"by the clocks of the logs the axis follows {1e3 * later_s:.2f} ms later than "
        notes = (*notes, f"{note}{other}: commands allow for it")
    return {**found, later: replace(one, plants=_later(one.plants, later_s), notes=notes)}


def _agreeing(logs: Sequence[Lateness]) -> list[Lateness]:
    """Return the logs near their median; none if most are elsewhere."""
    middle_s = float(np.median([one.late_s for one in logs])) if logs else 0.0
    near = [one for one in logs if abs(one.late_s - middle_s) <= _AGREE_S]
    return near if 2 * len(near) > len(logs) else []


def _later(plants: PlantSetSpec, delay_s: float) -> PlantSetSpec:
    members = plants.members
    if not isinstance(members, ParametricMembers):
        members = tuple(
            one.model_copy(update={"plant": delayed(one.plant, delay_s)}) for one in members
        )
    nominal = delayed(plants.nominal, delay_s)
    return plants.model_copy(update={"nominal": nominal, "members": members})


def _lag_s(response: FrequencyResponse, plant: PlantSpec) -> float:
    """Return the delay that explains the phase of a response over that of a plant best."""
    own = frequency_response(plant, response.f_hz)
    peak_hz = float(response.f_hz[np.argmax(np.abs(own))])
    low_hz, high_hz = max(_LOWEST_HZ, _BAND[0] * peak_hz), _BAND[1] * peak_hz
    near = (response.f_hz >= low_hz) & (response.f_hz <= high_hz)
    w: Array = 2.0 * np.pi * response.f_hz[near]
    phase = np.unwrap(np.angle(response.response[near] / own[near]))
    trust = response.coherence[near] ** 2
    return float(-np.sum(trust * w * phase) / np.sum(trust * w * w))
