"""Write the commanded and simulated motion of the nozzle as a table of samples.

The pipeline is run again on the sliced file, up to the end of the requested window.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np

from stillpath.compensation.defaults import DT_S
from stillpath.gcode.errors import GcodeError
from stillpath.models.machine import Machine
from stillpath.pipeline.columns import TableWriter, csv_table, npz_table
from stillpath.pipeline.compensate import compensate_file
from stillpath.pipeline.live_printing import simulate_live
from stillpath.pipeline.measuring.tracing import Trace
from stillpath.pipeline.options import Options
from stillpath.pipeline.progress import ProgressCallback, within
from stillpath.pipeline.simulate import simulate_file

__all__ = ["TrajectoryFormat", "write_trajectories"]

TrajectoryFormat = Literal["csv", "npz"]

_ADVISED = 0.8
"""Share of the work after which a file is advised, and its motion can be read."""


def write_trajectories(
    source: Path,
    target: Path,
    machine: Machine,
    options: Options,
    *,
    format: TrajectoryFormat = "csv",  # noqa: A002 - what everybody calls it
    window_s: tuple[float, float | None] = (0.0, None),
    cache_dir: Path | None = None,
    progress: ProgressCallback | None = None,
) -> int:
    """Write the motion of a print, 1000 rows a second.

    Parameters
    ----------
    target : Path
        Written atomically. Columns: ``t_s``; ``x_mm y_mm z_mm``, the motion that the
        firmware makes of the sliced file; ``after_x_mm after_y_mm``, that of the written file;
        ``before_sim_x_mm``, ..., the nozzle according to the machine's model;
        ``before_contour_um``, ``after_contour_um``, its distance to the planned path; ``line`` and
        ``layer`` of the sliced file (-1: before the first layer); ``extruding``, 0 or 1.
    options : Options
        Options of the job. For an advised file, motion and lines are those of the written file, and
        there are no ``before`` columns.
    format : {"csv", "npz"}
        Text (some 110 bytes a row, lengths to 0.1 um), or NumPy arrays.
    window_s : (start, stop)
        On the time axis of reports: that of the written file, with standstills cut to 2 s. A stop
        of None, or infinity, is the end.
    cache_dir, progress
        As in `compensate_file`.

    Returns
    -------
    int
        Rows.

    Raises
    ------
    GcodeError
        Nothing lies in the window; otherwise as `compensate_file`, as are other errors.
    """
    start_s, stop_s = window_s
    _check_window(start_s, stop_s)
    names = ("after",) if options.method == "advise" else ("before", "after")
    with (
        _table(target, format, names) as table,
        tempfile.TemporaryDirectory(dir=target.parent, prefix=".stillpath-trajectories-") as folder,
    ):
        window = _Window(table, names, start_s, stop_s)
        written = Path(folder, "written.gcode")
        with contextlib.suppress(_Passed):
            _run(source, written, machine, options, window, cache_dir, progress)
        if window.rows == 0:
            raise GcodeError(
                f"nothing moves from {start_s:g} s on: the print ends at {window.end_s:.3f} s"
            )
        return window.rows


def _check_window(start_s: float, stop_s: float | None) -> None:
    if not 0.0 <= start_s < (np.inf if stop_s is None else stop_s):
        raise GcodeError(
            f"{start_s:g} s to {stop_s or 0.0:g} s is not a period of the print: it must start at "
            "0 s or later, and end after its start"
        )


def _run(
    source: Path,
    written: Path,
    machine: Machine,
    options: Options,
    window: _Window,
    cache_dir: Path | None,
    progress: ProgressCallback | None,
) -> None:
    """Run a job again; the motion of an advised file is read from the written one."""
    options = options.model_copy(update={"compare_live": False})
    how: dict[str, Any] = {"cache_dir": cache_dir, "trace": window.add}
    if options.method == "advise":
        first, then = within(progress, 0.0, _ADVISED), within(progress, _ADVISED, 1.0)
        compensate_file(source, written, machine, options, cache_dir=cache_dir, progress=first)
        simulate_file(written, machine, dialect=options.dialect, progress=then, **how)
    elif options.method == "live":
        how.update(plate=options.plate, dialect=options.dialect)
        simulate_live(source, machine, progress=progress, **how)
    else:
        compensate_file(source, written, machine, options, progress=progress, **how)


class _Window:
    """Writes the samples between two times; `end_s` is the end of the motion so far."""

    def __init__(
        self, table: TableWriter, names: tuple[str, ...], start_s: float, stop_s: float | None
    ) -> None:
        self._table, self._names = table, names
        self._first = round(np.ceil(start_s / DT_S - 1e-6))
        stop = np.inf if stop_s is None else np.ceil(stop_s / DT_S - 1e-6)
        self._stop = None if np.isinf(stop) else round(stop)
        self.rows = 0
        self.end_s = 0.0

    def add(self, trace: Trace) -> None:
        count = len(trace.line)
        if trace.first == 0:  # also when restarted with a piece reverted
            self._table.clear()
            self.rows = 0
        first = max(self._first - trace.first, 0)
        last = count if self._stop is None else min(self._stop - trace.first, count)
        self.end_s = (trace.first + count) * DT_S
        if first < last:
            part = slice(first, last)
            columns: dict[str, np.ndarray] = {
                "t_s": (trace.first + np.arange(first, last)) * DT_S,
                "x_mm": trace.path_mm[0, part],
                "y_mm": trace.path_mm[1, part],
                "z_mm": trace.z_mm[part],
            }
            if "after" in self._names:
                columns |= {
                    "after_x_mm": trace.executed_mm[0, part],
                    "after_y_mm": trace.executed_mm[1, part],
                }
            for c, name in enumerate(self._names):
                columns[f"{name}_sim_x_mm"] = trace.simulated_mm[c, 0, part]
                columns[f"{name}_sim_y_mm"] = trace.simulated_mm[c, 1, part]
            for c, name in enumerate(self._names):
                columns[f"{name}_contour_um"] = 1e3 * trace.error_mm[c, part]
            columns |= {"line": trace.line[part], "layer": trace.layer[part]}
            columns["extruding"] = trace.extruding[part].astype(np.uint8)
            self._table.write(columns)
            self.rows += last - first
        if self._stop is not None and trace.first + count >= self._stop:
            raise _Passed


class _Passed(Exception):
    """The requested window is complete."""


@contextlib.contextmanager
def _table(target: Path, form: str, names: tuple[str, ...]) -> Iterator[TableWriter]:
    lengths = ["x_mm", "y_mm", "z_mm"]
    if "after" in names:
        lengths += ["after_x_mm", "after_y_mm"]
    lengths += [f"{name}_sim_{axis}_mm" for name in names for axis in ("x", "y")]
    errors = [f"{name}_contour_um" for name in names]
    if form == "csv":
        formats = {"t_s": "%.3f"} | dict.fromkeys(lengths, "%.4f") | dict.fromkeys(errors, "%.2f")
        with csv_table(target, formats | dict.fromkeys(_NUMBERS, "%d")) as table:
            yield table
    else:
        types = dict.fromkeys(["t_s", *lengths, *errors], "<f8") | _NUMBERS
        with npz_table(target, types) as table:
            yield table


_NUMBERS = {"line": "<i8", "layer": "<i4", "extruding": "|u1"}
