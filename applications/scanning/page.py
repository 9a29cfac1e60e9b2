"""Write a scan as scan.html and scan.json, and its command as a table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np

from stillpath.applications.controllers.page import STYLE, charted, short
from stillpath.applications.scanning.figures import ScanReport, TrackFigures
from stillpath.applications.scanning.scan import Scan
from stillpath.pipeline.files import replacing
from stillpath.reports.charts import Chart, Figure, Line
from stillpath.reports.pages import rendered, style_of, write_texts

__all__ = ["render_scan", "worst_tracks", "write_command", "write_scan"]

_STYLE = ("stillpath.applications.scanning", "scan.css")
_CLASSES = 6
_SIZE = 470.0
_MARGIN = 8.0
_MOST_DRAWN = 5000
_SHOWN = 12
_LINES = {"sent": "before thin", "prefilter": "shaper thin", "add-on": "after main"}


def write_scan(report: ScanReport, directory: Path) -> None:
    """Write scan.html and scan.json into a folder by `reports.pages.write_texts`."""
    page = render_scan(report)
    write_texts(directory, {"scan.json": report.model_dump_json(), "scan.html": page})


def write_command(scan: Scan, target: Path) -> None:
    """Write the command: ``.npz`` with t_s, x, y and track, or else CSV with the same columns.

    x and y are references in the machine's unit; track is -1 with the beam off.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    with replacing(target) as temporary:
        if target.suffix == ".npz":
            x, y = scan.command
            with temporary.open("wb") as file:
                np.savez(file, t_s=scan.t_s, x=x, y=y, track=scan.track)
            return
        unit = scan.report.unit or "unit"
        np.savetxt(
            temporary,
            np.column_stack([scan.t_s, *scan.command, scan.track]),
            fmt=("%.9f", "%.9g", "%.9g", "%d"),
            delimiter=",",
            header=f"t_s,x_{unit},y_{unit},track",
            comments="",
        )


def render_scan(report: ScanReport) -> str:
    """Return the scan as one HTML page."""
    # The lag of the path as sent would hide the effect of an add-on.
    drawn = report.variants[-2:]
    highest = max(track.rms_um[v.name] for track in report.tracks for v in drawn)
    plates = [_Plate(v.label, _plate(report, v.name, highest)) for v in drawn]
    return rendered(
        "stillpath.applications.scanning",
        "scan.html.j2",
        style_of(STYLE, _STYLE),
        {"short": short},
        d=report,
        first=report.variants[0],
        last=report.variants[-1],
        plates=plates,
        legend=[short(highest * k / _CLASSES) for k in range(_CLASSES + 1)],
        by_track=_by_track(report),
        worst=worst_tracks(report)[:_SHOWN],
    )


def worst_tracks(report: ScanReport) -> list[TrackFigures]:
    """Return the tracks, worst first by the rms error of the last variant."""
    name = report.variants[-1].name
    return sorted(report.tracks, key=lambda track: -track.rms_um[name])


@dataclass(frozen=True, slots=True)
class _Plate:
    title: str
    svg: str


def _by_track(report: ScanReport) -> Figure:
    numbers = range(1, len(report.tracks) + 1)
    lines = [
        Line(
            list(numbers),
            [track.rms_um[v.name] or None for track in report.tracks],
            _LINES[v.name],
            v.label.split(" and ")[-1] if v.name == "add-on" else v.label,
        )
        for v in report.variants
    ]
    chart = Chart(
        about="Error of every track, by variant.",
        x_title="track",
        y_title="µm rms",
        lines=lines,
        log=True,
    )
    return charted("Every track", "Distance to where the beam should be, rms.", chart, wide=True)


def _plate(report: ScanReport, name: str, highest: float) -> str:
    """Draw the tracks as they lie on the work, coloured by their error."""
    x = [v for track in report.tracks for v in track.x_mm]
    y = [v for track in report.tracks for v in track.y_mm]
    span = max(max(x) - min(x), max(y) - min(y)) or 1.0
    scale = (_SIZE - 2 * _MARGIN) / span
    height = (max(y) - min(y)) * scale + 2 * _MARGIN
    step = -(-len(report.tracks) // _MOST_DRAWN)
    about = f"Tracks on the work, {name}, coloured by their error"
    out = [f'<svg viewBox="0 0 {_SIZE:g} {height:.0f}" role="img" aria-label="{escape(about)}">']
    for track in report.tracks[::step]:
        level = min(int(_CLASSES * track.rms_um[name] / (highest or 1.0)), _CLASSES - 1)
        points = _points(track.x_mm, track.y_mm, min(x), max(y), scale)
        out.append(f'<polyline class="e{level}" points="{points}"/>')
    return "".join([*out, "</svg>"])


def _points(x: Sequence[float], y: Sequence[float], left: float, top: float, scale: float) -> str:
    return " ".join(
        f"{_MARGIN + (a - left) * scale:.1f},{_MARGIN + (top - b) * scale:.1f}"
        for a, b in zip(x, y, strict=True)
    )
