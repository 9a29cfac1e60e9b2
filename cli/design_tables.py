"""Terminal output of `stillpath design` and `stillpath track`."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table

from stillpath.applications.design.figures import DesignReport
from stillpath.applications.design.summary import Summary, modes_text, zero_text
from stillpath.applications.design.tracking import Tracked

__all__ = ["print_design", "print_tracked"]


def print_design(report: DesignReport) -> None:
    """Print the axis, its set, the ladder and what errors of frequency cost."""
    console = Console(highlight=False)
    summary = Summary(report)
    _axis(report, console)
    if len(report.plant.members) > 1:
        console.print(_members(report))
    _lifted(report, console)
    console.print(_ladder(report))
    # Rungs may all be refused for one reason.
    for refused in dict.fromkeys(rung.refused for rung in report.ladder if rung.refused):
        console.print(f"refused: {refused}", markup=False)
    own, rung = summary.own, summary.rung
    if own is not None and rung is not None and report.accel_limit_mm_s2 is not None:
        console.print(
            f"taken on the reference motion: n {rung.n}, price {rung.price:g}; command at most "
            f"{own.peak_accel_mm_s2:.0f} mm/s2 (path {report.path_peak_accel_mm_s2:.0f}, allowed "
            f"{report.accel_limit_mm_s2:.0f}), rms {own.rms_accel_mm_s2:.0f} mm/s2 "
            f"(path {report.path_rms_accel_mm_s2:.0f})"
        )
    console.print(_robustness(report, summary))
    for reason in report.robustness.missing:
        console.print(f"missing: {reason}", markup=False)


def print_tracked(tracked: Tracked) -> None:
    """Print what the command reaches on the nominal plant and on the set, and what it takes."""
    console = Console(highlight=False)
    report, members = tracked.report, tracked.members
    console.print(
        f"{report.functions} functions of {len(tracked.path_mm)} samples, rank {report.rank}, "
        f"condition {report.condition:.1e}"
    )
    table = Table("e/y_d", "plant", box=None, pad_edge=False)
    table.add_row(f"{tracked.error:.3g}", "nominal")
    if len(members) > 1:
        table.add_row(f"{sum(members) / len(members):.3g}", f"mean of the set of {len(members)}")
        table.add_row(f"{max(members):.3g}", "worst of the set")
    console.print(table)
    console.print(
        f"u/y_d {tracked.effort:.3g}; largest command {tracked.largest_mm:.4g} mm\n"
        f"J_e {tracked.j_e:.4f}, J_e,r {tracked.j_er:.4f}, J_c {tracked.j_c:.3g}"
    )


def _axis(report: DesignReport, console: Console) -> None:
    plant = report.plant
    console.print(
        f"{report.machine_title}, axis {report.axis}; {report.basis} basis, robust {report.robust}",
        markup=False,
    )
    console.print(f"modes: {modes_text(plant.modes)}")
    zeros = "; ".join(map(zero_text, plant.zeros_outside)) or "none"
    console.print(f"zeros outside the unit circle: {zeros}", markup=False)
    for note in plant.notes:
        console.print(f"note: {note}", markup=False)


def _members(report: DesignReport) -> Table:
    table = Table("member", "weight", "minimax", box=None, pad_edge=False)
    for member in report.plant.members:
        guarded = "-" if member.minimax_weight is None else f"{member.minimax_weight:.3f}"
        table.add_row(modes_text(member.modes), f"{member.weight:.3f}", guarded)
    return table


def _lifted(report: DesignReport, console: Console) -> None:
    lifted = report.lifted
    for name, sigma in (("position", lifted.position), ("increments", lifted.increments)):
        shown = ", ".join(
            f"{sigma[n - 1]:.2e} (n {n})" for n in (1, 30, 60, 90, 150) if n <= len(sigma)
        )
        console.print(f"singular values, {name}: {shown}")
    for metric in report.metrics.robust:
        model = "nominal plant" if metric.nominal == "plant" else "lifted optimum (4.28)"
        at = min(90, len(metric.error)) - 1
        console.print(
            f"J_e,r with the {model}: best number {metric.best} (remark 4.5); at n {at + 1} "
            f"{metric.error[at]:.4f}, nominal part {metric.nominal_part[at]:.4f}, "
            f"uncertainty part {metric.uncertainty_part[at]:.4f} (4.9)"
        )


def _ladder(report: DesignReport) -> Table:
    table = Table(title="ladder of designs", title_justify="left", box=None, pad_edge=False)
    for name in ("n", "cut-off Hz", "price", "rho(F)", "cond(R)", "J_e", "J_e,r", "J_c mm/s2/um"):
        table.add_column(name, justify="right")
    table.add_column("verdict")
    for k, rung in enumerate(report.ladder):
        figures = (
            (rung.spectral_radius, ".3f"),
            (rung.condition, ".0e"),
            (rung.error, ".4f"),
            (rung.robust_error, ".4f"),
            (rung.effort, ".3g"),
        )
        verdict = "refused" if rung.refused else "taken" if k == report.chosen else "accepted"
        table.add_row(
            str(rung.n),
            f"{rung.cutoff_hz:.1f}",
            f"{rung.price:g}",
            *("-" if value is None else format(value, form) for value, form in figures),
            verdict,
        )
    return table


def _robustness(report: DesignReport, summary: Summary) -> Table:
    title = "contour rms (um) and peak acceleration (mm/s2) on the reference motion"
    table = Table(title=title, title_justify="left", box=None, pad_edge=False)
    for name in ("command", "design"):
        table.add_column(name, no_wrap=True)
    reaches = [f"+-{reach:g} %" for reach in summary.reaches]
    for name in ("nominal", *reaches, "members", "worst", "peak"):
        table.add_column(name, justify="right")
    for curve in report.robustness.curves:
        errors = (curve.nominal_um, *summary.worst(curve), curve.members_mean_um)
        table.add_row(
            curve.label,
            curve.setting.replace("price ", "").removesuffix(" Hz"),
            *(f"{um:.2f}" for um in (*errors, curve.members_worst_um)),
            f"{curve.peak_accel_mm_s2:.0f}",
        )
    return table
