"""Terminal output of the commands `controller` and `loops`."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console

from stillpath.applications.controllers.figures import ControllerReport, LoopFigures

__all__ = ["print_controller", "print_loops"]


def print_controller(d: ControllerReport) -> None:
    """Print the figures of a design, a line each, and its notes."""
    console = Console(highlight=False, soft_wrap=True)
    console.print(f"{d.method} for {d.title}", markup=False)
    least, most = d.min_inverse_t, d.max_add_on
    before, after = d.time.before, d.time.after
    cause = f"{d.time.disturbance}, at the {d.time.enters}"
    rows = [
        ("output, rms", f"{before.rms:.4g} -> {after.rms:.4g} {d.unit}: {cause}"),
        ("output, largest", f"{before.peak:.4g} -> {after.peak:.4g} {d.unit}"),
        ("min 1/|T|", f"{least.db:.2f} dB at {least.at_hz:.5g} Hz"),
        ("max |1 - PQ|", f"{most.db:.2f} dB at {most.at_hz:.5g} Hz"),
        ("noise gain", f"{d.noise_gain:.3g}"),
        ("multiplications", f"{d.multiplications:.1f} per sample at {d.rate_hz:g} samples/s"),
    ]
    for m in d.time.members:
        text = f"rms {m.before_rms:.4g} -> {m.after_rms:.4g}, largest |z| {m.spectral_radius:.5f}"
        rows.append((f"plant {m.name}", text))
    width = max(len(name) for name, _ in rows)
    for name, text in rows:
        console.print(f"  {name:<{width}}  {text}", markup=False)
    for note in d.notes:
        console.print(f"note: {note}", markup=False)


def print_loops(loops: Sequence[LoopFigures]) -> None:
    """Print the built-in closed-loop machines and the methods that fit each."""
    console = Console(highlight=False, soft_wrap=True)
    for loop in loops:
        sensor = "" if loop.sensor_hz == loop.rate_hz else f", sensor {loop.sensor_hz:.5g} Hz"
        console.print(f"{loop.name} ({loop.rate_hz:g} Hz{sensor}): {loop.title}", markup=False)
        console.print(f"    {', '.join(loop.methods)}", markup=False)
