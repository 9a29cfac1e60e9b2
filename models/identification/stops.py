"""The response of an axis from sudden stops: a ring test's plan, and what was felt of it.

Each part of the test begins and ends at rest, so the whole-record transforms of all parts lead to
one response by local least squares. Stops are strong and short: with a few dozen of them the
response is known from 4 Hz to beyond the modes, with its phase but for the clock's offset. The
clock's rate was matched with plants that are not known yet; the right one explains most.

Where the axis reverses, dry friction holds it back on the other side. The stops are so short that
what rings reverses it, too, so the bend of the guides follows the motion as it was felt, or as the
response has it where a noisy log tells less. Motion and size are those of the smallest residual.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq
from scipy.interpolate import CubicSpline

from stillpath.models.arrays import Array
from stillpath.models.errors import ModelError
from stillpath.models.friction import bend_of
from stillpath.models.identification.averaging import low_frequency_delay
from stillpath.models.identification.friction import (
    CLEARLY,
    SIZES_MM,
    beyond_slow,
    lowest_size,
)
from stillpath.models.identification.local_model import (
    LocalResponse,
    Transformed,
    local_response,
    log_residual,
)
from stillpath.models.identification.nozzle import Frame, frame_of
from stillpath.models.identification.types import LEAST_COHERENCE, FrequencyResponse, StopsLog
from stillpath.models.plants import MOST_FRICTION_MM

__all__ = ["Stopped", "responses_of_stops"]

_LOWEST_HZ, _HIGHEST_HZ, _STEP_HZ, _HALF_BAND_HZ = 4.0, 150.0, 0.25, 1.5
_COMPARED_HZ, _COMPARED_STEP_HZ, _COMPARED_HALF_BAND_HZ = (5.0, 60.0), 0.5, 2.0
"""Where friction and clocks show: below and around the mode that rings most."""
_RATES = 2e-5 * np.arange(-25, 26)
"""Errors of the clock's rate that are tried: a millisecond in 50 s apart."""
_LEAST_FOLLOWED = 0.15
_KNOWN = 0.08
"""Standard deviation over response with which a frequency counts as coherent. Above 30 Hz gentle
stops shake an axis little, so that one of them says little, and all of them say it dozens of
times: a coherence of 0.95 would leave most of what is known out."""
_SLOW_HZ, _LEVELS = 12.0, (0.6, 1.6)
"""A sensor may be 16 % off, and a frame excited by reaction adds up to about 30 %."""
_SHAKES = 0.4
"""Damping of a frame, at most: feet have 0.1 to 0.25."""
_RINGS_HZ, _STEEPNESS = 12.0, 8
"""From where on the bend of the guides follows the motion as it was felt."""
_ROUNDS = 2
"""Response and frame are better known once friction is out of them; more rounds change nothing."""


@dataclass(frozen=True, slots=True)
class Stopped:
    """What the stops of one axis say.

    Attributes
    ----------
    responses : list of FrequencyResponse
        Of nozzle over bed, one per log, freed of dry friction.
    held_mm : float
        Distance by which friction holds the axis back; 0 where none is clear.
    frame : Frame, optional
        That was found and taken out.
    """

    responses: list[FrequencyResponse]
    held_mm: float
    frame: Frame | None


def responses_of_stops(
    logs: Sequence[StopsLog], labels: Sequence[str], *, frame_firm: bool = False
) -> Stopped:
    """Return the responses of an axis from the logs of its stops.

    Parameters
    ----------
    labels : sequence of str
        Of the conditions; logs of the same label are repeats.
    frame_firm : bool
        What the sensor feels is what prints (`ReadSettings.frame_firm`).

    Raises
    ------
    ModelError
        If the motion of a log follows its command at few frequencies.
    """
    logs = [_on_time(log) for log in logs]
    received = [log.command_mm for log in logs]
    held_mm, frame = 0.0, None
    for _ in range(_ROUNDS):
        felt = [_response(*row) for row in zip(logs, received, labels, strict=True)]
        frame = None if frame_firm else _frame_of(felt, frame)
        held_mm, bends = _held_mm(logs, felt, frame)
        received = [log.command_mm - held_mm * b for log, b in zip(logs, bends, strict=True)]
    felt = [_response(*row) for row in zip(logs, received, labels, strict=True)]
    frame = None if frame_firm else _frame_of(felt, frame)
    over_bed = felt if frame is None else [frame.over_bed(one) for one in felt]
    for one in over_bed:
        _check_followed(one)
    return Stopped([_from_start(one) for one in over_bed], held_mm, frame)


def _frame_of(felt: Sequence[FrequencyResponse], near: Frame | None) -> Frame | None:
    """Return the frame that shakes, unless it hardly does: what friction leaves looks like that."""
    frame = frame_of(felt, near=near)
    return None if frame is None or frame.zeta > _SHAKES else frame


def _response(log: StopsLog, received_mm: Array, label: str) -> FrequencyResponse:
    """Return the response of the acceleration to what the axis receives."""
    count = round((_HIGHEST_HZ - _LOWEST_HZ) / _STEP_HZ)
    f_hz = np.asarray(_LOWEST_HZ + _STEP_HZ * np.arange(count), np.float64)
    found = _fitted(log, received_mm, f_hz, _HALF_BAND_HZ)
    # Second differences are means over two intervals, weighted by a triangle.
    undone = np.sinc(f_hz / log.rate_hz) ** 2
    return FrequencyResponse(
        f_hz,
        found.response * undone,
        found.sd * undone,
        _as_coherence(found),
        axis=log.axis,
        label=label,
        source=log.source,
        notes=log.notes,
    )


def _as_coherence(found: LocalResponse) -> Array:
    """Return the coherence that stands for how well the response is known, shape (n,)."""
    unsure = found.sd / np.maximum(np.abs(found.response), 1e-12) / _KNOWN
    return np.asarray(1.0 / (1.0 + (1.0 / LEAST_COHERENCE - 1.0) * unsure**2), np.float64)


def _on_time(log: StopsLog) -> StopsLog:
    """Return the log with the rate of its clock that leaves the smallest residual."""
    time_s = np.arange(len(log.measured_mm_s2)) / log.rate_hz
    middle_s = time_s[log.parts[0][0]] / 2 + time_s[log.parts[-1][1] - 1] / 2
    spline = CubicSpline(time_s, log.measured_mm_s2)

    def timed(rate: float) -> StopsLog:
        return replace(log, measured_mm_s2=spline(time_s + rate * (time_s - middle_s)))

    left = np.array([_unexplained(timed(rate), log.command_mm) for rate in _RATES])
    best = int(np.clip(np.argmin(left), 1, len(_RATES) - 2))
    before, here, after = left[best - 1 : best + 2]
    bend = before - 2.0 * here + after
    between = 0.5 * (before - after) / bend if bend > 0.0 else 0.0
    return timed(float(_RATES[best] + between * (_RATES[1] - _RATES[0])))


def _unexplained(log: StopsLog, received_mm: Array) -> float:
    """Return the mean log residual of what was felt, given what the axis receives."""
    f_hz = np.arange(*_COMPARED_HZ, _COMPARED_STEP_HZ)
    found = _fitted(log, received_mm, f_hz, _COMPARED_HALF_BAND_HZ)
    return float(log_residual(found.coherence).mean())


def _fitted(log: StopsLog, received_mm: Array, f_hz: Array, half_band_hz: float) -> LocalResponse:
    accel = np.pad(np.diff(received_mm, 2), 1) * log.rate_hz**2
    records = [
        _transformed(accel[first:end], log.measured_mm_s2[first:end], log.rate_hz)
        for first, end in log.parts
    ]
    return local_response(records, f_hz, half_band_hz)


def _transformed(command: Array, measured: Array, rate_hz: float) -> Transformed:
    """Transform a part, with bins whose noise does not depend on its length."""
    n = len(command)
    size = next_fast_len(n, real=True)
    u, y = (rfft(row - row.mean(), size) / np.sqrt(n) for row in (command, measured))
    return Transformed(rate_hz / size, u, y)


def _bend(log: StopsLog, felt: FrequencyResponse, frame: Frame | None, *, as_felt: bool) -> Array:
    """Return the bend of the guides along the axis's motion over the frame, shape (n,), -1 to 1.

    The motion is the response's to the command, or from `_RINGS_HZ` on as it was felt, because
    friction bends what rings. Below that a sensor's noise, integrated twice, is micrometres.
    """
    n = len(log.command_mm)
    size = next_fast_len(2 * n, real=True)
    f_hz = rfftfreq(size, 1.0 / log.rate_hz)
    w = 2.0 * np.pi * np.maximum(f_hz, f_hz[1]) / log.rate_hz
    over_bed = felt if frame is None else frame.over_bed(felt)
    accel = rfft(np.pad(np.diff(log.command_mm, 2), 1), size)
    more = beyond_slow(_from_start(over_bed), f_hz) * accel
    if as_felt:
        level = float(np.median(np.abs(over_bed.response[felt.f_hz <= _SLOW_HZ])))
        on_time = np.exp(2j * np.pi * f_hz * _delay_s(felt)) * np.sinc(f_hz / log.rate_hz) ** 2
        measured = rfft(log.measured_mm_s2 / log.rate_hz**2, size) * on_time / level
        if frame is not None:
            measured *= 1 + frame.reaction(f_hz)
        rings = 1.0 / (1.0 + (2.0 * np.pi * _RINGS_HZ / log.rate_hz / w) ** _STEEPNESS)
        more += rings * (measured - accel - more)
    return bend_of(log.command_mm + irfft(-more / w**2, size)[:n], 1.0 / log.rate_hz)


def _delay_s(response: FrequencyResponse) -> float:
    """Return the delay of a response at low frequency, which is the clock's."""
    known = response.coherence >= LEAST_COHERENCE
    if not known.any():
        return 0.0
    return low_frequency_delay(response.f_hz[known], response.response[known])


def _from_start(response: FrequencyResponse) -> FrequencyResponse:
    """Return a response without that delay."""
    turn = np.exp(2j * np.pi * response.f_hz * _delay_s(response))
    return replace(response, response=response.response * turn)


def _held_mm(
    logs: Sequence[StopsLog], felt: Sequence[FrequencyResponse], frame: Frame | None
) -> tuple[float, list[Array]]:
    """Return the size of friction that explains the logs best, and the bends; 0 if none is clear.

    Guides rub on the frame, but what is taken for one may be none, and what rings may be lost in a
    noisy log: of the motions that the axis may have made, the one that explains most counts.
    """
    best, least = (0.0, [np.zeros(len(log.command_mm)) for log in logs]), -CLEARLY
    for shaken in (None,) if frame is None else (None, frame):
        for as_felt in (True, False):
            bends = [
                _bend(log, one, shaken, as_felt=as_felt)
                for log, one in zip(logs, felt, strict=True)
            ]
            left = _left(logs, bends)
            if left.min() - left[0] < least:
                least = float(left.min() - left[0])
                best = (min(lowest_size(left), MOST_FRICTION_MM), bends)
    return best


def _left(logs: Sequence[StopsLog], bends: Sequence[Array]) -> Array:
    """Return what is unexplained with friction of `SIZES_MM`, the mean over the logs."""
    every = [
        [_unexplained(log, log.command_mm - size_mm * bend) for size_mm in SIZES_MM]
        for log, bend in zip(logs, bends, strict=True)
    ]
    return np.asarray(np.mean(every, axis=0), np.float64)


def _check_followed(response: FrequencyResponse) -> None:
    slow = (response.f_hz <= _SLOW_HZ) & (response.coherence >= LEAST_COHERENCE)
    level = float(np.median(np.abs(response.response[slow]))) if slow.any() else 1.0
    if not _LEVELS[0] <= level <= _LEVELS[1]:
        raise ModelError(
            f"{response.source}: the sensor felt {level:.2f} of the slow motion of axis "
            f"{response.axis}: it is not fixed to the part that moves, or its scale is wrong"
        )
    share = float(np.mean(response.coherence >= LEAST_COHERENCE))
    if share < _LEAST_FOLLOWED:
        raise ModelError(
            f"{response.source}: the response is known within {_KNOWN:.0%} at only {share:.0%} of "
            f"the frequencies (at least {_LEAST_FOLLOWED:.0%} are needed): the stops were too "
            "gentle, the sensor is noisy or loose, or the file was printed with other limits than "
            "the machine says; look at these, and log a ring test with a larger --accel-mm-s2"
        )
