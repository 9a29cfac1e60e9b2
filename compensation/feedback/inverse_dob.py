"""Disturbance observer with a plant inverse, for comparison with the forward-model one.

dhat = z^-m P^-1 y - z^-m u, c = Q dhat, S = S0 (1 - z^-m Q); Q is a band pass times the FIR that
compensates the m samples of delay at the targets (paper 000, section VIII-A, after its reference
[21]). It needs zeros of P well inside the unit circle.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

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
from stillpath.compensation.feedback.fmsdob import QFilter, target_angles
from stillpath.compensation.feedback.interpolation import interpolating_fir
from stillpath.models.diagrams import Block
from stillpath.models.loops import Loop

__all__ = ["LARGEST_INVERSE_RADIUS", "inverse_dob"]

LARGEST_INVERSE_RADIUS = 0.97


def inverse_dob(
    loops: Sequence[Loop],
    targets_hz: Sequence[float],
    *,
    bandwidth_hz: float = 50.0,
    uncertainty: Uncertainty | None = None,
) -> Controller:
    """Design the observer for tones at `targets_hz`; parameters as in `fmsdob`.

    Raises
    ------
    DesignError
        If a target is out of range.
    Refusal
        If the inverse has a pole beyond |z| = .97, or the loop is unstable for a member, or
        small gain is violated.
    """
    nominal = loops[0]
    numerator = np.trim_zeros(np.asarray(nominal.plant_num), "f")
    delay = len(nominal.plant_num) - len(numerator)
    radius = float(np.abs(np.roots(numerator)).max(initial=0.0))
    if radius > LARGEST_INVERSE_RADIUS:
        raise Refusal(
            "inverse",
            f"inverse dob on {nominal.name!r}: the plant has a zero at |z| = {radius:.4f}, so its "
            f"inverse has a pole there (at most {LARGEST_INVERSE_RADIUS:g}); use fmsdob",
        )
    w = target_angles(nominal, targets_hz)
    widths = (bandwidth_hz,) * len(w)
    q = QFilter(
        tuple(interpolating_fir(w, np.exp(1j * delay * w)).tolist()),
        LatticeBandPass.at(tuple(map(float, targets_hz)), widths, nominal.dt_s),
    )
    f = frequency_grid(nominal.dt_s, targets_hz, widths)
    z = nominal.z(f)
    inverse_num, inverse_den = nominal.plant_den, tuple(numerator.tolist())
    design = Design(
        "inverse-dob",
        (
            Block("inverse", (("ym", 1.0),), inverse_num, inverse_den),
            Block("late", (("u", 1.0),), delay=delay),
            Block("dhat", (("inverse", 1.0), ("late", -1.0))),
            *q.blocks("dhat", "c"),
        ),
        Prediction(f, nominal.s0(f), 1.0 - z**-delay * q.response(np.angle(z))),
        (
            *q.coefficients(),
            CoefficientSet("inverse", "iir", {"num": inverse_num, "den": inverse_den}),
        ),
        settings={"targets_hz": [float(t) for t in targets_hz], "bandwidth_hz": bandwidth_hz},
        notes=(f"the inverse has its largest pole at |z| = {radius:.4f}",),
    )
    return judged(design, loops, uncertainty)
