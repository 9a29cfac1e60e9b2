"""How much print time the speed budget saves at the error of the best-tuned shaper.

For each file and machine the best shaper is tuned on the file as golden/README.md says (so does
`quality.py`) and judged at the file's own accelerations: the contour error (rms while extruding) of
the worst plant, nominal or member, is the budget. The file is then compensated within that budget,
and the written file is judged by the same judge, from its bytes alone: interpreted, planned by the
firmware's rules, sampled at 10 kHz, answered by the continuous plants. By its report, no class of
moves that was raised may be above the budget ("above" counts those that are), and the command must
keep the machine's own limit of acceleration ("accel": its largest in % of that).

A quicker file has other times, so paths compare by filament: where the written file has fed so
much, the nozzle should be where the original is after as much.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path
from statistics import geometric_mean

import numpy as np
from inputs import find_input, one_thread_each, plain_copy, shared_folder
from numpy.typing import NDArray
from quality import FILES, MACHINES, Task, best_shaper
from readback import DT_S, Judge, Motion, ReadBackError, Shaped, Timed, read_motion

from stillpath.gcode.sampler import sample_phases
from stillpath.gcode.types import Phases, rows_of
from stillpath.models.arrays import Array
from stillpath.models.store import load_machine
from stillpath.pipeline.compensate import compensate_file
from stillpath.pipeline.files import default_cache_dir
from stillpath.pipeline.options import Options
from stillpath.pipeline.result import BudgetClass

SAVED = 0.2
"""Part of the print time that must be saved, geometric mean over all cases."""
_LINE_SHARE = 0.7
_SAME_MM = 0.02
"""Filament, over a whole file."""


@dataclass(frozen=True, slots=True)
class Row:
    """What one case showed; errors in um."""

    file: str
    machine: str
    shaper: str
    shaper_rms: float
    shaper_worst: float
    ours_rms: float
    ours_worst: float
    ours_max: float
    original_s: float
    written_s: float
    shaper_s: float | None
    factors: str
    put_back_percent: float
    classes_above: int
    accel_share: float
    """Largest acceleration of the command over what the machine allows."""
    cpu_s: float

    @property
    def ratio(self) -> float:
        """Print time over the original's."""
        return self.written_s / self.original_s

    @property
    def missed(self) -> bool:
        """Tell whether the error is larger than the shaper's, or a limit is not kept."""
        larger = self.ours_worst > self.shaper_worst or self.ours_rms > self.shaper_rms
        return larger or self.classes_above > 0 or self.accel_share > 1.0


def main() -> None:
    parser = argparse.ArgumentParser(description="Print time saved at the best shaper's error.")
    parser.add_argument("--files", nargs="+", default=list(FILES), help="paths, or corpus names")
    parser.add_argument("--machines", nargs="+", default=list(MACHINES), help="names or .json")
    parser.add_argument("--method", default="fbf")
    parser.add_argument("--robust", default="auto")
    parser.add_argument("--shared", type=Path, help="default: $STILLPATH_SHARED or ../shared")
    parser.add_argument("--cache", type=Path, default=default_cache_dir() / "benchmarks")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    given = parser.parse_args()

    shared = shared_folder(given.shared)
    one_thread_each()
    options = Options(method=given.method, robust=given.robust)
    rows: list[Row] = []
    failures = 0
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="stillpath-budget-") as folder:
        files = [plain_copy(find_input(name, shared), Path(folder)) for name in given.files]
        tasks = [
            Task(file, machine, (), options, given.cache)
            for file in files
            for machine in given.machines
        ]
        print_head()
        with ProcessPoolExecutor(given.jobs, mp_context=get_context("spawn")) as pool:
            waiting = {pool.submit(judged, task): task for task in tasks}
            for done in as_completed(waiting):
                try:
                    rows.append(done.result())
                except Exception as error:
                    failures += 1
                    task = waiting[done]
                    print(f"{task.file.stem} {task.machine}: FAILED: {error!r}", flush=True)
                    continue
                print_row(rows[-1])
    met = print_means(rows) and not failures
    cpu_s, above = sum(row.cpu_s for row in rows), sum(row.missed for row in rows)
    print(
        f"{len(rows)} cases, {above} above the shaper's error or a limit, {failures} failed; "
        f"{cpu_s / 60:.1f} CPU min, {(time.monotonic() - began) / 60:.1f} min"
    )
    sys.exit(0 if met else 1)


def judged(task: Task) -> Row:
    """Judge one file on one machine."""
    machine = load_machine(task.machine)
    began = time.process_time()
    own = read_motion(task.file, machine)
    best = best_shaper(task, machine, own)
    shaped = Judge(machine, members=True)
    for shaped_section in Shaped.through(own, best.pulses):
        shaped.add(shaped_section)
    worst_um = _worst_um(shaped)
    with tempfile.TemporaryDirectory(prefix="stillpath-budget-") as folder:
        target = Path(folder) / "out.gcode"
        options = task.options.model_copy(update={"budget_um": worst_um})
        result = compensate_file(task.file, target, machine, options, cache_dir=task.cache)
        written = read_motion(target, machine)
    ours = Judge(machine, members=True)
    for part in Laid.sections(own, written):
        ours.add(part)
    assert result.budget is not None
    return Row(
        file=task.file.stem,
        machine=machine.name,
        shaper=best.label,
        shaper_rms=1e3 * shaped.contour.rms,
        shaper_worst=worst_um,
        ours_rms=1e3 * ours.contour.rms,
        ours_worst=_worst_um(ours),
        ours_max=1e3 * ours.contour.max,
        original_s=own.time_s,
        written_s=written.time_s,
        shaper_s=result.budget.shaper_time_s,
        factors=", ".join(f"{c.name} {c.acceleration_factor:.3g}" for c in result.budget.classes),
        put_back_percent=100.0 * result.put_back_extruding_share,
        classes_above=sum(_above(one, worst_um) for one in result.budget.classes),
        accel_share=result.peak_accel_mm_s2 / machine.command.accel_mm_s2,
        cpu_s=time.process_time() - began,
    )


def _above(one: BudgetClass, budget_um: float) -> bool:
    """Tell whether a class that was raised is above what it may have."""
    allowed_um = 2.0 * budget_um if one.name == "travel" else budget_um
    return one.acceleration_factor > 1.0 and one.contour_rms_um > allowed_um


class Laid(Timed):
    """A written file against the original's path, matched by the extruder's position.

    While it feeds, the extruder is where it was when the original was there. A segment of the
    written file may lie across the end of a line and the travel after it; it feeds less than the
    line did, and is not judged.
    """

    def __init__(self, original: Motion, written: Motion, first: int, last: int) -> None:
        theirs = _fed_rows(original.phases)
        # Start and end of every row that feeds; travel is a jump between two of them.
        places = np.stack([theirs.start_mm, theirs.end_mm], axis=1).reshape(-1, 4)
        self._e_mm = np.maximum.accumulate(places[:, 3])
        self._x, self._y = places[:, 0], places[:, 1]
        self._ratio = np.repeat(original.phases.direction[theirs.row, 3], 2)
        ours = _fed_rows(written.phases)
        if abs(ours.end_mm[-1, 3] - theirs.end_mm[-1, 3]) > _SAME_MM:
            raise ReadBackError(f"{ours.end_mm[-1, 3]} mm are fed, not {theirs.end_mm[-1, 3]} mm")
        reached = np.full(len(written.phases) + 1, self._e_mm[0])
        reached[ours.row + 1] = ours.end_mm[:, 3]
        self._reached = np.maximum.accumulate(reached)
        self._phases, self._first, self._last = written.phases, first, last
        self._begin_s = float(written.phases.t_s[first])
        self._end_s = written.phases.end_s
        self.samples = int(np.ceil((self._end_s[last - 1] - self._begin_s) / DT_S)) + 1

    @classmethod
    def sections(cls, original: Motion, written: Motion) -> Iterator[Laid]:
        """Cut at the jumps of the written file's position."""
        bounds = [0, *written.jumps().tolist(), len(written.phases)]
        for first, last in pairwise(bounds):
            yield cls(original, written, first, last)

    def path(self, first: int, last: int) -> tuple[Array, NDArray[np.bool_]]:
        position, row, feeds = self._sampled(first, last)
        now = np.where(feeds, np.maximum(position[3], self._reached[row]), self._reached[row])
        path = np.stack([np.interp(now, self._e_mm, one) for one in (self._x, self._y)])
        at = np.minimum(np.searchsorted(self._e_mm, now), len(self._e_mm) - 1)
        ratio = self._phases.direction[row, 3] / self._ratio[at]
        return path, feeds & (ratio > _LINE_SHARE)

    def command(self, first: int, last: int) -> Array:
        return self._sampled(first, last)[0][:2]

    def _sampled(self, first: int, last: int) -> tuple[Array, NDArray[np.int64], NDArray[np.bool_]]:
        t_s = self._begin_s + DT_S * np.arange(first, last, dtype=np.float64)
        a = max(int(np.searchsorted(self._phases.t_s, t_s[0], "right")) - 1, self._first)
        b = max(int(np.searchsorted(self._phases.t_s, t_s[-1], "right")), a + 1)
        b = min(b, self._last)
        position, row = sample_phases(rows_of(self._phases, slice(a, b)), t_s)
        row += a
        moving = t_s <= self._end_s[row]
        return position, row, moving & self._phases.prints[row]


@dataclass(frozen=True, slots=True)
class _Fed:
    """Rows that feed while X or Y moves: where each starts and ends, x y z e."""

    row: NDArray[np.int64]
    start_mm: Array
    end_mm: Array


def _fed_rows(phases: Phases) -> _Fed:
    length = 0.5 * (
        (phases.start_mm_s + phases.cruise_mm_s) * phases.accel_s
        + 2.0 * phases.cruise_mm_s * phases.cruise_s
        + (phases.cruise_mm_s + phases.end_mm_s) * phases.decel_s
    )
    row = np.flatnonzero(phases.prints)
    start = phases.start_mm[row]
    return _Fed(row, start, start + phases.direction[row] * length[row, None])


def _worst_um(judge: Judge) -> float:
    return 1e3 * max(tally.rms for tally in (judge.contour, *judge.members))


def print_head() -> None:
    print(
        "contour error in um, rms while extruding, nominal plant / worst plant of the set; time in"
    )
    print("s of the file, with the best shaper at its error, and written; factors of acceleration")
    print(
        f"{'file':26}{'machine':14}{'shaper':>13} {'ours':>13} {'max':>5} {'original':>9} "
        f"{'shaper':>8} {'written':>8} {'saved':>7} {'put':>6} {'above':>5} {'accel':>6} "
        f"{'CPU':>4}  factors"
    )


def print_row(r: Row) -> None:
    shaper_s = f"{r.shaper_s:8.1f}" if r.shaper_s is not None else f"{'never':>8}"
    print(
        f"{r.file[:25]:26}{r.machine[:13]:14}{r.shaper_rms:6.2f}/{r.shaper_worst:<6.2f} "
        f"{r.ours_rms:6.2f}/{r.ours_worst:<6.2f} {r.ours_max:5.0f} {r.original_s:9.1f} {shaper_s} "
        f"{r.written_s:8.1f} {100 * (1 - r.ratio):6.1f}% {r.put_back_percent:5.2f}% "
        f"{r.classes_above:5} {100 * r.accel_share:5.0f}% {r.cpu_s:4.0f}  "
        f"{'ABOVE  ' if r.missed else ''}{r.factors}",
        flush=True,
    )


def print_means(rows: list[Row]) -> bool:
    """Print the time saved and tell whether it is enough, at no larger error anywhere."""
    if not rows:
        return False

    def saved(some: list[Row]) -> float:
        return 1.0 - geometric_mean(row.ratio for row in some)

    for what in ("machine", "file"):
        for name in sorted({getattr(row, what) for row in rows}):
            some = [row for row in rows if getattr(row, what) == name]
            print(f"  {name:26} {100 * saved(some):5.1f} % less time")
    total = saved(rows)
    met = total >= SAVED and not any(row.missed for row in rows)
    print(
        f"geometric mean over {len(rows)} cases: {100 * total:.1f} % less time (at least "
        f"{100 * SAVED:.0f} % wanted): {'PASS' if met else 'MISS'}"
    )
    return met


if __name__ == "__main__":
    main()
