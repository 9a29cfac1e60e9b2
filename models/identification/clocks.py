"""Which axis follows its command later than the other, by the clocks of Klipper's logs.

A log begins with the first move of the test (klippy/extras/adxl345.py and resonance_tester.py,
2026-08-07), so it says how late the axis followed. That includes the sensor's own delay, which is
that of both axes; the rest comes from guides that damp motion, and would shear corners where it
differs between the axes. Alignment cannot see it: it places every start where slow motion is on
time.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import expit

from stillpath.models.arrays import Array
from stillpath.models.identification.excitation import regenerate
from stillpath.models.identification.prompt import delay_of, delayed
from stillpath.models.identification.types import (
    AccelerationLog,
    Axis,
    AxisIdentification,
    Excitation,
    FrequencyResponse,
)
from stillpath.models.plant_specs import RelativeModesSpec
from stillpath.models.plants import ParametricMembers, PlantSetSpec, PlantSpec, frequency_response
from stillpath.models.schedule import AxisSchedule

__all__ = ["Lateness", "lateness", "timed"]

_BANDS, _LOWEST_HZ = ((0.3, 0.5), (0.5, 0.8), (0.8, 1.2), (1.2, 1.6)), 8.0
"""Frequencies over that of the strongest response in which phases are compared."""
_ALIKE, _ALIKE_S = 3, 0.12e-3
"""How many bands must show the same difference between the axes, and how closely. A wrong mode
delays some of them only (docs/tried.md)."""
_AGREE_S = 0.5e-3
"""Largest distance of a log from the median of its axis: alignment may miss by a whole swing."""
_LEAST_APART_S, _MOST_APART_S = 0.05e-3, 1.5e-3
"""Differences between the axes that matter and are plausible."""
_FRICTION_DELAY, _FRICTION_UNKNOWN = 8.0, 0.07
"""Delay of the fundamental by friction, in c over accel_per_hz (`friction`), and the share of it
that a friction of another kind (LuGre instead of Dahl) makes unsure: five printers without viscous
guides, by somebody else, told .09 to .2 ms with friction of 3 to 21 um (2026-11-29)."""
_USUAL_S = 0.25e-3
"""Typical difference between the axes: guides that take a fifth of the damping at 40 Hz. Every
second machine is assumed to have none (rolling guides): a command that leads where nothing is late
shears corners as much as one that does not lead where something is."""
_LEAST_PLANTS = 3
"""How many plants of a set must tell a difference; by no more than what is usual may they differ.
On 65 virtual printers (2026-11-29) 2 plants told .13 to .2 ms three times where there was none, and
one difference of .73 ms instead of .1, for which plants told .1 to 1.03 (the others: sd to .16)."""
_SAME_RATE = 1.2
_STOP_S = 0.2
"""Longest braking after the test, which is in the log too: from 90 mm/s at 500 mm/s^2. Shake&Tune
(2025-04) records at least 0.25 s more, and begins before the test by the time that its host takes
to set up the sensor, which differs from run to run."""


@dataclass(frozen=True, slots=True)
class Lateness:
    """How late an axis follows in a log.

    Attributes
    ----------
    late_s : ndarray, shape (bands,)
        Against a test that begins with the log, by band; NaN where nothing was measured. The
        sensor's delay is in it.
    interval_s : float
        Between samples: the log begins anywhere within one of them after the test.
    whole : bool
        Whether the log has the length of the test, so that it does begin with it.
    by_plant_s : ndarray, shape (plants, bands)
        The same against each plant of the set; none: there is no other.
    unsure_s : float
        Standard deviation of what all logs of the axis have in common, by its friction.
    """

    late_s: Array
    interval_s: float
    whole: bool
    by_plant_s: Array = field(default_factory=lambda: np.zeros((0, len(_BANDS))))
    unsure_s: float = 0.0


def lateness(
    log: AccelerationLog,
    test: Excitation,
    started_s: float,
    response: FrequencyResponse,
    plant: PlantSpec,
    others: Sequence[PlantSpec] = (),
    friction_mm: float = 0.0,
) -> Lateness:
    """Return how late an axis follows, against a plant that does not delay slow motion.

    Parameters
    ----------
    others : sequence of PlantSpec
        The set: what else explains the logs.
    started_s : float
        Start of the test, on the clock of the log, to which `response` refers.
    friction_mm : float
        By how much dry friction holds the axis back, which was removed from the response.
    """
    interval_s = float(np.median(np.diff(log.time_s)))
    began_s = float(log.time_s[0]) - 0.5 * interval_s
    beyond_s = float(log.time_s[-1] - log.time_s[0]) - regenerate(test).duration_s
    whole = -2.0 * interval_s <= beyond_s <= _STOP_S
    lags_s = np.array([_lags_s(response, one) for one in (plant, *others)])
    late_s = started_s - began_s + lags_s
    delay_s = _FRICTION_DELAY * friction_mm / test.accel_per_hz_mm_s
    return Lateness(late_s[0], interval_s, whole, late_s[1:], _FRICTION_UNKNOWN * delay_s)


def timed(
    found: Mapping[Axis, AxisIdentification], late: Mapping[Axis, Sequence[Lateness]]
) -> dict[Axis, AxisIdentification]:
    """Delay the plants of the axis that follows later, if the logs tell which.

    Logs must agree within an axis. Those that do not begin with the test tell nothing, nor do
    sensors of different rates, which have delays of their own. What the phases say depends on the
    plant that they are compared with, so the plants of the set must agree, too.
    """
    known = {axis: _agreeing(late.get(axis, ())) for axis in ("x", "y")}
    if not all(known.values()):
        return dict(found)
    x_s, y_s = (np.median([one.late_s for one in known[axis]], axis=0) for axis in ("x", "y"))
    intervals_s = [one.interval_s for logs in known.values() for one in logs]
    apart_s = _alike(y_s - x_s)
    if max(intervals_s) > _SAME_RATE * min(intervals_s) or apart_s is None:
        return dict(found)
    begins_s = float(np.mean(intervals_s)) * math.sqrt(sum(1 / len(k) for k in known.values()) / 12)
    sd_s = math.hypot(begins_s, *(logs[0].unsure_s for logs in known.values()))
    later: Axis = "y" if apart_s > 0.0 else "x"
    other = "X" if later == "y" else "Y"
    expected_s, unsure_s = _expected(abs(apart_s), sd_s)
    own_s = _at_most_s(y_s if later == "y" else x_s)
    later_s = min(expected_s, own_s)
    if own_s < _ALIKE_S or not _LEAST_APART_S <= later_s <= _MOST_APART_S:
        return dict(found)
    if not _plants_agree(known[later], x_s if later == "y" else y_s):
        return dict(found)
    one = found[later]
    plants = _later(one.plants, later_s, 2.0 * unsure_s)
    # Leading by it where modes are damped against each other made two of four virtual printers
    # better and two worse (docs/tried.md).
    what = "ranges" if isinstance(plants.nominal, RelativeModesSpec) else "commands"
    note = (
        f"by the clocks of the logs the axis follows {1e3 * delay_of(plants.nominal):.2f} ms later "
        f"than {other}: {what} allow for it"
    )
    schedule = _later_places(one.schedule, later_s)
    notes = (*one.notes, note)
    return {**found, later: replace(one, plants=plants, schedule=schedule, notes=notes)}


def _expected(told_s: float, sd_s: float) -> tuple[float, float]:
    """Return what is to be expected of a difference that logs tell, and its standard deviation.

    Every second machine has none, that of the others is normal (`_USUAL_S`).
    """
    wide_s = math.hypot(sd_s, _USUAL_S)
    odds = math.log(sd_s / wide_s) + 0.5 * told_s**2 * (sd_s**-2 - wide_s**-2)
    likely, share = float(expit(odds)), (_USUAL_S / wide_s) ** 2
    there_s = share * told_s
    variance = likely * (share * sd_s**2 + (1.0 - likely) * there_s**2)
    return likely * there_s, math.sqrt(variance)


def _at_most_s(late_s: Array) -> float:
    """Return the most by which guides may delay an axis that is so late in its own log, by band.

    No axis moves before its command: if the other seems to, this one is not late by that. And it is
    slow motion that guides delay: if only faster bands are late, a mode is wrong (docs/tried.md).
    """
    known_s = late_s[np.isfinite(late_s)]
    return max(0.0, min(float(known_s[0]), float(np.median(known_s))))


def _agreeing(logs: Sequence[Lateness]) -> list[Lateness]:
    """Return the whole logs near their median; none if most are elsewhere."""
    logs = [one for one in logs if one.whole]
    # Above a stiff axis's peak the test may have ended before the last band.
    logs = [one for one in logs if np.count_nonzero(np.isfinite(one.late_s)) >= _ALIKE]
    if not logs:
        return []
    whole_s = np.array([np.nanmedian(one.late_s) for one in logs])
    close = np.abs(whole_s - np.median(whole_s)) <= _AGREE_S
    near = [one for one, is_near in zip(logs, close, strict=True) if is_near]
    return near if 2 * len(near) > len(logs) else []


def _plants_agree(logs: Sequence[Lateness], other_s: Array) -> bool:
    """Return whether the plants of a set tell by how much their axis is later than another.

    Parameters
    ----------
    other_s : ndarray, shape (bands,)
        How late the other axis follows.
    """
    by_plant_s = np.median([one.by_plant_s for one in logs], axis=0)
    if len(by_plant_s) < _LEAST_PLANTS:
        return True
    apart_s = (_alike(late_s - other_s) for late_s in by_plant_s)
    told_s = [one for one in apart_s if one is not None]
    return len(told_s) >= _LEAST_PLANTS and float(np.std(told_s)) <= _USUAL_S


def _later(plants: PlantSetSpec, delay_s: float, unsure_s: float) -> PlantSetSpec:
    members = plants.members
    if not isinstance(members, ParametricMembers):
        members = tuple(
            one.model_copy(update={"plant": delayed(one.plant, delay_s)}) for one in members
        )
    nominal = delayed(plants.nominal, delay_s)
    about = plants.provenance
    if about is not None:
        taken_s = delay_of(nominal)  # less, where an axis has too little damping for all of it
        span_s = (max(0.0, taken_s - unsure_s), taken_s + unsure_s)
        about = about.model_copy(update={"slow_delay_s": span_s})
    return plants.model_copy(
        update={
            "nominal": nominal,
            "members": members,
            "provenance": about,
        }
    )


def _later_places(schedule: AxisSchedule | None, delay_s: float) -> AxisSchedule | None:
    if schedule is None or schedule.grid is None:
        return schedule
    nodes = tuple(
        node.model_copy(update={"plant": delayed(node.plant, delay_s)})
        for node in schedule.grid.nodes
    )
    grid = schedule.grid.model_copy(update={"nodes": nodes})
    return schedule.model_copy(update={"grid": grid})


def _alike(apart_s: Array) -> float | None:
    """Return the mean of the bands whose values lie closest together; None if they differ."""
    rising = np.sort(apart_s[np.isfinite(apart_s)])
    if len(rising) < _ALIKE:
        return None
    widths = rising[_ALIKE - 1 :] - rising[: len(rising) - _ALIKE + 1]
    first = int(np.argmin(widths))
    if not widths[first] <= _ALIKE_S:
        return None
    return float(rising[first : first + _ALIKE].mean())


def _lags_s(response: FrequencyResponse, plant: PlantSpec) -> Array:
    """Return the delay that explains best the phase of a response over that of a plant, by band."""
    own = frequency_response(plant, response.f_hz)
    peak_hz = float(response.f_hz[np.argmax(np.abs(own))])
    w = 2.0 * np.pi * response.f_hz
    phase = np.unwrap(np.angle(response.response / own))
    lags = []
    for low, high in _BANDS:
        near = response.f_hz >= max(_LOWEST_HZ, low * peak_hz)
        near &= response.f_hz <= high * peak_hz
        weight = (response.coherence * w)[near] ** 2
        total = float(np.sum(weight))
        lags.append(-np.sum(weight * (phase / w)[near]) / total if total > 0.0 else np.nan)
    return np.array(lags)
