"""Write an `IdentificationReport` as identification.html and identification.json."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from stillpath.applications.identification.figures import AxisFigures, IdentificationReport
from stillpath.models.provenance import MeasuredMode
from stillpath.reports.charts import Chart, Figure, Line, Mark, captioned
from stillpath.reports.pages import rendered, style_of, thousands, write_texts

__all__ = [
    "change_text",
    "fit_text",
    "interval_text",
    "render_identification",
    "write_identification",
]

_PACKAGE = "stillpath.applications.identification"
_WIDE, _NARROW, _SMALL = (990.0, 340.0), (400.0, 320.0), (480.0, 250.0)
_MEASURED = ("before thin", "before thin d1", "before thin d2", "before thin d3", "before thin d5")
_LARGEST_LABEL, _MOST_NAMES = 18, 6
_SAME_MODE = 0.25
_OF_KLIPPER = re.compile(r"^(?:resonances|calibration_data|raw_data)_(.*)\.csv.*$")


def write_identification(report: IdentificationReport, directory: Path) -> None:
    """Write identification.html and identification.json by `reports.pages.write_texts`."""
    page = render_identification(report)
    texts = {"identification.json": report.model_dump_json(), "identification.html": page}
    write_texts(directory, texts)


def render_identification(report: IdentificationReport) -> str:
    """Return the identification as one HTML page."""
    return rendered(
        _PACKAGE,
        "identification.html.j2",
        style_of((_PACKAGE, "identification.css")),
        {"number": thousands, "fit": fit_text, "interval": interval_text, "change": change_text},
        d=report,
        axes=[_Axis(axis, _figures(axis)) for axis in report.axes],
    )


@dataclass(frozen=True, slots=True)
class _Axis:
    """An axis with its drawings."""

    a: AxisFigures
    figures: Sequence[Figure]

    @property
    def lead(self) -> int:
        """Index of the strongest mode within what was measured; outside, modes are a guess."""
        low_hz, high_hz = self.a.band_hz or (0.0, math.inf)
        inside = (k for k, mode in enumerate(self.a.modes) if low_hz <= mode.f_hz <= high_hz)
        return next(inside, 0)


def _figures(axis: AxisFigures) -> list[Figure]:
    if axis.spectra:
        return [_spectrum(axis), _magnitude(axis)]
    if axis.responses:
        return [_magnitude(axis), _phase(axis), _coherence(axis), _residual(axis)]
    return [_magnitude(axis)]


def _magnitude(axis: AxisFigures) -> Figure:
    named = zip(axis.responses, _named([r.label for r in axis.responses]), strict=True)
    measured = [Line(r.f_hz, r.magnitude, style, name) for r, (style, name) in named]
    members = [Line(m.f_hz, m.magnitude, "soft thin member") for m in axis.members]
    model = Line(axis.model.f_hz, axis.model.magnitude, "after main", "model")
    note = "How much further the nozzle moves than it is told: 1 is rigid."
    if members:
        note += " Grey: members of the set."
    last = axis.model.f_hz[-1]
    marks = [Mark(m.f_hz, f"{m.f_hz:.1f} Hz") for m in _apart(axis.modes) if m.f_hz <= last]
    # Measured curves on top, as a good model would hide them.
    return _figure("Magnitude", note, "|G|", [*members, model, *measured], True, marks)


def _phase(axis: AxisFigures) -> Figure:
    measured = [Line(r.f_hz, r.phase_deg, _style(k)) for k, r in enumerate(axis.responses)]
    model = Line(axis.model.f_hz, axis.model.phase_deg, "after main")
    note = "Degrees; a delay of the recording is taken out."
    return _figure("Phase", note, "phase, °", [model, *measured], False)


def _coherence(axis: AxisFigures) -> Figure:
    lines = [Line(r.f_hz, r.coherence, _style(k)) for k, r in enumerate(axis.responses)]
    note = "How much of the measured motion follows the command; below 0.95 is not fitted."
    return _figure("Coherence", note, "coherence", lines, False)


def _residual(axis: AxisFigures) -> Figure:
    lines = [
        Line(r.f_hz, [None if v is None else 100 * v for v in r.residual], _style(k))
        for k, r in enumerate(axis.responses)
    ]
    note = "Measured against model: |H / G − 1|."
    return _figure("What the model misses", note, "%", lines, True)


def _spectrum(axis: AxisFigures) -> Figure:
    named = zip(axis.spectra, _named([s.label for s in axis.spectra]), strict=True)
    measured = [Line(s.f_hz, s.measured, style, name) for s, (style, name) in named]
    first = axis.spectra[0]
    model = Line(first.f_hz, first.predicted, "after main", "model")
    note = "Acceleration, as the printer's own test recorded it, and as the model predicts it."
    return _figure("Power spectrum", note, "(mm/s²)²/Hz", [model, *measured], True)


def _figure(
    title: str,
    note: str,
    y_title: str,
    lines: Sequence[Line],
    log: bool,
    marks: Sequence[Mark] = (),
) -> Figure:
    chart = Chart(
        about=f"{title} against frequency. {note}",
        x_title="frequency, Hz",
        y_title=y_title,
        lines=lines,
        log=log,
        marks=marks,
    )
    wide = title in ("Magnitude", "Power spectrum")
    return captioned(title, note, chart, _WIDE if wide else _SMALL, _NARROW)


def _named(labels: Sequence[str]) -> list[tuple[str, str]]:
    """Return the style of every measured line, and the name of the first of each label."""
    short = [_OF_KLIPPER.sub(r"\1", label)[:_LARGEST_LABEL] for label in labels]
    if len(short) == 1:
        short = ["measured"]
    names = dict.fromkeys(short)
    if len(names) > _MOST_NAMES:
        return [(_style(k), "") for k in range(len(labels))]
    return [(_style(k), "" if n in short[:k] else n) for k, n in enumerate(short)]


def _style(number: int) -> str:
    return _MEASURED[number % len(_MEASURED)]


def _apart(modes: Sequence[MeasuredMode]) -> list[MeasuredMode]:
    """Leave out modes whose labels would overlap on a phone, and spurious modes."""
    out: list[MeasuredMode] = []
    for mode in sorted(modes, key=lambda m: m.zeta):
        if mode.zeta < 0.4 and all(abs(mode.f_hz - other.f_hz) > 25.0 for other in out):
            out.append(mode)
    return sorted(out, key=lambda m: m.f_hz)


def fit_text(axis: AxisFigures) -> str:
    """Return the residual with its unit."""
    if axis.residual is None:
        return "–"
    return f"{axis.residual:.2f} dB" if axis.spectra else f"{100 * axis.residual:.2f} %"


def interval_text(value: float, deviation: float | None, digits: int) -> str:
    """Return a value with its 95 % interval, with as many digits as that needs."""
    if deviation is None or deviation == 0.0:
        return f"{value:.{digits}f}"
    half = 1.96 * deviation
    digits = min(max(digits, -math.floor(math.log10(half))), digits + 2)
    return f"{value:.{digits}f} ± {half:.{digits}f}"


def change_text(mode: MeasuredMode, before: Sequence[MeasuredMode]) -> str:
    """Return a text about the corresponding mode of the former model."""
    near = min(before, key=lambda other: abs(other.f_hz - mode.f_hz))
    change = mode.f_hz / near.f_hz - 1
    return f"{near.f_hz:.1f} Hz ({100 * change:+.1f} %)" if abs(change) < _SAME_MODE else "new"
