"""Zeros and poles: the DC gain, stability, scaling of frequencies, and real sections.

The common form that every kind of plant is turned into. A continuous plant has roots in s
(rad/s) and `dt_s` None; a discrete one has roots in z.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stillpath.models.errors import ModelError
from stillpath.models.notes import WarningNote

__all__ = [
    "Roots",
    "check_stable",
    "dc_gain",
    "frequency_and_damping",
    "normalise_dc",
    "pole_text",
    "scaled_roots",
    "to_s",
]

_NOTE, _WARN = 0.02, 0.15


@dataclass(frozen=True, slots=True)
class Roots:
    """Zeros and poles, closed under conjugation, with the DC gain instead of a leading gain."""

    zeros: NDArray[np.complex128]
    poles: NDArray[np.complex128]
    gain: float
    """DC gain."""
    dt_s: float | None


def dc_gain(
    zeros: NDArray[np.complex128], poles: NDArray[np.complex128], dt_s: float | None
) -> float:
    """Return prod(v0 - zeros) / prod(v0 - poles), with v0 = 0 in s (no `dt_s`) and 1 in z.

    Raises
    ------
    ModelError
        For an integrator.
    """
    at = 0.0 if dt_s is None else 1.0
    if np.any(poles == at):
        raise ModelError(
            f"model has an integrator: a pole at {'s = 0' if dt_s is None else 'z = 1'}, "
            "so its DC gain is infinite; a position plant has DC gain 1"
        )
    # Interleaved in the order of size, so that no partial product overflows.
    scale = 1.0 + 0.0j
    top = sorted(at - zeros, key=abs)
    bottom = sorted(at - poles, key=abs)
    for i in range(max(len(top), len(bottom))):
        scale *= top[i] if i < len(top) else 1.0
        scale /= bottom[i] if i < len(bottom) else 1.0
    return float(scale.real)


def check_stable(roots: Roots) -> None:
    """Raise ModelError, naming the pole, unless the plant is finite, proper and stable."""
    if not (np.isfinite(roots.zeros).all() and np.isfinite(roots.poles).all()):
        raise ModelError("a zero or pole is not finite; check the coefficients")
    if len(roots.zeros) > len(roots.poles):
        raise ModelError(
            f"{len(roots.zeros)} zeros against {len(roots.poles)} poles: the plant is improper "
            "(it would differentiate its command); give at least as many poles as zeros"
        )
    if len(roots.poles) == 0:
        return
    if roots.dt_s is None:
        near = np.abs(roots.poles) <= 1e-9 * np.abs(roots.poles).max()
        bad = roots.poles.real >= 0
        rule = "Re s must be below 0"
    else:
        near = np.abs(roots.poles - 1) < 1e-9
        bad = np.abs(roots.poles) >= 1
        rule = "|z| must be below 1"
    if near.any():
        raise ModelError(
            "model has an integrator (coefficients rounded?): pole "
            f"{pole_text(roots.poles[near][0], roots.dt_s)}; a position plant has DC gain 1"
        )
    if bad.any():
        worst = roots.poles[bad][np.argmax(np.abs(roots.poles[bad].imag))]
        raise ModelError(
            f"unstable plant: pole {pole_text(worst, roots.dt_s)}; {rule}. "
            "Fit the model again with stable poles, or give more decimals"
        )


def normalise_dc(roots: Roots) -> tuple[Roots, tuple[str, ...]]:
    """Scale the DC gain to 1 and say so; refuse when it is off by more than 15 %.

    A stepped axis without slip has DC gain 1 by physics; a few percent are sensor gain or
    misalignment, more is another quantity.
    """
    gain = roots.gain
    off = abs(gain - 1.0)
    if not np.isfinite(gain) or off > _WARN:
        raise ModelError(
            f"DC gain {gain:.4g} is more than {_WARN:.0%} from 1: an axis that keeps its steps "
            "ends where it is told. Check that the model maps commanded to actual position "
            "in the same unit, and the steps per mm"
        )
    notes: tuple[str, ...] = ()
    if off > 1e-9:
        text = f"DC gain {gain:.6g} scaled to 1"
        if off > _NOTE:
            text = f"{text}; more than {_NOTE:.0%} off, check sensor gain and direction"
        notes = (WarningNote(text) if off > _NOTE else text,)
    return replace(roots, gain=1.0), notes


def to_s(
    roots: NDArray[np.complex128], dt_s: float | None
) -> tuple[NDArray[np.complex128], NDArray[np.bool_]]:
    """Map roots (n,) to s = log(z) / dt_s; the mask (n,) tells which have such an image.

    Zero and the negative real axis of z have none (above or at the Nyquist frequency).
    """
    if dt_s is None:
        return roots, np.ones(len(roots), bool)
    has = (roots != 0) & ~((roots.imag == 0) & (roots.real <= 0))
    images = np.asarray(np.log(np.where(has, roots, 1.0)) / dt_s, dtype=np.complex128)
    return images, has


def scaled_roots(roots: Roots, frequency: float, damping: float) -> Roots:
    """Multiply frequency and damping ratio of the complex pairs, frequency of the real poles."""
    return Roots(
        _scaled(roots.zeros, roots.dt_s, frequency, damping, real=False),
        _scaled(roots.poles, roots.dt_s, frequency, damping, real=True),
        roots.gain,
        roots.dt_s,
    )


def frequency_and_damping(roots: NDArray[np.complex128], dt_s: float | None) -> NDArray[np.float64]:
    """Return the rows (f_hz, zeta) of the complex pairs, shape (pairs, 2), rising in frequency."""
    s, has = to_s(roots, dt_s)
    s = s[has & (roots.imag > 0)]
    size = np.abs(s)
    rows = np.column_stack([size / (2 * np.pi), -s.real / size])
    return rows[np.argsort(rows[:, 0])]


def pole_text(pole: complex, dt_s: float | None) -> str:
    """Name a pole for a message: its value, and frequency and damping if it has them."""
    name = f"{'s' if dt_s is None else 'z'} = {pole:.6g}"
    if dt_s is not None:
        name += f" (|z| = {abs(pole):.6f})"
    rows = frequency_and_damping(np.array([complex(pole.real, abs(pole.imag))]), dt_s)
    if len(rows):
        name += f", {rows[0, 0]:.4g} Hz, damping {rows[0, 1]:.3g}"
    return name


def _scaled(
    roots: NDArray[np.complex128],
    dt_s: float | None,
    frequency: float,
    damping: float,
    *,
    real: bool,
) -> NDArray[np.complex128]:
    s, has = to_s(roots, dt_s)
    size = np.abs(s) * frequency
    moved = s.copy()
    pair = roots.imag != 0
    zeta = np.where(size > 0, -s.real / np.where(size > 0, np.abs(s), 1.0), 0.0) * damping
    if np.any(pair & (np.abs(zeta) >= 1)):
        raise ModelError(f"damping scale {damping} makes a pair of the plant real; use a smaller")
    root = np.sqrt(np.clip(1 - zeta * zeta, 0, None))
    moved[pair] = (size * (-zeta + 1j * np.sign(s.imag) * root))[pair]
    if real:
        moved[~pair] = s[~pair] * frequency
    if dt_s is None:
        return moved
    back: NDArray[np.complex128] = np.where(has, np.exp(moved * dt_s), roots)
    return back
