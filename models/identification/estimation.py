"""Frequency responses of measurements: Klipper's resonance test, and any recorded drive."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.fft import next_fast_len, rfft
from scipy.interpolate import CubicSpline
from scipy.signal.windows import tukey

from stillpath.models.arrays import Array
from stillpath.models.errors import ModelError
from stillpath.models.identification.alignment import AlignedLog, align
from stillpath.models.identification.local_model import (
    LocalResponse,
    Transformed,
    bins_needed,
    local_response,
)
from stillpath.models.identification.nozzle import frame_of
from stillpath.models.identification.types import (
    LEAST_COHERENCE,
    AccelerationLog,
    DrivenLog,
    Excitation,
    FrequencyResponse,
)

__all__ = [
    "Progress",
    "check_plateau",
    "estimate_aligned",
    "estimate_driven",
    "estimate_response",
    "plateau_gain",
    "response_at",
]

Progress: TypeAlias = Callable[[str, float], None]
"""Called with a stage ("align", "estimate") and how much of it is done, 0 to 1."""

_HALF_BAND_HZ = 1.0
_STEP_HZ = 0.25
_TAPER = 0.01
_PLATEAU_HZ = (8.0, 15.0)
_PLATEAU_TOLERANCE = 0.22
"""Sensors are up to 15 % off, and a frame on its feet adds some per cent."""
_NOT_MOVING = 0.3
_LEAST_FOLLOWED = 0.15
_DRIFT_S = 0.05
"""Modes delay the upper half of the band by some 10 ms more or less than the lower one."""
_LEVEL_UNKNOWN = "level not checked: nothing between 8 and 15 Hz follows the command"
_WEAKEST_DRIVE = 1e-5
_MOST_POINTS = 4096
_REST = 0.25
_MOST_SD = 0.15
"""Standard deviation, as a share of the response, up to which a drive with transients is used."""


def estimate_response(
    log: AccelerationLog,
    excitation: Excitation,
    *,
    aligned: AlignedLog | None = None,
    label: str = "",
    progress: Progress | None = None,
) -> FrequencyResponse:
    """Return the response of the tested axis from a log of Klipper's resonance test.

    Whole-record transforms of regenerated command and aligned measurement, then local least
    squares in +-1 Hz around every 0.25 Hz between f_start + 1 Hz and 1 Hz below what the log
    reaches. All points are returned; those of coherence below 0.95 are best left out of a fit.

    Parameters
    ----------
    aligned : AlignedLog, optional
        The log as it was aligned already.

    Raises
    ------
    ModelError
        If the test cannot be found in the log (`alignment.align`), the log follows it only at few
        frequencies, or its level is not that of `excitation` (`check_plateau`).
    """
    report = progress or _silent
    report("align", 0.0)
    aligned = aligned or align(log, excitation)
    report("align", 1.0)
    response = estimate_aligned(log, aligned, label=label)
    _check_followed(response, excitation)
    check_plateau(response, excitation)
    report("estimate", 1.0)
    if plateau_gain(response) is None:
        return replace(response, notes=(*response.notes, _LEVEL_UNKNOWN))
    return response


def estimate_aligned(
    log: AccelerationLog, aligned: AlignedLog, *, label: str = ""
) -> FrequencyResponse:
    """Return the response from a log that is aligned already; its level is not checked.

    Raises
    ------
    ModelError
        If the log shows too little of the sweep, or too few samples per second.
    """
    first, last = aligned.excitation.f_start_hz + 1.0, aligned.f_reached_hz - 1.0
    if last < first + 1.0:
        raise ModelError(
            f"{log.source}: the log reaches {aligned.f_reached_hz:.1f} Hz of the sweep only; "
            "record the whole test"
        )
    shown_hz = 0.5 * aligned.rate_hz
    if shown_hz <= aligned.f_reached_hz:
        raise ModelError(
            f"{log.source}: {aligned.rate_hz:g} samples per s show less than {shown_hz:g} Hz, and "
            f"the test goes to {aligned.f_reached_hz:g} Hz; set a higher rate of the sensor, or "
            f"give max_freq = {shown_hz - 2.0:.0f} to use what is there"
        )
    f_hz = np.arange(np.ceil(first / _STEP_HZ), np.floor(last / _STEP_HZ) + 1) * _STEP_HZ
    found = response_at(aligned, f_hz)
    # The command is known as averages over sampling intervals, the sensor's data as points.
    undone = np.sinc(f_hz / aligned.rate_hz)
    notes = (*log.notes, *aligned.notes)
    return FrequencyResponse(
        f_hz,
        found.response * undone,
        found.sd * undone,
        found.coherence,
        axis=log.axis,
        label=label,
        source=log.source,
        notes=notes,
        sensor_direction=tuple(aligned.direction.tolist()),
    )


def response_at(aligned: AlignedLog, f_hz: Array) -> LocalResponse:
    """Return the response of an aligned log at the frequencies `f_hz`, shape (n,)."""
    record = _transformed(
        aligned.command_mm_s2, aligned.measured_mm_s2, aligned.rate_hz, taper=_TAPER
    )
    return local_response([record], f_hz, _HALF_BAND_HZ)


def plateau_gain(response: FrequencyResponse) -> float | None:
    """Return the gain that the response has towards 0 Hz, from 8 to 15 Hz; None if unknown.

    A resonance above lifts the band by 1/(1 - f^2/f_r^2), so 1/|H| is a line in f^2;
    the gain is where it meets 0 Hz.
    """
    low, high = _PLATEAU_HZ
    used = (response.f_hz >= low) & (response.f_hz <= high) & (response.coherence >= 0.8)
    if np.count_nonzero(used) < 4:
        return None
    squared, magnitude = response.f_hz[used] ** 2, np.abs(response.response[used])
    slope, inverse_gain = np.polyfit(squared, 1.0 / magnitude, 1)
    # A falling response has no resonance above: use its level instead of the line.
    return float(1.0 / inverse_gain) if slope < 0 else float(np.median(magnitude))


def check_plateau(response: FrequencyResponse, excitation: Excitation) -> None:
    """Raise ModelError if the gain towards 0 Hz is more than 22 % off 1.

    An axis without slip follows slow motion exactly, so any other level means that the command
    was another one than `excitation` says, that the sensor's scale is off, or (below 0.3) that
    the sensor sits elsewhere.
    """
    gain = plateau_gain(response)
    if gain is None or abs(gain - 1.0) <= _PLATEAU_TOLERANCE:
        return
    if gain >= _NOT_MOVING:
        # A frame resonance within the plateau distorts it.
        frame = frame_of(response)
        if frame is not None and abs(frame.level - 1.0) <= _PLATEAU_TOLERANCE:
            return
    if gain < _NOT_MOVING:
        raise ModelError(
            f"{response.source}: between {_PLATEAU_HZ[0]:g} and {_PLATEAU_HZ[1]:g} Hz the sensor "
            f"moved {gain:.2f} times as much as commanded: it is not mounted on what moves "
            "(another axis was measured, or only shaken along); measure at the part that the "
            "axis moves"
        )
    stated = excitation.accel_per_hz_mm_s
    rubs = ", or whether the axis rubs much, which makes it move less, too" if gain < 1.0 else ""
    raise ModelError(
        f"{response.source}: between {_PLATEAU_HZ[0]:g} and {_PLATEAU_HZ[1]:g} Hz the axis moved "
        f"{gain:.2f} times as much as commanded with accel_per_hz = {stated:g}; it must be 1 "
        f"within {_PLATEAU_TOLERANCE:.0%}. The log looks like accel_per_hz = {stated * gain:.3g}: "
        "check [resonance_tester] in printer.cfg (default 75 before 2024-12, 60 since) and the "
        f"sensor's scale{rubs}"
    )


def estimate_driven(
    driven: DrivenLog | Sequence[DrivenLog],
    *,
    label: str = "",
) -> FrequencyResponse:
    """Return the response of a recorded drive by local least squares.

    For a swept sine, a step or any other short record: there Welch's method has only one segment
    at each frequency, and its coherence says nothing. Several logs of the same axis are put into
    one set of equations. Transients are fitted too unless every command begins and ends at the
    same rest (near both ends of a sweep they can hardly be told from the response). The band around
    each frequency is what the unknowns need, some 8 bins of one log and fewer of several; more of
    long logs, so that there are some 4000 points at most.

    Returns
    -------
    FrequencyResponse
        At the frequencies with at least -50 dB of the strongest drive.
    """
    logs = [_uniform(log) for log in _several(driven)]
    records = []
    transient = not all(_rests(log.command) for log in logs)
    for log in logs:
        # Remove gravity and sensor offsets.
        command, measured = (
            v - np.mean(v if transient else _ends(v)) for v in (log.command, log.measured)
        )
        records.append(_transformed(command, measured, _rate_hz(log), taper=0.0))
    reach = bins_needed(len(records), transient=transient) // 2
    half = max(*(reach * r.spacing_hz for r in records), 4.0 * _nyquist_hz(records) / _MOST_POINTS)
    f_hz = _driven_grid(records, half)
    found = local_response(records, f_hz, half, transient=transient)
    if transient:
        # Beside a sweep the transients explain the bins by themselves: coherent, but no response.
        known = found.sd <= _MOST_SD * np.abs(found.response)
        found = replace(found, coherence=np.where(known, found.coherence, 0.0))
    return _driven_response(logs, f_hz, found, label)


def _check_followed(response: FrequencyResponse, excitation: Excitation) -> None:
    coherent = response.coherence >= LEAST_COHERENCE
    if np.mean(coherent) < _LEAST_FOLLOWED:
        raise ModelError(
            f"{response.source}: the log follows a sweep at {excitation.hz_per_s:g} Hz/s at only "
            f"{np.mean(coherent):.0%} of its frequencies (coherence of at least "
            f"{LEAST_COHERENCE}; at least {_LEAST_FOLLOWED:.0%} are needed): the sensor is too "
            "noisy or loose, the axis rubs so much that it hardly moves, or the sweep was another "
            "one, see hz_per_sec in printer.cfg"
        )
    drift_s, per_hz_s = _drift(response.f_hz[coherent], response.response[coherent])
    if abs(drift_s) > _DRIFT_S:
        rate = 1.0 / (1.0 / excitation.hz_per_s + per_hz_s)
        # Kalico caps the test's speed by printer.cfg's accel_per_hz (resonance_tester.py, 2026-07).
        kalico = (
            ". Kalico slows a test down whose ACCEL_PER_HZ is above accel_per_hz in printer.cfg, "
            "and no option undoes that: set accel_per_hz there, and measure again"
        )
        raise ModelError(
            f"{response.source}: the log drifts away from a sweep at {excitation.hz_per_s:g} Hz/s, "
            f"by {abs(drift_s):.2g} s over half of it; it looks like hz_per_sec = {rate:.4g}: see "
            f"printer.cfg{kalico if rate < excitation.hz_per_s else ''}"
        )


def _drift(f_hz: Array, response: NDArray[np.complex128]) -> tuple[float, float]:
    """Return by how much later the upper half follows than the lower one, and that per Hz.

    Medians of the group delay: a resonance delays much, but only near its frequency.
    """
    steps = np.diff(f_hz)
    near = steps < 1.5 * _STEP_HZ
    turned = np.angle(response[1:] * response[:-1].conj())[near]
    delay_s = -turned / (2 * np.pi * steps[near])
    half = len(delay_s) // 2
    if half < 2:
        return 0.0, 0.0
    centres = f_hz[1:][near]
    apart_hz = float(np.median(centres[half:]) - np.median(centres[:half]))
    later_s = float(np.median(delay_s[half:]) - np.median(delay_s[:half]))
    return later_s, later_s / apart_hz


def _transformed(command: Array, measured: Array, rate_hz: float, *, taper: float) -> Transformed:
    """Transform a whole record, with bins whose noise does not depend on its length."""
    n = len(command)
    window = tukey(n, taper) if taper else np.ones(n)
    size = next_fast_len(n, real=True)
    scale = 1.0 / np.sqrt(n)
    u, y = (rfft(v * window, size) * scale for v in (command, measured))
    return Transformed(rate_hz / size, u, y)


def _driven_grid(records: Sequence[Transformed], half_band_hz: float) -> Array:
    """Return frequencies, an eighth of the band's width apart, where there is enough drive."""
    step = 0.25 * half_band_hz
    end = _nyquist_hz(records) - half_band_hz
    grid = np.arange(1, int(end / step)) * step
    power = np.zeros(len(grid))
    for record in records:
        summed = np.concatenate([[0.0], np.cumsum(np.abs(record.command) ** 2)])
        above = ((grid + half_band_hz) / record.spacing_hz).astype(int)
        below = (np.maximum(grid - half_band_hz, 0.0) / record.spacing_hz).astype(int)
        power += summed[above] - summed[below]
    driven = grid[power >= _WEAKEST_DRIVE * power.max()] if len(grid) else grid
    if len(driven) == 0:
        raise ModelError("the record is too short for a frequency response; record longer")
    return np.asarray(driven, np.float64)


def _nyquist_hz(records: Sequence[Transformed]) -> float:
    return min(r.spacing_hz * (len(r.command) - 1) for r in records)


def _driven_response(
    logs: Sequence[DrivenLog], f_hz: Array, found: LocalResponse, label: str
) -> FrequencyResponse:
    if not np.any(found.coherence >= LEAST_COHERENCE):
        raise ModelError(
            f"{logs[0].source}: the measurement follows the command at no frequency (greatest "
            f"coherence {found.coherence.max():.2f}, {LEAST_COHERENCE} is needed); check that the "
            "columns are command and measurement of the same axis, and drive it harder"
        )
    return FrequencyResponse(
        f_hz,
        found.response,
        found.sd,
        found.coherence,
        axis=logs[0].axis,
        label=label,
        source=", ".join(dict.fromkeys(log.source for log in logs)),
        notes=tuple(dict.fromkeys(note for log in logs for note in log.notes)),
    )


def _several(driven: DrivenLog | Sequence[DrivenLog]) -> tuple[DrivenLog, ...]:
    logs = (driven,) if isinstance(driven, DrivenLog) else tuple(driven)
    if not logs:
        raise ModelError("no log to estimate from; give at least one")
    axes = {log.axis for log in logs if log.axis is not None}
    if len(axes) > 1:
        raise ModelError(f"logs of different axes ({', '.join(sorted(axes))}); one axis at a time")
    return logs


def _uniform(log: DrivenLog) -> DrivenLog:
    """Return the log at its usual sampling interval throughout, by cubic splines."""
    steps = np.diff(log.time_s)
    count = round(float(np.sum(steps) / np.median(steps))) + 1
    time_s = np.linspace(log.time_s[0], log.time_s[-1], count)
    columns = np.stack([log.command, log.measured], axis=1)
    command, measured = CubicSpline(log.time_s, columns)(time_s).T
    return replace(log, time_s=time_s, command=command, measured=measured)


def _rests(values: Array) -> bool:
    """Whether a record ends where it began, and hardly moves there."""
    return bool(np.std(_ends(values)) <= _REST * np.std(values))


def _ends(values: Array) -> Array:
    edge = max(len(values) // 50, 1)
    return np.concatenate([values[:edge], values[-edge:]])


def _rate_hz(log: DrivenLog) -> float:
    return (len(log.time_s) - 1) / float(log.time_s[-1] - log.time_s[0])


def _silent(_stage: str, _fraction: float) -> None:
    pass
