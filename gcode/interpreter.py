"""Interpret bytes as moves and events by the dialect of a firmware.

`Interpreter` takes a file in chunks of any size. The kernel (`_lex_kernels.run`) executes the plain
lines, and `gcode.handback` those that it hands back. Every byte of the file belongs to exactly one
line, and every line is one event, or one or more moves, or moves followed by the event that stops
the machine.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Iterator
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode import _slots as at
from stillpath.gcode._lex_kernels import PADDING, run
from stillpath.gcode.dialect import Dialect
from stillpath.gcode.errors import GcodeError
from stillpath.gcode.firmware.dialects import dialect_of
from stillpath.gcode.firmware.registry import adapter
from stillpath.gcode.handback import SPARE_ROWS, carry_out_line, refuse_or_skip
from stillpath.gcode.lexer import check_line_ends
from stillpath.gcode.state import EXTRUDER_MODE, MachineState
from stillpath.gcode.types import Events, Limits, ModalState, Moves, ProgramBlock
from stillpath.models.machine import Machine

__all__ = ["Interpreter"]

_MOVE = re.compile(rb"\s*G0*[0-3](?![\d.])", re.IGNORECASE)
_PAD = b"\n" * PADDING
_BLOCK_BYTES, _CHUNK = 1 << 17, 1 << 20
_LONGEST_LINE = 1 << 24
_FEWEST_ROWS, _MOST_ROWS = 1024, 32_768
_SHORT_LINE = 24  # bytes; rows are allocated for lines of about this length


class Interpreter:
    """Read G-code in pieces.

    Parameters
    ----------
    machine : Machine
        Its firmware facts and travel.
    strict_bounds : bool
        Refuse moves that leave the travel of an axis whose position is known.
    dialect : Dialect, optional
        How the file is read; None: as the machine's firmware does.

    Attributes
    ----------
    feature_names : list of str
        Names behind the `feature` column.

    Notes
    -----
    Moves that a line other than G0 to G3 and G5 makes (G10, G11, G61, RESTORE_GCODE_STATE MOVE=1,
    SET_GCODE_OFFSET MOVE=1) have no known axis: such a line does more than move, and must stay.
    All but G10 and G11 have the bit `OF_STATE`.
    """

    def __init__(
        self, machine: Machine, *, strict_bounds: bool = True, dialect: Dialect | None = None
    ) -> None:
        self.machine = machine
        dialect = dialect or dialect_of(machine.firmware)
        limits = adapter(machine).initial_limits()
        self.state = MachineState(machine, dialect, limits, strict=strict_bounds)
        if not dialect.extruder_mode_known:
            self.state.hold(EXTRUDER_MODE, True)
        self._modal: list[ModalState] = []
        self._limits: list[Limits] = []
        self._pending: list[bytes] = []
        self._pending_bytes = 0
        self._offset = 0
        self._first_move = 0
        self._text = b""

    @property
    def dialect(self) -> Dialect:
        """Rules and words in force; RepRapFirmware's modes change them."""
        return self.state.dialect

    @property
    def feature_names(self) -> list[str]:
        """Names behind the `feature` column."""
        return self.state.features.names

    @property
    def warnings(self) -> list[str]:
        """Commands that the firmware skips, or whose effect is unknown before the print."""
        return [f"line {line}: {text}" for text, line in self.state.warnings.items()]

    @property
    def macro_with_limits(self) -> tuple[str, int] | None:
        """Name and line of a macro whose limits may be meant: the file states no acceleration."""
        return None if self.state.states_acceleration else self.state.first_macro

    @property
    def position_mm(self) -> NDArray[np.float64]:
        """Where the firmware believes the tool is: x y z e, shape (4,)."""
        return self.state.f[at.F_LAST : at.F_LAST + 4].copy()

    @property
    def extruder_mm(self) -> float:
        """What the firmware takes for E: counted from the last G92, in the file's own measure."""
        f = self.state.f
        return float((f[at.F_LAST + 3] - f[at.F_BASE + 3]) / f[at.F_EXTRUDE_FACTOR])

    @property
    def known(self) -> int:
        """Bit 0..2 set: x, y, z are known."""
        return int(self.state.i[at.I_KNOWN])

    def push(self, data: bytes) -> list[ProgramBlock]:
        """Read the next bytes of the file; return the content of complete lines.

        Raises
        ------
        GcodeError
            For a line that the firmware would reject or that leaves the travel.
        """
        blocks: list[ProgramBlock] = []
        for first in range(0, len(data), _CHUNK):
            blocks += self._push(data[first : first + _CHUNK] if len(data) > _CHUNK else data)
        return blocks

    def flush(self) -> list[ProgramBlock]:
        """Interpret the rest as the last line; it may lack its newline."""
        text = b"".join((*self._pending, _PAD))
        self._pending, self._pending_bytes = [], 0
        if _MOVE.match(text):
            self.state.warn(
                "the file ends with a move and without a line end: it may have been cut off; "
                "compare its size, and copy or export it again"
            )
        return self._read(text) if len(text) > PADDING else []

    def blocks(self, file: BinaryIO) -> Iterator[ProgramBlock]:
        """Read a file from its present position to its end; errors are those of `push`."""
        while data := file.read(_BLOCK_BYTES):
            yield from self.push(data)
        yield from self.flush()

    def snapshot(self) -> Interpreter:
        """Return an independent interpreter that continues from here."""
        other = copy.copy(self)
        other.state = self.state.snapshot()
        for name in ("_modal", "_limits", "_pending"):
            setattr(other, name, getattr(self, name).copy())
        return other

    # Reading

    def _push(self, data: bytes) -> list[ProgramBlock]:
        first = data.find(b"\n") if self._pending_bytes else -1
        if self._pending_bytes + (len(data) if first < 0 else first) > _LONGEST_LINE + _CHUNK:
            raise GcodeError(
                f"the line has more than {_LONGEST_LINE} bytes; is this G-code?",
                line=int(self.state.i[at.I_LINE]),
            )
        cut = data.rfind(b"\n") + 1
        if cut == 0:
            self._pending.append(data)
            self._pending_bytes += len(data)
            return []
        text = b"".join((*self._pending, memoryview(data)[:cut], _PAD))
        self._pending = [data[cut:]] if cut < len(data) else []
        self._pending_bytes = len(data) - cut
        return self._read(text)

    def _read(self, text: bytes) -> list[ProgramBlock]:
        """Read whole lines; after them is the padding."""
        state, i = self.state, self.state.i
        stop = len(text) - PADDING
        check_line_ends(text, int(i[at.I_LINE]), self.dialect)
        self._text = text
        state.buffer = np.frombuffer(text, np.uint8)
        i[at.I_POS] = 0
        i[at.I_OFFSET] = self._offset
        blocks: list[ProgramBlock] = []
        begun = 0
        self._allocate(stop)
        while True:
            status = run(state.buffer, stop, state.f, i, state.w, state.rows, state.tables)
            if status == at.HANDBACK:
                status = carry_out_line(state)
            if status >= at.ERROR_INCHES:
                status = refuse_or_skip(state, status)
            if status == at.OK:
                i[at.I_POS] = i[at.I_END]
                i[at.I_LINE] += 1
            elif status == at.GROW:
                state.grow_tables()
            elif status == at.FULL and i[at.I_MOVES] == 0 and i[at.I_EVENTS] == 0:
                self._allocate(stop - begun, int(i[at.I_NEED]))
            else:
                if status != at.DONE:
                    state.settle()
                end = int(i[at.I_POS])
                blocks.append(self._block(begun, end))
                begun = end
                if status == at.DONE:
                    break
                self._allocate(stop - begun)
        self._offset += stop
        self._text = b""
        return blocks

    def _allocate(self, size: int, need: int = 0) -> None:
        rows = max(min(size // _SHORT_LINE, _MOST_ROWS), _FEWEST_ROWS, need) + SPARE_ROWS
        self.state.allocate(rows)

    def _block(self, begun: int, end: int) -> ProgramBlock:
        """Hand the rows over; they must be settled."""
        state, i = self.state, self.state.i
        n, m = int(i[at.I_MOVES]), int(i[at.I_EVENTS])
        self._note_tables()
        moves = state.rows.moves(n, apart=bool(i[at.I_APART]))
        events = state.rows.events(m)
        if 2 * (n + m) < state.rows.room:
            # A view of a few rows would keep the whole buffer alive.
            moves = {name: column.copy() for name, column in moves.items()}
            events = {name: column.copy() for name, column in events.items()}
        block = ProgramBlock(
            first_move=self._first_move,
            moves=Moves(**moves),
            events=Events(**events),
            limits=self._limits,
            modal=self._modal,
            text_offset=self._offset + begun,
            text=self._text[begun:end],
        )
        self._first_move += n
        if state.forget_rows():
            self._limits, self._modal = [], []
        return block

    def _note_tables(self) -> None:
        """Bring the public tables up to the kernel's."""
        i, tables = self.state.i, self.state.tables
        for row in tables.modal[len(self._modal) : int(i[at.I_N_MODAL])].tolist():
            absolute_xyz, absolute_e, speed, extrude, x, y, z = row
            self._modal.append(
                ModalState(bool(absolute_xyz), bool(absolute_e), speed, extrude, (x, y, z))
            )
        for row in tables.limits[len(self._limits) : int(i[at.I_N_LIMITS])].tolist():
            self._limits.append(self.state.limits_type.from_row(row))
