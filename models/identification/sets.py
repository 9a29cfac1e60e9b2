"""Plant sets for robust design: the plants that an axis may have.

Several measurements give their own members; a single one is varied by the typical spread of such
measurements.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import date

import numpy as np
from pydantic import ValidationError

from stillpath.models.arrays import Array
from stillpath.models.errors import ModelError
from stillpath.models.friction import Guides, with_least_friction
from stillpath.models.identification.averaging import mean_response
from stillpath.models.identification.frame import LIKELY
from stillpath.models.identification.modal_fit import fit_modes, refit
from stillpath.models.identification.prompt import delay_of, prompt
from stillpath.models.identification.response_bootstrap import explain_response
from stillpath.models.identification.response_data import coherent_part
from stillpath.models.identification.spectrum_fit import Explanations
from stillpath.models.identification.types import (
    AxisIdentification,
    Fit,
    FrequencyResponse,
)
from stillpath.models.plants import (
    ParametricMembers,
    PlantSetSpec,
    PlantSpec,
    RelativeModesSpec,
    WeightedMember,
    frequency_response,
)
from stillpath.models.provenance import Kind, MeasuredMode, Provenance, SourceFile

__all__ = [
    "Origin",
    "measured_modes",
    "model_file_set",
    "parametric_members",
    "plant_set_from",
    "response_set",
    "spectrum_set",
]

_PARAMETRIC_SPREAD: dict[Kind, tuple[float, float]] = {
    "raw log": (0.02, 0.20),
    "ring test": (0.02, 0.20),
    "frequency response": (0.02, 0.20),
    "recorded drive": (0.02, 0.20),
    "spectrum": (0.03, 0.50),
    "model file": (0.02, 0.20),
}
"""Relative spread of frequencies and of damping ratios where there is one measurement: repeats on
real axes differ by 0.7 % and 12 % within a session, by 2 % over weeks; damping from a spectrum
depends on the order that is fitted."""


@dataclass(frozen=True, slots=True)
class Origin:
    """The files that measurements come from, and their day."""

    sources: tuple[SourceFile, ...] = ()
    measured_on: date | None = None


_UNKNOWN = Origin()

_MOST_MEMBERS = 15
_SIGMAS = 3.0
_NO_DIFFERENCE = 0.02
"""Relative difference of responses that is none: a delay and a far zero trade off by as much."""
_BAD_MEMBER = 3.0
_FEW_REPEATS = 1.25
"""Factor on the scatter of two or three repeats, which show less than there is."""
_NO_MIDDLE = 1.05
"""Ratio of resonances under different labels from which their mean is the response of no plant."""
_POINTS = 200
_MOST_GROUNDED = 0.5
"""Largest share of the damping that may act against the frame (viscous guides)."""


def response_set(
    measured: Sequence[FrequencyResponse],
    *,
    axis: str,
    kind: Kind = "raw log",
    frame_firm: bool = False,
    frame_hz: float | None = None,
    max_order: int = 4,
    origin: Origin = _UNKNOWN,
    progress: Callable[[float], None] | None = None,
) -> AxisIdentification:
    """Identify an axis from one or more responses: repeats, amplitudes, positions, heights.

    Responses with the same label are repeats, which show the scatter. Labels that differ beyond it
    become members, fits of one structure; nominal is the fit to the mean of all (weighted by
    1/sd^2, delays aligned). Where nothing differs, members are what else explains the responses
    (`response_bootstrap`), the first of them nominal: that fit, without a frame that is not firm.

    Parameters
    ----------
    frame_firm : bool
        What the sensor feels is what prints (`ReadSettings.frame_firm`).
    frame_hz : float, optional
        Of a frame that was found and removed from the responses.

    Raises
    ------
    ModelError
        If there is no response, or one cannot be fitted.
    """
    groups = _by_label(measured, axis)
    means = [mean_response(group) for group in groups]
    if len(means) > 1:
        # The mean of shifted peaks has humps that no machine has: they must not add modes.
        max_order = fit_modes(means[0], max_order=max_order).order
    fitted, drawn = _parts(progress)
    fit = fit_modes(measured, max_order=max_order, progress=fitted)
    fits = [refit(m, fit) for m in means] if len(means) > 1 else []
    kept = _outside_scatter(fits, fit, _scatter(measured, groups, fit, fits))
    if kept:
        plants = plant_set_from(fit, kept, kind=kind, origin=origin)
    else:
        population, delays_s = explain_response(
            measured, fit, frame_firm=frame_firm, frame_hz=frame_hz, progress=drawn
        )
        plants = PlantSetSpec(
            nominal=population.members[0],
            members=_weighted(population.members, population.weights),
            band_hz=fit.band_hz,
            provenance=_provenance_of(fit, kind, measured, delays_s=delays_s, origin=origin),
        )
    names = [mean.label or mean.source for mean in means]
    return AxisIdentification(
        axis=axis,
        plants=plants,
        fit=fit,
        measured=tuple(measured),
        member_fits=tuple(kept),
        warnings=(*fit.warnings, *_set_warnings(names, fits, kept, fit)),
    )


def spectrum_set(
    explanations: Explanations,
    *,
    axis: str,
    frame_likely: float = LIKELY,
    guides: Guides = "rails",
    origin: Origin = _UNKNOWN,
) -> AxisIdentification:
    """Identify an axis from what explains its spectra, within their scatter.

    Parameters
    ----------
    frame_likely : float
        Probability that a weak mode far below the strongest is the frame's (`frame.likely_of`).
    guides : str
        Whose least friction is assumed, as spectra show none.
    """
    found = explanations.explained(frame_likely)
    fit, population = found.fit, found.population
    members = _with_delays(population.members)
    plants = PlantSetSpec(
        nominal=fit.spec,
        members=_weighted(members, population.weights),
        band_hz=fit.band_hz,
        provenance=_provenance_of(
            fit,
            "spectrum",
            delays_s=_span([plant.delay_s for plant in members]),
            origin=origin,
        ),
    )
    plants = with_least_friction(plants, guides)
    return AxisIdentification(
        axis=axis, plants=plants, fit=fit, measured=explanations.spectra, warnings=fit.warnings
    )


def _with_delays(members: Sequence[RelativeModesSpec]) -> list[RelativeModesSpec]:
    """Let guides damp every second member, as their share of the damping is not measured."""
    shares = np.linspace(0.0, _MOST_GROUNDED, max(len(members) // 2, 1))
    out: list[RelativeModesSpec] = []
    for k, plant in enumerate(members):
        grounded = float(shares[k // 2]) if k % 2 else 0.0
        modes = tuple(m.model_copy(update={"grounded": grounded}) for m in plant.modes)
        out.append(RelativeModesSpec(modes=modes))
    return out


def plant_set_from(
    fit: Fit,
    members: Sequence[Fit] = (),
    *,
    kind: Kind,
    origin: Origin = _UNKNOWN,
) -> PlantSetSpec:
    """Return the set of a nominal fit and the fits of its members.

    Without members the nominal plant is varied by its typical spread (`parametric_members`).
    """
    listed: tuple[WeightedMember, ...] | ParametricMembers = parametric_members(kind)
    if members:
        plants = [prompt(fit), *map(prompt, members)]
        listed = tuple(WeightedMember(plant=p) for p in plants)
    delays_s = _span([delay_of(one.spec) for one in (fit, *members)])
    return PlantSetSpec(
        nominal=prompt(fit),
        members=listed,
        band_hz=fit.band_hz,
        provenance=_provenance_of(fit, kind, delays_s=delays_s, origin=origin),
    )


def model_file_set(spec: PlantSpec) -> PlantSetSpec:
    """Return the set of a plant that was not measured here but read from a file.

    It is varied as far as it can be: taps have no frequencies, and pairs that hardly ring no more
    damping.
    """
    kind: Kind = "model file"
    alone = PlantSetSpec(nominal=spec, provenance=Provenance(kind=kind))
    every = parametric_members(kind)
    for members in (every, ParametricMembers(frequency_scale=every.frequency_scale)):
        with contextlib.suppress(ValidationError):
            return PlantSetSpec.model_validate({**dict(alone), "members": members})
    return alone


def parametric_members(kind: Kind) -> ParametricMembers:
    """Return the corners, sides and centre of the spread that `kind` of measurement has."""
    f, z = _PARAMETRIC_SPREAD[kind]
    return ParametricMembers(frequency_scale=(1 - f, 1.0, 1 + f), damping_scale=(1 - z, 1.0, 1 + z))


def measured_modes(fit: Fit) -> tuple[MeasuredMode, ...]:
    """Return the modes of a fit as in documents, without unknown figures."""
    return tuple(
        MeasuredMode(
            f_hz=m.f_hz,
            zeta=m.zeta,
            f_sd_hz=m.f_sd_hz if np.isfinite(m.f_sd_hz) else None,
            zeta_sd=m.zeta_sd if np.isfinite(m.zeta_sd) else None,
        )
        for m in fit.modes
    )


def _by_label(measured: Sequence[FrequencyResponse], axis: str) -> list[list[FrequencyResponse]]:
    if not measured:
        raise ModelError(f"axis {axis}: no frequency response to identify from; give one or more")
    groups: dict[str, list[FrequencyResponse]] = {}
    for response in measured:
        groups.setdefault(response.label, []).append(response)
    return list(groups.values())


def _parts(
    progress: Callable[[float], None] | None,
) -> tuple[Callable[[float], None] | None, Callable[[float], None] | None]:
    """Part progress between a fit and the draws after it."""
    if progress is None:
        return None, None
    return lambda part: progress(0.5 * part), lambda part: progress(0.5 + 0.5 * part)


def _provenance_of(
    fit: Fit,
    kind: Kind,
    measured: Sequence[FrequencyResponse] = (),
    *,
    delays_s: tuple[float, float] | None,
    origin: Origin,
) -> Provenance:
    """Return the provenance that a store keeps with a plant.

    Parameters
    ----------
    measured : sequence of FrequencyResponse
        Responses whose coherence is recorded, if it is known.
    delays_s : (float, float) or None
        What the plants that explain the measurement delay slow motion by, if that is known.
    """
    share, band_hz = coherent_part(measured)
    return Provenance(
        kind=kind,
        measured_on=origin.measured_on,
        sources=origin.sources,
        residual=fit.residual,
        delay_s=fit.delay_s,
        gain=fit.gain,
        modes=measured_modes(fit),
        trust_below_hz=fit.trust_below_hz,
        phase="not measured" if fit.magnitude_only else "aligned at low frequency",
        slow_delay_s=delays_s,
        coherent_share=share,
        coherent_band_hz=band_hz,
    )


def _weighted(plants: Sequence[PlantSpec], weights: Sequence[float]) -> tuple[WeightedMember, ...]:
    pairs = zip(plants, weights, strict=True)
    return tuple(WeightedMember(plant=plant, weight=weight) for plant, weight in pairs)


def _span(values: Sequence[float]) -> tuple[float, float]:
    return float(min(values)), float(max(values))


def _grid(fit: Fit) -> Array:
    return np.linspace(*fit.band_hz, _POINTS)


def _distance(member: Fit, nominal: Fit) -> Array:
    """Return |G_j/G_0 - 1| over the band, shape (points,)."""
    f = _grid(nominal)
    ratio = frequency_response(prompt(member), f) / frequency_response(prompt(nominal), f)
    return np.asarray(np.abs(ratio - 1), np.float64)


def _scatter(
    measured: Sequence[FrequencyResponse],
    groups: Sequence[Sequence[FrequencyResponse]],
    fit: Fit,
    fits: Sequence[Fit],
) -> Array:
    """Return how far responses of one state differ, relative, over the band.

    Three standard deviations of the noise, 2 % at least, and more where repeats show more.
    """
    f = _grid(fit)
    known = [r for r in measured if np.isfinite(r.sd).all()]
    rows = [np.interp(f, r.f_hz, r.sd / np.abs(r.response)) for r in known]
    noise = _SIGMAS * np.median(rows, axis=0) if rows else np.zeros(len(f))
    scatter = np.maximum(noise, _NO_DIFFERENCE)
    for group, of_mean in zip(groups, fits, strict=False):
        # Judged about their own mean, whose peaks are as rounded as the nominal plant's.
        for repeat in group if len(group) > 1 else ():
            around = _distance(refit(repeat, fit), of_mean)
            scatter = np.maximum(scatter, _FEW_REPEATS * around)
    return scatter


def _outside_scatter(fits: list[Fit], nominal: Fit, scatter: Array) -> list[Fit]:
    """Keep members that leave the scatter somewhere; the farthest if there are too many."""
    distances = [_distance(fit, nominal) for fit in fits]
    kept = [i for i, d in enumerate(distances) if np.any(d > scatter)]
    # The nominal plant is a member too.
    room = _MOST_MEMBERS - 1
    farthest = sorted(kept, key=lambda i: -float(distances[i].max()))[:room]
    return [fits[i] for i in sorted(farthest)]


def _set_warnings(
    names: list[str], fits: list[Fit], kept: list[Fit], nominal: Fit
) -> tuple[str, ...]:
    pairs = list(zip(names, fits, strict=False))
    warnings = [
        f"{name or 'a measurement'}: the pairs of the mean leave {100 * fit.residual:.2g} % "
        f"of it (of the mean {100 * nominal.residual:.2g} %); fit it by itself, another "
        "mode may have moved into the band"
        for name, fit in pairs
        if fit.residual > _BAD_MEMBER * nominal.residual
    ]
    main = sorted((max(fit.modes, key=lambda m: m.peak).f_hz, name) for name, fit in pairs)
    if main and main[-1][0] > _NO_MIDDLE * main[0][0]:
        warnings.append(
            f"what rings most is at {main[0][0]:.1f} Hz in {main[0][1] or 'a measurement'} and at "
            f"{main[-1][0]:.1f} Hz in {main[-1][1] or 'another'}, too far apart for a plant in the "
            "middle; say where each was measured (FILE@z=150), or leave all but one label out"
        )
    if len(kept) < len(fits):
        warnings.append(
            f"{len(fits) - len(kept)} of {len(fits)} measurements add no member of their own: "
            f"they lie within the scatter of repeats, or {_MOST_MEMBERS} plants are enough"
        )
    return tuple(warnings)
