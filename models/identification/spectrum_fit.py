"""Plants that explain power spectral densities, as Klipper's resonance test writes them.

The drive is known, so |G| is absolute; the phase is not. What is fitted are modes without delay
(`modal_structure`), seen through the window's bandwidth, with errors that bins share (`scatter`).
One fit is not enough: others with more or fewer modes, with shares of other signs or modes beyond
the band explain the same table. They are searched from many starting points and for resampled
spectra (bootstrap; `spectrum_search`). The result is a set of the most different ones, weighted by
how many others each represents.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass

import numpy as np

from stillpath.models.errors import ModelError
from stillpath.models.identification.averaging import mean_spectrum
from stillpath.models.identification.frame import (
    LIKELY,
    SURELY_HZ,
    frame_hz_of,
    shaken,
    without_frame,
)
from stillpath.models.identification.messages import (
    apart_warning,
    cross_axis_warning,
    drowned_warning,
    frame_mode_warnings,
    spectrum_level_warning,
)
from stillpath.models.identification.representatives import Population, mode_spread, representatives
from stillpath.models.identification.scatter import SCATTERS
from stillpath.models.identification.spectrum_model import (
    cross_axis_share,
    driven_column,
)
from stillpath.models.identification.spectrum_search import Search, SpectrumCandidate, whitening_of
from stillpath.models.identification.types import (
    Excitation,
    Fit,
    OrderTrial,
    Spectrum,
)
from stillpath.models.plants import RelativeModesSpec

__all__ = ["Explained", "Explanations", "explanations", "refit_spectrum", "same_test"]

_AS_LIKELY = 4.0
"""Excess of cost over the best fit up to which one may be the central plant: a narrow peak is
explained as well by two modes close to each other, but not as likely."""
_GOOD_DB, _NO_WORSE = 1.0, 1.1
"""Of those, it is within 1 dB, or 1.1 times the least residual."""


@dataclass(frozen=True, slots=True, eq=False)
class Explained:
    """Identification of an axis from spectra: a central plant, and a representative set.

    Attributes
    ----------
    fit : Fit
        Of the plant in the middle; `modes` with the spread over the set.
    population : Population
        The members and their weights, the plant in the middle first.
    """

    fit: Fit
    population: Population[RelativeModesSpec]


@dataclass(frozen=True, slots=True, eq=False)
class Explanations:
    """Fits that explain spectra of an axis; which of them count depends on its frame.

    Attributes
    ----------
    frame_hz : float or None
        Where most of them have a weak mode that may be the frame's.
    """

    spectra: tuple[Spectrum, ...]
    excitation: Excitation
    column: str
    search: Search
    found: tuple[SpectrumCandidate, ...]
    """From many starts, the best first."""
    accepted: tuple[SpectrumCandidate, ...]
    likeliest: tuple[SpectrumCandidate, ...]
    """Those of the accepted ones that may be the plant in the middle."""
    drawn: tuple[SpectrumCandidate, ...]
    frame_hz: float | None

    def explained(self, frame_likely: float = LIKELY) -> Explained:
        """Return a plant in the middle and the set that stands for all.

        Parameters
        ----------
        frame_likely : float
            Share of the plants that are without what may be the frame's mode.
        """
        search, found = self.search, self.found
        least_db = min(c.residual_db for c in self.likeliest)
        most_db = max(_GOOD_DB, _NO_WORSE * least_db)
        good = [c for c in self.likeliest if c.residual_db <= most_db]
        centres = [c.structure.spec(c.theta) for c in good]
        crowd = [c.structure.spec(c.theta) for c in (*self.accepted, *self.drawn)]
        if frame_likely:
            crowd = shaken(crowd, deepcopy(search.rng), frame_likely)
            crowd = [without_frame(plant, highest_hz=SURELY_HZ) for plant in crowd]
            centres += [without_frame(plant) for plant in centres]
        population = representatives(centres, crowd)
        chosen = good[population.middle % len(good)]
        gain = float(np.exp(chosen.vector[0]))
        best = {
            n: min(c.residual_db for c in found if c.structure.modes == n) for n in search.orders
        }
        felt = chosen.structure.spec(chosen.theta)
        left_out = frame_mode_warnings(felt, population.members[0], table=True)
        fit = Fit(
            spec=population.members[0],
            residual=chosen.residual_db,
            gain=gain,
            delay_s=0.0,
            band_hz=search.model.band_hz,
            modes=mode_spread(population),
            trials=tuple(OrderTrial(n, db) for n, db in best.items()),
            magnitude_only=True,
            trust_below_hz=min(population.agree_below_hz(), search.model.band_hz[1]),
            warnings=(*self._warnings(gain), *left_out),
        )
        return Explained(fit, population)

    def _warnings(self, gain: float) -> tuple[str, ...]:
        """Return what speaks against the spectra, of which a fit has this gain."""
        band_hz = self.search.model.band_hz
        cross = cross_axis_share(mean_spectrum(self.spectra), self.column, band_hz)
        names = ", ".join(one.source for one in self.spectra)
        return (
            *spectrum_level_warning(gain, self.excitation, names),
            *cross_axis_warning(*cross, self.column),
            *(text for one in self.spectra for text in drowned_warning(one, self.column)),
            *apart_warning(self.spectra, self.search.repeats),
        )


def explanations(
    spectra: Sequence[Spectrum],
    excitation: Excitation | Sequence[Excitation],
    *,
    column: str | None = None,
    max_order: int = 4,
    progress: Callable[[float], None] | None = None,
) -> Explanations:
    """Find what explains one or more spectra of an axis, all of one test.

    Parameters
    ----------
    excitation : Excitation, or one per spectrum
        The test that made them: the mean of spectra of different tests cannot be taken.
    column : str, optional
        Default: the one that follows the drive from 8 to 15 Hz.
    max_order : int
        Most modes to try.
    progress : callable, optional
        Told the share done, 0 to 1.

    Raises
    ------
    ModelError
        If there is no spectrum, the tests differ, the column does not exist or is dead, or too few
        bins are left.
    """
    tests = [excitation] if isinstance(excitation, Excitation) else excitation
    test = same_test(spectra, tests)
    single = mean_spectrum(spectra)
    name = column or driven_column(single, test.f_start_hz)
    search = Search(single, name, test, spectra, max_order)
    found = search.candidates(progress)
    accepted, drawn = _accepted_and_drawn(search, found, progress)
    explaining = tuple(c for some in accepted for c in some)
    likeliest = tuple(c for some in accepted for c in some if c.cost <= some[0].cost + _AS_LIKELY)
    return Explanations(
        spectra=tuple(spectra),
        excitation=test,
        column=name,
        search=search,
        found=tuple(found),
        accepted=explaining,
        likeliest=likeliest,
        drawn=tuple(drawn),
        frame_hz=frame_hz_of([c.structure.spec(c.theta) for c in (*explaining, *drawn)]),
    )


def same_test(spectra: Sequence[Spectrum], tests: Sequence[Excitation]) -> Excitation:
    """Return the test that made all spectra.

    Raises
    ------
    ModelError
        If there are several: spectra of different tests have no mean.
    """
    if any(test != tests[0] for test in tests):
        raise ModelError(
            f"{', '.join(s.source for s in spectra)}: the spectra come from different tests "
            "(accel_per_hz, range or direction), so they have no mean; identify from those of one "
            "test"
        )
    return tests[0]


def _accepted_and_drawn(
    search: Search, found: Sequence[SpectrumCandidate], progress: Callable[[float], None] | None
) -> tuple[list[list[SpectrumCandidate]], list[SpectrumCandidate]]:
    """Return what explains the spectra by kind of scatter, the best first, and draws around it."""
    accepted: list[list[SpectrumCandidate]] = []
    drawn: list[SpectrumCandidate] = []
    for k, scatter in enumerate(SCATTERS):
        some = search.accepted(found, scatter)
        accepted.append(some)
        drawn += search.drawn(some, scatter)
        if progress:
            progress(0.5 + 0.5 * (k + 1) / len(SCATTERS))
    return accepted, drawn


def refit_spectrum(
    spectrum: Spectrum, excitation: Excitation, like: Fit, *, column: str | None = None
) -> Fit:
    """Fit a plant with the modes of `like`, starting from it: the axis under another condition.

    Raises
    ------
    ModelError
        As `explanations`.
    """
    name = column or driven_column(spectrum, excitation.f_start_hz)
    search = Search(spectrum, name, excitation, [spectrum], len(like.modes))
    whitening = whitening_of(SCATTERS[0].covariance(search.model))
    fitted = search.polished(search.like(like.spec), whitening, search.model.log_psd, 40)
    return Fit(
        spec=fitted.structure.spec(fitted.theta),
        residual=fitted.residual_db,
        gain=float(np.exp(fitted.vector[0])),
        delay_s=0.0,
        band_hz=search.model.band_hz,
        modes=fitted.mode_estimates(),
        trials=(OrderTrial(fitted.structure.modes, fitted.residual_db),),
        magnitude_only=True,
    )
