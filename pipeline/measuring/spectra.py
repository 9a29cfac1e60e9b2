"""Spectra of the nozzle's error along X and Y while it prints."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from stillpath.models.arrays import Array
from stillpath.models.machine import Machine
from stillpath.models.schedule import resonances_hz
from stillpath.pipeline.result import AxisSpectrum

__all__ = ["BLOCK", "ErrorSpectra"]

BLOCK = 1024
_KEPT = 64
"""Largest number of blocks: when reached, every second one is dropped, and from then on only every
second one is taken."""
_LEAST_HZ, _BEYOND = 150.0, 1.4
"""Spectra extend to this, or to this multiple of the highest resonance."""


class ErrorSpectra:
    """Amplitude spectral density of position minus planned position, by axis and channel.

    Mean over blocks (Welch 1967, Hann window, no overlap, mean taken off) that lie evenly over
    the print and extrude for more than half of their time. Memory and work are bounded.

    Parameters
    ----------
    names : sequence of str
        Channels.
    """

    def __init__(self, machine: Machine, dt_s: float, names: Sequence[str]) -> None:
        self._dt_s, self._names = dt_s, list(names)
        self._resonances = {a: resonances_hz(machine.axes[a].nominal) for a in ("x", "y")}
        found = np.concatenate(list(self._resonances.values()))
        f_hz = np.fft.rfftfreq(BLOCK, dt_s)
        top_hz = max(_LEAST_HZ, _BEYOND * float(np.max(found, initial=0.0)))
        self._f_hz = f_hz[: int(np.searchsorted(f_hz, top_hz)) + 1]
        self._window = np.hanning(BLOCK + 1)[:-1]
        # Blocks are transformed at the end, as most of them are dropped.
        self._blocks = np.zeros((_KEPT, len(self._names), 2, BLOCK))
        self._numbers: list[int] = []
        self._every = 1
        self._seen = self._printing = 0

    def add(self, path_mm: Array, positions_mm: Array, extruding: NDArray[np.bool_]) -> None:
        """Add planned positions (2, n) and those of every channel (channels, 2, n)."""
        at, count = 0, len(extruding)
        while at < count:
            number, filled = divmod(self._seen, BLOCK)
            others = -number % self._every
            take = min((others or 1) * BLOCK - filled, count - at)
            if not others:
                part = slice(at, at + take)
                into = self._blocks[len(self._numbers), :, :, filled : filled + take]
                np.subtract(positions_mm[:, :, part], path_mm[:, part], out=into)
                self._printing += int(np.count_nonzero(extruding[part]))
                if filled + take == BLOCK:
                    if self._printing > BLOCK // 2:
                        self._keep(number)
                    self._printing = 0
            at += take
            self._seen += take

    def jump(self) -> None:
        """Begin anew: what follows is not connected to the motion so far."""
        self._seen += -self._seen % BLOCK
        self._printing = 0

    def spectra(self) -> list[AxisSpectrum]:
        """Return the spectra of both axes; none if nothing long enough was printed."""
        if not self._numbers:
            return []
        # One-sided: includes the power at negative frequencies.
        scale = 2e6 * self._dt_s / float(np.sum(self._window**2))
        powers = [self._power(block) for block in self._blocks[: len(self._numbers)]]
        density = np.sqrt(scale * np.mean(powers, axis=0))
        return [
            AxisSpectrum(
                axis=axis,
                f_hz=self._f_hz[1:].round(4).tolist(),
                um_per_sqrt_hz={
                    name: [float(f"{v:.4g}") for v in density[c, i, 1:]]
                    for c, name in enumerate(self._names)
                },
                resonances_hz=self._resonances[axis].round(3).tolist(),
            )
            for i, axis in enumerate(("x", "y"))
        ]

    def _keep(self, number: int) -> None:
        self._numbers.append(number)
        while len(self._numbers) == _KEPT:
            self._every *= 2
            kept = [k for k, n in enumerate(self._numbers) if n % self._every == 0]
            self._blocks[: len(kept)] = self._blocks[kept]
            self._numbers = [self._numbers[k] for k in kept]

    def _power(self, block: Array) -> Array:
        even = block - block.mean(axis=2, keepdims=True)
        spectrum = np.fft.rfft(even * self._window)[:, :, : len(self._f_hz)]
        return np.asarray(spectrum.real**2 + spectrum.imag**2)
