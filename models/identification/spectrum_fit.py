"""Plants that explain power spectral densities, as Klipper's resonance test writes them.

The drive is known, so |G| is absolute; the phase is not. What is fitted are modes without delay
(`modal_structure`), seen through the window's bandwidth, with errors that bins share (`scatter`).
One fit says little: others with more or fewer modes, with shares of other signs or modes beyond the
band explain the same table. They are looked for from many starts, drawn anew from spectra as they
might have come out (bootstrap), and the result is all of them: some that differ most stand for the
rest, weighted by how many they stand for.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from stillpath.models.errors import ModelError
from stillpath.models.identification.averaging import mean_spectrum
from stillpath.models.identification.frame import LIKELY, frame_hz_of, shaken, without_frame
from stillpath.models.identification.last_kept import last_kept
from stillpath.models.identification.messages import (
    apart_warning,
    cross_axis_warning,
    frame_mode_notes,
    spectrum_level_warning,
)
from stillpath.models.identification.modal_structure import ModalStructure
from stillpath.models.identification.representatives import Population, mode_spread, representatives
from stillpath.models.identification.scatter import SCATTERS, Scatter
from stillpath.models.identification.spectrum_model import (
    cross_axis_share,
    driven_column,
    spectrum_model,
)
from stillpath.models.identification.types import (
    Excitation,
    Fit,
    ModeEstimate,
    OrderTrial,
    Spectrum,
)
from stillpath.models.plants import PlantSpec, RelativeModesSpec, frequency_response

__all__ = ["Explained", "Explanations", "explain_spectra", "explanations", "refit_spectrum"]

Array = NDArray[np.float64]

_DB = 10 / np.log(10)
_SEED = 20
_STARTS, _KEPT_STARTS = 48, 12
_DRAWS = 16
"""Per kind of scatter."""
_LEVEL, _LEVEL_SPREAD = np.log(0.92), 0.13
"""Of log gain. In 109 real tables the level implied accel_per_hz = 69 mm/s (57 to 88) where 75 were
stated (reference notes on identification); sensors read up to 15 % wrong."""
_MISSTATED = 0.3
"""A plateau this far off (log) means other settings of the test: it is taken as the level."""
_ZETA, _ZETA_SPREAD = 0.08, 0.5
"""Damping where a spectrum does not tell it, and the standard deviation of its logarithm."""
_SHARE_SPREAD = 0.6
_ZETA_BAND, _SHARE_BAND = (0.008, 0.4), (-2.0, 2.5)
_MODES_BAND = (1.1, 2.4)
"""Modes lie above the lowest bin and below so many times the highest, by these factors."""
_BEYOND = 0.6
"""Share of the starts with a mode beyond the band."""
_SEEN, _UNSEEN_ZETA = 1.1, (0.005, 0.2)
"""Modes above so many times the highest bin were not seen, and damping that they may have."""
_PEAKS = 4
_MUCH_WORSE = 14.0
"""Cost (twice the negative log-likelihood) beyond the best one that is no explanation any more."""
_PER_PARAMETER = 2.0
"""Cost of a parameter (Akaike 1974): a mode must explain more than three numbers of noise."""
_SAME = 0.03
_GOOD_DB, _NO_WORSE = 1.0, 1.1


@dataclass(frozen=True, slots=True, eq=False)
class Explained:
    """What spectra say of an axis: a plant in the middle, and a set that stands for all others.

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
    search: _Search
    found: tuple[_Candidate, ...]
    """From many starts, the best first."""
    accepted: tuple[_Candidate, ...]
    drawn: tuple[_Candidate, ...]
    frame_hz: float | None

    def explained(self, frame_likely: float = LIKELY) -> Explained:
        """Return a plant in the middle and the set that stands for all.

        Parameters
        ----------
        frame_likely : float
            Share of the plants that are without what may be the frame's mode.
        """
        search, found = self.search, self.found
        least_db = min(c.residual_db for c in self.accepted)
        good = [c for c in self.accepted if c.residual_db <= max(_GOOD_DB, _NO_WORSE * least_db)]
        centres = [c.structure.spec(c.theta) for c in good]
        crowd = [c.structure.spec(c.theta) for c in (*self.accepted, *self.drawn)]
        if frame_likely:
            crowd = shaken(crowd, deepcopy(search.rng), frame_likely)
            centres += [without_frame(plant) for plant in centres]
        population = representatives(centres, crowd)
        chosen = good[population.middle % len(good)]
        gain = float(np.exp(chosen.vector[0]))
        best = {
            n: min(c.residual_db for c in found if c.structure.modes == n) for n in search.orders
        }
        cross = cross_axis_share(mean_spectrum(self.spectra), self.column, search.model.band_hz)
        notes = (
            *spectrum_level_warning(gain, self.excitation),
            *cross_axis_warning(*cross, self.column),
            *apart_warning(self.spectra, search.repeats),
            *frame_mode_notes(chosen.structure.spec(chosen.theta), population.members[0]),
        )
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
            notes=notes,
        )
        return Explained(fit, population)


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
    tests = [excitation] if isinstance(excitation, Excitation) else list(excitation)
    if any(test != tests[0] for test in tests):
        raise ModelError(
            f"{', '.join(s.source for s in spectra)}: the spectra come from different tests "
            "(accel_per_hz, range or direction), so they have no mean; identify from those of one "
            "test"
        )
    single = mean_spectrum(spectra)
    name = _column(single, column)
    search = _Search(single, name, tests[0], spectra, max_order)
    found = search.candidates(progress)
    accepted, drawn = _explanations(search, found, progress)
    return Explanations(
        spectra=tuple(spectra),
        excitation=tests[0],
        column=name,
        search=search,
        found=tuple(found),
        accepted=tuple(accepted),
        drawn=tuple(drawn),
        frame_hz=frame_hz_of([c.structure.spec(c.theta) for c in (*accepted, *drawn)]),
    )


def explain_spectra(
    spectra: Sequence[Spectrum],
    excitation: Excitation,
    *,
    column: str | None = None,
    frame_likely: float = LIKELY,
    max_order: int = 4,
) -> Explained:
    """Find the plants that explain spectra of an axis: `explanations`, and the set of them."""
    found = explanations(spectra, excitation, column=column, max_order=max_order)
    return found.explained(frame_likely)


def _explanations(
    search: _Search, found: Sequence[_Candidate], progress: Callable[[float], None] | None
) -> tuple[list[_Candidate], list[_Candidate]]:
    """Return the candidates that explain the spectra, and draws around them."""
    accepted: list[_Candidate] = []
    drawn: list[_Candidate] = []
    for k, scatter in enumerate(SCATTERS):
        some = search.accepted(found, scatter)
        accepted += some
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
        As `explain_spectra`.
    """
    name = _column(spectrum, column)
    search = _Search(spectrum, name, excitation, [spectrum], len(like.modes))
    whitening = _whitening(SCATTERS[0].covariance(search.model))
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


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    """Parameters [log gain, log noise, modes ...] of a structure, and what they leave.

    `cost` is twice the negative log of likelihood times prior, and what parameters cost;
    `covariance` that of the vector where both are taken to be normal around the fit (Laplace).
    """

    structure: ModalStructure
    vector: Array
    residual_db: float = np.inf
    cost: float = np.inf
    covariance: Array | None = None

    @property
    def theta(self) -> Array:
        return self.vector[2:]

    def mode_estimates(self) -> tuple[ModeEstimate, ...]:
        """Return the modes, rising in frequency."""
        assert self.covariance is not None
        n, spec = self.structure.modes, self.structure.spec(self.theta)
        sd = np.sqrt(np.diag(self.covariance))[2 : 2 + 2 * n]
        order = np.argsort(self.theta[:n])
        return tuple(
            ModeEstimate(
                f_hz=mode.f_hz,
                zeta=mode.zeta,
                f_sd_hz=mode.f_hz * float(sd[i]),
                zeta_sd=mode.zeta * float(sd[n + i]),
                peak=float(abs(frequency_response(spec, mode.f_hz)[0])),
            )
            for i, mode in zip(order, spec.modes, strict=True)
        )


class _Search:
    """The spectra of an axis, and the ways to explain them."""

    def __init__(
        self,
        single: Spectrum,
        column: str,
        excitation: Excitation,
        repeats: Sequence[Spectrum],
        max_order: int,
    ) -> None:
        self.model = model = spectrum_model(single, column, excitation)
        tiny = np.finfo(float).tiny
        self.repeats = np.array(
            [
                np.interp(model.f_hz, s.f_hz, np.log(np.maximum(s.psd[column], tiny)))
                for s in repeats
            ]
        )
        self.rng = np.random.default_rng(_SEED)
        self._unit_hz = float(np.sqrt(model.f_hz[0] * model.f_hz[-1]))
        most = max(1, min(max_order, len(model.f_hz) // 12))
        self.orders = tuple(range(1, most + 1))
        plateau = float(np.log(model.gain_of_plateau()))
        self._level = plateau if abs(plateau - _LEVEL) > _MISSTATED else float(_LEVEL)

    def like(self, plant: PlantSpec) -> _Candidate:
        """Return a start from a plant with modes.

        Raises
        ------
        ModelError
            If it is of another kind.
        """
        if not isinstance(plant, RelativeModesSpec):
            raise ModelError("a plant of relative modes is needed to start from; fit one first")
        f_hz, zeta, share = np.array([[m.f_hz, m.zeta, m.share] for m in plant.modes]).T
        structure = ModalStructure(len(plant.modes), self._unit_hz)
        theta = structure.parameters(f_hz, zeta, share)
        quiet = float(self.model.log_psd.min())
        return _Candidate(structure, np.concatenate([[self._level, quiet - 3.0], theta]))

    def candidates(self, progress: Callable[[float], None] | None) -> list[_Candidate]:
        """Return fits from many starts, the best first."""
        whitening = _whitening(SCATTERS[0].covariance(self.model))
        # More of the larger ones: they have more ways to explain a spectrum.
        likely = [n for n in self.orders for _ in range(n * n)]
        counts = [*self.orders, *self.rng.choice(likely, _STARTS - len(self.orders)).tolist()]
        found = []
        for k, modes in enumerate(counts):
            found.append(self.polished(self._start(int(modes)), whitening, self.model.log_psd, 40))
            if progress:
                progress(0.5 * (k + 1) / len(counts))
        return sorted(found, key=lambda c: c.cost)

    def accepted(self, found: Sequence[_Candidate], scatter: Scatter) -> list[_Candidate]:
        """Return those of the fits, made anew with this scatter, that explain the spectrum."""
        whitening = self._whitening(found, scatter)
        log_psd = self.model.log_psd
        again = [self.polished(c, whitening, log_psd, 25) for c in found[:_KEPT_STARTS]]
        again.sort(key=lambda c: c.cost)
        kept = [c for c in again if c.cost <= again[0].cost + _MUCH_WORSE]
        distinct: list[_Candidate] = []
        answers: list[NDArray[np.complex128]] = []
        for one in kept:
            answer = one.structure.response(one.theta, self.model.f_hz)
            if all(np.max(np.abs(answer - other)) > _SAME for other in answers):
                distinct.append(one)
                answers.append(answer)
        return distinct

    def drawn(self, accepted: Sequence[_Candidate], scatter: Scatter) -> list[_Candidate]:
        """Return fits to spectra as they might have come out."""
        whitening = self._whitening(accepted, scatter)
        root = np.linalg.inv(whitening)
        likely = np.exp(-0.25 * (np.array([c.cost for c in accepted]) - accepted[0].cost))
        out = []
        for _ in range(_DRAWS):
            start = accepted[int(self.rng.choice(len(accepted), p=likely / likely.sum()))]
            # Which of the repeats happen to be there (Bayesian bootstrap, Rubin 1981).
            weights = self.rng.dirichlet(np.ones(len(self.repeats)))
            log_psd = weights @ self.repeats + root @ self.rng.standard_normal(len(root))
            out.append(self._rung(self.polished(start, whitening, log_psd, 12)))
        return out

    def _rung(self, fit: _Candidate) -> _Candidate:
        """Give modes beyond the band any damping: of them only a flank was seen."""
        n, vector = fit.structure.modes, fit.vector.copy()
        beyond = np.exp(fit.theta[:n]) * self._unit_hz > _SEEN * self.model.f_hz[-1]
        low, high = np.log(_UNSEEN_ZETA)
        vector[2 + n : 2 + 2 * n][beyond] = self.rng.uniform(low, high, np.count_nonzero(beyond))
        return replace(fit, vector=vector)

    def _whitening(self, fits: Sequence[_Candidate], scatter: Scatter) -> Array:
        """Whiten errors; where even the best fit leaves more than that, there is more of them."""
        covariance = scatter.covariance(self.model)
        whitening = _whitening(covariance)
        best = fits[0]
        error = self.model.log_spectrum(best.structure, best.vector) - self.model.log_psd
        freedom = len(error) - best.structure.size - 2
        excess = float(np.sum((whitening @ error) ** 2)) / freedom
        return np.asarray(whitening / np.sqrt(max(1.0, excess)))

    def _start(self, modes: int) -> _Candidate:
        """Return a random start: modes at peaks, elsewhere in the band, perhaps one beyond it."""
        rng, model = self.rng, self.model
        structure = ModalStructure(modes, self._unit_hz)
        size = model.log_psd - model.log_drive
        inner = np.arange(2, len(size) - 2)
        peaks = inner[[size[i] == size[i - 2 : i + 3].max() for i in inner]]
        highest = peaks[np.argsort(-size[peaks])][:_PEAKS]
        if len(highest) == 0:
            highest = np.array([int(np.argmax(size))])
        beyond = int(modes > 1 and rng.random() < _BEYOND)
        at_peaks = model.f_hz[[highest[0], *rng.permutation(highest[1:])]]
        at_peaks = at_peaks[: modes - beyond] * np.exp(0.05 * rng.standard_normal())
        low, high = model.band_hz
        left = modes - beyond - len(at_peaks)
        within = np.exp(rng.uniform(np.log(1.4 * low), np.log(high), left))
        above = high * np.exp(rng.uniform(np.log(1.05), np.log(2.3), beyond))
        zeta = np.exp(rng.uniform(np.log(0.03), np.log(0.3), modes))
        share = 0.5 * rng.standard_normal(modes)
        share[0] = abs(share[0])
        theta = structure.parameters(np.concatenate([at_peaks, within, above]), zeta, share)
        quiet = float(model.log_psd.min())
        return _Candidate(structure, np.concatenate([[self._level, quiet - 3.0], theta]))

    def polished(
        self, start: _Candidate, whitening: Array, log_psd: Array, rounds: int
    ) -> _Candidate:
        """Minimise whitened errors and what is unlikely of the parameters."""
        model, structure, n = self.model, start.structure, start.structure.modes
        band_hz = (_MODES_BAND[0] * model.f_hz[0], _MODES_BAND[1] * model.f_hz[-1])
        low, high = structure.bounds(band_hz, _ZETA_BAND, _SHARE_BAND)
        quiet = float(log_psd.min())
        low = np.append([self._level - 0.6, quiet - 12.0], low)
        high = np.append([self._level + 0.6, quiet + 0.5], high)
        unit = np.eye(len(low))
        zetas, shares = unit[2 + n : 2 + 2 * n], unit[2 + 2 * n :]
        # The last share is what the others leave.
        prior = np.vstack(
            [
                unit[:1] / _LEVEL_SPREAD,
                zetas / _ZETA_SPREAD,
                shares / _SHARE_SPREAD,
                -shares.sum(axis=0, keepdims=True) / _SHARE_SPREAD,
            ]
        )
        usual = np.concatenate(
            [
                [self._level / _LEVEL_SPREAD],
                np.full(n, np.log(_ZETA) / _ZETA_SPREAD),
                np.zeros(n - 1),
                [-1.0 / _SHARE_SPREAD],
            ]
        )

        @last_kept
        def known(vector: Array) -> tuple[Array, Array]:
            return model.log_spectrum_and_gradient(structure, vector)

        def residual(vector: Array) -> Array:
            error = whitening @ (known(vector)[0] - log_psd)
            return np.concatenate([error, prior @ vector - usual])

        def jacobian(vector: Array) -> Array:
            return np.vstack([whitening @ known(vector)[1], prior])

        inside = np.clip(start.vector, low + 1e-6, high - 1e-6)
        solution = least_squares(
            residual, inside, jacobian, (low, high), x_scale="jac", max_nfev=rounds
        )
        vector = np.asarray(solution.x, np.float64)
        error = known(vector)[0] - model.log_psd
        slope = jacobian(vector)
        return replace(
            start,
            vector=vector,
            residual_db=float(_DB * np.std(error)),
            cost=float(2 * solution.cost) + _PER_PARAMETER * structure.size,
            covariance=np.asarray(np.linalg.pinv(slope.T @ slope, hermitian=True), np.float64),
        )


def _whitening(covariance: Array) -> Array:
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)), np.float64)


def _column(spectrum: Spectrum, column: str | None) -> str:
    if column is None:
        return driven_column(spectrum)
    if column not in spectrum.psd:
        raise ModelError(
            f"{spectrum.source or 'spectrum'}: no column {column!r}; there are "
            f"{', '.join(spectrum.psd)}"
        )
    return column
