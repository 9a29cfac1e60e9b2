"""Terminal output of the command `scan`."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table

from stillpath.applications.scanning.figures import ScanReport
from stillpath.applications.scanning.page import worst_tracks

__all__ = ["print_scan"]

_SHOWN = 5


def print_scan(d: ScanReport) -> None:
    """Print the totals of every variant, the worst tracks, and notes."""
    console = Console(highlight=False, soft_wrap=True)
    console.print(
        f"{d.source} on {d.title}: {len(d.tracks)} tracks, {d.drawn_mm:.4g} mm, "
        f"{d.duration_s:.3g} s at {d.rate_hz:g} samples/s",
        markup=False,
    )
    if d.disturbance is not None:
        console.print(f"disturbance: {d.disturbance}, at the {d.enters}", markup=False)
    total = Table("error, µm", "rms", "across", "largest", box=None, pad_edge=False)
    for v in d.variants:
        total.add_row(v.label, *[f"{x:.3f}" for x in (v.rms_um, v.across_um, v.largest_um)])
    console.print(total)
    worst = Table("worst tracks", *[v.label for v in d.variants], box=None, pad_edge=False)
    for track in worst_tracks(d)[:_SHOWN]:
        lines = (
            f"{track.line}"
            if track.line == track.last_line
            else f"{track.line} to {track.last_line}"
        )
        worst.add_row(f"line {lines}", *[f"{track.rms_um[v.name]:.3f}" for v in d.variants])
    console.print(worst)
    for note in d.notes:
        console.print(f"note: {note}", markup=False)
