"""Terminal output of the commands of proof on metal."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.table import Table

from stillpath.applications.proof.figures import ReadbackReport
from stillpath.applications.proof.halves import ProofPrint
from stillpath.applications.proof.ring_figures import Half, RingReport
from stillpath.applications.proof.tower import Tower
from stillpath.models.confirmation import rounded_um

__all__ = ["print_proof", "print_readback", "print_ring", "print_tower"]


def print_proof(
    made: ProofPrint,
    warnings: Sequence[str] = (),
    *,
    lines: int | None = None,
) -> None:
    """Print the legend (its first lines) and all warnings about a print and its machine."""
    console = Console(highlight=False, soft_wrap=True)
    for line in made.legend[:lines]:
        console.print(line, markup=False)
    for warning in (*warnings, *made.warnings):
        console.print(f"warning: {warning}", markup=False)


def print_tower(tower: Tower) -> None:
    """Print the bands of a tower, from the top down as they stand on the bed."""
    console = Console(highlight=False)
    table = Table(
        "band",
        "height, mm",
        "mm/s²",
        "mm/s",
        "as planned, µm",
        "compensated, µm",
        box=None,
        pad_edge=False,
    )
    for number, band in reversed(list(enumerate(tower.bands, 1))):
        table.add_row(
            str(number),
            f"{band.bottom_mm:.1f} - {band.top_mm:.1f}",
            f"{band.accel_mm_s2:g}",
            f"{band.speed_mm_s:g}",
            f"{band.before.rms_um:.1f} (max {band.before.largest_um:.0f})",
            f"{band.after.rms_um:.1f} (max {band.after.largest_um:.0f})",
        )
    console.print(table)
    console.print(tower.written.legend[-1], markup=False)


def print_readback(report: ReadbackReport) -> None:
    """Print verdicts and figures of a log that was read back."""
    console = Console(highlight=False, soft_wrap=True)
    for verdict in report.verdicts:
        console.print(verdict, markup=False)
    if report.axes:
        table = Table("", box=None, pad_edge=False)
        for axis in report.axes:
            table.add_column(axis.axis.upper(), justify="right")
        for label, cells in (
            ("correlation", [f"{a.correlation:.3f}" for a in report.axes]),
            ("prediction misses", [f"{100 * a.nrmse:.1f} %" for a in report.axes]),
            ("with the frequency found", [f"{100 * a.nrmse_fitted:.1f} %" for a in report.axes]),
            ("damping found (model)", [f"{a.zeta:.3f} ({a.model_zeta:.3f})" for a in report.axes]),
            ("gain of the sensor", [f"{a.gain:.3f}" for a in report.axes]),
            (
                "after corners, mm/s² (model)",
                [
                    f"{a.corners.measured_mm_s2:.0f} ({a.corners.predicted_mm_s2:.0f})"
                    for a in report.axes
                ],
            ),
            (
                "after corners, µm (model)",
                [
                    f"{a.corners.measured_um:.1f} ({a.corners.predicted_um:.1f})"
                    for a in report.axes
                ],
            ),
        ):
            table.add_row(label, *cells)
        console.print(table)
        console.print(
            f"compared {report.compared_s:.0f} s from {report.plan_start_s:.0f} s of the print on; "
            f"the log's clock is {report.clock_ppm:+.0f} ppm off"
        )
    for note in report.notes:
        console.print(f"note: {note}", markup=False)


def print_ring(report: RingReport) -> None:
    """Print verdicts and figures of a ring test."""
    console = Console(highlight=False, soft_wrap=True)
    for axis in report.axes:
        console.print(axis.text, markup=False)
    table = Table(
        "",
        "stops",
        "measured, µm",
        "predicted, µm",
        "measured, mm/s²",
        "predicted, mm/s²",
        box=None,
        pad_edge=False,
    )
    for axis in report.axes:
        for label, half in (("as planned", axis.as_planned), ("compensated", axis.compensated)):
            if half is not None:
                table.add_row(f"{axis.axis.upper()} {label}", *_half(half))
    if table.row_count:
        console.print(table)
    for axis in report.axes:
        if axis.gain is not None:
            low, high = axis.band_hz
            console.print(
                f"{axis.axis.upper()}: {', '.join(axis.logs)}, {low:.0f} to {high:.0f} Hz, noise "
                f"{rounded_um(axis.floor_um or 0.0)} µm taken off, "
                f"gain of the sensor {axis.gain:.2f}, "
                f"{100 * (axis.misses or 0.0):.0f} % of the motion in no plant of the set"
            )
    for note in report.notes:
        console.print(f"note: {note}", markup=False)


def _half(half: Half) -> tuple[str, ...]:
    return (
        str(half.stops),
        f"{rounded_um(half.measured_um)} ± {rounded_um(half.scatter_um, 1)}",
        " - ".join(rounded_um(value) for value in half.predicted_um),
        f"{half.measured_mm_s2:.0f}",
        "{:.0f} - {:.0f}".format(*half.predicted_mm_s2),
    )
