"""Charts of the report that need no script."""

from __future__ import annotations

from stillpath.pipeline.result import AxisSpectrum, Result
from stillpath.reports.charts import Chart, Figure, Line, Mark, captioned

__all__ = ["spectrum_figures"]

_SIZE, _NARROW = (470.0, 290.0), (350.0, 260.0)
_HERTZ_APART = 0.12
"""Marks nearer to each other than this share of the axis have one text."""


def spectrum_figures(result: Result) -> list[Figure]:
    """Return the spectra of the error, before and after."""
    names = [channel.name for channel in result.channels]
    figures = []
    for spectrum in result.spectra:
        axis = spectrum.axis.upper()
        chart = Chart(
            about=f"Spectrum of the error along {axis}: {_resonances(spectrum)}.",
            x_title="frequency, Hz",
            y_title="µm/√Hz",
            lines=[
                Line(spectrum.f_hz, spectrum.um_per_sqrt_hz[name], name)
                for name in reversed(names)  # the sliced file lies on top
                if name in spectrum.um_per_sqrt_hz
            ],
            log=True,
            marks=_marks(spectrum),
        )
        title = f"{axis}: {_resonances(spectrum)}"
        figures.append(captioned(title, "", chart, _SIZE, _NARROW))
    return figures


def _resonances(spectrum: AxisSpectrum) -> str:
    found = [f"{f_hz:.1f}" for f_hz in spectrum.resonances_hz]
    if not found:
        return "no resonance in the model"
    return f"resonance{'s' * (len(found) > 1)} at {', '.join(found)} Hz"


def _marks(spectrum: AxisSpectrum) -> list[Mark]:
    marks: list[Mark] = []
    written_hz = -float("inf")
    for f_hz in spectrum.resonances_hz:
        apart = f_hz - written_hz > _HERTZ_APART * spectrum.f_hz[-1]
        marks.append(Mark(f_hz, f"{f_hz:.0f}" if apart else ""))
        written_hz = f_hz if apart else written_hz
    return marks
