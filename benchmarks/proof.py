"""First print and ringing tower of every built-in machine: what is predicted for both halves.

The right half is compensated by the pipeline that any file takes, and both halves are judged on the
written file. Pieces that are put back would make a right half like the left: they are counted.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from stillpath.applications.proof.coupon import coupon_program, write_coupon
from stillpath.applications.proof.drive import ringing_mode
from stillpath.applications.proof.program import PrintSettings
from stillpath.applications.proof.tower import write_tower
from stillpath.models.machine import Machine
from stillpath.models.store import builtin_machines, load_machine
from stillpath.pipeline.files import default_cache_dir

_SHARE = 3.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--machines", nargs="*", default=builtin_machines())
    parser.add_argument("--bands", type=int, default=3)
    given = parser.parse_args()
    machines = [load_machine(name) for name in given.machines]
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "proof.gcode"
        missed = coupons(machines, target) + towers(machines, target, given.bands)
    print("PASS" if not missed else f"MISS {', '.join(missed)}")
    sys.exit(1 if missed else 0)


def coupons(machines: list[Machine], target: Path) -> list[str]:
    """Print the table of coupons; return those whose right half is not three times nearer."""
    print(
        "| coupon | ripple X, Y, mm | minutes | as planned, um rms (max) | compensated | put back |"
    )
    print("|---|---|---|---|---|---|")
    missed = []
    for machine in machines:
        _, drive = coupon_program(machine, PrintSettings())
        waves = [drive.speed_mm_s / ringing_mode(machine.axes[a].nominal).f_hz for a in ("x", "y")]
        made = write_coupon(machine, target, cache_dir=default_cache_dir())
        before, after = made.ringing["as planned"], made.ringing["compensated"]
        print(
            f"| {machine.name} | {waves[0]:.1f}, {waves[1]:.1f} | {made.result.time_s / 60:.1f} "
            f"| {before.rms_um:.1f} ({before.largest_um:.0f}) "
            f"| {after.rms_um:.1f} ({after.largest_um:.0f}) | {len(made.result.put_back)} |",
            flush=True,
        )
        if made.result.put_back or _SHARE * after.rms_um > before.rms_um:
            missed.append(f"coupon {machine.name}")
    return missed


def towers(machines: list[Machine], target: Path, bands: int) -> list[str]:
    """Print the table of towers, the worst band of each; return those that miss."""
    print("\n| tower | axis | worst band: as planned, compensated, um rms | put back |")
    print("|---|---|---|---|")
    missed = []
    for k, machine in enumerate(machines):
        axis = "xy"[k % 2]
        made = write_tower(machine, axis, target, count=bands, cache_dir=default_cache_dir())
        worst = max(made.bands, key=lambda band: band.after.rms_um / band.before.rms_um)
        put_back = made.written.result.put_back
        print(
            f"| {machine.name} | {axis} | {worst.before.rms_um:.1f}, {worst.after.rms_um:.1f} "
            f"| {len(put_back)} |",
            flush=True,
        )
        if put_back or _SHARE * worst.after.rms_um > worst.before.rms_um:
            missed.append(f"tower {machine.name}")
    return missed


if __name__ == "__main__":
    main()
