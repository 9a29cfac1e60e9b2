"""Write a `DesignReport` as design.html and design.json.

The page is static, without scripts, and has a content security policy that allows only its own
style by hash.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from stillpath.applications.design.figures import (
    Curve,
    DesignReport,
    RobustMetric,
)
from stillpath.applications.design.summary import Summary, modes_text, zero_text
from stillpath.compensation.basis import ZERO
from stillpath.compensation.preview import MAX_CONDITION, MAX_SPECTRAL_RADIUS
from stillpath.reports.charts import Band, Chart, Line, Mark, draw
from stillpath.reports.pages import rendered, style_of, thousands, um_text, write_texts

__all__ = ["render_design", "write_design"]

_PACKAGE = "stillpath.applications.design"
_WIDE, _NARROW, _SMALL = (990.0, 400.0), (400.0, 420.0), (410.0, 280.0)
_COUNTS = (1, 2, 5, 10, 18, 26, 34, 45, 60, 75, 90, 120, 150, 200, 250, 300)
_STYLES = {
    "none": "before main",
    "zv": "shaper thin",
    "mzv": "shaper thin d1",
    "ei": "shaper thin d2",
    "2hump_ei": "shaper thin d3",
    "3hump_ei": "shaper thin d5",
    "fbf-off": "after",
    "fbf-ensemble": "after d4",
    "fbf-minimax": "after d2",
}


def write_design(report: DesignReport, directory: Path) -> None:
    """Write design.html and design.json into a folder by `reports.pages.write_texts`."""
    page = render_design(report)
    write_texts(directory, {"design.json": report.model_dump_json(), "design.html": page})


def render_design(report: DesignReport) -> str:
    """Return the design as one HTML page."""
    summary = Summary(report)
    chart = _robustness_chart(report, summary)
    return rendered(
        _PACKAGE,
        "design.html.j2",
        style_of(),
        {
            "um": um_text,
            "number": thousands,
            "power": _power,
            "figures": _figures,
            "modes": modes_text,
            "zero": zero_text,
        },
        d=report,
        bare=summary.uncompensated,
        own=summary.own,
        best=summary.best_shaper,
        best_worst=summary.best_shaper_of_set,
        rung=summary.rung,
        reaches=summary.reaches,
        rows=[
            {"curve": c, "style": _style(c, summary), "worst": summary.worst(c)}
            for c in report.robustness.curves
        ],
        response=_response_figures(report),
        robust_wide=chart and draw(chart, *_WIDE),
        robust_narrow=chart and draw(chart, *_NARROW),
        figures=_all_figures(report, summary),
        counts=[n for n in _COUNTS if n <= report.lifted.samples],
        max_radius=MAX_SPECTRAL_RADIUS,
        max_condition=MAX_CONDITION,
    )


@dataclass(frozen=True, slots=True)
class _Figure:
    """A small chart with its caption, and the names of its lines in the table."""

    title: str
    note: str
    lines: Sequence[Line]
    columns: Sequence[str]
    svg: str


def _response_figures(report: DesignReport) -> list[_Figure]:
    """Return gain and phase of the axis, with the set as a band around the nominal plant."""
    found = report.frequencies
    several = len(report.plant.members) > 1
    source = "measured" if found.phase_measured else "from the model; not measured"
    rows = (
        ("Gain", "nozzle over command, mm/mm", found.gain, found.gain_low, found.gain_high),
        ("Phase", source, found.phase_deg, found.phase_low_deg, found.phase_high_deg),
    )
    out = []
    for title, note, middle, low, high in rows:
        unit = "gain" if title == "Gain" else "phase, °"
        line = Line(found.f_hz, middle, "after main", "")
        chart = Chart(
            about=f"{title} of axis {report.axis.upper()} against frequency"
            + (f", with the range of {len(report.plant.members)} plants." if several else "."),
            x_title="Hz",
            y_title=unit,
            lines=[line],
            log=title == "Gain",
            log_x=True,
            bands=[Band(found.f_hz, low, high, "band")] if several else (),
        )
        out.append(_Figure(title, note, [line], [unit], draw(chart, *_SMALL)))
    return out


def _robustness_chart(report: DesignReport, summary: Summary) -> Chart | None:
    errors = report.robustness.errors_percent
    if len(errors) < 2:
        return None
    curves = report.robustness.curves
    names = ", ".join(c.label for c in curves)
    return Chart(
        about=f"Contour error against the error of frequency, logarithmic, of {names}. "
        "The table below holds the figures.",
        x_title=f"error of all frequencies of axis {report.axis.upper()}, %",
        y_title="contour error while extruding, rms, µm",
        lines=[Line(errors, c.contour_um, _style(c, summary), c.label) for c in curves],
        tick=lambda v: f"{v:+g}" if v else "0",
        log=True,
    )


def _style(curve: Curve, summary: Summary) -> str:
    style = _STYLES[curve.name]
    return f"{style} main" if summary.own is curve else style


def _all_figures(report: DesignReport, summary: Summary) -> list[_Figure]:
    draw_figure = partial(_figure, report, summary)
    return [*_plant_figures(report, draw_figure), *_error_figures(report, draw_figure)]


def _figure(
    report: DesignReport,
    summary: Summary,
    title: str,
    note: str,
    y_title: str,
    *lines: Line,
    log: bool = True,
) -> _Figure:
    """Return a figure over the number of functions n, with the chosen one marked."""

    def tick(n: float) -> str:
        return f"{n:g}\n{n / (2 * report.window_s):.0f} Hz" if n else "0"

    chart = Chart(
        about=f"{title}: {y_title} against the number of functions n. The table below holds "
        "the figures.",
        x_title="n",
        y_title=y_title,
        lines=lines,
        tick=tick,
        log=log,
        marks=[Mark(summary.rung.n, f"n {summary.rung.n} taken")] if summary.rung else [],
    )
    columns = [f"{y_title.split(',')[0]} {line.name}".strip() for line in lines]
    return _Figure(title, note, lines, columns, draw(chart, *_SMALL))


def _plant_figures(report: DesignReport, figure: Callable[..., _Figure]) -> list[_Figure]:
    """Return the plant's demands on any command: singular values and effort."""
    lifted, metrics = report.lifted, report.metrics
    counts = range(1, lifted.samples + 1)
    alone = report.robust == "off" or len(report.plant.members) < 2
    seen = "the nominal plant" if alone else "the weighted set"
    position, increments = (_nonzero(s) for s in (lifted.position, lifted.increments))
    return [
        figure(
            "Singular values, position command",
            f"of {seen}, lifted over the window (3.22)",
            "σ, mm/mm",
            Line(counts, position, "plain"),
        ),
        figure(
            "Singular values, command increments",
            "two integrators in front: what limited preview works on",
            "σₐ, mm per mm/sample²",
            Line(counts, increments, "plain"),
        ),
        figure(
            "Effort of a position command",
            "J<sub>c</sub>, the least that n functions of the nominal plant need (3.23)",
            "effort, mm/mm",
            Line(counts, metrics.effort_position, "plain"),
        ),
        figure(
            "Effort as acceleration",
            "the same J<sub>c</sub> for increments of the command",
            "effort, mm/s² per µm",
            Line(counts, metrics.effort_increments, "plain"),
        ),
    ]


def _error_figures(report: DesignReport, figure: Callable[..., _Figure]) -> list[_Figure]:
    """Return the expected error and, for a set, the robustness of each function."""
    metrics = report.metrics
    counts = range(1, report.lifted.samples + 1)
    lines = [Line(counts, metrics.error, "plain main", "Jₑ")]
    for metric, style in zip(metrics.robust, ("after", "shaper"), strict=False):
        n = range(1, len(metric.error) + 1)
        name = _model(metric)
        lines.append(Line(n, metric.error, style, f"Jₑ,ᵣ {name}"))
        lines.append(Line(n, metric.uncertainty_part, f"{style} d2", f"unc. {name}"))
    if not metrics.robust:
        note = "n functions of any basis (2.26)"
        return [figure("Expected error", note, "error, white paths", *lines, log=False)]
    note = (
        "J<sub>e</sub> (2.26) is also the nominal part of J<sub>e,r</sub>; the squares of both "
        "parts add up (4.9)"
    )
    spread = [
        Line(range(1, len(m.singular_values) + 1), m.singular_values, style, _model(m))
        for m, style in zip(metrics.robust, ("after", "shaper"), strict=False)
    ]
    return [
        figure("Expected error", note, "error, white paths", *lines, log=False),
        figure(
            "Uncertainty, function by function",
            "singular values of the relative uncertainty (4.11); below 1 a function helps",
            "σ(Δ)",
            *spread,
            Line((1, report.lifted.samples), (1.0, 1.0), "soft d1"),
            log=False,
        ),
    ]


def _model(metric: RobustMetric) -> str:
    return "plant" if metric.nominal == "plant" else "(4.28)"


def _nonzero(singular_values: Sequence[float]) -> list[float | None]:
    """Leave out what is zero but for rounding."""
    return [s if s > ZERO * singular_values[0] else None for s in singular_values]


def _power(value: float) -> str:
    mantissa, exponent = f"{value:.0e}".split("e")
    return f"{mantissa}e{int(exponent)}"


def _figures(value: float | None) -> str:
    if value is None:
        return "–"
    return f"{value:.3g}" if 1e-3 <= abs(value) < 1e4 or value == 0 else f"{value:.1e}"
