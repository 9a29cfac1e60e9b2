"""How near the nozzle comes to its path: compensated files, read back and judged.

For each file and machine the written file is interpreted, planned and sampled at 10 kHz like any
other file (`readback.py`), and the continuous plants answer: the nominal one at 10 kHz, all members
at 2.5 kHz. The original
is planned again with the stops that the written file has on top of its own (a piece is cut at least
every 60 s), so that paths compare; both files are then matched stretch by stretch: a stretch is an
unbroken motion of X and Y between two rests, it must end at the same X Y Z E in both, and the
original's stretch counts from the instant at which the written one starts. Contour error is taken
within 80 ms on that common time, tracking error at equal time.

`none` and the shaper are judged on the original's own plan, in the same way and at 10 kHz. The
shaper's type and frequencies are tuned as golden/README.md says on the first 120 s of the same file
(cached, see --cache). Time is compared with the original's plan without added stops.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from statistics import geometric_mean

from inputs import find_input, one_thread_each, plain_copy, shared_folder
from readback import Aligned, Judge, Motion, Own, Shaped, forced_stops, read_motion

from stillpath.models.machine import Machine
from stillpath.models.store import load_machine
from stillpath.pipeline.compensate import compensate_file
from stillpath.pipeline.files import default_cache_dir
from stillpath.pipeline.measuring.reference_shaper import BestShaper, tune_shaper
from stillpath.pipeline.options import Options

FILES = ("ps_voron_klipper_ringing", "cura_ender3_gear24", "klipper_excludeobj_multi")
MACHINES = ("ender3", "voron-v0", "voron-v24-250", "annex-k3")
RATIO = {"ender3": 0.25, "voron-v0": 0.25, "voron-v24-250": 0.5, "annex-k3": 1.0}
MEMBERS = {"ender3": 0.5, "voron-v0": 0.5, "voron-v24-250": 0.6, "annex-k3": 1.0}
_TUNE_S = 120.0
_REASONS = 5


@dataclass(frozen=True, slots=True)
class Task:
    """One file on one machine, at several tolerances."""

    file: Path
    machine: str
    tolerances_um: tuple[float, ...]
    options: Options
    cache: Path


@dataclass(frozen=True, slots=True)
class Row:
    """What one case showed; lengths in um."""

    file: str
    machine: str
    tolerance_um: float
    none_rms: float
    none_max: float
    shaper: str
    shaper_rms: float
    shaper_max: float
    ours_rms: float
    ours_max: float
    ours_max_at_s: float
    ratio: float
    members_ratio: float
    members_rms: float
    tracking_none: float
    tracking_ours: float
    tracking_ratio: float
    bend_rms_ratio: float
    bend_max_ratio: float
    original_s: float
    time_percent: float
    megabytes: float
    size_ratio: float
    segments_per_s: float
    peak_segments_per_s: float
    put_back: int
    put_back_percent: float
    put_back_reasons: list[str]
    emission_rms: float
    emission_max: float
    cpu_s: float
    missed: list[str]


def main() -> None:
    parser = argparse.ArgumentParser(description="Quality of compensated files, read back.")
    parser.add_argument("files", nargs="*", default=list(FILES), help="paths, or corpus names")
    parser.add_argument("--machines", nargs="+", default=list(MACHINES), help="names or .json")
    parser.add_argument("--tolerance-um", nargs="+", type=float, default=[2.0, 5.0])
    parser.add_argument("--method", default="fbf")
    parser.add_argument("--basis", default="ce-opt")
    parser.add_argument("--robust", default=None, help="default: the product's")
    parser.add_argument("--along", type=float, default=None)
    parser.add_argument("--shared", type=Path, help="default: $STILLPATH_SHARED or ../shared")
    parser.add_argument("--cache", type=Path, default=default_cache_dir() / "benchmarks")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--json", type=Path, help="write the rows here too")
    given = parser.parse_args()

    chosen = {"method": given.method, "basis": given.basis}
    chosen |= {k: getattr(given, k) for k in ("robust", "along") if getattr(given, k) is not None}
    options = Options(**chosen)
    shared = shared_folder(given.shared)
    one_thread_each()
    rows: list[Row] = []
    failures = 0
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="stillpath-quality-") as folder:
        files = [plain_copy(find_input(name, shared), Path(folder)) for name in given.files]
        tasks = [
            Task(file, machine, tuple(given.tolerance_um), options, given.cache)
            for file in files
            for machine in given.machines
        ]
        print_head()
        # Fresh processes read the settings above before they load any library.
        with ProcessPoolExecutor(given.jobs, mp_context=get_context("spawn")) as pool:
            waiting = {pool.submit(judged, task): task for task in tasks}
            for done in as_completed(waiting):
                task = waiting[done]
                try:
                    found = done.result()
                except Exception as error:
                    failures += 1
                    print(f"{task.file.stem} {task.machine}: FAILED: {error!r}", flush=True)
                    continue
                for row in found:
                    print_row(row)
                rows += found
    rows.sort(key=lambda r: (r.file, r.machine, r.tolerance_um))
    print_notes(rows)
    print_means(rows)
    cpu_s = sum(row.cpu_s for row in rows)
    missed = sum(bool(row.missed) for row in rows)
    print(
        f"{len(rows)} cases, {missed} with a miss, {failures} tasks failed; "
        f"{cpu_s / 60:.1f} CPU min, {(time.monotonic() - began) / 60:.1f} min"
    )
    if given.json:
        given.json.write_text(json.dumps([asdict(row) for row in rows], indent=1) + "\n")
    sys.exit(1 if missed or failures else 0)


def judged(task: Task) -> list[Row]:
    """Judge one file on one machine."""
    machine = load_machine(task.machine)
    began = time.process_time()
    own = read_motion(task.file, machine)
    best = best_shaper(task, machine, own)
    none, shaped = Judge(machine, members=False), Judge(machine, members=True)
    for section in Own.sections(own):
        none.add(section)
    for shaped_section in Shaped.through(own, best.pulses):
        shaped.add(shaped_section)
    rows = []
    with tempfile.TemporaryDirectory(prefix="stillpath-quality-") as folder:
        for tolerance_um in task.tolerances_um:
            row = _case(task, tolerance_um, own, best, none, shaped, Path(folder))
            rows.append(replace(row, cpu_s=time.process_time() - began))
            began = time.process_time()
    return rows


def _case(
    task: Task,
    tolerance_um: float,
    own: Motion,
    best: BestShaper,
    none: Judge,
    shaped: Judge,
    folder: Path,
) -> Row:
    machine, target = load_machine(task.machine), folder / "out.gcode"
    options = task.options.model_copy(update={"tolerance_um": tolerance_um})
    result = compensate_file(task.file, target, machine, options, cache_dir=task.cache)
    written = read_motion(target, machine)
    original = read_motion(task.file, machine, forced_stops(own, written))
    ours = Judge(machine, members=True)
    for section in Aligned(original, written).sections(original, written):
        ours.add(section)
    nominal, without, shaper = ours.contour, none.contour, shaped.contour
    members = 1e3 * ours.members_rms_mm
    row = Row(
        file=task.file.stem,
        machine=machine.name,
        tolerance_um=tolerance_um,
        none_rms=1e3 * without.rms,
        none_max=1e3 * without.max,
        shaper=best.label,
        shaper_rms=1e3 * shaper.rms,
        shaper_max=1e3 * shaper.max,
        ours_rms=1e3 * nominal.rms,
        ours_max=1e3 * nominal.max,
        ours_max_at_s=ours.worst_s,
        ratio=_over(nominal.rms, shaper.rms),
        members_ratio=_over(members, 1e3 * shaped.members_rms_mm),
        members_rms=members,
        tracking_none=1e3 * none.tracking.rms,
        tracking_ours=1e3 * ours.tracking.rms,
        tracking_ratio=_over(ours.tracking.rms, none.tracking.rms),
        bend_rms_ratio=_over(ours.bend.rms, none.bend.rms),
        bend_max_ratio=_over(ours.bend.max, none.bend.max),
        original_s=own.time_s,
        time_percent=100.0 * (written.time_s / own.time_s - 1.0),
        megabytes=result.written_bytes / 1e6,
        size_ratio=result.written_bytes / result.original_bytes,
        segments_per_s=result.segments_per_s,
        peak_segments_per_s=result.peak_segments_per_s,
        put_back=len(result.put_back),
        put_back_percent=100.0 * result.put_back_extruding_share,
        put_back_reasons=[
            f"lines {p.line_first}-{p.line_last}, {p.seconds:.1f} s: {p.reason}"
            for p in result.put_back
        ],
        emission_rms=result.emission_rms_um,
        emission_max=result.emission_max_um,
        cpu_s=0.0,
        missed=[],
    )
    row.missed.extend(missed(row))
    return row


def missed(row: Row) -> Iterator[str]:
    """Name the criteria that a case does not meet; machines kept aside have no shaper ratio."""
    checks = [
        ("tracking", row.tracking_ratio, 0.125),
        ("bend rms", row.bend_rms_ratio, 2.0),
        ("bend max", row.bend_max_ratio, 2.0),
        ("time %", row.time_percent, 0.5),
        ("put back %", row.put_back_percent, 1.0),
    ]
    if row.tolerance_um == 2.0:
        checks.append(("contour um", row.ours_rms, max(1.5, 0.04 * row.none_rms)))
    if row.machine in RATIO:
        checks.append(("ratio", row.ratio, RATIO[row.machine]))
        checks.append(("members", row.members_ratio, MEMBERS[row.machine]))
    for name, value, limit in checks:
        if not value <= limit:
            yield f"{name} {value:.3g} > {limit:.3g}"


def best_shaper(task: Task, machine: Machine, own: Motion) -> BestShaper:
    """Tune the shaper on the first 120 s of the file, once per file and machine revision."""
    digest = hashlib.sha256(task.file.read_bytes()).hexdigest()[:12]
    path = task.cache / f"file-shaper-{machine.revision}-{digest}.json"
    if path.is_file():
        return BestShaper(**json.loads(path.read_text()))
    section = max(Own.sections(own), key=lambda s: s.samples)
    position, extruding = section.path(0, min(section.samples, round(_TUNE_S * 1e4)))
    best = tune_shaper(machine, position[:, ::10].copy(), 1e-3, extruding[::10].copy())
    task.cache.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(asdict(best)))
    return best


def _over(value: float, base: float) -> float:
    return value / base if base > 0 else float("inf")


def print_head() -> None:
    print("contour error in um, rms/max while extruding; bend: second difference of the command at")
    print("1 kHz over that of the plan, rms/max; put: pieces put back and share of extruding time;")
    print("gap: executed against commanded, rms/max um")
    print(
        f"{'file':26}{'machine':14}{'tol':>4} {'none':>10} {'shaper':>10} {'ours':>10} "
        f"{'ratio':>6} {'memb.':>6} {'tracking':>10} {'ratio':>6} {'bend':>10} {'time%':>6} "
        f"{'MB':>6} {'x':>5} {'seg/s':>9} {'put':>9} {'gap':>9} {'CPU':>5}  verdict"
    )


def print_row(r: Row) -> None:
    verdict = "PASS" if not r.missed else "MISS " + ", ".join(r.missed)
    print(
        f"{r.file[:25]:26}{r.machine[:13]:14}{r.tolerance_um:4g} "
        f"{r.none_rms:5.1f}/{r.none_max:<4.0f} {r.shaper_rms:5.2f}/{r.shaper_max:<4.0f} "
        f"{r.ours_rms:5.2f}/{r.ours_max:<4.0f} {r.ratio:6.3f} {r.members_ratio:6.3f} "
        f"{r.tracking_none:5.1f}/{r.tracking_ours:<4.1f} {r.tracking_ratio:6.3f} "
        f"{r.bend_rms_ratio:4.2f}/{r.bend_max_ratio:<5.2f} {r.time_percent:+6.3f} "
        f"{r.megabytes:6.1f} {r.size_ratio:5.2f} "
        f"{r.segments_per_s:4.0f}/{r.peak_segments_per_s:<4.0f} "
        f"{r.put_back:3d}/{r.put_back_percent:<4.2f}% {r.emission_rms:4.2f}/{r.emission_max:<4.1f} "
        f"{r.cpu_s:5.0f}  {verdict}",
        flush=True,
    )


def print_notes(rows: list[Row]) -> None:
    print("\ntuned shapers:")
    for (file, machine), shaper in {(r.file, r.machine): r.shaper for r in rows}.items():
        print(f"  {file:26}{machine:14}{shaper}")
    if any(row.put_back for row in rows):
        print("\npieces put back:")
    for row in rows:
        for reason in row.put_back_reasons[:_REASONS]:
            print(f"  {row.file} {row.machine} {row.tolerance_um:g} um, {reason}")
        if len(row.put_back_reasons) > _REASONS:
            print(f"  ... and {len(row.put_back_reasons) - _REASONS} more")
    print()


def print_means(rows: list[Row]) -> None:
    """Geometric means over printers of what each file shows, as the robustness limits ask."""
    print("geometric means over the machines of (contour rms / best shaper's):")
    for tolerance_um in sorted({row.tolerance_um for row in rows}):
        some = [row for row in rows if row.tolerance_um == tolerance_um]
        mean = {
            name: geometric_mean(getattr(row, name) for row in some)
            for name in ("members_ratio", "ratio", "tracking_ratio")
        }
        print(
            f"  {tolerance_um:g} um: members {mean['members_ratio']:.3f} (worst machine "
            f"{max(row.members_ratio for row in some):.3f}), nominal {mean['ratio']:.3f}, "
            f"tracking over uncompensated {mean['tracking_ratio']:.3f} "
            f"(worst {max(row.tracking_ratio for row in some):.3f})"
        )


if __name__ == "__main__":
    main()
