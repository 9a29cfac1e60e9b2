"""Terminal output of an identification."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table

from stillpath.applications.identification.figures import AxisFigures, IdentificationReport
from stillpath.applications.identification.page import change_text, fit_text, interval_text

__all__ = ["print_identification"]


def print_identification(report: IdentificationReport) -> None:
    """Print modes, fit and warnings of every axis."""
    console = Console(highlight=False)
    for axis in report.axes:
        console.print(_modes(axis))
        console.print(f"the model misses {fit_text(axis)}{_order(axis)}")
        for shaper in axis.shapers:
            if shaper.recommended:
                console.print(
                    f"Klipper would recommend {shaper.name} at {shaper.f_hz:.1f} Hz "
                    f"({shaper.vibrations_percent:.1f} % vibration left, at most "
                    f"{shaper.max_accel_mm_s2:.0f} mm/s2)"
                )
        for note in axis.notes:
            console.print(f"note: {note}", markup=False)
        for warning in axis.warnings:
            console.print(f"warning: {warning}", markup=False)


def _modes(axis: AxisFigures) -> Table:
    band = f", {axis.band_hz[0]:.0f} to {axis.band_hz[1]:.0f} Hz" if axis.band_hz else ""
    table = Table(title=f"axis {axis.axis.upper()}: {axis.kind}{band}", title_justify="left")
    for column in ("frequency, Hz", "damping", "|G|", "before"):
        table.add_column(column, justify="right")
    for mode, peak in zip(axis.modes, axis.peaks, strict=True):
        table.add_row(
            interval_text(mode.f_hz, mode.f_sd_hz, 2),
            interval_text(mode.zeta, mode.zeta_sd, 4),
            f"{peak:.1f}",
            change_text(mode, axis.before) if axis.before else "",
        )
    return table


def _order(axis: AxisFigures) -> str:
    others = [
        f"{t.order}: {t.residual:.2f} dB"
        if axis.spectra
        else f"{t.order}: {100 * t.residual:.2f} %"
        for t in axis.trials
    ]
    return f" (modes {', '.join(others)})" if others else ""
