"""What must hold for any bytes: what one file may do to interpreter, planner and pipeline.

Nothing but a `GcodeError` may come out, and what comes out of the pipeline holds every line of the
file, with the machine in the same state at each of them. No piece is reverted for an error of ours.
"""

from __future__ import annotations

import re
import time
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from stillpath.gcode.dialect import Dialect
from stillpath.gcode.errors import GcodeError
from stillpath.gcode.interpreter import Interpreter
from stillpath.gcode.splitter import Splitter
from stillpath.gcode.types import Moves, Phases, ProgramBlock
from stillpath.models.machine import AxisTravel, Machine
from stillpath.pipeline.compensate import compensate_file
from stillpath.pipeline.options import Options
from stillpath.pipeline.result import Result
from stillpath.pipeline.verbatim import plan_verbatim
from tests.gcode.states import differences, has_code

__all__ = ["Outcome", "interpreted", "read_through", "roomy", "through_the_pipeline", "walk"]

_LONGEST_S, _LONGEST_PRINT_S = 300.0, 3.0 * 3600.0
"""Lines whose moves last longer, and those that make a print longer, are taken out before the
pipeline: every second of print costs."""

_REPEATED = re.compile(rb"SET_INPUT_SHAPER|M572|M593|M900", re.IGNORECASE)
_TICKS_MM_S = 0.02
"""By how much a speed may be below 0 where a firmware rounds times to its clock's ticks."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of one file."""

    text: bytes
    """The file without the lines that were refused."""
    refusals: list[GcodeError]
    written: bytes | None
    """None: refused as a whole."""
    put_back: int = 0
    cpu_s: float = 0.0
    """CPU time of reading it, and of the longest run: it runs again without each refused line."""


def roomy(machine: Machine, half_mm: float = 5000.0) -> Machine:
    """Return the machine with room for files of other printers."""
    travel = {axis: AxisTravel(min_mm=-half_mm, max_mm=half_mm) for axis in ("x", "y", "z")}
    return machine.model_copy(update={"travel": travel})


def walk(data: bytes, machine: Machine, folder: Path, method: str, cache: Path) -> Outcome:
    """Bring a damaged file through everything; what may not be is an AssertionError or worse."""
    began = time.process_time()
    read_through(data, machine)
    text, refusals = without_refused(data, machine)
    reading_s, runs_s = time.process_time() - began, [0.0]
    if text and not text.endswith(b"\n"):
        text += b"\n"  # the writer would add it before its footer
    # Ends of lines other than LF and CRLF are the interpreter's business alone.
    if b"\r" not in text.replace(b"\r\n", b"\n"):
        text = _tagged(text)
    written, put_back = None, 0
    for _ in range(8):
        began = time.process_time()
        try:
            written, result = through_the_pipeline(text, machine, folder, method, cache)
            put_back = len(result.put_back)
            for piece in result.put_back:
                assert "internal error" not in piece.reason, piece.reason
            break
        except GcodeError as error:
            refusals.append(error)
            if error.line is None:
                break
            text = _without(text, {error.line})
        finally:
            runs_s.append(time.process_time() - began)
    cpu_s = reading_s + max(runs_s)
    return Outcome(text, refusals, written, put_back, cpu_s)


def read_through(data: bytes, machine: Machine) -> GcodeError | None:
    """Interpret and plan a file as it is; return why it is refused."""
    blocks, error = interpreted(data, machine)
    splitter = Splitter(machine, compensate=False)
    try:
        for block in blocks:
            for verbatim in splitter.push(block):
                for part in plan_verbatim(verbatim, machine):
                    if isinstance(part, Phases):
                        check_phases(part)
    except GcodeError as caught:
        error = error or caught
    return error


def interpreted(
    data: bytes, machine: Machine, dialect: Dialect | None = None
) -> tuple[list[ProgramBlock], GcodeError | None]:
    """Interpret a file in blocks; return what was read, and why the rest is refused."""
    reader = Interpreter(machine, dialect=dialect)
    error = None
    blocks: list[ProgramBlock] = []
    try:
        for start in range(0, len(data), 4096):
            blocks += reader.push(data[start : start + 4096])
        blocks += reader.flush()
    except GcodeError as caught:
        error = caught
    if error is not None:
        assert error.line is not None
        assert 1 <= error.line <= data.count(b"\n") + 1
    text = b"".join(block.text for block in blocks)
    assert data.startswith(text) if error else text == data
    for block in blocks:
        moves, events = block.moves, block.events
        assert np.all(np.isfinite(moves.start_mm))
        assert np.all(np.isfinite(moves.end_mm))
        assert np.all(moves.speed_mm_s > 0.0)
        assert np.all(np.isfinite(moves.speed_mm_s))
        for table, ids in ((block.limits, "limits_id"), (block.modal, "modal_id")):
            for rows in (moves, events):
                column = getattr(rows, ids)
                assert np.all((column >= 0) & (column < len(table)))
        spans = {*zip(moves.byte_start.tolist(), moves.byte_end.tolist(), strict=True)}
        spans |= {*zip(events.byte_start.tolist(), events.byte_end.tolist(), strict=True)}
        assert sum(end - start for start, end in spans) == len(block.text)
    for limits in blocks[-1].limits if blocks else []:
        assert np.all(np.isfinite(limits.as_row()))
    return blocks, error


def check_phases(phases: Phases) -> None:
    """Durations and speeds are finite and not negative; time only grows."""
    for f in fields(phases):
        assert np.all(np.isfinite(getattr(phases, f.name))), f.name
    for name in ("accel_s", "cruise_s", "decel_s", "start_mm_s", "cruise_mm_s", "end_mm_s"):
        assert np.all(getattr(phases, name) >= (-_TICKS_MM_S if "mm_s" in name else 0.0)), name
    assert np.all(np.diff(phases.t_s) >= -1e-9)


def without_refused(data: bytes, machine: Machine) -> tuple[bytes, list[GcodeError]]:
    """Take out the lines that are refused, and those that take minutes, one after the other."""
    refusals: list[GcodeError] = []
    reader = Interpreter(machine, strict_bounds=True)
    good = bytearray()
    end, total_s = 0, 0.0
    while end < len(data):
        start, end = end, data.find(b"\n", end) + 1 or len(data)
        ended = data[start:end]
        before = reader.snapshot()
        try:
            blocks = reader.push(ended) + ([] if ended.endswith(b"\n") else reader.flush())
            times_s = np.concatenate(
                [[0.0], *(t for b in blocks for t in (_lasts_s(b.moves), b.events.dwell_s))]
            )
            slow = bool(np.max(times_s) > _LONGEST_S)
            slow = slow or total_s + float(np.sum(times_s)) > _LONGEST_PRINT_S
        except GcodeError as error:
            # Its frames would hold the reader that is given up here.
            error.__context__ = None
            refusals.append(error.with_traceback(None))
            slow = True
        if slow:
            reader = before
        else:
            good += ended
            total_s += float(np.sum(times_s))
    return bytes(good), refusals


def through_the_pipeline(
    text: bytes, machine: Machine, folder: Path, method: str, cache: Path
) -> tuple[bytes, Result]:
    """Compensate a file; check lines, states and that nothing else is left behind."""
    source, target = folder / "in.gcode", folder / "out.gcode"
    target.unlink(missing_ok=True)
    source.write_bytes(text)
    try:
        result = compensate_file(source, target, machine, Options(method=method), cache_dir=cache)
    except GcodeError:
        assert source.read_bytes() == text
        assert sorted(p.name for p in folder.iterdir()) == ["in.gcode"]
        raise
    assert source.read_bytes() == text
    assert sorted(p.name for p in folder.iterdir()) == ["in.gcode", "out.gcode"]
    written = target.read_bytes()
    if method == "none":
        assert written == text
    elif b"\r" not in text.replace(b"\r\n", b"\n"):
        problems = differences(text, written, machine)
        assert problems == [], problems[:5]
    return written, result


def _lasts_s(moves: Moves) -> np.ndarray:
    way = moves.end_mm - moves.start_mm
    length = np.sqrt(np.sum(way[:, :3] ** 2, axis=1))
    return np.asarray(np.where(length > 0.0, length, np.abs(way[:, 3])) / moves.speed_mm_s)


def _tagged(text: bytes) -> bytes:
    """Number the lines that hold code, so that they can be found again (`tests.gcode.states`)."""
    out = []
    for number, line in enumerate(text.split(b"\n"), 1):
        body = line.rstrip(b"\r")
        # What a file says about the shaper is said again later: such lines may be there twice.
        plain = has_code(body) and not _REPEATED.search(body)
        out.append(body + b" ;#%d" % number + line[len(body) :] if plain else line)
    return b"\n".join(out)


def _without(text: bytes, numbers: set[int]) -> bytes:
    lines = text.split(b"\n")
    return b"\n".join(line for number, line in enumerate(lines, 1) if number not in numbers)
