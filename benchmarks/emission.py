"""Does the firmware execute what was commanded? Written pieces against their command at 10 kHz.

Runs the pipeline itself and looks over its shoulder: whenever a piece was written and planned again
from its text, the executed motion is compared with the command u, linear between its 1 kHz samples.
Each stretch of X Y motion counts from its own start, since the rests between them take the time
that the firmware gives them. Pieces that the pipeline puts back afterwards are left out and
counted.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from inputs import find_input, plain_copy, shared_folder
from numpy.typing import NDArray
from quality import FILES, MACHINES
from readback import DT_S, read_motion

from stillpath.gcode.pieces import Piece
from stillpath.gcode.sampler import sample_phases
from stillpath.gcode.slicers.facts import SlicerFacts
from stillpath.gcode.types import Phases
from stillpath.models.machine import Machine
from stillpath.models.store import load_machine
from stillpath.pipeline.compensated_piece import CompensatedPiece
from stillpath.pipeline.files import default_cache_dir
from stillpath.pipeline.options import Options
from stillpath.pipeline.order import Order
from stillpath.pipeline.pipeline_run import PieceAttempt, PipelineRun
from stillpath.pipeline.result import Result

_BIN_UM, _BINS = 0.01, 40_000


@dataclass(slots=True)
class Spread:
    """Histogram of distances [um] with their maximum and its place."""

    counts: NDArray[np.int64] = field(default_factory=lambda: np.zeros(_BINS, np.int64))
    max: float = 0.0
    line: int = 0

    def add(self, gap_um: NDArray[np.float64], line: int) -> None:
        """Add the distances of a stretch that begins at a line of the original."""
        if len(gap_um) == 0:
            return
        bins = np.minimum(gap_um / _BIN_UM, _BINS - 1).astype(np.int64)
        self.counts += np.bincount(bins, minlength=_BINS)
        if gap_um.max() > self.max:
            self.max, self.line = float(gap_um.max()), line

    def within(self, limit_um: float) -> float:
        """Share of the samples that lie within a limit."""
        return float(self.counts[: round(limit_um / _BIN_UM)].sum() / max(self.counts.sum(), 1))

    def quantile(self, share: float) -> float:
        """Distance that the share of all samples does not exceed."""
        total = np.cumsum(self.counts)
        return float(_BIN_UM * (1 + np.searchsorted(total, share * total[-1])))


class Watched(PipelineRun):
    """The pipeline, with every verified piece measured."""

    def prepare(self) -> None:
        """Set the sums to nothing."""
        self.xy, self.xy_extruding, self.filament = Spread(), Spread(), Spread()
        self.along, self.across = Spread(), Spread()
        """What of the extruding motion's distance lies along the command and across it."""
        self.late_s = self.off_grid_s = self.end_mm = 0.0

    def _attempt(self, piece: Piece, paced: Piece) -> PieceAttempt:
        found = super()._attempt(piece, paced)
        self._watch(piece, found.made, found.executed)
        return found

    def _watch(self, piece: Piece, made: CompensatedPiece, executed: Phases) -> None:
        timeline, encoded = made.timeline, made.encoded
        origin_s = float(timeline.start_s[0])
        grid_s = timeline.dt_s * np.arange(made.command_mm.shape[1])
        for k, group in enumerate(timeline.groups):
            if group.rest:
                continue
            n = int((timeline.end_s[k] - timeline.start_s[k]) / DT_S)
            t_s = timeline.start_s[k] + DT_S * np.arange(n)
            wanted = np.stack([np.interp(t_s, grid_s, made.command_mm[i]) for i in (0, 1, 3)])
            shift_s = float(encoded.group_start_s[k] - timeline.start_s[k]) - origin_s
            actual = sample_phases(executed, t_s + shift_s)[0]
            apart = 1e3 * np.hypot(actual[0] - wanted[0], actual[1] - wanted[1])
            line = int(piece.moves.line[group.first])
            sample = np.minimum((t_s / timeline.dt_s).astype(np.int64), len(grid_s) - 1)
            self.xy.add(apart, line)
            prints = made.extruding[sample]
            self.xy_extruding.add(apart[prints], line)
            if n > 1:
                way = np.gradient(wanted[:2], axis=1)
                way /= np.maximum(np.hypot(*way), 1e-12)
                off = 1e3 * (actual[:2] - wanted[:2])
                self.along.add(np.abs(np.sum(off * way, axis=0))[prints], line)
                self.across.add(np.abs(off[0] * way[1] - off[1] * way[0])[prints], line)
            # Before the first sample of a stretch the command's E still belongs to the rest.
            own = t_s >= timeline.dt_s * np.ceil(timeline.start_s[k] / timeline.dt_s - 1e-6)
            self.filament.add(1e3 * np.abs(actual[3] - wanted[2])[own], line)
        taken_s = executed.duration_s
        stretch_s = float(timeline.end_s[-1] - timeline.start_s[-1])
        self.late_s += taken_s - (float(encoded.group_start_s[-1]) + stretch_s - origin_s)
        self.off_grid_s += taken_s - (float(timeline.end_s[-1]) - origin_s)
        gap_mm = float(np.max(np.abs(executed.end_mm[-1, :3] - piece.moves.end_mm[-1, :3])))
        self.end_mm = max(self.end_mm, gap_mm)


def watched(
    source: Path, target: Path, machine: Machine, tolerance_um: float, cache: Path
) -> tuple[Watched, Result]:
    """Compensate a file on the watched pipeline."""
    options = Options(tolerance_um=tolerance_um)
    with source.open("rb") as text, target.open("wb") as written:
        run = Watched(text, written, Order(machine, options, cache))
        run.prepare()
        return run, run.write(source.name, SlicerFacts())


def measure(source: Path, machine: Machine, tolerance_um: float, cache: Path) -> str:
    """Return a table row for one case."""
    with tempfile.TemporaryDirectory(prefix="stillpath-emission-") as folder:
        target = Path(folder) / "out.gcode"
        run, result = watched(source, target, machine, tolerance_um, cache)
        total_mm = read_motion(source, machine).end_mm[-1, 3]
        filament_mm = abs(read_motion(target, machine).end_mm[-1, 3] - total_mm)
    hours = result.compensated_s / 3600.0
    q, q_print = run.xy.quantile(0.999), run.xy_extruding.quantile(0.999)
    checks = {
        "99.9 %": q <= tolerance_um + 1,
        # At sudden starts the firmware, which keeps what the motors bear, is a little late.
        "max": run.xy.max <= tolerance_um + 20,
        "E": run.filament.max <= 3,
        # A stretch that begins or ends steeply is late by up to .25 ms.
        "time": abs(run.late_s) <= 10e-3 * hours,
        "E total": filament_mm <= 1e-4,
        "end": run.end_mm <= 1e-6,
        "put back": result.put_back_extruding_share <= 0.01,
    }
    bad = [name for name, good in checks.items() if not good]
    return (
        f"{source.stem[:25]:26}{machine.name[:13]:14}{tolerance_um:4g} "
        f"{q:6.2f} {run.xy.max:7.2f} {q_print:6.2f} {run.xy_extruding.max:7.2f} "
        f"{run.filament.max:6.2f} {1e3 * run.late_s / hours:+8.3f} "
        f"{1e3 * run.off_grid_s / hours:+8.2f} {filament_mm:9.1e} {run.end_mm:8.1e} "
        f"{len(result.put_back):3d}/{100 * result.put_back_extruding_share:.2f}%  "
        f"{'MISS ' + ', '.join(bad) if bad else 'PASS'}"
        f" (max at line {run.xy.line}; E at line {run.filament.line})"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description="Executed against commanded motion, 10 kHz.")
    parser.add_argument("files", nargs="*", default=list(FILES), help="paths, or corpus names")
    parser.add_argument("--machines", nargs="+", default=list(MACHINES), help="names or .json")
    parser.add_argument("--tolerance-um", nargs="+", type=float, default=[2.0, 5.0])
    parser.add_argument("--shared", type=Path, help="default: $STILLPATH_SHARED or ../shared")
    parser.add_argument("--cache", type=Path, default=default_cache_dir() / "benchmarks")
    given = parser.parse_args()
    shared = shared_folder(given.shared)
    print(
        "X Y in um, all motion | extruding: 99.9 % quantile and maximum; E: largest, um; end time"
    )
    print(
        "in ms per hour against the command, and against the first sampling grid (rests included)"
    )
    print(
        f"{'file':26}{'machine':14}{'tol':>4} {'99.9%':>6} {'max':>7} {'99.9%':>6} {'max':>7} "
        f"{'E':>6} {'time':>8} {'grid':>8} {'E total':>9} {'end mm':>8} put back"
    )
    with tempfile.TemporaryDirectory(prefix="stillpath-emission-") as folder:
        for name in given.files:
            source = plain_copy(find_input(name, shared), Path(folder))
            for machine in map(load_machine, given.machines):
                for tolerance_um in given.tolerance_um:
                    print(measure(source, machine, tolerance_um, given.cache), flush=True)


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    main()
