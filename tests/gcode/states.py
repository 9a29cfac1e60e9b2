"""What the machine's state is at every line of a file, and how two files differ in it.

The strongest check of a written file: every line that came from the original must find the
machine as it was in the original: position, filament, modes, F and limits.
"""

from __future__ import annotations

import re
from codecs import BOM_UTF8
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stillpath.gcode.firmware.registry import adapter
from stillpath.gcode.interpreter import Interpreter
from stillpath.gcode.types import EventKind, Limits, ModalState
from stillpath.models.machine import Machine

__all__ = ["State", "differences", "states", "tagged"]

_TAG = re.compile(rb";#(\d+)\s*$")
_HELD = b"; stillpath, held back: "
_DUST_MM, _LAST_DIGIT_MM = 1e-9, 1e-5
"""Of E in a stream, which an absolute E given in inches may not hit."""
_XYZ = np.array([True, True, True, False])
_STILL = re.compile(rb"\s*(?:N\d+\s*)?G-?0*[0-35](?!\d).*[XYZEIJK]", re.IGNORECASE)
_TIMES = re.compile(
    rb"M73 |;TIME|;PRINT\.TIME|;Print Time|;PRINTING_TIME|;REMAINING_TIME|; estimated |; model "
    rb"|; (?:Calculated|Estimated)\S+ Build Time|; --- print time|;estimated_time|;file_total_lines"
    rb"|;   Build [Tt]ime"
)
_OWN = (b"; stillpath: ", b"; stillpath, held back: ", b"; Processed by stillpath ")
_DUSTY = ({-1, EventKind.MODE}, {-1, EventKind.UNKNOWN})
POSITION_MM = 2e-6
FILAMENT_MM = 1e-4


@dataclass(frozen=True, slots=True)
class State:
    """One line: `kind` -1 is a move; `modal`, `limits` are in force for a move, after an event."""

    text: bytes
    kind: int
    start_mm: np.ndarray
    end_mm: np.ndarray
    known: int
    speed_mm_s: float
    modal: ModalState
    limits: Limits
    stream: bool
    """Between our own 'stream on' and 'stream off'."""
    travels_xy: bool = False
    """Some piece of it moves X or Y: an arc may end where it began."""

    @property
    def moves_xy(self) -> bool:
        return bool(np.any(self.start_mm[:2] != self.end_mm[:2]))


def tagged(data: bytes) -> bytes:
    """Number every line that holds code, so that it can be found again."""
    out = []
    for number, line in enumerate(data.splitlines(keepends=True), 1):
        body = line.rstrip(b"\r\n")
        if has_code(body):
            line = body + b" ;#%d" % number + line[len(body) :]
        out.append(line)
    return b"".join(out)


def has_code(line: bytes) -> bool:
    text = line.strip()
    return bool(text) and not text.startswith(b";")


def timeless(line: bytes) -> bytes:
    """Hide the numbers of the lines that may tell another time: the documented ones."""
    code, mark, tag = line.partition(b" ;#")
    return re.sub(rb"(?:[\d.]+[dhms]? ?)+", b"?", code) + mark + tag if _TIMES.match(line) else line


def states(data: bytes, machine: Machine) -> list[State]:
    """Return one state per line of the file."""
    reader = Interpreter(machine)
    lines = data.splitlines(keepends=True)
    found: dict[int, State] = {}
    last, known = np.zeros(4), 0
    streams = _streams(lines)
    for block in [*reader.push(data), *reader.flush()]:
        moves, events = block.moves, block.events
        # Dust (see `_is_dust`) is a move in one file and none in the other: it tells nothing.
        is_move = np.max(np.abs(moves.end_mm - moves.start_mm), axis=1, initial=0.0) >= _DUST_MM
        latest = np.maximum.accumulate(np.where(is_move, np.arange(len(moves)), -1))
        # One of the extruder by itself (G10) does not say whether X and Y are known.
        tells = (moves.known != 0) | np.any(moves.start_mm != moves.end_mm, axis=1, where=_XYZ)
        told = np.maximum.accumulate(np.where(is_move & tells, np.arange(len(moves)), -1))
        for i in range(len(moves)):
            number = int(moves.line[i])
            first = found.get(number)
            found[number] = State(
                lines[number - 1],
                -1,
                moves.start_mm[i] if first is None else first.start_mm,
                moves.end_mm[i],
                int(moves.known[i]),
                float(moves.speed_mm_s[i]),
                block.modal[moves.modal_id[i]],
                block.limits[moves.limits_id[i]],
                streams[number - 1],
                bool(np.any(moves.start_mm[i, :2] != moves.end_mm[i, :2]))
                or (first is not None and first.travels_xy),
            )
        for i in range(len(events)):
            number, at = int(events.line[i]), int(events.move_index[i]) - block.first_move
            if len(moves) and at > 0 and latest[at - 1] >= 0:
                row = latest[at - 1]
                last = moves.end_mm[row]
                known = int(moves.known[told[at - 1]]) if told[at - 1] >= 0 else known
            found[number] = State(
                lines[number - 1],
                int(events.kind[i]),
                last,
                last,
                known,
                0.0,
                block.modal[events.modal_id[i]],
                block.limits[events.limits_id[i]],
                streams[number - 1],
            )
        if len(moves) and latest[-1] >= 0:
            last = moves.end_mm[latest[-1]]
            known = int(moves.known[told[-1]]) if told[-1] >= 0 else known
    assert sorted(found) == list(range(1, len(lines) + 1))
    return [found[k] for k in sorted(found)]


def differences(original: bytes, written: bytes, machine: Machine) -> list[str]:
    """Say where the written file treats a line of the (tagged) original differently.

    Both may begin with the same byte order mark, though not with the same line.
    """
    if original.startswith(BOM_UTF8):
        assert written.startswith(BOM_UTF8)
        original, written = (text.removeprefix(BOM_UTF8) for text in (original, written))
    before = {_tag(s.text): s for s in states(original, machine) if _tag(s.text) is not None}
    after = states(written, machine)
    comments = [s.text for s in after if not has_code(s.text) and not s.text.startswith(_OWN)]
    wanted = [s for s in original.splitlines(keepends=True) if not has_code(s)]
    comments, wanted = [timeless(s) for s in comments], [timeless(s) for s in wanted]
    problems = [] if comments == wanted else [_first_difference(wanted, comments)]
    # A firmware that counts steps has the same place within one.
    place_mm = POSITION_MM + np.array(adapter(machine).step_mm[:3])
    seen: list[int] = []
    for state in after:
        tag = _tag(state.text)
        if tag is None:
            continue
        seen.append(tag)
        found = _compare(before[tag], state, place_mm, adapter(machine).shortest_move_mm > 0.0)
        problems += [f"#{tag} {before[tag].text!r}: {p}" for p in found]
    if sorted(seen) != seen or len(set(seen)) != len(seen):
        problems.append("lines are out of order, or twice")
    present = set(seen)
    must = [t for t, s in before.items() if t is not None and not (s.kind < 0 and s.travels_xy)]
    problems += [f"#{t} {before[t].text!r} is missing" for t in must if t not in present]
    return problems


def _compare(old: State, new: State, place_mm: np.ndarray, swallows: bool) -> list[str]:
    if new.text.startswith(_HELD):
        # Limits would break the stream, a move of no length would go where the command is not.
        still = old.kind == EventKind.MODE and _STILL.match(old.text)
        if (old.kind == EventKind.LIMITS or still) and new.text == _HELD + old.text:
            return [] if new.stream else ["held back outside the stream"]
        return ["wrongly held back"]
    if timeless(new.text) != timeless(old.text):
        return [f"became {new.text!r}"]
    problems = []
    kinds = {new.kind, old.kind}
    # What a firmware swallows may be a move to it from where the stream stands, or none.
    dust_mm = float(place_mm[:2].max()) if swallows else _DUST_MM
    if kinds in _DUSTY and _is_dust(old, dust_mm) and _is_dust(new, dust_mm):
        return []
    if new.kind != old.kind:
        return [f"kind {new.kind}, not {old.kind}"]
    # After a move that is swallowed, a line comes before the move that makes up for it.
    if new.known != old.known and not (swallows and new.kind >= 0):
        problems.append(f"known {new.known}, not {old.known}")
    knows = np.array([bool(old.known >> k & 1) for k in range(3)])
    if new.kind < 0 or not new.stream:
        gap = np.abs(new.end_mm - old.end_mm)
        if np.any((gap[:3] > place_mm)[knows]) or gap[3] > FILAMENT_MM:
            problems.append(f"ends at {new.end_mm}, not {old.end_mm}")
    if new.kind < 0:
        gap = np.abs(new.start_mm - old.start_mm)
        if np.any((gap[:3] > place_mm)[knows]) or gap[3] > FILAMENT_MM:
            problems.append(f"starts at {new.start_mm}, not {old.start_mm}")
        if abs(new.speed_mm_s - old.speed_mm_s) > 1e-6 * old.speed_mm_s:
            problems.append(f"speed {new.speed_mm_s}, not {old.speed_mm_s}")
    if new.stream:
        if new.kind >= EventKind.STOP:
            problems.append("stops inside the stream")
        return problems
    problems += _differ("modal", old.modal, new.modal, 2e-5)
    # Pressure advance is set again before something is printed; until then it makes no difference.
    prints = new.kind < 0 and (old.moves_xy or old.travels_xy) and old.end_mm[3] > old.start_mm[3]
    hidden = () if prints else ("pressure_advance_s",)
    problems += _differ("limits", old.limits, new.limits, 1e-6, hidden)
    return problems


def _is_dust(state: State, dust_mm: float) -> bool:
    """Sums of relative E miss the absolute one by rounding errors, which are moves."""
    way_mm = np.abs(state.end_mm - state.start_mm)
    return bool(np.all(way_mm < [dust_mm, dust_mm, dust_mm, max(dust_mm, _LAST_DIGIT_MM)]))


def _differ(
    name: str,
    old: ModalState | Limits,
    new: ModalState | Limits,
    tolerance: float,
    hidden: Sequence[str] = (),
) -> list[str]:
    out = []
    for field in old.__dataclass_fields__:
        if field in hidden:
            continue
        a, b = np.atleast_1d(getattr(old, field)), np.atleast_1d(getattr(new, field))
        if not np.allclose(a.astype(float), b.astype(float), rtol=1e-9, atol=tolerance):
            out.append(f"{name}.{field} {getattr(new, field)}, not {getattr(old, field)}")
    return out


def _streams(lines: Sequence[bytes]) -> list[bool]:
    on, out = False, []
    for line in lines:
        if line.startswith(b"; stillpath: stream on"):
            on = True
        elif line.startswith(b"; stillpath: stream off"):
            on = False
        out.append(on)
    return out


def _tag(text: bytes) -> int | None:
    found = _TAG.search(text)
    return int(found[1]) if found else None


def _first_difference(wanted: list[bytes], got: list[bytes]) -> str:
    for k, (a, b) in enumerate(zip(wanted, got, strict=False)):
        if a != b:
            return f"comment {k} is {b!r}, not {a!r}"
    return f"{len(got)} comments, not {len(wanted)}"
