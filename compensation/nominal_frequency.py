"""Robust nominal model from frequency responses (paper 003, appendix I).

At every frequency the plant is spread over a region of the complex plane. The controller that
tracks best on average is C_opt = E[G*] / E[|G|^2] (I.2); filtered basis functions approximate its
inverse when they are filtered with

    G_r = E[|G|^2] / E[G*]                                                              (I.3)

in place of a nominal plant. The expectations depend on the distribution over the region:

- ``sampled``: the given responses with their weights, magnitude and phase paired;
- ``uniform``: even over the box r_min..r_max, theta_min..theta_max of (I.4);
- ``kernel``: normal kernels about every sample's magnitude, and about every sample's phase, taken
  as independent of each other and cut off at the box (I.5, I.6).

For the last two the area element is r dr dtheta, as in (I.6): of two equally frequent magnitudes
the larger one counts more.

G_r is not a plant: its magnitude and phase follow from different averages, so its impulse response
is non-causal even if all plants are causal. It is returned as a two-sided impulse response, which a
lifted design uses directly.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stillpath.compensation.base import DesignError
from stillpath.compensation.lifted import checked_weights
from stillpath.compensation.operators import ToeplitzOperator
from stillpath.models.arrays import Array
from stillpath.models.plants import DiscretePlant

__all__ = [
    "CAUSAL_SHARE",
    "Distribution",
    "FrequencyNominal",
    "Region",
    "bandwidths",
    "extended_response",
    "robust_nominal",
    "robust_response",
    "sampled_responses",
]

Responses = NDArray[np.complex128]
Distribution = Literal["sampled", "uniform", "kernel"]
_Integrands = Callable[[Array], Responses]

CAUSAL_SHARE = 1e-4
"""Largest share of non-causal energy in a response that still counts as causal (1 % rms)."""
_LEAST_TRACKED = 1e-6
"""Below this share of tracked energy the phases are spread in all directions."""
_UNSETTLED = 1e-3
"""Share of energy in the outer half of the time grid above which the grid is too short."""
_NODES = 48
_REACH = 8.0
"""Kernels are integrated over this many standard deviations on either side."""
_POINT = 1e-9
"""Spreads below this, relative to magnitude 1 or 1 rad, are points."""


@dataclass(frozen=True, slots=True, eq=False)
class Region:
    """Polar form of the responses and the box around them, per frequency (I.4).

    Attributes
    ----------
    r, theta : ndarray, shape (l, f)
        Magnitudes and phases [rad]; phases within pi of their circular mean.
    r_span, theta_span : ndarray, shape (2, f)
        Smallest and largest.
    """

    r: Array
    theta: Array
    r_span: Array
    theta_span: Array

    @classmethod
    def of(cls, responses: ArrayLike) -> Region:
        """Make the region of responses, shape (l, f)."""
        g = np.asarray(responses, np.complex128)
        r = np.abs(g)
        middle = np.sum(g / np.where(r > 0, r, 1.0), axis=0)
        middle = np.where(np.abs(middle) > _POINT, middle, 1.0)
        theta = np.angle(middle) + np.angle(g * middle.conj())
        return cls(r, theta, np.stack([r.min(0), r.max(0)]), np.stack([theta.min(0), theta.max(0)]))


@dataclass(frozen=True, slots=True, eq=False)
class FrequencyNominal:
    """G_r and its two-sided impulse response.

    Attributes
    ----------
    f_hz, response : ndarray, shape (points / 2 + 1,)
        G_r from 0 Hz to the Nyquist frequency.
    tracked : ndarray, same shape
        |E G|^2 / E|G|^2: the share of a path's energy at this frequency that the best controller
        tracks on average; 1 for a plant that is known.
    markov : ndarray, shape (points / 2,)
        Response at 0, 1, 2, ...
    ahead : ndarray, shape (points / 2 - 1,)
        Response at -1, -2, ...
    """

    f_hz: Array
    response: Responses
    tracked: Array
    markov: Array
    ahead: Array

    @property
    def ahead_share(self) -> float:
        """Share of the response's energy that is non-causal."""
        early = float(self.ahead @ self.ahead)
        return early / (early + float(self.markov @ self.markov))

    def operator(self, samples: int) -> ToeplitzOperator:
        """Return G_r over a number of samples, as filtered basis functions take it.

        It includes the non-causal part. Use `needed_delay` more samples than the path has, hold the
        path there, and drop their commands: otherwise the last commands are huge, because the
        samples that G_r looks ahead to are missing.
        """
        markov = np.zeros(samples)
        used = min(samples, len(self.markov))
        markov[:used] = self.markov[:used]
        return ToeplitzOperator(markov, self.ahead[: samples - 1])

    def causal(self) -> Array:
        """Return taps of a stable causal filter for G_r, shape (points / 2,).

        Raises
        ------
        DesignError
            If more than `CAUSAL_SHARE` of the response's energy is non-causal: a causal filter with
            this frequency response would be unstable, or does not exist.
        """
        if self.ahead_share > CAUSAL_SHARE:
            raise DesignError(
                f"G_r is not a stable causal filter: {self.ahead_share:.2%} of its response lies "
                f"ahead of time, limit {CAUSAL_SHARE:.2%}. Take it two-sided (operator), or delay "
                f"it (delayed) by {self.needed_delay()} samples and the path with it"
            )
        return self.markov.copy()

    def needed_delay(self, limit: float = CAUSAL_SHARE) -> int:
        """Return the smallest delay in samples that leaves at most `limit` non-causal energy."""
        energy = float(self.ahead @ self.ahead + self.markov @ self.markov)
        # left[d]: non-causal energy after a delay of d samples.
        left = np.append(np.cumsum(self.ahead[::-1] ** 2)[::-1], 0.0)
        return int(np.argmax(left <= limit * energy))

    def delayed(self, delay: int) -> Array:
        """Return causal taps of q^-delay G_r: for a path known `delay` samples ahead."""
        if not 0 <= delay <= len(self.ahead):
            raise DesignError(
                f"delay {delay} of a response that begins {len(self.ahead)} samples ahead: take "
                f"0 to {len(self.ahead)}"
            )
        return np.concatenate([self.ahead[:delay][::-1], self.markov])


def sampled_responses(plants: Sequence[DiscretePlant], points: int) -> tuple[Array, Responses]:
    """Return the frequencies (points / 2 + 1,) of a real FFT and the responses (l, f) there.

    Raises
    ------
    DesignError
        If there is no plant, or their sampling times differ.
    """
    steps = sorted({plant.dt_s for plant in plants})
    if len(steps) != 1:
        raise DesignError(
            f"plants at sampling times {steps} s: give at least one, all at the same time"
        )
    f_hz = _grid(points, steps[0])
    return f_hz, np.stack([plant.frequency_response(f_hz) for plant in plants])


def extended_response(
    f_hz: ArrayLike, response: ArrayLike, outside: DiscretePlant, points: int
) -> Responses:
    """Bring a measured response to the grid of a real FFT, shape (points / 2 + 1,).

    Magnitude and phase are interpolated within the measured band. Beyond it the model `outside`
    is used, joined to the measurement by a ratio that fades within an octave, and within half the
    lowest frequency.

    Parameters
    ----------
    f_hz, response : array_like, shape (k,)
        Rising frequencies and the measured response.

    Raises
    ------
    DesignError
        If frequencies do not rise, leave 0 to Nyquist, or the response is zero or not finite.
    """
    f, g = np.asarray(f_hz, np.float64), np.asarray(response, np.complex128)
    nyquist = 0.5 / outside.dt_s
    if f.shape != g.shape or f.ndim != 1 or len(f) < 2:
        raise DesignError(f"{f.shape} frequencies and {g.shape} responses: give two or more pairs")
    if np.any(np.diff(f) <= 0) or f[0] < 0 or f[-1] > nyquist:
        raise DesignError(
            f"frequencies {f[0]:g} to {f[-1]:g} Hz must rise between 0 and {nyquist:g} Hz"
        )
    if not np.all(np.isfinite(g) & (g != 0)):
        raise DesignError("a measured response is zero or not finite; leave that frequency out")
    grid = _grid(points, outside.dt_s)
    model = outside.frequency_response(grid)
    ratio = g / outside.frequency_response(f)
    # The logarithm of the ratio is smooth even where the responses rotate quickly.
    size, angle = np.log(np.abs(ratio)), np.unwrap(np.angle(ratio))
    inner = np.interp(grid, f, size) + 1j * np.interp(grid, f, angle)
    above = np.clip((2 * f[-1] - grid) / f[-1], 0.0, 1.0)
    below = np.clip(2 * grid / max(f[0], _POINT) - 1.0, 0.0, 1.0)
    return np.asarray(model * np.exp(inner * np.minimum(above, below)), np.complex128)


def bandwidths(samples: ArrayLike) -> Array:
    """Return the standard deviation of normal kernels for samples (l, f), shape (f,).

    Optimal for normally distributed samples: s (4 / (3 l))^(1/5), with s the median absolute
    deviation over .6745, or the range where that is zero. This is Silverman's rule with a robust s,
    the default of ``fitdist``, which appendix I.3 used.
    """
    x = np.asarray(samples, np.float64)
    spread = np.median(np.abs(x - np.median(x, axis=0)), axis=0) / 0.6745
    spread = np.where(spread > 0, spread, np.ptp(x, axis=0))
    return np.asarray(spread * (4.0 / (3.0 * len(x))) ** 0.2, np.float64)


def robust_response(
    responses: ArrayLike,
    weights: ArrayLike | None = None,
    distribution: Distribution = "kernel",
    *,
    r_bandwidth: ArrayLike | None = None,
    theta_bandwidth: ArrayLike | None = None,
) -> tuple[Responses, Array]:
    """Return G_r (I.3) and the share of energy that it tracks, each of shape (f,).

    Parameters
    ----------
    responses : array_like, shape (l, f)
        One row per plant or measurement; all at the same frequencies.
    weights : array_like, shape (l,), optional
        Not negative, sum 1; equal by default. Not used by the uniform distribution.
    distribution : str
        ``sampled``, ``uniform`` or ``kernel``.
    r_bandwidth, theta_bandwidth : array_like, shape (f,) or (), optional
        Standard deviations of the kernels in magnitude and phase [rad]; `bandwidths` by default.

    Raises
    ------
    DesignError
        If a response is not finite, all are zero at a frequency, or their phases point in all
        directions, so that no controller tracks better than none.
    """
    g = np.asarray(responses, np.complex128)
    if g.ndim != 2 or g.size == 0 or not np.isfinite(g).all():
        raise DesignError(
            f"responses of shape {g.shape}: give finite values, (plants, frequencies)"
        )
    silent = np.all(g == 0, axis=0)
    if silent.any():
        raise DesignError(
            f"all plants are silent at frequency {int(np.argmax(silent))} of the grid"
        )
    shares = checked_weights(np.full(len(g), 1.0 / len(g)) if weights is None else weights, len(g))
    first, second = _moments(g, shares, distribution, r_bandwidth, theta_bandwidth)
    tracked = np.abs(first) ** 2 / second
    if tracked.min() < _LEAST_TRACKED:
        raise DesignError(
            f"phases point in all directions at frequency {int(np.argmin(tracked))} of the grid: "
            f"the best controller tracks {tracked.min():.1e} of the energy there, at least "
            f"{_LEAST_TRACKED:.0e} needed; narrow the set, or replace it by one plant beyond the "
            "band in which it is known"
        )
    return np.asarray(second / first.conj(), np.complex128), np.asarray(tracked, np.float64)


def _moments(
    g: Responses,
    shares: Array,
    distribution: Distribution,
    r_bandwidth: ArrayLike | None,
    theta_bandwidth: ArrayLike | None,
) -> tuple[Responses, Array]:
    """Return the means of G and of |G|^2 over a distribution, each of shape (f,)."""
    if distribution == "sampled":
        return shares @ g, shares @ np.abs(g) ** 2
    region = Region.of(g)
    if distribution == "uniform":
        r = _uniform_mean(region.r_span, _moments_of_r)
        turn = _uniform_mean(region.theta_span, _turn)[0]
    elif distribution == "kernel":
        r = _kernel_mean(region.r, shares, region.r_span, r_bandwidth, _moments_of_r)
        turn = _kernel_mean(region.theta, shares, region.theta_span, theta_bandwidth, _turn)[0]
    else:
        raise DesignError(
            f"no distribution is called {distribution!r}; there are sampled, uniform, kernel"
        )
    return r[1] / r[0] * turn, (r[2] / r[0]).real


def robust_nominal(
    plants: Sequence[DiscretePlant] | ArrayLike,
    *,
    distribution: Distribution = "kernel",
    points: int = 4096,
    dt_s: float | None = None,
) -> FrequencyNominal:
    """Make the robust nominal model of a set of plants or of measured responses.

    Parameters
    ----------
    plants : sequence of DiscretePlant, or array_like, shape (l, points / 2 + 1)
        Responses from 0 Hz to the Nyquist frequency; see `extended_response` for measured ones.
    distribution : str
        See `robust_response`.
    points : int
        Length of the two-sided impulse response, even; longer than the plants ring.
    dt_s : float, optional
        Sampling time of responses; plants have their own.

    Raises
    ------
    DesignError
        As `robust_response`; if the grid does not fit; if the response outlasts it.
    """
    if points < 4 or points % 2:
        raise DesignError(f"{points} points: an even number, at least 4, is needed")
    given = list(plants) if isinstance(plants, Sequence) else []
    models = [p for p in given if isinstance(p, DiscretePlant)]
    if models:
        f_hz, responses = sampled_responses(models, points)
    else:
        responses = np.asarray(plants, np.complex128)
        if dt_s is None or responses.ndim != 2 or responses.shape[1] != points // 2 + 1:
            raise DesignError(
                f"responses of shape {responses.shape} with {points} points: give "
                f"(plants, {points // 2 + 1}) and the sampling time"
            )
        f_hz = _grid(points, dt_s)
    response, tracked = robust_response(responses, distribution=distribution)
    # The response of a real filter is real at 0 Hz and at the Nyquist frequency.
    response[[0, -1]] = response[[0, -1]].real
    h = np.fft.irfft(response, points)
    half = points // 2
    late = float(h[half // 2 : half + half // 2] @ h[half // 2 : half + half // 2] / (h @ h))
    if late > _UNSETTLED:
        raise DesignError(
            f"{late:.1%} of the response of G_r lies beyond half of its {points} points, limit "
            f"{_UNSETTLED:.1%}: it would wrap around; take more points"
        )
    return FrequencyNominal(f_hz, response, tracked, h[:half], h[:half:-1].copy())


def _grid(points: int, dt_s: float) -> Array:
    return np.asarray(np.fft.rfftfreq(points, dt_s), np.float64)


def _moments_of_r(r: Array) -> Responses:
    """Integrands of the area, of E|G| and of E|G|^2: r, r^2, r^3."""
    return np.stack([r, r**2, r**3]).astype(np.complex128)


def _turn(theta: Array) -> Responses:
    """Integrand of the mean direction."""
    return np.asarray(np.exp(1j * theta)[None], np.complex128)


def _uniform_mean(span: Array, integrands: _Integrands) -> Responses:
    """Mean of the integrands over the span, shape (k, f)."""
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    middle, half = 0.5 * (span[0] + span[1]), 0.5 * (span[1] - span[0])
    values = integrands(middle[:, None] + half[:, None] * nodes)
    return np.asarray(values @ weights / 2.0, np.complex128)


def _kernel_mean(
    samples: Array,
    shares: Array,
    span: Array,
    bandwidth: ArrayLike | None,
    integrands: _Integrands,
) -> Responses:
    """Mean of the integrands over normal kernels cut off at the span, shape (k, f)."""
    sigma = bandwidths(samples) if bandwidth is None else np.asarray(bandwidth, np.float64)
    if not (np.isfinite(sigma).all() and np.all(sigma >= 0)):
        raise DesignError(f"kernel bandwidth {sigma.min():g} must be finite and not negative")
    scale = np.maximum(np.abs(samples).max(axis=0), _POINT)
    sigma = np.maximum(np.broadcast_to(sigma, span[0].shape), 1e-3 * _POINT * scale)
    low, high = span
    # Where all samples agree the kernel is not cut off.
    agree = high - low <= _POINT * scale
    low, high = np.where(agree, -np.inf, low), np.where(agree, np.inf, high)
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    total = np.zeros((1, 1), complex)
    mass = np.zeros(len(sigma))
    for share, x in zip(shares, samples, strict=True):
        begin = np.clip((low - x) / sigma, -_REACH, _REACH)
        end = np.clip((high - x) / sigma, -_REACH, _REACH)
        half = 0.5 * (end - begin)
        s = 0.5 * (begin + end)[:, None] + half[:, None] * nodes
        density = share * half[:, None] * weights * np.exp(-0.5 * s**2)
        part = np.sum(integrands(x[:, None] + sigma[:, None] * s) * density, axis=-1)
        total = total + part
        mass += density.sum(axis=-1)
    return np.asarray(total / mass, np.complex128)
