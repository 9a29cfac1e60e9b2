"""The designs of an axis: a ladder from the most accurate to the gentlest."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

from stillpath.compensation._window_kernels import Functions
from stillpath.compensation.base import DesignError
from stillpath.compensation.basis import BASES, ce_opt_basis, robust_basis
from stillpath.compensation.lifted_window import LiftedWindow, condensed, lifted_window
from stillpath.compensation.preview import PreviewDesign
from stillpath.compensation.window_problem import functions_of
from stillpath.models.arrays import Array
from stillpath.models.plants import DiscretePlant

__all__ = [
    "BAND_MARGIN",
    "GENTLE_RUNG",
    "LADDER",
    "Designs",
    "Rung",
    "designs",
    "functions_within",
]


@dataclass(frozen=True, slots=True)
class Rung:
    """One step of the ladder: number of functions (per 300 samples) and price of acceleration.

    Both refer to samples of 1 ms: at another sampling time the same ladder is another design.
    """

    n: int
    price: float


LADDER = (
    *(Rung(90, price) for price in (0.03, 0.1, 0.3, 1.0)),
    *(Rung(n, 3.0) for n in (75, 60, 45, 34, 26, 18)),
)
"""Designs from the most accurate to the gentlest."""
GENTLE_RUNG = 3
"""Last rung with all functions: gentler ones trade accuracy for smoothness."""
BAND_MARGIN = 1.2
"""Ratio of a command's bandwidth to its model's band. The price makes the cut-off gradual: little
is left beyond the band, while a cut-off right at its edge would cost accuracy within it."""

REST_FUNCTIONS = 64
"""Most functions (per 300 samples) in windows with a rest, which are solved individually."""
ROBUST_CHOICE = 1.1
"""The robust basis selects n of this many times n functions."""
_NESTED = {"ce-opt", "dct"}
"""Bases whose n functions are the first n of any larger number."""


class Designs:
    """The designs of an axis, computed when first needed.

    Attributes
    ----------
    ladder : tuple of Rung
        `LADDER` with at most as many functions as the model's band allows; equal rungs are merged.
    at_rests : Condensed
        Reduced form of `lifted` for windows with rests.
    """

    def __init__(self, lifted: LiftedWindow, basis: str, most: int = 300) -> None:
        self.lifted = lifted
        capped = (Rung(min(rung.n, most), rung.price) for rung in LADDER)
        self.ladder = tuple(dict.fromkeys(capped))
        self._basis = basis
        self._made: dict[tuple[int, float], PreviewDesign] = {}
        self._set = lifted.lifted_set()
        self._functions: dict[int, Array] = {}
        self.at_rests = condensed(lifted)
        self._rest_functions: dict[PreviewDesign, Functions] = {}

    def rest_functions(self, rung: int) -> Functions:
        """Return the functions for a rung's windows that contain a rest (`at_rests`)."""
        design = self.design(rung, REST_FUNCTIONS)
        if design not in self._rest_functions:
            made = functions_of(design, at_rests=True, part=self.at_rests)
            self._rest_functions[design] = made
        return self._rest_functions[design]

    def design(self, rung: int, most: int = 300) -> PreviewDesign:
        """Return the design of a rung, with at most `most` functions per 300 samples."""
        step = self.ladder[rung]
        n = self._scaled(min(step.n, most))
        if (n, step.price) not in self._made:
            psi = self._psi(n)
            self._made[n, step.price] = PreviewDesign(self.lifted, n, self._basis, step.price, psi)
        return self._made[n, step.price]

    def check(self) -> None:
        """Raise the DesignError of the first rung if all rungs fail."""
        refusals = []
        for rung in range(len(self.ladder)):
            try:
                self.design(rung)
            except DesignError as error:
                refusals.append(error)
            else:
                return
        raise refusals[0]

    def _psi(self, n: int) -> Array:
        size = self._scaled(self.ladder[0].n) if self._basis in _NESTED else n
        if size not in self._functions:
            self._functions[size] = self._made_for(size)
        return self._functions[size]

    def _made_for(self, n: int) -> Array:
        # With equal members all functions are equally robust.
        if self._basis == "robust" and len(self.lifted.integrated) == 1:
            return ce_opt_basis(self._set.gram, n)
        if self._basis != "robust":
            return BASES[self._basis](self._set, n)
        # Far above its modes a set also agrees, as it hardly responds: choose among the directions
        # of largest gain (4.10).
        window = self.lifted.window
        kept = min(window, round(ROBUST_CHOICE * n))
        return robust_basis(self._set.gram, self._set.mean, n, window - kept)

    def _scaled(self, n: int) -> int:
        return max(4, round(n * self.lifted.window / 300))


@lru_cache(maxsize=12)
def designs(
    plants: tuple[DiscretePlant, ...],
    weights: tuple[float, ...],
    window: int,
    update: int,
    basis: str,
    most: int = 300,
) -> Designs:
    """Return the designs of an axis, cached by recent use (up to 30 MB each for sets)."""
    return Designs(lifted_window(plants, weights, window, update), basis, most)


def functions_within(band_hz: tuple[float, float] | None, dt_s: float) -> int:
    """Return the most functions per 300 samples that keep a command within its model's band.

    n functions over a window T span frequencies up to n / (2 T).
    """
    return 300 if band_hz is None else max(4, int(2 * 300 * dt_s * BAND_MARGIN * band_hz[1]))
