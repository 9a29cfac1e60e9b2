"""Measure how much of a planned motion lies above the band in which a model is valid."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from stillpath.models.arrays import Array
from stillpath.models.machine import Machine

__all__ = ["BandContent"]

T = TypeVar("T", bound=np.generic)

BLOCK = 1024
_ALL_BITS = 6
"""Long prints are thinned out: every second block after the first 64, every fourth after the
first 128, and so on; each is weighted by the number of blocks it represents."""
_TOGETHER = 16
"""Blocks transformed together, to share the overhead of a transform."""
NOTABLE_UM = 1.0
"""Motion beyond the band is reported from this rms on."""


class BandContent:
    """Spectrum of the planned motion of X and Y while it prints.

    Blocks of 1024 samples (Welch 1967, Hann window, no overlap) of the planned acceleration, as
    slow travel would leak from a spectrum of positions; |Y(f)| = |A(f)| / (2 sin(pi f dt) / dt)^2,
    since the acceleration is a second difference.
    """

    def __init__(self, machine: Machine, dt_s: float) -> None:
        self._machine, self._dt_s = machine, dt_s
        self._window = np.hanning(BLOCK + 1)[:-1]
        self._power = np.zeros((2, BLOCK // 2 + 1))
        self._seen = self._blocks = 0
        self._accel = np.zeros((_TOGETHER, 2, BLOCK))
        """Blocks still to be transformed, and (below) the number of blocks each represents."""
        self._weights: list[int] = []
        self._limited = any(
            axis.band_hz or (axis.provenance and axis.provenance.trust_below_hz)
            for axis in machine.axes.values()
        )
        self._path, self._prints = np.zeros((2, 0)), np.zeros(0, dtype=bool)

    def add(self, path_mm: Array, extruding: NDArray[np.bool_]) -> None:
        """Add planned positions, shape (2, n), that follow those added before."""
        if not self._limited:
            return
        before, printed = self._path, self._prints
        total = before.shape[1] + path_mm.shape[1]
        count = max(0, (total - 2) // BLOCK)
        for k in range(count):
            every = 1 << max(0, self._seen.bit_length() - _ALL_BITS)
            self._seen += 1
            if self._seen % every:
                continue
            first = k * BLOCK
            prints = _span(printed, extruding, first, first + BLOCK)
            if np.count_nonzero(prints) > BLOCK // 2:
                path = _span(before, path_mm, first, first + BLOCK + 2)
                self._accel[len(self._weights)] = np.diff(path, 2) / self._dt_s**2
                self._weights.append(every)
                if len(self._weights) == _TOGETHER:
                    self._transform()
        self._path = _span(before, path_mm, count * BLOCK, total).copy()
        self._prints = _span(printed, extruding, count * BLOCK, total).copy()

    def jump(self) -> None:
        """Begin anew: what follows is not connected to the motion so far."""
        self._path, self._prints = np.zeros((2, 0)), np.zeros(0, dtype=bool)

    def beyond_um(self, f_hz: float) -> Array:
        """Return the rms of the planned X and Y above a frequency, shape (2,)."""
        self._transform()
        f = np.fft.rfftfreq(BLOCK, self._dt_s)
        above = f > f_hz
        scale = 2.0 / (BLOCK * np.sum(self._window**2) * max(self._blocks, 1))
        second = (2.0 * np.sin(np.pi * f[above] * self._dt_s) / self._dt_s) ** 2
        square = self._power[:, above] @ second**-2.0
        return np.asarray(1e3 * np.sqrt(scale * square))

    def _transform(self) -> None:
        spectrum = np.fft.rfft(self._accel[: len(self._weights)] * self._window)
        self._power += np.tensordot(self._weights, spectrum.real**2 + spectrum.imag**2, 1)
        self._blocks += sum(self._weights)
        self._weights.clear()

    def warnings(self) -> list[str]:
        """Return warnings about motion outside the bands of the models."""
        found = []
        for i, axis in enumerate(("x", "y")):
            plants = self._machine.axes[axis]  # type: ignore[index]
            trust_hz = plants.provenance.trust_below_hz if plants.provenance else None
            if plants.band_hz is not None:
                high_hz = plants.band_hz[1]
                beyond = float(self.beyond_um(high_hz)[i])
                if beyond > NOTABLE_UM:
                    found.append(
                        f"Axis {axis}: {beyond:.1f} µm rms of the planned motion lie above "
                        f"{high_hz:g} Hz, where its model was not measured (band_hz): the figures "
                        "are a guess there. Measure up to higher frequencies, or print with less "
                        "acceleration."
                    )
            if trust_hz is not None:
                beyond = float(self.beyond_um(trust_hz)[i])
                if beyond > NOTABLE_UM:
                    found.append(
                        f"Axis {axis}: {beyond:.1f} µm rms of the planned motion lie above "
                        f"{trust_hz:.3g} Hz, where its model cannot be trusted "
                        "(trust_below_hz): the phase was not measured. A raw accelerometer log "
                        "would show it."
                    )
        return found


def _span(before: NDArray[T], newer: NDArray[T], start: int, stop: int) -> NDArray[T]:
    """Return samples start..stop - 1 of the concatenation of two arrays."""
    held = before.shape[-1]
    if start >= held:
        return newer[..., start - held : stop - held]
    return np.concatenate([before[..., start:stop], newer[..., : max(stop - held, 0)]], axis=-1)
