"""Find Klipper's resonance test in an accelerometer log, and the direction of the sensor.

`chirp_search` finds the regenerated command. Here a log is refused that holds no such test, or
another one, and what else it shows of the test is noted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.fft import next_fast_len, rfft, rfftfreq

from stillpath.models.arrays import Array
from stillpath.models.errors import ModelError
from stillpath.models.identification.chirp_search import (
    Placed,
    band_pass,
    best_placed,
    resample,
    sampling_rate_hz,
)
from stillpath.models.identification.excitation import VelocityProfile, regenerate
from stillpath.models.identification.strength import strength
from stillpath.models.identification.types import AccelerationLog, Excitation
from stillpath.models.notes import WarningNote

__all__ = ["AlignedLog", "align", "check_pair"]

_BAND_HZ = 10.0
_LEAST_CORRELATION = 0.6
_LEAST_FRACTION = 0.95  # of the sweep, before a cut log is refused
_LEAST_FIRST_HZ = 0.5  # that of excitations
_EARLIER_S, _FOLLOWS, _LEAST_LEVEL = 0.5, 0.6, 0.3  # of a test that began at a lower frequency
_LATEST_START_S = 0.6  # half a second, plus delays of sensor, plant and time stamps
_LEAD_S = 0.5
_UNSURE_S = 0.01  # of a start, where friction and a frame delay slow motion
_CROSS = 0.2  # of the power along the axis
_AS_STRONG, _STRENGTHS_MM_S = 0.07, 5.0  # the slow sweep tells accel_per_hz within 2 %
_LEAST_COSINE = 0.7  # 45 degrees: nearer to this axis than to another


@dataclass(frozen=True, slots=True, eq=False)
class AlignedLog:
    """Command and measured acceleration of one test, sampled together.

    Attributes
    ----------
    command_mm_s2, measured_mm_s2 : ndarray, shape (n,)
        The command as averages over the sampling interval (`VelocityProfile.cell_averages`), the
        measurement along `direction`; from just before the test to its end.
    start_s : float
        Start of the test on the clock of the log. Delays of sensor and machine are in it.
    f_reached_hz : float
        Where the record ends in the sweep.
    direction : ndarray, shape (3,)
        Unit vector of the tested axis in the sensor's axes.
    correlation : float
        Of command and measurement in the band of alignment, 0 to 1.
    excitation : Excitation
        The test as the log shows it.
    """

    rate_hz: float
    command_mm_s2: Array
    measured_mm_s2: Array
    start_s: float
    f_reached_hz: float
    direction: Array
    correlation: float
    excitation: Excitation
    notes: tuple[str, ...] = ()


def align(
    log: AccelerationLog,
    excitation: Excitation,
    *,
    sensor_direction: ArrayLike | None = None,
    is_strength_known: bool = True,
) -> AlignedLog:
    """Find the test in the whole of `log`, its start and the sensor's direction.

    A test without the slow square wave may be that of before 2024-12 (`out_and_back`), whatever
    the date: the log shows it.

    Parameters
    ----------
    is_strength_known : bool
        Whether accel_per_hz is that of `excitation`; else the log may show another one, if it has
        the slow square wave.
    sensor_direction : array_like, shape (3,), optional
        Direction of the tested axis in the sensor's axes, if the mounting is known: the log of
        another axis is then refused.

    Raises
    ------
    ModelError
        If the test is not in the log (another sweep, a sensor that does not move with the axis, a
        resonance within 10 Hz above the start of the sweep, where the axis must still follow),
        is there twice, lacks its start or its end, or if the axis is not the one that was asked
        for.
    """
    grid_s, accel = resample(log)
    rate_hz = sampling_rate_hz(grid_s)
    found = _find(log, excitation, grid_s, accel)
    profile, start_s, command = found.profile, found.start_s, found.command
    direction = found.vector / np.linalg.norm(found.vector)
    _check_direction(log, direction, sensor_direction)
    _check_first_frequency(log, found.excitation, grid_s, accel @ direction, start_s)
    f_reached_hz, notes = _check_ends(log, excitation, profile, grid_s, start_s)

    kept = (grid_s >= start_s - _LEAD_S) & (grid_s <= start_s + profile.duration_s)
    along = np.asarray(accel[kept] @ direction, np.float64)
    if not is_strength_known and excitation.sweeping_accel_mm_s2 > 0.0:
        shown = _as_strong(excitation, grid_s[kept] - start_s, command[kept], along, rate_hz)
        if shown is not excitation:
            again = align(log, shown, sensor_direction=sensor_direction)
            return replace(again, notes=(*again.notes, _strength_note(excitation, shown)))
    coupled = _coupling(log, accel[kept], direction, rate_hz, excitation)
    # Klipper begins a log with the first move; before, the machine stood still.
    lead_s = float(grid_s[0]) - (start_s - _LEAD_S)
    rest = round(lead_s * rate_hz) if 0.0 < lead_s <= _LEAD_S + _UNSURE_S else 0
    return AlignedLog(
        rate_hz,
        np.pad(command[kept], (rest, 0)),
        np.pad(along, (rest, 0)),
        start_s,
        f_reached_hz,
        direction,
        found.correlation,
        found.excitation,
        (*notes, *coupled),
    )


def check_pair(x: ArrayLike, y: ArrayLike) -> None:
    """Raise ModelError if the tests of X and Y moved the sensor along the same of its directions.

    The machine's axes are perpendicular: either one axis was measured twice, or the sensor was
    turned in between.
    """
    cosine = abs(float(np.dot(x, y)))
    if cosine > _LEAST_COSINE:
        raise ModelError(
            f"the logs of X and Y both show motion along the sensor direction {_vector(x)}: the "
            "same axis was measured twice, so measure the other one; if the sensor was turned "
            "between the tests, say so (option sensor_turned)"
        )


def _find(log: AccelerationLog, excitation: Excitation, grid_s: Array, accel: Array) -> Placed:
    """Return the test where it fits a log best, of the kind that fits best."""
    _check_axis(log, excitation)
    low_hz = 1.2 * excitation.f_start_hz
    band_hz = (low_hz, min(low_hz + _BAND_HZ, excitation.f_end_hz))
    _check_length(log, grid_s, excitation, band_hz[1])
    found = best_placed(excitation, grid_s, accel, band_hz)
    if found.correlation < _LEAST_CORRELATION:
        raise ModelError(_not_found(log, excitation, accel, found.correlation))
    if found.other_s is not None:
        raise ModelError(
            f"{log.source}: the log holds more than one test: it fits at {found.start_s:.1f} s "
            f"and as well at {found.other_s:.1f} s; give a log of one test"
        )
    return found


def _check_axis(log: AccelerationLog, excitation: Excitation) -> None:
    named = {"x": (1.0, 0.0), "y": (0.0, 1.0)}.get(log.axis or "")
    if named is None:
        return
    cosine = abs(float(np.dot(named, excitation.direction)))
    if cosine < _LEAST_COSINE:
        raise ModelError(
            f"{log.source}: the file is a test of axis {log.axis}, but the direction "
            f"({excitation.direction[0]:g}, {excitation.direction[1]:g}) was asked for; "
            "name the axis of the file"
        )


def _check_length(
    log: AccelerationLog, grid_s: Array, excitation: Excitation, band_end_hz: float
) -> None:
    span_s = float(grid_s[-1] - grid_s[0])
    needed_s = (band_end_hz - excitation.f_start_hz) / excitation.hz_per_s
    if span_s < needed_s:
        total_s = (excitation.f_end_hz - excitation.f_start_hz) / excitation.hz_per_s
        raise ModelError(
            f"{log.source}: the log is {span_s:.1f} s long, too short to find a test of "
            f"{total_s:.0f} s in it; record the whole test"
        )


def _check_direction(
    log: AccelerationLog, direction: Array, sensor_direction: ArrayLike | None
) -> None:
    if sensor_direction is None:
        return
    expected = np.asarray(sensor_direction, np.float64)
    cosine = abs(float(direction @ expected)) / float(np.linalg.norm(expected))
    if cosine < _LEAST_COSINE:
        raise ModelError(
            f"{log.source}: the sensor moved along {_vector(direction)}, not along "
            f"{_vector(expected)} as its mounting says: another axis was measured, or the sensor "
            "is mounted otherwise; measure the axis again or correct the sensor's axes"
        )


def _as_strong(
    excitation: Excitation, since_s: Array, command: Array, along: Array, rate_hz: float
) -> Excitation:
    """Return the test with accel_per_hz as a log shows it; the same one if that is so."""
    alone = regenerate(replace(excitation, sweeping_accel_mm_s2=0.0))
    pulses = alone.cell_averages(since_s, 1.0 / rate_hz)
    ratio = strength(command - pulses, pulses, along, rate_hz, excitation.f_start_hz)
    if abs(np.log(ratio)) <= _AS_STRONG:
        return excitation
    # Repeats must be of one strength, and most people choose a multiple of five.
    shown_mm_s = _STRENGTHS_MM_S * max(
        1.0, round(ratio * excitation.accel_per_hz_mm_s / _STRENGTHS_MM_S)
    )
    return replace(excitation, accel_per_hz_mm_s=shown_mm_s)


def _strength_note(assumed: Excitation, shown: Excitation) -> str:
    return (
        f"accel_per_hz {shown.accel_per_hz_mm_s:g} instead, as the log shows beside its slow sweep "
        f"of {assumed.sweeping_accel_mm_s2:g} mm/s^2"
    )


def _check_first_frequency(
    log: AccelerationLog, excitation: Excitation, grid_s: Array, along: Array, start_s: float
) -> None:
    """Refuse a test that began with the log, at a lower frequency than `excitation` says.

    Its pulses are those of `excitation` later on, but at other times within their periods, which
    looks like friction or damping.
    """
    early_s = start_s - float(grid_s[0])
    first_hz = 0.5 * round(2.0 * (excitation.f_start_hz - excitation.hz_per_s * early_s))
    if early_s < _EARLIER_S or first_hz < _LEAST_FIRST_HZ:
        return
    rate_hz = sampling_rate_hz(grid_s)
    profile = regenerate(replace(excitation, f_start_hz=first_hz))
    before = grid_s < start_s
    command = profile.cell_averages(grid_s[before] - grid_s[0], 1.0 / rate_hz)
    size = next_fast_len(len(command), real=True)
    passed = band_pass(rfftfreq(size, 1.0 / rate_hz), (0.0, excitation.f_start_hz + 1.0))
    sent, seen = (rfft(v - np.mean(v), size) * passed for v in (command, along[before]))
    both = abs(float(np.real(np.sum(sent.conj() * seen))))
    sent_all, seen_all = (float(np.linalg.norm(v)) for v in (sent, seen))
    # The noise of a rest follows anything, but is weak.
    follows = both >= _FOLLOWS * sent_all * seen_all and both >= _LEAST_LEVEL * sent_all**2
    if follows:
        raise ModelError(
            f"{log.source}: the test began {early_s:.1f} s before it reached "
            f"{excitation.f_start_hz:g} Hz, at {first_hz:g} Hz: give min_freq = {first_hz:g}, as "
            "printer.cfg says"
        )


def _check_ends(
    log: AccelerationLog,
    excitation: Excitation,
    profile: VelocityProfile,
    grid_s: Array,
    start_s: float,
) -> tuple[float, tuple[str, ...]]:
    """Return the frequency that the log reaches, and notes on a small part that is missing."""
    late_s = float(grid_s[0]) - start_s
    if late_s > _LATEST_START_S:
        raise ModelError(
            f"{log.source}: the log begins {late_s:.1f} s after the start of the test, at "
            f"{excitation.f_start_hz + excitation.hz_per_s * late_s:.1f} Hz of the sweep; "
            "record from before its start, or correct min_freq"
        )
    lasted_s = float(grid_s[-1]) - start_s
    f_reached_hz = min(excitation.f_start_hz + excitation.hz_per_s * lasted_s, excitation.f_end_hz)
    if lasted_s >= profile.duration_s - 0.01:
        return f_reached_hz, ()
    if f_reached_hz < _LEAST_FRACTION * excitation.f_end_hz:
        raise ModelError(
            f"{log.source}: the log ends {profile.duration_s - lasted_s:.1f} s before the end of "
            f"the test, at {f_reached_hz:.1f} Hz of {excitation.f_end_hz:g} Hz; record the whole "
            f"test, or give max_freq = {np.floor(f_reached_hz):g} to use what is there"
        )
    return f_reached_hz, (f"the log ends at {f_reached_hz:.1f} Hz of the sweep",)


def _coupling(
    log: AccelerationLog, accel: Array, direction: Array, rate_hz: float, excitation: Excitation
) -> tuple[str, ...]:
    """Return a warning if the sensor moved across the axis too, at frequencies of the test."""
    f_hz = rfftfreq(len(accel), 1.0 / rate_hz)
    swept = (f_hz >= excitation.f_start_hz) & (f_hz <= excitation.f_end_hz)
    spectra = rfft(accel, axis=0)[swept]
    along = float(np.sum(np.abs(spectra @ direction) ** 2))
    share = float(np.sum(np.abs(spectra) ** 2)) / along - 1.0
    if share <= _CROSS:
        return ()
    text = (
        f"across axis {log.axis} the sensor moved with {share:.0%} of the power along it: "
        "the axes are coupled (CoreXY belts of unequal tension?), the frame rocks, or the sensor "
        "is loose; the model describes the motion along the axis alone"
    )
    return (WarningNote(text),)


def _not_found(
    log: AccelerationLog, excitation: Excitation, accel: Array, correlation: float
) -> str:
    """Return why nothing correlates: a dead axis, no motion, or other motion."""
    dead = [name for name, v in zip("xyz", log.accel_mm_s2.T, strict=True) if np.ptp(v) == 0.0]
    if dead:
        return (
            f"{log.source}: the test is not in the log, and accel_{dead[0]} is constant "
            "throughout: that axis of the sensor is dead; check its wiring and measure again"
        )
    moved = float(np.sqrt(np.sum(np.var(accel, axis=0))))
    sent = excitation.accel_per_hz_mm_s * 0.5 * (excitation.f_start_hz + excitation.f_end_hz)
    if moved < 0.1 * sent:
        return (
            f"{log.source}: the sensor saw {moved:.0f} mm/s^2 rms of a test of about "
            f"{sent:.0f} mm/s^2: it does not move with the tested axis (another axis, a bed "
            "whose sensor sits on the toolhead, a loose sensor); measure at the part that moves"
        )
    return (
        f"{log.source}: the test is not in the log: the greatest correlation with a sweep from "
        f"{excitation.f_start_hz:g} to {excitation.f_end_hz:g} Hz at {excitation.hz_per_s:g} Hz/s "
        f"is {correlation:.2f}; check min_freq, max_freq, hz_per_sec and the Klipper version "
        "against printer.cfg (a resonance below 16 Hz would hide it too, and Kalico's speed limit "
        "spoils tests with the slow sweep: leave out its sweeping_period)"
    )


def _vector(direction: ArrayLike) -> str:
    return "({:.2f}, {:.2f}, {:.2f})".format(*np.asarray(direction, float))
