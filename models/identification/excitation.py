"""Klipper's resonance test, regenerated: the command, and the spectrum of its drive.

The rules are those of klippy/extras/resonance_tester.py and shaper_calibrate.py (Klipper,
2026-08), written down as mathematics: a pulse train whose frequency rises by `hz_per_s`, since
2024-12 with a slow square wave of acceleration added, seen through Klipper's own Welch estimate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike

from stillpath.models.arrays import Array
from stillpath.models.errors import ModelError
from stillpath.models.identification.types import Excitation

__all__ = [
    "VelocityProfile",
    "drive_spectrum",
    "drive_spectrum_regenerated",
    "klipper_psd",
    "regenerate",
    "welch_kernel",
    "welch_length",
]

_KAISER_BETA = 6.0
_WINDOW_S = 0.5
_RANGES = {
    "f_start_hz": ("min_freq", 0.5, 1000.0),
    "accel_per_hz_mm_s": ("accel_per_hz", 0.1, 1e4),
    "hz_per_s": ("hz_per_sec", 0.05, 100.0),
    "sweeping_accel_mm_s2": ("sweeping_accel", 0.0, 1e5),
    "sweeping_period_s": ("sweeping_period", 0.05, 1000.0),
}
"""Option, least and largest value: beyond, a test is no test, or takes all memory to regenerate."""


@dataclass(frozen=True, slots=True, eq=False)
class VelocityProfile:
    """A velocity along one direction, linear between its knots.

    Before the first knot it is at rest. After the last it keeps its velocity: the stop is a move
    of the machine's own acceleration, which no test file tells.

    Attributes
    ----------
    time_s, velocity_mm_s : ndarray, shape (n,)
        The first knot is at time 0 with velocity 0.
    """

    time_s: Array
    velocity_mm_s: Array

    @property
    def duration_s(self) -> float:
        """Time of the last knot."""
        return float(self.time_s[-1])

    @property
    def segments(self) -> int:
        """Number of pieces of constant acceleration."""
        return len(self.time_s) - 1

    def accelerations_mm_s2(self) -> Array:
        """Return the acceleration of every piece, shape (segments,)."""
        return np.diff(self.velocity_mm_s) / np.diff(self.time_s)

    def travel_mm(self) -> tuple[float, float]:
        """Return the least and the greatest position, from 0 at the start."""
        v0, v1 = self.velocity_mm_s[:-1], self.velocity_mm_s[1:]
        dt = np.diff(self.time_s)
        ends = np.concatenate([[0.0], np.cumsum(0.5 * (v0 + v1) * dt)])
        turns = v0 * v1 < 0
        span = np.where(turns, v0 - v1, 1.0)
        turning_points = (ends[:-1] + 0.5 * v0 * v0 * dt / span)[turns]
        reached = np.concatenate([ends, turning_points])
        return float(reached.min()), float(reached.max())

    def cell_averages(self, time_s: ArrayLike, width_s: float) -> Array:
        """Return the mean acceleration over cells of `width_s` centred at `time_s`, mm/s^2.

        One for each time. Exact, by differences of the velocity: sampling the square wave itself
        would alias.
        """
        t = np.asarray(time_s, np.float64)
        after = np.interp(t + 0.5 * width_s, self.time_s, self.velocity_mm_s)
        before = np.interp(t - 0.5 * width_s, self.time_s, self.velocity_mm_s)
        return np.asarray((after - before) / width_s, np.float64)


def regenerate(excitation: Excitation) -> VelocityProfile:
    """Return the velocity that Klipper commands along `excitation.direction`.

    Each half period is +a, -a for a quarter of the period 1/f each, a = accel_per_hz * f, with
    the sign turned every time; f then grows by hz_per_s/(2 f), so that df/dt = hz_per_s.

    Before 2024-12 (16b4b6b30; Kalico before 2025-01) the quarters are moves of a/2 (1/4f)^2 from
    the start of the test and back, to alternate sides. The planner does not stop there, only where
    the motion turns: so velocity peaks at the start of the test, not between turns, and is a
    quarter of a period away from that of newer versions, at every frequency. The first move out
    and the last one back begin and end at rest, which takes sqrt(2) times their time.

    Raises
    ------
    ModelError
        If a parameter of `excitation` is outside what Klipper can execute.
    """
    _check(excitation)
    quarter_s, peak_mm_s = _half_periods(excitation)
    if excitation.out_and_back:
        return _about_the_start(quarter_s, peak_mm_s)
    # Velocity is a triangle per half period: 0, peak, 0, -peak, 0, ...
    pulse_t = np.concatenate([[0.0], np.cumsum(np.repeat(quarter_s, 2))])
    pulse_v = np.zeros(len(pulse_t))
    pulse_v[1::2] = peak_mm_s
    if excitation.sweeping_accel_mm_s2 == 0 or excitation.sweeping_period_s == 0:
        return VelocityProfile(pulse_t, pulse_v)
    slow_t, slow_v = _slow_wave(excitation, pulse_t[-1])
    knots = np.union1d(pulse_t, slow_t[slow_t < pulse_t[-1]])
    total = np.interp(knots, pulse_t, pulse_v) + np.interp(knots, slow_t, slow_v)
    return VelocityProfile(knots, np.asarray(total, np.float64))


def drive_spectrum(excitation: Excitation, f_hz: ArrayLike) -> Array:
    """Return the one-sided spectral density E(f) of the whole test's acceleration command.

    E(f) = (4/pi)^2 accel_per_hz^2 f^2 / (2 (f_end - f_start)) * sum of k^-5 over the odd k with
    f_start <= f/k <= f_end: the harmonics of a square wave, each spending 1/k of the time per
    hertz. `hz_per_s` cancels. The slow square wave is left out; it matters below 15 Hz
    (`drive_spectrum_regenerated` has it).

    Returns
    -------
    ndarray, shape of `f_hz`
        (mm/s^2)^2/Hz
    """
    _check(excitation)
    f = np.asarray(f_hz, np.float64)
    low, high = excitation.f_start_hz, excitation.f_end_hz
    highest = float(f.max(initial=0.0)) / low
    harmonics = np.zeros(f.shape)
    for k in range(1, int(highest) + 1, 2):
        harmonics += np.where((f >= k * low) & (f <= k * high), float(k) ** -5, 0.0)
    amplitude = 4 / np.pi * excitation.accel_per_hz_mm_s * f
    return np.asarray(amplitude**2 / (2 * (high - low)) * harmonics, np.float64)


def drive_spectrum_regenerated(excitation: Excitation, f_hz: ArrayLike) -> Array:
    """Return the drive's spectral density as Klipper's Welch estimate sees the command.

    Includes the slow square wave, the transient at both ends of the band, and the bandwidth of
    the window; interpolated from the bins of a record at 3200 Hz.

    Returns
    -------
    ndarray, shape of `f_hz`
        (mm/s^2)^2/Hz
    """
    rate_hz = 3200.0
    profile = regenerate(excitation)
    time_s = np.arange(0.0, profile.duration_s, 1.0 / rate_hz)
    bins, density = klipper_psd(time_s, profile.cell_averages(time_s, 1.0 / rate_hz))
    density /= np.sinc(bins / rate_hz) ** 2  # a sensor does not average over cells
    return np.asarray(np.interp(np.asarray(f_hz, np.float64), bins, density), np.float64)


def klipper_psd(time_s: ArrayLike, accel_mm_s2: ArrayLike) -> tuple[Array, Array]:
    """Return the power spectral density as Klipper computes it (shaper_calibrate.py, 2026-08).

    Welch: Kaiser window (beta 6) of the power of two that holds 0.5 s, half overlapping, mean of
    each segment removed, one-sided, rate = samples/duration. The interval convention is
    Klipper's: N samples over t[-1] - t[0].

    Parameters
    ----------
    time_s : array_like, shape (n,)
    accel_mm_s2 : array_like, shape (n,) or (n, columns)

    Returns
    -------
    f_hz : ndarray, shape (m,)
    psd : ndarray, shape (m,) or (m, columns)
        (mm/s^2)^2/Hz

    Raises
    ------
    ModelError
        If the record is shorter than one window.
    """
    t, a = np.asarray(time_s, np.float64), np.asarray(accel_mm_s2, np.float64)
    span_s = float(t[-1] - t[0]) if len(t) > 1 else 0.0
    rate_hz = len(t) / span_s if span_s > 0 else 0.0
    nfft = welch_length(rate_hz)
    if len(t) <= nfft:
        raise ModelError(
            f"a record of {len(t)} samples ({span_s:.3f} s) is shorter than one window of "
            f"{nfft}; record the whole test"
        )
    window = np.kaiser(nfft, _KAISER_BETA)
    segments = sliding_window_view(a, nfft, axis=0)[:: nfft // 2]
    spectra = np.fft.rfft((segments - segments.mean(axis=-1, keepdims=True)) * window)
    power = np.moveaxis(np.mean(np.abs(spectra) ** 2, axis=0), -1, 0)
    power[1:-1] *= 2.0
    psd = power / (rate_hz * float(window @ window))
    f_hz = np.fft.rfftfreq(nfft, 1.0 / rate_hz)
    return np.asarray(f_hz, np.float64), np.asarray(psd, np.float64)


def welch_length(rate_hz: float) -> int:
    """Return Klipper's window length: the power of two that holds 0.5 s (2048 at 3200 Hz)."""
    return 1 << int(max(rate_hz * _WINDOW_S - 1, 0)).bit_length()


def welch_kernel(nfft: int, rate_hz: float, offsets_hz: ArrayLike) -> Array:
    """Return the spectral window of Klipper's Welch estimate, |FFT(kaiser)|^2 of unit area.

    The expected estimate is a convolution: E[psd(f)] = integral of S(nu) K(f - nu) d nu over all
    nu, S two-sided and continued by its mirror image below 0. (Equivalent noise bandwidth
    1/K(0): 2.3 Hz at 2048 samples of 3200 Hz.)

    Parameters
    ----------
    offsets_hz : array_like
        f - nu, any shape.

    Returns
    -------
    ndarray, shape of `offsets_hz`
        K, 1/Hz; even, periodic in `rate_hz`.
    """
    offsets = np.asarray(offsets_hz, np.float64)
    window = np.kaiser(nfft, _KAISER_BETA)
    centred_s = (np.arange(nfft) - 0.5 * (nfft - 1)) / rate_hz
    # The window is even about its centre, so its transform is real.
    transform = np.cos(2 * np.pi * offsets[..., None] * centred_s) @ window
    return np.asarray(transform**2 / (rate_hz * float(window @ window)), np.float64)


def _half_periods(excitation: Excitation) -> tuple[Array, Array]:
    """Return a quarter of the period and the signed peak velocity of every half period."""
    frequencies = []
    f = excitation.f_start_hz
    while f <= excitation.f_end_hz + 1e-6:
        frequencies.append(f)
        f += 0.5 * excitation.hz_per_s / f
    quarter_s = 0.25 / np.array(frequencies)
    signs = np.where(np.arange(len(frequencies)) % 2 == 0, 1.0, -1.0)
    # accel_per_hz f for 1/(4 f): the peak velocity is the same in every half period.
    return quarter_s, signs * 0.25 * excitation.accel_per_hz_mm_s


def _about_the_start(quarter_s: Array, peak_mm_s: Array) -> VelocityProfile:
    """Return the velocity of moves out from the start and back, to alternate sides."""
    # From rest to rest, a move has half of its way for each ramp.
    edge_s, edge_mm_s = quarter_s[[0, -1]] / np.sqrt(2.0), peak_mm_s[[0, -1]] / np.sqrt(2.0)
    ramps_s = np.repeat(quarter_s, 2)[1:-1]
    steps_s = np.concatenate([np.repeat(edge_s[0], 2), ramps_s, np.repeat(edge_s[1], 2)])
    back_mm_s = np.zeros(len(ramps_s) + 1)
    back_mm_s[1::2] = -peak_mm_s[:-1]
    velocity = np.concatenate([[0.0, edge_mm_s[0]], back_mm_s, [-edge_mm_s[1], 0.0]])
    return VelocityProfile(np.concatenate([[0.0], np.cumsum(steps_s)]), velocity)


def _slow_wave(excitation: Excitation, end_s: float) -> tuple[Array, Array]:
    """Return knots (t, v) of the slow square wave of acceleration, beyond `end_s`.

    The first flips come early, by sqrt(2)/8 of a period, so that neither velocity nor position
    drifts away from the start.
    """
    period_s, early = excitation.sweeping_period_s, np.sqrt(2.0) / 8.0
    first, second = early * period_s, (2 * early + 0.25) * period_s
    regular = second + np.arange(1, int(2 * end_s / period_s) + 3) * period_s / 2
    knots = np.concatenate([[0.0, first, second], regular])
    signs = np.where(np.arange(len(knots) - 1) % 2 == 0, 1.0, -1.0)
    gained = np.cumsum(signs * np.diff(knots)) * excitation.sweeping_accel_mm_s2
    return knots, np.concatenate([[0.0], gained])


def _check(excitation: Excitation) -> None:
    e = excitation
    for name, (option, least, most) in _RANGES.items():
        value = getattr(e, name)
        if not least <= value <= most and not (value == 0 and name == "sweeping_period_s"):
            raise ModelError(
                f"excitation: {name} = {value:g} must be {least:g} to {most:g}; see {option} in "
                "printer.cfg"
            )
    if not e.f_start_hz < e.f_end_hz <= 1000.0:
        raise ModelError(
            f"excitation: f_end_hz = {e.f_end_hz:g} must lie above f_start_hz = "
            f"{e.f_start_hz:g} and at most at 1000 Hz; see min_freq and max_freq in printer.cfg"
        )
    if (e.f_end_hz**2 - e.f_start_hz**2) / e.hz_per_s > 5e6:
        raise ModelError(
            f"excitation: hz_per_s = {e.hz_per_s:g} makes the test last "
            f"{(e.f_end_hz - e.f_start_hz) / e.hz_per_s:.0f} s; see hz_per_sec in printer.cfg"
        )
