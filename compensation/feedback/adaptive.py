"""Identify tones of unknown, jumping frequency, and retune the observer to follow them.

A notch A(z)/A(rho z) with mirror-symmetric A is fitted to the disturbance estimate by recursive
least squares. To lock on the right frequency, covariance and data are reset after every jump, and
the notch starts wide (rho .3) with a short memory (lambda .9) before it narrows (.98, .995).
Started at rho = .9 it locked 1 kHz off.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev
from scipy.signal import lfilter

from stillpath.compensation.base import DesignError
from stillpath.compensation.feedback._adaptive_kernels import track
from stillpath.compensation.feedback.controller import Controller
from stillpath.compensation.feedback.fmsdob import QFilter, add_on_blocks, design_q, fmsdob
from stillpath.models.arrays import Array
from stillpath.models.diagrams import Block
from stillpath.models.loops import Loop

__all__ = ["AdaptiveFmsdob", "FrequencyTracker", "Retuning"]

_START_RADIUS, _END_RADIUS = 0.3, 0.98
_START_FORGETTING, _END_FORGETTING = 0.9, 0.995
_DECAY_SAMPLES = 25
_START_COVARIANCE = 1e4
_LARGEST_POLE = 0.97
# Shares of power that the zeros leave once a tone has moved. When locked: after the poles, which
# amplify the tone, about 1/600 of the noise-to-tone ratio; of the signal itself, the noise.
_LEFT_BEHIND_POLES, _LEFT_OF_SIGNAL = 2e-3, 0.4


class FrequencyTracker:
    """Frequencies of a known number of tones, from samples that arrive in blocks.

    Parameters
    ----------
    tones : int
        At most 8. One locks within about 100 samples, three within about 500, even at a
        signal-to-noise ratio of 8 dB.
    floor_rms : float
        Signals below this rms are ignored.

    Attributes
    ----------
    jumped : bool
        Whether the last block caused a restart.
    """

    def __init__(self, tones: int, dt_s: float, floor_rms: float = 1e-6) -> None:
        if not 1 <= tones <= 8:
            raise DesignError(f"{tones} tones; between 1 and 8 can be told apart")
        self._tones, self._dt_s, self._floor = tones, dt_s, floor_rms
        self._now = _Estimate.fresh(tones)
        self._found: tuple[float, ...] = ()
        self.jumped = False

    def push(self, x: Array) -> tuple[float, ...]:
        """Return the frequencies [Hz], rising, after samples x (n,); () while there are none.

        Samples that are no numbers count as 0: one would stay in the recursion for good.
        """
        self.jumped = False
        if len(x):
            self._found = self._pushed(_numbers(x))
        return self._found

    def _pushed(self, x: Array) -> tuple[float, ...]:
        now = self._now
        power = float(np.mean(x**2))
        if math.sqrt(power) < self._floor:
            return self._restart() if now.heard else ()
        if not now.heard:
            now.covariance[:] = np.eye(self._tones) * _START_COVARIANCE / power
        now.heard += len(x)
        track(
            np.ascontiguousarray(x), now.theta, now.covariance, now.history,
            now.poles, now.radius, now.forgetting, now.levels,
        )  # fmt: skip
        cosines = _cosines(now.theta)
        now.poles[:] = _coefficients(cosines)
        if now.heard <= 2 * _DECAY_SAMPLES:
            # The first errors are meaningless and may be huge.
            now.levels[:] = 0.0
        elif now.heard > 4 * _DECAY_SAMPLES * self._tones and now.lost:
            return self._restart()
        if now.heard < 8 * self._tones:
            return ()
        f = np.sort(np.arccos(cosines)) / (2 * math.pi * self._dt_s)
        return tuple(float(v) for v in f)

    def _restart(self) -> tuple[float, ...]:
        self._now = _Estimate.fresh(self._tones)
        self.jumped = True
        return ()


@dataclass(frozen=True, slots=True)
class Retuning:
    """New coefficients for running blocks, and whether their states start at 0."""

    blocks: tuple[Block, ...]
    reset: bool


class AdaptiveFmsdob:
    """A forward-model observer whose targets follow the disturbance.

    Run a loop with `blocks` for a short time (1 ms), pass the recorded signal "dhat" to `hear`, and
    apply the coefficients that it returns to the loop.

    Parameters
    ----------
    loops : sequence of Loop
        The nominal loop, then the members of its plant set.
    bandwidth_hz : float
        Of the band pass.
    floor_rms : float
        Below this rms of the disturbance the observer is silent.
    """

    def __init__(
        self,
        loops: Sequence[Loop],
        tones: int,
        *,
        bandwidth_hz: float = 50.0,
        floor_rms: float = 1e-6,
    ) -> None:
        self._loops, self._tones = tuple(loops), tones
        self._bandwidth_hz, self._floor_rms = bandwidth_hz, floor_rms
        self.tracker = FrequencyTracker(tones, loops[0].dt_s, floor_rms)
        top = 0.5 / loops[0].dt_s
        self._idle = tuple(top * (i + 1) / (tones + 1) for i in range(tones))
        self._tuned: tuple[float, ...] = ()
        self._last: tuple[float, ...] = ()
        self._judged: tuple[float, ...] = ()
        self._refused: tuple[float, ...] = ()
        self._unloop = _unlooped(loops[0])
        self._memory = np.zeros(max(map(len, self._unloop)) - 1)

    @property
    def targets_hz(self) -> tuple[float, ...]:
        """Frequencies currently rejected; () while the observer is silent."""
        return self._tuned

    @property
    def blocks(self) -> tuple[Block, ...]:
        """The observer, silent, with its final structure."""
        return add_on_blocks(self._loops[0], self._silent(), "servo")

    def hear(self, dhat: Array) -> Retuning | None:
        """Return new coefficients after the samples `dhat`, shape (n,); None: no change."""
        disturbance, self._memory = lfilter(*self._unloop, _numbers(dhat), zi=self._memory)
        found = self.tracker.push(disturbance)
        moved, self._last = _apart(found, self._last), found
        if moved > 0.25 * self._bandwidth_hz:
            return self._retuned(()) if self.tracker.jumped else None
        near = 0.5 * self._bandwidth_hz
        if _apart(found, self._tuned) <= 1e-13 * max(found) or _apart(found, self._refused) <= near:
            return None
        return self._retuned(found)

    def controller(self) -> Controller:
        """Return the checked controller for the present targets.

        Raises
        ------
        DesignError
            If there are no targets, or the design is refused.
        """
        if not self._tuned:
            raise DesignError(f"fmsdob-adaptive on {self._loops[0].name!r}: {self._why_silent()}")
        return fmsdob(self._loops, self._tuned, bandwidth_hz=self._bandwidth_hz)

    def _retuned(self, targets: tuple[float, ...]) -> Retuning | None:
        if targets == self._tuned:
            return None
        before, self._tuned = self._tuned, targets
        if not targets:
            return Retuning(self._silent().blocks("dhat", "c"), reset=True)
        try:
            if _apart(targets, self._judged) > 0.5 * self._bandwidth_hz:
                self.controller()
                self._judged = targets
            q = design_q(self._loops[0], targets, bandwidth_hz=self._bandwidth_hz)
        except DesignError:
            # Tones not separated yet, or an unstable member: keep the old targets until they move.
            self._tuned, self._refused = before, targets
            return None
        far = _apart(targets, before) > 0.5 * self._bandwidth_hz
        return Retuning(q.blocks("dhat", "c"), reset=far)

    def _why_silent(self) -> str:
        heard = ", ".join(f"{f:.5g}" for f in self._last)
        if not self._last:
            return (
                f"nothing of more than floor_rms {self._floor_rms:g} rms is heard, or a tone has "
                "just jumped; lower floor_rms, or let it run longer"
            )
        if self._refused:
            return f"{heard} Hz are heard, but cannot be rejected together; take fewer tones"
        return (
            f"what is heard as {heard} Hz still moves by more than "
            f"{0.25 * self._bandwidth_hz:g} Hz a time: it is noise, or its tones are not "
            f"{self._tones}; change tones, or raise floor_rms above the noise"
        )

    def _silent(self) -> QFilter:
        q = design_q(self._loops[0], self._idle, bandwidth_hz=self._bandwidth_hz)
        return QFilter(q.taps, q.band_pass, 0.0)


@dataclass(slots=True, eq=False)
class _Estimate:
    """State of the recursion; arrays as in `track`."""

    theta: Array
    poles: Array
    covariance: Array
    history: Array
    radius: Array
    forgetting: Array
    levels: Array
    heard: int = 0

    @classmethod
    def fresh(cls, tones: int) -> _Estimate:
        decay = math.exp(-1 / _DECAY_SAMPLES)
        return cls(
            np.zeros(tones),
            np.zeros(tones),
            np.zeros((tones, tones)),
            np.zeros(2 * tones),
            np.array([_START_RADIUS, _END_RADIUS, decay]),
            np.array([_START_FORGETTING, _END_FORGETTING, decay]),
            np.zeros(3),
        )

    @property
    def lost(self) -> bool:
        """Return whether the residual is larger than noise would leave."""
        error, filtered, signal = self.levels
        return bool(error > _LEFT_BEHIND_POLES * filtered or error > _LEFT_OF_SIGNAL * signal)


def _numbers(x: Array) -> Array:
    """Return samples with 0 in place of those that a sensor did not give."""
    return np.where(np.isfinite(x), x, 0.0)


def _cosines(theta: Array) -> Array:
    """Return cos w of the tones: z^m A(z) is a Chebyshev series in cos w."""
    series = np.concatenate([theta[-1:], 2 * theta[-2::-1], [2.0]])
    roots = chebyshev.chebroots(series)
    return np.asarray(np.clip(np.real(roots), -1 + 1e-9, 1 - 1e-9), np.float64)


def _unlooped(loop: Loop) -> tuple[Array, Array]:
    """Return a stable filter close to 1/S0.

    Around the servo, dhat is S0 d: tones that the baseline loop suppresses would be lost in noise.
    """
    poles = np.roots(np.convolve(loop.plant_den, loop.controller[1]))
    size = np.maximum(np.abs(poles), 1e-300)
    poles = poles * np.minimum(1.0, _LARGEST_POLE / size)
    return np.asarray(loop.t0_den), np.asarray(np.real(np.poly(poles)), np.float64)


def _apart(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    """Return the largest step between two lists of tones, infinite unless both have tones."""
    if not a or not b:
        return math.inf
    return max(abs(x - y) for x, y in zip(a, b, strict=True))


def _coefficients(cosines: Array) -> Array:
    """Return a_1 .. a_m of prod(1 - 2 cos w z^-1 + z^-2)."""
    poly = np.ones(1)
    for c in cosines:
        poly = np.convolve(poly, [1.0, -2.0 * c, 1.0])
    return np.asarray(poly[1 : len(cosines) + 1], np.float64)
