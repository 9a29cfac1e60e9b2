"""Computes the figures on the page from an identification."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from stillpath.applications.identification.figures import (
    AxisFigures,
    IdentificationReport,
    ModelCurve,
    ResponseFigures,
    ShaperFigures,
    SpectrumFigures,
    TrialFigures,
)
from stillpath.applications.machines.resonances import resonances
from stillpath.models.arrays import Array
from stillpath.models.identification.prediction import predicted_psd, predicted_spectrum
from stillpath.models.identification.readers import ReadSettings, assumed_test, direction_of
from stillpath.models.identification.sets import measured_modes
from stillpath.models.identification.shaper_choice import choose_shaper, choose_shaper_of
from stillpath.models.identification.spectrum_model import driven_column
from stillpath.models.identification.types import (
    AxisIdentification,
    Excitation,
    Fit,
    FrequencyResponse,
    Spectrum,
)
from stillpath.models.machine import Machine
from stillpath.models.plants import PlantSpec, frequency_response
from stillpath.models.provenance import MeasuredMode, SourceFile
from stillpath.version import __version__

__all__ = ["identification_report"]

_POINTS = 240
_MOST_POINTS = 500
_MEMBERS_SHOWN = 15
_COHERENT = 0.8
_WITHOUT_BAND_HZ = (1.0, 150.0)
_DIGITS = 5


def identification_report(
    machine: Machine,
    base: Machine,
    found: Mapping[Literal["x", "y"], AxisIdentification],
    settings: ReadSettings,
    sources: Sequence[SourceFile],
) -> IdentificationReport:
    """Return the figures of an identification.

    Parameters
    ----------
    machine, base : Machine
        With the new plants, and before.
    found : mapping
        Axis to what was identified.
    settings : ReadSettings
        Settings with which the measurements were read.
    """
    return IdentificationReport(
        version=__version__,
        machine=machine.name,
        machine_title=machine.title,
        machine_revision=machine.revision,
        base_revision=base.revision,
        sources=tuple(sources),
        axes=tuple(
            _axis(axis, one, base.axes[axis].nominal, settings)
            for axis, one in sorted(found.items())
        ),
    )


def _axis(
    axis: Literal["x", "y"], found: AxisIdentification, before: PlantSpec, settings: ReadSettings
) -> AxisFigures:
    plants, fit = found.plants, found.fit
    about = plants.provenance
    low, high = plants.band_hz or _WITHOUT_BAND_HZ
    f = np.linspace(low, high, _POINTS)
    modes = _modes(plants.nominal, fit)
    peaks = np.abs(frequency_response(plants.nominal, [m.f_hz for m in modes]))
    order = sorted(range(len(modes)), key=lambda k: -float(peaks[k]))
    members = plants.weighted_members() if plants.members else ()
    return AxisFigures(
        axis=axis,
        kind=about.kind if about else "model file",
        band_hz=plants.band_hz,
        trust_below_hz=about.trust_below_hz if about else None,
        residual=fit.residual if fit else None,
        delay_ms=1e3 * fit.delay_s if fit and not fit.magnitude_only else None,
        gain=fit.gain if fit else None,
        modes=tuple(modes[k] for k in order),
        peaks=tuple(float(peaks[k]) for k in order),
        before=_modes(before, None),
        trials=tuple(
            TrialFigures(order=t.order, residual=t.residual) for t in (fit.trials if fit else ())
        ),
        model=_curve(plants.nominal, f),
        members=tuple(_curve(m.plant, f) for m in members[:_MEMBERS_SHOWN]),
        responses=tuple(
            _response(r, fit) for r in found.measured if isinstance(r, FrequencyResponse) and fit
        ),
        spectra=tuple(
            _spectrum(s, fit, settings) for s in found.measured if isinstance(s, Spectrum) and fit
        ),
        shapers=_shapers(found),
        notes=found.notes,
        warnings=found.warnings,
    )


def _modes(plant: PlantSpec, fit: Fit | None) -> tuple[MeasuredMode, ...]:
    if fit is not None:
        return measured_modes(fit)
    return tuple(MeasuredMode(f_hz=f, zeta=zeta) for f, zeta in resonances(plant))


def _curve(plant: PlantSpec, f: Array) -> ModelCurve:
    g = frequency_response(plant, f)
    return ModelCurve(f_hz=_plain(f), magnitude=_plain(np.abs(g)), phase_deg=_plain(_degrees(g)))


def _response(measured: FrequencyResponse, fit: Fit) -> ResponseFigures:
    step = -(-len(measured.f_hz) // _MOST_POINTS)
    f = measured.f_hz[::step]
    # The recording's delay differs between runs; the fit has that of the mean.
    h = measured.response[::step] / (fit.gain * np.exp(-2j * np.pi * f * fit.delay_s))
    coherence = measured.coherence[::step]
    known = ~(coherence < _COHERENT)
    g = frequency_response(fit.spec, f)
    phase = np.full(len(f), np.nan)
    phase[known] = _degrees(h[known])
    return ResponseFigures(
        label=measured.label or measured.source,
        f_hz=_plain(f),
        magnitude=_gaps(np.abs(h), known),
        phase_deg=_gaps(phase, known),
        coherence=_gaps(coherence, np.isfinite(coherence)),
        residual=_gaps(np.abs(h / g - 1), known),
    )


def _spectrum(measured: Spectrum, fit: Fit, settings: ReadSettings) -> SpectrumFigures:
    test = assumed_test(measured, settings).excitation
    column = settings.sensor_axis or driven_column(measured, test.f_start_hz)
    f, seen, predicted = predicted_psd(measured, column, test, fit)
    return SpectrumFigures(
        label=f"{measured.source} ({column})",
        f_hz=_plain(f),
        measured=_plain(seen),
        predicted=_plain(predicted),
    )


def _shapers(found: AxisIdentification) -> tuple[ShaperFigures, ...]:
    """Return Klipper's choice on the first spectrum, or on the one that the plant would show."""
    spectrum = next((s for s in found.measured if isinstance(s, Spectrum)), None)
    if spectrum is not None:
        best, each = choose_shaper_of(spectrum)
    else:
        test = Excitation(direction_of(found.axis))
        best, each = choose_shaper(*predicted_spectrum(found.plants.nominal, test))
    return tuple(
        ShaperFigures(
            name=c.name,
            f_hz=c.f_hz,
            vibrations_percent=100 * c.vibrations,
            smoothing_mm=c.smoothing_mm,
            max_accel_mm_s2=c.max_accel_mm_s2,
            recommended=c.name == best.name,
        )
        for c in each
    )


def _degrees(g: NDArray[np.complex128]) -> Array:
    return np.asarray(np.degrees(np.unwrap(np.angle(g))), np.float64)


def _plain(values: Array) -> tuple[float, ...]:
    """Return values with few digits: a page draws them."""
    return tuple(float(f"{v:.{_DIGITS}g}") for v in values)


def _gaps(values: Array, known: NDArray[np.bool_]) -> tuple[float | None, ...]:
    usable = known & np.isfinite(values)
    return tuple(
        float(f"{v:.{_DIGITS}g}") if ok else None for v, ok in zip(values, usable, strict=True)
    )
