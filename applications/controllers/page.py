"""Write a designed controller as controller.html, controller.json and controller.h."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from stillpath.applications.controllers.design import Designed
from stillpath.applications.controllers.figures import ControllerReport, Envelope
from stillpath.reports.charts import Chart, Figure, Line, Mark, captioned
from stillpath.reports.pages import rendered, style_of, write_texts

__all__ = [
    "STYLE",
    "charted",
    "decibels",
    "render_controller",
    "short",
    "write_controller",
]

STYLE = ("stillpath.applications.controllers", "controller.css")
_WIDE, _NARROW, _SMALL = (990.0, 340.0), (400.0, 300.0), (480.0, 270.0)
_LOWEST_DB, _HIGHEST_DB = -60.0, 40.0


def write_controller(made: Designed, directory: Path) -> None:
    """Write controller.html, controller.json and controller.h by `reports.pages.write_texts`."""
    texts = {
        "controller.json": made.report.model_dump_json(),
        "controller.h": made.controller.to_c_header(),
        "controller.html": render_controller(made.report),
    }
    write_texts(directory, texts)


def render_controller(report: ControllerReport) -> str:
    """Return the design as one HTML page."""
    return rendered(
        "stillpath.applications.controllers",
        "controller.html.j2",
        style_of(STYLE),
        {"short": short, "db": decibels, "setting": _setting},
        d=report,
        sensitivity=_sensitivity(report),
        response=_response(report),
        figures=[*_frequency(report), *_time(report)],
    )


def charted(title: str, note: str, chart: Chart, *, wide: bool = False) -> Figure:
    """Return a chart, drawn for a screen and for a phone."""
    return captioned(title, note, chart, _WIDE if wide else _SMALL, _NARROW)


def short(value: float) -> str:
    """Return a number with three digits; rounding residues below 1e-9 as 0."""
    if abs(value) < 1e-9:
        return "0"
    return f"{value:.3g}" if 1e-3 <= abs(value) < 1e4 else f"{value:.1e}"


def decibels(value: float, digits: int = 2) -> str:
    """Return dB with a typographic minus, and none before zero."""
    text = f"{value:.{digits}f}"
    return text.lstrip("-") if float(text) == 0 else text.replace("-", "−")


def _setting(value: object) -> str:
    """Return a setting, or a list of them, without rounding residues."""
    if isinstance(value, float):
        return f"{value:.7g}"
    return ", ".join(map(_setting, value)) if isinstance(value, list | tuple) else str(value)


def _sensitivity(d: ControllerReport) -> Figure:
    return _over_frequency(
        d,
        "Sensitivity",
        "What is left of a disturbance at the output, |S|; cut off at -60 dB.",
        [("before main", "without", d.curves.s0), ("after main", "with add-on", d.curves.s)],
        wide=True,
    )


def _frequency(d: ControllerReport) -> list[Figure]:
    bounds = [("after main", "1/|T|", d.curves.inverse_t)]
    note = "How far off the plant may be, relative, at every frequency at once (small gain)."
    if d.uncertainty is not None:
        bounds.append(("before d1", "asked", (d.uncertainty,) * len(d.curves.f_hz)))
        note += " Dashed: how far it may be, as asked."
    least = Mark(d.min_inverse_t.at_hz, f"{decibels(d.min_inverse_t.db, 1)} dB")
    return [
        _over_frequency(
            d,
            "Factor of the add-on",
            "|1 - PQ|: below 0 dB the add-on helps, above it pays for that.",
            [("after main", "", d.curves.add_on)],
        ),
        _over_frequency(d, "Robustness", note, bounds, marks=(least,)),
        _over_frequency(
            d, "Filter", "|Q|: where the add-on works.", [("shaper main", "", d.curves.q)]
        ),
    ]


def _over_frequency(
    d: ControllerReport,
    title: str,
    note: str,
    curves: Sequence[tuple[str, str, Sequence[float]]],
    *,
    marks: Sequence[Mark] = (),
    wide: bool = False,
) -> Figure:
    chart = Chart(
        about=f"{title} against frequency. {note}",
        x_title="frequency, Hz",
        y_title="dB",
        lines=[Line(d.curves.f_hz, [_db(v) for v in y], style, name) for style, name, y in curves],
        marks=marks,
        log_x=True,
    )
    return charted(title, note, chart, wide=wide)


def _response(d: ControllerReport) -> Figure:
    lines = _both(d.time.before.whole, d.time.after.whole)
    note = f"{d.time.disturbance}, at the {d.time.enters} of the plant; extremes of every stretch."
    return charted("Output in time", note, _over_time("Output in time", d.unit, lines), wide=True)


def _time(d: ControllerReport) -> list[Figure]:
    title, note = "The end of it", "The last samples of the same run."
    out = [
        charted(
            title,
            note,
            _over_time(title, d.unit, _both(d.time.before.end, d.time.after.end)),
        )
    ]
    found = d.time.predictor
    if found is not None:
        t = [1e3 * v for v in found.t_s]
        lines = [
            Line(t, found.true, "soft main", "true"),
            Line(t, found.held, "before thin d1", "held"),
            Line(t, found.predicted, "after", "predicted"),
        ]
        title = "Predictor"
        note = (
            "The disturbance, what the slow sensor holds of it, and what is predicted from that; "
            f"rms error {short(found.error_rms)} {d.unit}."
        )
        out.append(charted(title, note, _over_time(title, d.unit, lines)))
    return out


def _both(before: Envelope, after: Envelope) -> list[Line]:
    return [
        Line([1e3 * t for t in before.t_s], before.values, "before thin", "without"),
        Line([1e3 * t for t in after.t_s], after.values, "after thin", "with"),
    ]


def _over_time(title: str, unit: str, lines: Sequence[Line]) -> Chart:
    return Chart(about=f"{title}.", x_title="time, ms", y_title=unit, lines=lines)


def _db(value: float) -> float:
    """Return dB, cut off below so that other curves are not flattened."""
    return min(max(20 * math.log10(value), _LOWEST_DB), _HIGHEST_DB)
