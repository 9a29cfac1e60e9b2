"""Learning the ripple of an axis from passes: position logs, accelerometers, slow sensors.

A pass is a motion along one axis with a log of what followed. Its ripple is linear in the
coefficients of the harmonics, whose spatial frequencies are known, so a pass is one least-squares
problem. The waves of ripple that enters at the input go through the plant before they are fitted:
the map is then the input's own, valid at every speed (reference, finding (iii)).

An accelerometer is read where the command moves steadily: there the harmonic h is a line at
f = h v / p, and dividing by -(2 pi f)^2 integrates twice.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import ValidationError
from scipy.linalg import block_diag

from stillpath.models.arrays import Array, Complex
from stillpath.models.errors import ModelError
from stillpath.models.identification.ripple_observability import (
    Observability,
    folded_distances,
    observability,
    refuse_unobservable,
)
from stillpath.models.plants import DiscretePlant
from stillpath.models.response_kernels import dense_response
from stillpath.models.ripple import AxisRipple, RippleHarmonic, RippleSide, RippleSource
from stillpath.models.runs import runs

__all__ = ["PassLog", "RippleLearning", "WaveBasis", "check_gain", "learn_ripple", "update_ripple"]

_STEADY = 1e-3
"""Relative change of speed that still counts as steady."""
_FEWEST = 4
"""Samples per unknown that a fit must have."""
_FASTEST = 0.2
"""Frequency of a wave times the sampling time: lines between samples take sinc^2 off, 12 % here."""
_LARGEST_MATRIX = 50_000_000
"""Numbers in the matrix of a fit: 400 MB."""


@dataclass(frozen=True, slots=True, eq=False)
class PassLog:
    """One motion along an axis and the readings of a sensor.

    Attributes
    ----------
    command_mm : ndarray, shape (n,)
        Commanded position, at the plant's sampling time, from rest; machine coordinates.
    sensor_time_s, measured : ndarray, shape (k,)
        Since the first sample of the command; position in mm, or acceleration in mm/s^2. Any
        rate, also below that of the ripple.
    homed : bool
        Whether `command_mm` counts from the machine's homed zero: without, phases mean nothing.
    """

    command_mm: Array
    sensor_time_s: Array
    measured: Array
    kind: Literal["position", "acceleration"] = "position"
    homed: bool = False
    source: str = "pass"


@dataclass(frozen=True, slots=True)
class WaveBasis:
    """Which part repeats with which pitch, and which of its harmonics to learn."""

    name: str
    pitch_mm: float
    numbers: tuple[int, ...] = (1, 2, 3)
    enters: RippleSide = "input"


@dataclass(frozen=True, slots=True, eq=False)
class RippleLearning:
    """What passes teach.

    Attributes
    ----------
    explained : float
        Share of the log's deviation (rms) that the waves explain, 0..1.
    """

    ripple: AxisRipple
    observability: tuple[Observability, ...]
    explained: float


def learn_ripple(
    passes: Sequence[PassLog],
    basis: Sequence[WaveBasis],
    plant: DiscretePlant,
    *,
    homing_repeatability_mm: float = 0.0,
) -> RippleLearning:
    """Fit the harmonics of `basis` to all passes at once.

    Parameters
    ----------
    passes : sequence of PassLog
        All positions or all accelerations.
    plant : DiscretePlant
        The axis, at the sampling time of the commands.
    homing_repeatability_mm : float
        Written into the result.

    Raises
    ------
    ModelError
        If a pass was not homed, is too short or never steady, a harmonic is not observable at the
        speeds driven or faster than the sampling shows, or what was learnt cannot be the ripple of
        an axis; says which, and the remedy.
    """
    _check(passes, basis)
    blocks = [_block(log, basis, plant) for log in passes]
    matrix = np.hstack(
        [
            np.concatenate([block.waves for block in blocks]),
            block_diag(*(block.others for block in blocks)),
        ]
    )
    aim = np.concatenate([block.values for block in blocks])
    waves = sum(len(source.numbers) for source in basis)
    if len(aim) < _FEWEST * 2 * waves:
        raise ModelError(
            f"{len(aim)} usable samples for {2 * waves} unknowns, at least {_FEWEST * 2 * waves} "
            "needed: drive longer, or learn fewer harmonics"
        )
    seen = observability(
        matrix,
        [(source.name, number) for source, number in _waves(basis)],
        [
            folded_distances(
                block.frequencies_hz, 1.0 / float(np.median(np.diff(log.sensor_time_s)))
            )
            for block, log in zip(blocks, passes, strict=True)
            if block.frequencies_hz is not None
        ],
    )
    refuse_unobservable(seen)
    amplitudes, sd_mm, residual = _solved(matrix, aim, waves)
    ripple = _axis_ripple(_sources(basis, amplitudes, sd_mm), homing_repeatability_mm)
    total = _rms_beside(matrix[:, 2 * waves :], aim)
    explained = 1.0 - min(residual / total, 1.0) if total > 0 else 0.0
    return RippleLearning(ripple, seen, explained)


def _solved(matrix: Array, aim: Array, waves: int) -> tuple[Complex, Array, float]:
    """Return complex amplitudes of the waves, their standard deviations, and the residual (rms)."""
    unknown, *_ = np.linalg.lstsq(matrix, aim, rcond=None)
    left = aim - matrix @ unknown
    residual = math.sqrt(float(left @ left) / len(left))
    spread = residual * np.sqrt(np.diag(np.linalg.pinv(matrix.T @ matrix)))
    sines, cosines = unknown[: 2 * waves : 2], unknown[1 : 2 * waves : 2]
    sd_mm = np.hypot(spread[: 2 * waves : 2], spread[1 : 2 * waves : 2]) / math.sqrt(2)
    return sines + 1j * cosines, sd_mm, residual


def check_gain(gain: float) -> None:
    """Refuse a gain with which passes would not converge, or teach nothing.

    Raises
    ------
    ModelError
    """
    if not 0.0 < gain <= 1.0:
        raise ModelError(f"learning gain {gain:g} must lie above 0 and not above 1")


def update_ripple(
    known: AxisRipple, learnt: AxisRipple, *, gain: float = 0.5, remaining: bool = False
) -> AxisRipple:
    """Carry a later learning into a table: the repetitive controller between prints.

    Parameters
    ----------
    known, learnt : AxisRipple
        Harmonics that `learnt` lists alone count as zero in `known`; those that it does not list
        were not looked for, and stay.
    gain : float
        1: take the new as it is; smaller: average over passes, against noise.
    remaining : bool
        True: `learnt` is what was left with `known` at work (logs against the plan); False: the
        whole ripple again (logs against the command as it was sent).

    Raises
    ------
    ModelError
        If `gain` is outside 0 to 1, a source of the same name has another pitch or side, or the
        sum cannot be the ripple of an axis.
    """
    check_gain(gain)
    old, new = _by_wave(known), _by_wave(learnt)
    parts, learnt_parts = (dict.fromkeys(wave[:3] for wave in waves) for waves in (old, new))
    for name, pitch_mm, enters in learnt_parts:
        for other, other_pitch, other_side in parts:
            if name == other and (name, pitch_mm, enters) not in parts:
                raise ModelError(
                    f"ripple {name!r}: pitch {pitch_mm:g} mm, {enters}, but the table has "
                    f"{other_pitch:g} mm, {other_side}; name it otherwise, or learn afresh"
                )
    keep = 1.0 if remaining else 1.0 - gain
    merged: dict[tuple[str, float, RippleSide], list[RippleHarmonic]] = {}
    for wave in dict.fromkeys([*old, *new]):
        c_before, sd_before = old.get(wave, (0j, 0.0))
        c, sd = c_before, sd_before
        if wave in new:
            c_learnt, sd_learnt = new[wave]
            c = keep * c_before + gain * c_learnt
            sd = math.hypot(keep * sd_before, gain * sd_learnt)
        merged.setdefault(wave[:3], []).append(_harmonic(wave[3], c, sd))
    return _axis_ripple(
        (
            RippleSource(name=name, pitch_mm=pitch_mm, enters=enters, harmonics=tuple(harmonics))
            for (name, pitch_mm, enters), harmonics in merged.items()
        ),
        max(known.homing_repeatability_mm, learnt.homing_repeatability_mm),
    )


def _check(passes: Sequence[PassLog], basis: Sequence[WaveBasis]) -> None:
    if not passes or not basis:
        raise ModelError("at least one pass and one pitch are needed to learn a ripple")
    if len({log.kind for log in passes}) > 1:
        raise ModelError("positions and accelerations cannot be learnt together; learn one kind")
    for log in passes:
        if not log.homed:
            raise ModelError(
                f"{log.source}: the log does not say that the machine was homed: without the "
                "machine's zero the phase of the ripple is arbitrary and a table would do harm; "
                "home (G28), drive the pass in machine coordinates and mark the log as homed"
            )
        if len(log.sensor_time_s) != len(log.measured) or len(log.command_mm) < 3:
            raise ModelError(f"{log.source}: times and values of unequal number, or no motion")
        if not (np.all(np.isfinite(log.measured)) and np.all(np.isfinite(log.command_mm))):
            raise ModelError(f"{log.source}: values that are not finite numbers; cut them out")
    unknowns = 2 * sum(len(source.numbers) for source in basis)
    rows = sum(max(len(log.measured), len(log.command_mm)) for log in passes)
    if unknowns * rows > _LARGEST_MATRIX:
        raise ModelError(
            f"{rows} samples times {unknowns} unknowns are more than {_LARGEST_MATRIX}: cut the "
            "passes, or learn fewer harmonics"
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Block:
    """One pass: columns of sine and cosine of every wave, columns of its own, and its values."""

    waves: Array
    others: Array
    values: Array
    frequencies_hz: Array | None


def _block(log: PassLog, basis: Sequence[WaveBasis], plant: DiscretePlant) -> _Block:
    of_position = log.kind == "position"
    _check_band(log, basis, plant.dt_s)
    return _positions(log, basis, plant) if of_position else _accelerations(log, basis, plant)


def _check_band(log: PassLog, basis: Sequence[WaveBasis], dt_s: float) -> None:
    """Refuse waves that the command's samples do not show."""
    fastest = float(np.abs(np.diff(log.command_mm)).max()) / dt_s
    limit_hz = _FASTEST / dt_s
    for source, number in _waves(basis):
        # An accelerometer's waves on the output side are computed at its own samples.
        sampled = log.kind == "position" or source.enters == "input"
        f_hz = number * fastest / source.pitch_mm
        if sampled and f_hz > limit_hz:
            raise ModelError(
                f"{log.source}: at {fastest:.4g} mm/s harmonic {number} of {source.name} is a wave "
                f"of {f_hz:.4g} Hz, above the {limit_hz:.4g} Hz that {1 / dt_s:.4g} samples/s of "
                f"the command show; drive at most {limit_hz * source.pitch_mm / number:.3g} mm/s, "
                "or learn fewer harmonics"
            )


def _positions(log: PassLog, basis: Sequence[WaveBasis], plant: DiscretePlant) -> _Block:
    times = plant.dt_s * np.arange(len(log.command_mm))
    inside = (log.sensor_time_s >= 0) & (log.sensor_time_s <= times[-1])
    at = log.sensor_time_s[inside]

    def seen(values: Array) -> Array:
        return np.asarray(np.interp(at, times, values))

    columns = []
    for source, number in _waves(basis):
        angle = _wavenumber(source, number) * log.command_mm
        for wave in (np.sin(angle), np.cos(angle)):
            entered = _answer(plant, wave) if source.enters == "input" else wave
            columns.append(seen(entered))
    followed = _answer(plant, log.command_mm)
    # The sensor's offset, and the lag that the model does not have: not by the mean beforehand,
    # because short passes hold broken periods.
    lag = seen(np.gradient(followed)) / plant.dt_s
    others = np.stack([np.ones(len(at)), lag - lag.mean()], axis=1)
    deviation = log.measured[inside] - seen(followed)
    steady = _steady(log.command_mm, plant)
    whole = steady.stop - steady.start > 0.5 * len(times)
    speed = _speed(log, steady, plant.dt_s)
    frequencies = _frequencies(basis, speed) if whole else None
    return _Block(np.stack(columns, axis=1), others, deviation, frequencies)


def _accelerations(log: PassLog, basis: Sequence[WaveBasis], plant: DiscretePlant) -> _Block:
    steady = _steady(log.command_mm, plant)
    times = plant.dt_s * np.arange(len(log.command_mm))
    at = log.sensor_time_s
    inside = (at >= times[steady.start]) & (at <= times[steady.stop - 1])
    position = np.interp(at[inside], times, log.command_mm)
    speed = _speed(log, steady, plant.dt_s)
    columns = []
    for source, number in _waves(basis):
        wavenumber = _wavenumber(source, number)
        rate = wavenumber * speed
        # exp(j k s(t)) turns with `rate`, backwards if the axis moves back.
        gain = -(rate**2) * (
            _signed_response(plant, rate) if source.enters == "input" else complex(1.0)
        )
        turned = gain * np.exp(1j * wavenumber * position)
        columns += [turned.imag, turned.real]
    gravity = np.ones((int(inside.sum()), 1))
    waves = np.stack(columns, axis=1)
    return _Block(waves, gravity, log.measured[inside], _frequencies(basis, speed))


def _steady(command: Array, plant: DiscretePlant) -> slice:
    """Return the longest stretch of steady speed, from where the start has died down."""
    speed = np.diff(command)
    if len(speed) == 0 or np.abs(speed).max() == 0.0:
        return slice(0, 0)
    same = np.abs(np.diff(speed)) <= _STEADY * np.abs(speed).max()
    same &= np.abs(speed[1:]) > 0.05 * np.abs(speed).max()
    start, end = max(runs(same), key=lambda run: run[1] - run[0], default=(0, 0))
    settled = start + math.ceil(plant.settling_time_s(1e-3) / plant.dt_s)
    return slice(min(settled, end), end)


def _speed(log: PassLog, steady: slice, dt_s: float) -> float:
    """Speed of the steady stretch, mm/s; 0 if there is none (positions do not need one)."""
    length = int(steady.stop - steady.start)
    if length < 2:
        if log.kind == "acceleration":
            raise ModelError(
                f"{log.source}: the command never moves steadily for longer than the axis needs "
                "to settle; an accelerometer needs a stretch of constant speed, drive longer"
            )
        return 0.0
    moved = float(log.command_mm[steady.stop - 1] - log.command_mm[steady.start])
    return moved / ((length - 1) * dt_s)


def _waves(basis: Sequence[WaveBasis]) -> list[tuple[WaveBasis, int]]:
    return [(source, number) for source in basis for number in source.numbers]


def _wavenumber(source: WaveBasis, number: int) -> float:
    return 2 * math.pi * number / source.pitch_mm


def _frequencies(basis: Sequence[WaveBasis], speed: float) -> Array:
    return np.array([number * abs(speed) / source.pitch_mm for source, number in _waves(basis)])


def _answer(plant: DiscretePlant, values: Array) -> Array:
    """Response of the axis that stood still before."""
    out = np.empty(len(values))
    state = np.zeros(plant.order)
    u = np.ascontiguousarray(values, np.float64)
    dense_response(plant.a, plant.b, plant.c, plant.d, float(u[0]), state, u, out)
    return out


def _signed_response(plant: DiscretePlant, rate: float) -> complex:
    value = complex(plant.frequency_response(abs(rate) / (2 * math.pi))[0])
    return value if rate >= 0 else value.conjugate()


def _rms_beside(columns: Array, values: Array) -> float:
    """Return the rms of the residual without the waves."""
    left = values - columns @ np.linalg.lstsq(columns, values, rcond=None)[0]
    return math.sqrt(float(left @ left) / len(left))


def _axis_ripple(sources: Iterable[RippleSource], repeatability_mm: float) -> AxisRipple:
    try:
        return AxisRipple(sources=tuple(sources), homing_repeatability_mm=repeatability_mm)
    except ValidationError as error:
        first = error.errors()[0]
        remedy = "is it this axis's plant, and the log's unit right?"
        if first["type"] == "too_long":
            remedy = f"learn fewer {first['loc'][-1]}"
        raise ModelError(
            "what the passes teach cannot be the ripple of an axis: "
            f"{first['msg'].removeprefix('Value error, ')}; {remedy}"
        ) from None


def _sources(basis: Sequence[WaveBasis], c_mm: Complex, sd_mm: Array) -> Iterator[RippleSource]:
    first = 0
    for source in basis:
        harmonics = tuple(
            _harmonic(number, complex(c_mm[first + k]), float(sd_mm[first + k]))
            for k, number in enumerate(source.numbers)
        )
        yield RippleSource(
            name=source.name,
            pitch_mm=source.pitch_mm,
            enters=source.enters,
            harmonics=harmonics,
        )
        first += len(source.numbers)


def _harmonic(number: int, c_mm: complex, sd_mm: float) -> RippleHarmonic:
    return RippleHarmonic(
        number=number,
        amplitude_um=1e3 * abs(c_mm),
        phase_deg=math.degrees(math.atan2(c_mm.imag, c_mm.real)),
        sd_um=1e3 * sd_mm,
    )


def _by_wave(
    ripple: AxisRipple,
) -> dict[tuple[str, float, RippleSide, int], tuple[complex, float]]:
    return {
        (source.name, source.pitch_mm, source.enters, h.number): (
            1e-3 * h.amplitude_um * np.exp(1j * math.radians(h.phase_deg)),
            1e-3 * (h.sd_um or 0.0),
        )
        for source in ripple.sources
        for h in source.harmonics
    }
