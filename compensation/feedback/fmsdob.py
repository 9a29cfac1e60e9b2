"""Forward-model selective disturbance observer: rejects tones and bands without a plant inverse.

Paper 000 (Jiang, Xiao, Tang, Sun, Chen, IEEE TCST 2020):  dhat = y - F (what F was driven with),
c = Q dhat, S = S0 (1 - F Q), with Q = 1/F at the targets only. The forward model F is one of

- "servo" (default): F = P/(1 + PC), driven with the loop's input; T0 itself if C = 1. F and Q
  are stable, so the loop is internally stable for every plant whose baseline is, integrators
  included: this is (18) of Youla, with X/Y = C and N = F (Remark 8 of the paper).
- "plant": F = P, driven with u, as the paper draws it. P must be strictly stable.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from stillpath.compensation.base import DesignError
from stillpath.compensation.feedback.bandpass import LatticeBandPass
from stillpath.compensation.feedback.controller import (
    CoefficientSet,
    Controller,
    Design,
    Prediction,
    Refusal,
    Uncertainty,
    frequency_grid,
    judged,
)
from stillpath.compensation.feedback.interpolation import interpolating_fir, inverse_and_slope
from stillpath.models.arrays import Array, Complex
from stillpath.models.diagrams import Block
from stillpath.models.loops import Loop

__all__ = [
    "Around",
    "QFilter",
    "Shape",
    "Trim",
    "add_on_blocks",
    "band_widths",
    "design_q",
    "fmsdob",
    "forward_model",
    "instant_check",
    "model_blocks",
    "target_angles",
]

Around = Literal["servo", "plant"]
Shape = Literal["pointwise", "hermite"]


@dataclass(frozen=True, slots=True)
class QFilter:
    """Q = gain * Q_BP(z) * (q_0 + q_1 z^-1 + ...).

    Attributes
    ----------
    gain : float
        Detuning: below 1 the depth of the notches is 1 - gain.
    """

    taps: tuple[float, ...]
    band_pass: LatticeBandPass | None = None
    gain: float = 1.0

    def response(self, w: ArrayLike) -> Complex:
        """Return Q at w rad/sample."""
        at = np.atleast_1d(np.asarray(w, float))
        out = np.asarray(self.gain * np.polyval(self.taps[::-1], np.exp(-1j * at)), complex)
        if self.band_pass is not None:
            out *= self.band_pass.response(at)
        return out

    def blocks(self, source: str, target: str) -> tuple[Block, ...]:
        """Return Q as blocks from the signal `source` to `target`."""
        if self.band_pass is None:
            return (Block(target, ((source, self.gain),), self.taps),)
        return (
            *self.band_pass.blocks(source, "band"),
            Block(target, (("band", self.gain),), self.taps),
        )

    def coefficients(self) -> tuple[CoefficientSet, ...]:
        """Return the coefficients that a controller loads."""
        taps = tuple(self.gain * q for q in self.taps)
        fir = CoefficientSet("q", "fir", {"taps": taps})
        if self.band_pass is None:
            return (fir,)
        sections = {"k1": self.band_pass.k1, "k2": self.band_pass.k2}
        rows = tuple(num + den for num, den in self.band_pass.notches())
        return (
            CoefficientSet("band", "lattice", sections),
            CoefficientSet("notch", "sos", {"rows": rows}),
            fir,
        )


@dataclass(frozen=True, slots=True)
class Trim:
    """Further requirements on Q.

    Attributes
    ----------
    detuning : float
        In (0, 1]; below 1 the notches are shallower, and less is amplified elsewhere.
    zeros : sequence of (radius, f_hz)
        Fixed zeros of Q, at frequencies that must not change.
    through_band : bool
        Interpolate 1/(F Q_BP) with its slope instead of 1/F. The phase slope of the band pass makes
        the notches of a Hermite Q as narrow as pointwise ones; this compensates it, and also loses
        what the band pass had saved elsewhere.
    """

    detuning: float = 1.0
    zeros: Sequence[tuple[float, float]] = ()
    through_band: bool = False

    def settings(self) -> dict[str, object]:
        """Return the settings as stored in a controller's document."""
        zeros = [list(zero) for zero in self.zeros]
        return {"detuning": self.detuning, "zeros": zeros, "through_band": self.through_band}


_UNTRIMMED = Trim()


def fmsdob(
    loops: Sequence[Loop],
    targets_hz: Sequence[float],
    *,
    shape: Shape = "pointwise",
    bandwidth_hz: float | Sequence[float] | None = 50.0,
    trim: Trim = _UNTRIMMED,
    around: Around = "servo",
    uncertainty: Uncertainty | None = None,
) -> Controller:
    """Design the observer for disturbances at `targets_hz`.

    Parameters
    ----------
    loops : sequence of Loop
        The nominal loop, then the members of its plant set.
    shape : "pointwise" or "hermite"
        Whether 1 - FQ has a zero, or a double zero (wider notch) at the targets. Low targets
        against the sampling rate make Hermite filters amplify elsewhere: see `max_add_on`.
    bandwidth_hz : float, sequence of float, or None
        -3 dB width of the band pass; None: no band pass.
    around : "servo" or "plant"
        Forward model, see the module.
    uncertainty : float or function of f_hz, optional
        Relative plant error to tolerate everywhere.

    Raises
    ------
    DesignError
        If a target is not below half the sampling rate, or two are too close.
    Refusal
        If the loop would be unstable for a member, or small gain is violated.
    """
    nominal = loops[0]
    _check_model(nominal, around)
    q = design_q(
        nominal, targets_hz, shape=shape, bandwidth_hz=bandwidth_hz, trim=trim, around=around
    )
    asked = band_widths(bandwidth_hz, len(targets_hz))
    f = frequency_grid(nominal.dt_s, targets_hz, asked or (0.01 / nominal.dt_s,) * len(targets_hz))
    least = instant_check(nominal, targets_hz)
    design = Design(
        "fmsdob",
        add_on_blocks(nominal, q, around),
        Prediction(f, nominal.s0(f), 1.0 - _forward(nominal, around, f) * _at(q, nominal, f)),
        (*q.coefficients(), _model_coefficients(nominal, around)),
        settings={
            "targets_hz": [float(t) for t in targets_hz],
            "shape": shape,
            "bandwidth_hz": list(asked),
            **trim.settings(),
            "around": around,
        },
        notes=tuple(
            f"narrow band at {target:g} Hz: 1/|T| there at least {20 * math.log10(value):.2f} dB"
            for target, value in zip(targets_hz, least, strict=True)
        ),
    )
    return judged(design, loops, uncertainty)


def _check_model(loop: Loop, around: Around) -> None:
    """Refuse a forward model that would drift."""
    if around == "plant" and loop.plant_radius >= 1.0 - 1e-9:
        raise Refusal(
            "unstable",
            f"fmsdob on {loop.name!r}: the plant has a pole at |z| = "
            f"{loop.plant_radius:.6f}, so its model alone would drift; use around='servo'",
        )


def design_q(
    loop: Loop,
    targets_hz: Sequence[float],
    *,
    shape: Shape = "pointwise",
    bandwidth_hz: float | Sequence[float] | None = 50.0,
    trim: Trim = _UNTRIMMED,
    around: Around = "servo",
) -> QFilter:
    """Return Q with F Q = `trim.detuning` at the targets; parameters as in `fmsdob`.

    Raises
    ------
    DesignError
        See `fmsdob`.
    """
    w = target_angles(loop, targets_hz)
    if not 0.0 < trim.detuning <= 1.0:
        raise DesignError(f"detuning {trim.detuning:g}: take a factor in (0, 1]")
    values, slopes = inverse_and_slope(*forward_model(loop, around), w)
    widths = band_widths(bandwidth_hz, len(w))
    band = LatticeBandPass.at(tuple(map(float, targets_hz)), widths, loop.dt_s) if widths else None
    if trim.through_band and band is not None:
        slopes = slopes - values * np.array([band.slope(i) for i in range(len(w))])
    angles = [(radius, 2 * math.pi * f_hz * loop.dt_s) for radius, f_hz in trim.zeros]
    taps = interpolating_fir(w, values, slopes if shape == "hermite" else None, angles)
    return QFilter(tuple(taps.tolist()), band, trim.detuning)


def target_angles(loop: Loop, targets_hz: Sequence[float]) -> Array:
    """Return the targets in rad/sample.

    Raises
    ------
    DesignError
        If there is none, one is not between 0 and half the sampling rate, or one is repeated.
    """
    top = 0.5 / loop.dt_s
    targets = np.asarray(targets_hz, float)
    if targets.ndim != 1 or len(targets) == 0:
        raise DesignError("name at least one target frequency")
    for f in targets:
        if not 0.0 < f < top:
            raise DesignError(
                f"target {f:g} Hz does not lie between 0 and half the sampling rate, {top:g} Hz"
            )
    if len(np.unique(targets)) < len(targets):
        raise DesignError("a target frequency is named twice")
    return np.asarray(2 * np.pi * targets * loop.dt_s, np.float64)


def instant_check(loop: Loop, targets_hz: ArrayLike) -> Array:
    """Return min 1/|T| near each target for any narrow band pass, before any design.

    On a narrow band the locus of T is the circle through T0 and 1, so it is
    2/(|1 + T0| + |1 - T0|) whatever Q is.
    """
    t0 = loop.t0(targets_hz)
    return np.asarray(2.0 / (np.abs(1 + t0) + np.abs(1 - t0)), np.float64)


def forward_model(loop: Loop, around: Around) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return F, numerator and denominator in rising powers of z^-1."""
    if around == "plant":
        return loop.plant_num, loop.plant_den
    return loop.servo_num, loop.t0_den


def add_on_blocks(loop: Loop, q: QFilter, around: Around) -> tuple[Block, ...]:
    """Return the observer as blocks that read ym, r, u and write c."""
    dhat = Block("dhat", (("ym", 1.0), ("model", -1.0)))
    return (*model_blocks(loop, around), dhat, *q.blocks("dhat", "c"))


def model_blocks(loop: Loop, around: Around = "servo") -> tuple[Block, ...]:
    """Return blocks that write "model", the output of the machine without disturbance."""
    if around == "plant":
        return (Block("model", (("u", 1.0),), loop.plant_num, loop.plant_den),)
    if loop.tracking_num == loop.servo_num:
        driven = (("r", 1.0), ("c", -1.0))
        return (Block("model", driven, loop.servo_num, loop.t0_den),)
    return (
        Block("told", (("r", 1.0),), loop.tracking_num, loop.t0_den),
        Block("answer", (("c", -1.0),), loop.servo_num, loop.t0_den),
        Block("model", (("told", 1.0), ("answer", 1.0))),
    )


def band_widths(bandwidth_hz: float | Sequence[float] | None, count: int) -> tuple[float, ...]:
    """Return the width of each of `count` bands; () for no band pass."""
    if bandwidth_hz is None:
        return ()
    if isinstance(bandwidth_hz, Sequence):
        if len(bandwidth_hz) != count:
            raise DesignError(f"{len(bandwidth_hz)} bandwidths for {count} targets")
        return tuple(float(b) for b in bandwidth_hz)
    return (float(bandwidth_hz),) * count


def _forward(loop: Loop, around: Around, f_hz: Array) -> Complex:
    return loop.plant(f_hz) if around == "plant" else loop.servo(f_hz)


def _at(q: QFilter, loop: Loop, f_hz: Array) -> Complex:
    return q.response(2 * np.pi * f_hz * loop.dt_s)


def _model_coefficients(loop: Loop, around: Around) -> CoefficientSet:
    num, den = forward_model(loop, around)
    return CoefficientSet("model", "iir", {"num": num, "den": den})
