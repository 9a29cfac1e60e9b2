"""Judge one axis of a log against its prediction: deviation, frequency, and a verdict.

The command's acceleration is known, so the axis can be identified from the print itself: all its
frequencies and damping ratios are scaled until the predicted spectrum fits the measured one, the
mode that rings most a little further than the others if need be.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.optimize import least_squares
from scipy.signal import welch
from scipy.signal.windows import tukey

from stillpath.applications.proof.drive import RingingMode, ringing_mode
from stillpath.applications.proof.figures import AxisReadback, Corners, Curve
from stillpath.applications.proof.matching import band_pass
from stillpath.models.arrays import Array
from stillpath.models.plants import PlantSpec, frequency_response

__all__ = ["AxisMotion", "judge"]

Spectrum = NDArray[np.complex128]

_BAND_HZ = (5.0, 200.0)
_BELOW_MODES_HZ = 20.0
_SMOOTH_HZ = 2.0
_EXCERPT_S = 0.4
_CORNER_S = (0.02, 0.12)
_FREQUENCY_TOLERANCE, _DAMPING_TOLERANCE, _GAIN_TOLERANCE = 0.01, 0.35, 0.15
_SIGMAS = 3.0
_OWN_SHIFT = 0.03
"""Expected shift of one mode relative to the others."""
_QUIET, _FEWEST_CORNERS = 0.05, 5
_POOR_NRMSE = 0.4
_VAGUE = 0.03
"""Uncertainty above which a frequency does not judge the model."""


@dataclass(frozen=True, slots=True)
class AxisMotion:
    """Acceleration [mm/s^2] of an axis on one grid of time, shape (n,) each."""

    name: str
    spec: PlantSpec
    command: Array
    predicted: Array
    measured: Array


def judge(axis: AxisMotion, dt_s: float) -> AxisReadback:
    """Compare, identify, and judge.

    Parameters
    ----------
    axis : AxisMotion
        Predicted and measured acceleration, aligned but for a millisecond or so.
    """
    n = len(axis.measured)
    window = tukey(n, 0.02)
    f = np.asarray(np.fft.rfftfreq(n, dt_s), np.float64)
    # A second difference averages acceleration over a triangle of two samples.
    correction = 1.0 / np.maximum(np.sinc(f * dt_s) ** 2, 0.1)
    top_hz = min(_BAND_HZ[1], 0.4 / dt_s)
    band = (f >= _BAND_HZ[0]) & (f <= top_hz)
    command, predicted = (
        (np.fft.rfft(window * rows) * correction)[band] for rows in (axis.command, axis.predicted)
    )
    measured = np.fft.rfft(window * axis.measured)[band]
    mode = ringing_mode(axis.spec)
    fit = _fit(axis, mode, f[band], command, measured)
    predicted = predicted * np.exp(-2j * np.pi * f[band] * fit.delay_s)
    waves = [_wave(x, band, n) for x in (measured, predicted, fit.spectrum)]
    corners = _corner_samples(axis.command, dt_s)
    misses = [
        float(np.sqrt(_power(measured - x) / _power(measured))) for x in (predicted, fit.spectrum)
    ]
    verdict, holds = _verdict(axis.name.upper(), mode, fit, misses[1])
    return AxisReadback(
        axis=axis.name,
        model_hz=mode.f_hz,
        model_zeta=mode.zeta,
        f_hz=mode.f_hz * fit.frequency,
        f_sd_hz=mode.f_hz * fit.frequency_sd,
        zeta=mode.zeta * fit.damping,
        zeta_sd=mode.zeta * fit.damping_sd,
        gain=fit.gain,
        correlation=float(
            np.real(np.vdot(predicted, measured)) / np.sqrt(_power(predicted) * _power(measured))
        ),
        nrmse=misses[0],
        nrmse_fitted=misses[1],
        corners=_corners(waves, corners, mode, dt_s),
        spectrum=_spectrum(waves, dt_s, top_hz),
        excerpt=_excerpt(waves, corners, dt_s),
        verdict=verdict,
        holds=holds,
    )


@dataclass(frozen=True, slots=True)
class _Fit:
    """Factors of frequency, damping and gain with standard deviations, and the fitted spectrum."""

    frequency: float
    frequency_sd: float
    damping: float
    damping_sd: float
    gain: float
    delay_s: float
    spectrum: Spectrum


def _fit(
    axis: AxisMotion, mode: RingingMode, f: Array, command: Spectrum, measured: Spectrum
) -> _Fit:
    """Scale frequencies, damping and gain of a plant, and shift it, to fit a spectrum.

    All frequencies share a factor; the ringing mode may have a little more of its own. The residual
    is weighted with its own smoothed spectrum, from a first pass without weights; standard
    deviations are those of the weighted least squares.
    """
    s = 2j * np.pi * f

    def model(x: Array) -> Spectrum:
        plant = axis.spec.scaled(float(np.exp(x[0])), float(np.exp(x[1])))
        shift = np.exp(x[2] - 1e-3 * s * x[3])
        before, after = (abs(mode.pole) * np.exp(x[0] + extra) for extra in (0.0, x[4]))
        zeta = mode.zeta * np.exp(x[1])
        own = (1 + 2 * zeta * s / before + (s / before) ** 2) / (
            1 + 2 * zeta * s / after + (s / after) ** 2
        )
        return np.asarray(shift * own * frequency_response(plant, f) * command)  # type: ignore[arg-type]

    sd = np.full(len(f), np.sqrt(_power(measured) / len(f)))
    # The log's scale is that of the motion below the modes: its unit may be another.
    low, x = f < _BELOW_MODES_HZ, np.zeros(5)
    made, felt = model(x)[low], measured[low]
    x[2] = np.log(max(np.real(np.vdot(made, felt)), 1e-9 * _power(made)) / _power(made))
    most = np.array([0.5, 1.5, 1.0, 6.0, 0.2])
    limits = (x - most, x + most)
    width = max(3, round(_SMOOTH_HZ / (f[1] - f[0])))
    for _ in range(3):

        def residual(x: Array, sd: Array = sd) -> Array:
            e = (model(x) - measured) / sd
            # Without other modes the data cannot separate both factors.
            return np.concatenate([e.real, e.imag, [x[4] / _OWN_SHIFT]])

        solved = least_squares(residual, x, bounds=limits, x_scale=[0.01, 0.1, 0.05, 0.1, 0.01])
        x = solved.x
        power = uniform_filter1d(np.abs(model(x) - measured) ** 2, width, mode="nearest")
        # Half of the power lies in each of the real and imaginary parts.
        sd = np.sqrt(0.5 * power + 1e-12 * float(power.max()))
    jacobian = np.asarray(solved.jac, np.float64)
    covariance = np.linalg.pinv(jacobian.T @ jacobian) * 2 * solved.cost / len(solved.fun)
    both = np.array([1.0, 0.0, 0.0, 0.0, 1.0])
    frequency, damping, gain = (float(np.exp(v)) for v in (x[0] + x[4], x[1], x[2]))
    return _Fit(
        frequency=frequency,
        frequency_sd=frequency * float(np.sqrt(both @ covariance @ both)),
        damping=damping,
        damping_sd=damping * float(np.sqrt(covariance[1, 1])),
        gain=gain,
        delay_s=1e-3 * float(x[3]),
        spectrum=model(x),
    )


def _verdict(axis: str, mode: RingingMode, fit: _Fit, missing: float) -> tuple[str, bool]:
    """Return the verdict as text, and whether the model holds."""
    f_hz, sd_hz = mode.f_hz * fit.frequency, mode.f_hz * fit.frequency_sd
    hz = f"{f_hz:.2f} ± {max(sd_hz, 0.01):.2f} Hz, model {mode.f_hz:.2f} Hz"
    change = fit.frequency - 1.0
    holds = False
    if abs(change) > max(_FREQUENCY_TOLERANCE, _SIGMAS * fit.frequency_sd):
        text = (
            f"The machine's {axis} mode is {100 * abs(change):.1f} % "
            f"{'lower' if change < 0 else 'higher'} than the model ({hz}): measure again."
        )
    elif abs(fit.gain - 1.0) > _GAIN_TOLERANCE:
        text = (
            f"{axis}: the sensor reads {fit.gain:{'.2f' if fit.gain > 0.1 else '.2g'}} of the "
            f"predicted acceleration ({hz}): check its scale (the log is in mm/s2) and that it is "
            "fixed to the moving part."
        )
    elif missing > _POOR_NRMSE:
        text = (
            f"{axis}: {100 * missing:.0f} % of the measured acceleration is not in the model, "
            f"whatever its frequency ({hz}): other modes, or a loose sensor."
        )
    elif fit.frequency_sd > _VAGUE:
        text, holds = f"{axis}: this log cannot tell the mode's frequency ({hz}).", True
    elif abs(fit.damping - 1.0) > max(_DAMPING_TOLERANCE, _SIGMAS * fit.damping_sd):
        text = (
            f"{axis}: the frequency holds ({hz}), the damping does not "
            f"({mode.zeta * fit.damping:.3f}, model {mode.zeta:.3f}): measure again."
        )
    else:
        text, holds = f"{axis}: the model holds ({hz}).", True
    return text, holds


def _power(x: Spectrum) -> float:
    return float(np.sum(np.abs(x) ** 2))


def _wave(x: Spectrum, band: NDArray[np.bool_], n: int) -> Array:
    """Return a band of a spectrum as a time signal."""
    full = np.zeros(len(band), complex)
    full[band] = x
    return np.fft.irfft(full, n)


def _corner_samples(command: Array, dt_s: float) -> NDArray[np.int64]:
    """Return the samples at which the strongest speed changes of the command end.

    Preferably those followed by quiet motion, but compensated motion is never entirely quiet.
    """
    change = uniform_filter1d(np.abs(command), max(1, round(0.01 / dt_s)))
    strongest = float(np.quantile(change, 0.99))
    strong = change > 0.5 * strongest
    ends = np.flatnonzero(strong[:-1] & ~strong[1:]) + 1
    first, last = (round(s / dt_s) for s in _CORNER_S)
    ends = ends[ends + last < len(command)]
    # A corner counts if its vibration can be seen before the next one.
    ends = ends[np.append(np.diff(ends) > last, True)[: len(ends)]]
    total = np.concatenate([[0.0], np.cumsum(np.abs(command))])
    quiet = total[ends + last] - total[ends + first] < _QUIET * strongest * (last - first)
    return np.asarray(ends[quiet] if np.sum(quiet) >= _FEWEST_CORNERS else ends)


def _corners(
    waves: list[Array], corners: NDArray[np.int64], mode: RingingMode, dt_s: float
) -> Corners:
    first, last = (round(s / dt_s) for s in _CORNER_S)
    at = (corners[:, None] + np.arange(first, last)).ravel()
    narrow = [band_pass(w, dt_s, 0.75 * mode.f_hz, 1.33 * mode.f_hz) for w in waves[:2]]
    measured, predicted = (float(np.sqrt(np.mean(w[at] ** 2))) if len(at) else 0.0 for w in narrow)
    to_um = 1e3 / (2 * np.pi * mode.f_hz) ** 2
    return Corners(
        count=len(corners),
        measured_mm_s2=measured,
        predicted_mm_s2=predicted,
        measured_um=to_um * measured,
        predicted_um=to_um * predicted,
    )


def _spectrum(waves: list[Array], dt_s: float, top_hz: float) -> Curve:
    size = min(1024, len(waves[0]))
    f, power = zip(*(welch(w, 1.0 / dt_s, nperseg=size) for w in waves), strict=True)
    shown = (f[0] >= _BAND_HZ[0]) & (f[0] <= top_hz)
    return Curve(
        x=_rounded(f[0][shown]),
        measured=_rounded(power[0][shown]),
        predicted=_rounded(power[1][shown]),
        fitted=_rounded(power[2][shown]),
    )


def _excerpt(waves: list[Array], corners: NDArray[np.int64], dt_s: float) -> Curve:
    """Return the surroundings of the corner that rings most."""
    n = min(round(_EXCERPT_S / dt_s), len(waves[0]))
    energy = np.cumsum(waves[0] ** 2)
    first, last = (round(s / dt_s) for s in _CORNER_S)
    places = corners if len(corners) else np.array([len(energy) // 2])
    after = energy[np.minimum(places + last, len(energy) - 1)] - energy[places + first]
    start = int(np.clip(places[np.argmax(after)] - n // 4, 0, len(energy) - n))
    rows = [_rounded(w[start : start + n]) for w in waves]
    t_ms = [round(1e3 * dt_s * k, 3) for k in range(n)]
    return Curve(x=t_ms, measured=rows[0], predicted=rows[1], fitted=rows[2])


def _rounded(values: Array) -> list[float]:
    return [float(f"{v:.5g}") for v in values]
