"""Search fits to a power spectral density from many starts, and to resampled spectra.

Modes without delay (`modal_structure`), seen through the window's bandwidth, with errors that bins
share (`scatter`). Fits are ranked by likelihood times a prior of typical modes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from stillpath.models.arrays import Array
from stillpath.models.errors import ModelError
from stillpath.models.identification.last_kept import last_kept
from stillpath.models.identification.modal_structure import ModalStructure
from stillpath.models.identification.scatter import SCATTERS, Scatter
from stillpath.models.identification.spectrum_model import spectrum_model
from stillpath.models.identification.types import Excitation, ModeEstimate, Spectrum
from stillpath.models.plants import PlantSpec, RelativeModesSpec, frequency_response

__all__ = ["Search", "SpectrumCandidate", "whitening_of"]

_DB = 10 / np.log(10)
_SEED = 20
_STARTS, _KEPT_STARTS = 48, 12
_HOPS, _BASES = 300, 8
"""Starts near one of the best fits found until then, and among how many. Random starts alone miss
the best fits of tables with modes close to each other, and a hundred hops those with two modes
above the band (docs/tried.md)."""
_JUMP = (0.1, 0.5, 0.3)
"""Standard deviations of a hop: of log frequencies, log damping ratios and shares."""
_NEW_MODE = (1.2, 2.4)
"""A hop puts a mode above the lowest bin and below the highest one, times these factors."""
_DRAWS = 16
"""Per kind of scatter."""
_LEVEL, _LEVEL_SPREAD = np.log(0.92), 0.2
"""Of log gain. In 109 real tables the level implied accel_per_hz = 69 mm/s (57 to 88) where 75 were
stated (reference notes on identification); sensors read up to 15 % wrong."""
_MISSTATED = 0.3
"""A plateau this far off (log) means other settings of the test: it is taken as the level."""
_QUIETEST, _NOISIER = 10.0, 4.0
"""Percentile of an undriven column's bins that shows the sensor's noise, and how many times as much
power the driven one may have: Z of an ADXL345 hisses twice as much as X and Y (data sheet)."""
_ZETA, _ZETA_SPREAD = 0.08, 0.5
"""Damping where a spectrum does not tell it, and the standard deviation of its logarithm."""
_SHARE_SPREAD = 0.6
_ZETA_BAND, _SHARE_BAND = (0.008, 0.25), (-2.0, 2.5)
"""A mode with more damping shows no peak, and stands for whatever bends a table below 30 Hz: slow
motion follows it far (docs/tried.md)."""
_MODES_BAND = (1.1, 2.4)
"""Modes lie above the lowest bin and below the highest one, times these factors."""
_BEYOND = 0.6
"""Share of the starts with a mode beyond the band."""
_SEEN, _UNSEEN_ZETA = 1.1, (0.005, 0.2)
"""Modes above this multiple of the highest bin were not seen; bounds of their damping."""
_PEAKS = 4
_MUCH_WORSE = 14.0
"""Excess of cost (twice the negative log-likelihood) over the best at which a fit is rejected."""
_PER_PARAMETER = 2.0
"""Cost of a parameter (Akaike 1974): a mode must explain more than three numbers of noise."""
_SAME = 0.03


@dataclass(frozen=True, slots=True, eq=False)
class SpectrumCandidate:
    """Parameters [log gain, log noise, modes ...] of a structure, and their residual.

    `cost` is twice the negative log of likelihood times prior, plus a penalty per parameter;
    `covariance` that of the vector where both are taken to be normal around the fit (Laplace).
    """

    structure: ModalStructure
    vector: Array
    residual_db: float = np.inf
    cost: float = np.inf
    covariance: Array | None = None

    @property
    def theta(self) -> Array:
        """Parameters of the structure alone."""
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


class Search:
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
        self._noise = _most_noise(repeats, column, model.band_hz)
        plateau = float(np.log(model.gain_of_plateau()))
        self._level = plateau if abs(plateau - _LEVEL) > _MISSTATED else float(_LEVEL)

    def like(self, plant: PlantSpec) -> SpectrumCandidate:
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
        return SpectrumCandidate(structure, np.concatenate([[self._level, quiet - 3.0], theta]))

    def candidates(self, progress: Callable[[float], None] | None) -> list[SpectrumCandidate]:
        """Return fits from many starts, the best first."""
        whitening = whitening_of(SCATTERS[0].covariance(self.model))
        # More starts for larger orders, which have more ways to explain a spectrum.
        likely = [n for n in self.orders for _ in range(n * n)]
        counts = [*self.orders, *self.rng.choice(likely, _STARTS - len(self.orders)).tolist()]
        log_psd = self.model.log_psd
        found = []
        for k, modes in enumerate(counts):
            found.append(self.polished(self._start(int(modes)), whitening, log_psd, 40))
            if progress:
                progress(0.2 * (k + 1) / len(counts))
        best = self._distinct(found)
        for k in range(_HOPS):
            base = best[int(self.rng.integers(min(_BASES, len(best))))]
            found.append(self.polished(self._hop(base), whitening, log_psd, 60))
            best = self._distinct([*best, found[-1]])
            if progress:
                progress(0.2 + 0.3 * (k + 1) / _HOPS)
        return sorted(found, key=lambda c: c.cost)

    def accepted(
        self, found: Sequence[SpectrumCandidate], scatter: Scatter
    ) -> list[SpectrumCandidate]:
        """Return those of the fits, made anew with this scatter, that explain the spectrum."""
        whitening = self._whitening(found, scatter)
        log_psd = self.model.log_psd
        starts = self._distinct(found)[:_KEPT_STARTS]
        again = self._distinct([self.polished(c, whitening, log_psd, 25) for c in starts])
        return [c for c in again if c.cost <= again[0].cost + _MUCH_WORSE]

    def drawn(
        self, accepted: Sequence[SpectrumCandidate], scatter: Scatter
    ) -> list[SpectrumCandidate]:
        """Return fits to resampled spectra."""
        whitening = self._whitening(accepted, scatter)
        enlarged = self._excess(accepted[0], scatter)
        root = enlarged * np.linalg.cholesky(scatter.drifted().covariance(self.model))
        likely = np.exp(-0.25 * (np.array([c.cost for c in accepted]) - accepted[0].cost))
        out = []
        for _ in range(_DRAWS):
            start = accepted[int(self.rng.choice(len(accepted), p=likely / likely.sum()))]
            # Random weights of the repeats (Bayesian bootstrap, Rubin 1981).
            weights = self.rng.dirichlet(np.ones(len(self.repeats)))
            log_psd = weights @ self.repeats + root @ self.rng.standard_normal(len(root))
            out.append(self._with_drawn_damping(self.polished(start, whitening, log_psd, 12)))
        return out

    def _with_drawn_damping(self, fit: SpectrumCandidate) -> SpectrumCandidate:
        """Draw the damping of modes beyond the band, of which only the flank was measured."""
        n, vector = fit.structure.modes, fit.vector.copy()
        beyond = np.exp(fit.theta[:n]) * self._unit_hz > _SEEN * self.model.f_hz[-1]
        low, high = np.log(_UNSEEN_ZETA)
        vector[2 + n : 2 + 2 * n][beyond] = self.rng.uniform(low, high, np.count_nonzero(beyond))
        return replace(fit, vector=vector)

    def _distinct(self, fits: Sequence[SpectrumCandidate]) -> list[SpectrumCandidate]:
        """Return the fits that respond differently from all better ones, the best first."""
        distinct: list[SpectrumCandidate] = []
        answers: list[NDArray[np.complex128]] = []
        for one in sorted(fits, key=lambda c: c.cost):
            answer = one.structure.response(one.theta, self.model.f_hz)
            if all(np.max(np.abs(answer - other)) > _SAME for other in answers):
                distinct.append(one)
                answers.append(answer)
        return distinct

    def _whitening(self, fits: Sequence[SpectrumCandidate], scatter: Scatter) -> Array:
        """Return the whitening of errors, enlarged if even the best fit leaves more."""
        whitening = whitening_of(scatter.covariance(self.model))
        return np.asarray(whitening / self._excess(fits[0], scatter))

    def _excess(self, best: SpectrumCandidate, scatter: Scatter) -> float:
        """Return how many times as large as the scatter the errors of the best fit are, from 1."""
        error = self.model.log_spectrum(best.structure, best.vector) - self.model.log_psd
        freedom = len(error) - best.structure.size - 2
        whitening = whitening_of(scatter.covariance(self.model))
        return max(1.0, float(np.sqrt(np.sum((whitening @ error) ** 2) / freedom)))

    def _start(self, modes: int) -> SpectrumCandidate:
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
        return SpectrumCandidate(structure, np.concatenate([[self._level, quiet - 3.0], theta]))

    def _hop(self, base: SpectrumCandidate) -> SpectrumCandidate:
        """Return a start near a fit: a mode more, a mode elsewhere, or all of them moved a bit."""
        rng, n = self.rng, base.structure.modes
        f, zeta, share = base.structure.split(base.theta)
        low, high = np.log(np.multiply(_NEW_MODE, self.model.band_hz) / self._unit_hz)
        new_f = np.exp(rng.uniform(low, high))
        new_zeta = np.exp(rng.uniform(np.log(0.03), np.log(0.3)))
        kind = rng.integers(3)
        if kind == 0 and n < self.orders[-1]:
            f, zeta = np.append(f, new_f), np.append(zeta, new_zeta)
            share = np.append(share, 0.1 * rng.standard_normal())
        elif kind == 1 and n > 1:
            moved = int(rng.integers(n))
            f[moved], zeta[moved] = new_f, new_zeta
        else:
            jumps = np.array(_JUMP)[:, None] * rng.standard_normal((3, n))
            f, zeta, share = f * np.exp(jumps[0]), zeta * np.exp(jumps[1]), share + jumps[2]
        structure = ModalStructure(len(f), self._unit_hz)
        theta = structure.parameters(f * self._unit_hz, zeta, share)
        return SpectrumCandidate(structure, np.concatenate([base.vector[:2], theta]))

    def polished(
        self, start: SpectrumCandidate, whitening: Array, log_psd: Array, rounds: int
    ) -> SpectrumCandidate:
        """Minimise whitened errors plus the prior's penalty."""
        model, structure, n = self.model, start.structure, start.structure.modes
        band_hz = (_MODES_BAND[0] * model.f_hz[0], _MODES_BAND[1] * model.f_hz[-1])
        low, high = structure.bounds(band_hz, _ZETA_BAND, _SHARE_BAND)
        noise = min(float(log_psd.min()) + 0.5, self._noise)
        low = np.append([self._level - 0.6, noise - 12.0], low)
        high = np.append([self._level + 0.6, noise], high)
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


def whitening_of(covariance: Array) -> Array:
    """Return the matrix that makes errors of this covariance independent with variance 1."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)), np.float64)


def _most_noise(spectra: Sequence[Spectrum], column: str, band_hz: tuple[float, float]) -> float:
    """Return the logarithm of the largest noise that the sensor's other columns allow.

    Without this bound, white noise stands for whatever power a table has beyond the drive's at low
    frequency. Then the level comes out too low, and with it all of |G| too high.

    Returns
    -------
    float
        Infinite where there are no other columns.
    """
    undriven = [
        np.percentile(psd[(s.f_hz >= band_hz[0]) & (s.f_hz <= band_hz[1])], _QUIETEST)
        for s in spectra
        for name, psd in s.psd.items()
        if name in ("x", "y", "z") and name != column
    ]
    heard = [psd for psd in undriven if psd > 0.0]
    return float(np.log(_NOISIER * min(heard))) if heard else np.inf
