"""Write a `ReadbackReport` as readback.html and readback.json."""

from __future__ import annotations

from pathlib import Path

from stillpath.applications.proof.figures import AxisReadback, Curve, ReadbackReport
from stillpath.reports.charts import Chart, Figure, Line, Mark, captioned
from stillpath.reports.pages import rendered, style_of, write_texts

__all__ = ["render_readback", "write_readback"]

_SIZE = (480.0, 290.0)


def write_readback(report: ReadbackReport, directory: Path) -> None:
    """Write readback.html and readback.json into a folder by `reports.pages.write_texts`."""
    page = render_readback(report)
    write_texts(directory, {"readback.json": report.model_dump_json(), "readback.html": page})


def render_readback(report: ReadbackReport) -> str:
    """Return the comparison as one HTML page."""
    return rendered(
        "stillpath.applications.proof",
        "readback.html.j2",
        style_of(),
        {},
        d=report,
        axes=[(axis, _figures(axis)) for axis in report.axes],
    )


def _figures(axis: AxisReadback) -> list[Figure]:
    name = axis.axis.upper()
    marks = [Mark(axis.f_hz, f"{axis.f_hz:.1f} Hz")]
    return [
        captioned(
            f"Axis {name}: spectrum of the acceleration",
            "measured, by the model, and fitted: with the frequency found here",
            Chart(
                about=f"Power spectrum of the acceleration of {name}, measured and predicted.",
                x_title="frequency, Hz",
                y_title="(m/s²)²/Hz",
                lines=_lines(axis.spectrum, 1e-6),
                log=True,
                marks=marks,
            ),
            _SIZE,
        ),
        captioned(
            f"Axis {name}: around one corner",
            "the one that rings most, 5 to 200 Hz",
            Chart(
                about=f"Acceleration of {name} around one corner, measured and predicted.",
                x_title="time, ms",
                y_title="m/s²",
                lines=_lines(axis.excerpt, 1e-3),
            ),
            _SIZE,
        ),
    ]


def _lines(curve: Curve, scale: float) -> list[Line]:
    measured, predicted, fitted = (
        [scale * v for v in values] for values in (curve.measured, curve.predicted, curve.fitted)
    )
    return [
        Line(curve.x, measured, "before main", "measured"),
        Line(curve.x, predicted, "after", "model"),
        Line(curve.x, fitted, "after thin d2", "fitted"),
    ]
