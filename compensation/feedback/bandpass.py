"""Lattice band pass of several bands: selects the frequencies of an add-on controller.

Q_BP = 1 - prod_i (1/2)(1 + k2_i)(1 + 2 k1_i z^-1 + z^-2)/(1 + k1_i (1 + k2_i) z^-1 + k2_i z^-2),
paper 000 (16) (after Hirano, Nishimura, Mitra 1974); paper 001 prints the numerator of (6) wrongly.
Exactly 1 at every centre, exactly 0 at dc and at half the sampling rate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stillpath.compensation.base import DesignError
from stillpath.models.arrays import Array, Complex
from stillpath.models.diagrams import Block, polynomial_response

__all__ = ["LatticeBandPass"]


@dataclass(frozen=True, slots=True)
class LatticeBandPass:
    """A band pass with one lattice notch per band.

    Attributes
    ----------
    centres, widths : tuple of float
        rad/sample; the width is that of one section at -3 dB.

    Raises
    ------
    DesignError
        If a centre is not inside (0, pi) or a width not inside (0, pi/2).
    """

    centres: tuple[float, ...]
    widths: tuple[float, ...]

    def __post_init__(self) -> None:
        for centre, width in zip(self.centres, self.widths, strict=True):
            if not (0 < centre < math.pi and 0 < width < math.pi / 2):
                raise DesignError(
                    f"band at {centre:.6g} rad/sample, {width:.6g} wide: the centre must lie in "
                    "(0, pi), the width in (0, pi/2)"
                )

    @classmethod
    def at(
        cls, f_hz: tuple[float, ...], width_hz: tuple[float, ...], dt_s: float
    ) -> LatticeBandPass:
        """Make the band pass of the given frequencies and -3 dB widths."""
        turn = 2 * math.pi * dt_s
        return cls(tuple(turn * f for f in f_hz), tuple(turn * b for b in width_hz))

    @property
    def k1(self) -> tuple[float, ...]:
        """-cos of the centres: these set only the frequencies."""
        return tuple(-math.cos(w) for w in self.centres)

    @property
    def k2(self) -> tuple[float, ...]:
        """Coefficients that set only the widths."""
        return tuple((1 - math.tan(b / 2)) / (1 + math.tan(b / 2)) for b in self.widths)

    def notches(self) -> tuple[tuple[tuple[float, ...], tuple[float, ...]], ...]:
        """Return (num, den) of every section's notch, in rising powers of z^-1."""
        return tuple(
            (
                (0.5 * (1 + k2), k1 * (1 + k2), 0.5 * (1 + k2)),
                (1.0, k1 * (1 + k2), k2),
            )
            for k1, k2 in zip(self.k1, self.k2, strict=True)
        )

    def response(self, w: Array) -> Complex:
        """Return Q_BP at w rad/sample, an array of any shape."""
        z = np.exp(1j * np.asarray(w, float))
        out = np.ones(len(z), complex)
        for num, den in self.notches():
            out *= polynomial_response(num, den, z)
        return np.asarray(1.0 - out, complex)

    def slope(self, index: int) -> complex:
        """Return dQ_BP/dw at the centre `index`: purely phase, as the magnitude is flat there."""
        others = 1.0 + 0.0j
        z = np.exp(1j * np.array([self.centres[index]]))
        for i, (num, den) in enumerate(self.notches()):
            if i != index:
                others *= complex(polynomial_response(num, den, z)[0])
        num, den = self.notches()[index]
        powers = np.arange(3)
        steepness = np.sum(-1j * powers * np.asarray(num) * z**-powers)
        return complex(-others * steepness / np.sum(np.asarray(den) * z**-powers))

    def blocks(self, source: str, target: str) -> tuple[Block, ...]:
        """Return the band pass as blocks from the signal `source` to `target`."""
        out = []
        through = source
        for i, (num, den) in enumerate(self.notches()):
            out.append(Block(f"{target}_notch{i}", ((through, 1.0),), num, den))
            through = f"{target}_notch{i}"
        return (*out, Block(target, ((source, 1.0), (through, -1.0))))
