"""From bytes to moves and events, as Klipper reads them.

`Interpreter` takes a file in pieces of any size. The kernel (`_lex_kernels.run`) carries out the
plain lines; lines it hands back are carried out here and it goes on behind them. Every byte of
the file belongs to exactly one line, and every line is either one event or one or more moves.

Rules: klippy/gcode.py, klippy/extras/gcode_move.py, gcode_arcs.py, firmware_retraction.py,
exclude_object.py, klippy/toolhead.py, 2026-08.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from gcode import _lex_kernels as lex
from gcode.errors import GcodeError
from gcode.firmware.klipper.dialect import KERNEL_WORDS, classify, word_table
from gcode.lexer import extended_parameters, split_line
from gcode.markers import MarkKind, read_mark
from gcode.types import KEPT, EventKind, Events, Limits, ModalState, Moves, ProgramBlock
from models.machine import Machine

__all__ = ["Interpreter", "interpret_bytes"]

_ROWS = 32_768
_BOM = b"\xef\xbb\xbf"
_DEFAULT_SPEED_MM_S = 25.0
_MARK_SLOTS = 4096
_LONGEST_COMMAND = 65_536

# Words whose numbers a command needs; Klipper does not look at the others.
_NEEDED = {
    "G0": "XYZEF",
    "G1": "XYZEF",
    "G2": "XYZEFRIJK",
    "G3": "XYZEFRIJK",
    "G4": "P",
    "G92": "XYZE",
    "M204": "SPT",
    "M220": "S",
    "M221": "S",
}


_WORK_SPACE = frozenset({"_mf", "_mi", "_ei", "_ef", "_g_table", "_m_table"})


class Interpreter:
    """Read G-code in pieces.

    Parameters
    ----------
    machine : Machine
        Its firmware facts and travel.
    strict_bounds : bool
        Refuse moves that leave the travel of an axis whose position is known.

    Attributes
    ----------
    feature_names, object_names : list of str
        Names behind the `feature` and `object_id` columns.
    layer_z_mm : list of float
        Height of each layer as the slicer's marks say; NaN where they do not.

    Notes
    -----
    Moves that a line other than G0 to G3 makes (G10, G11, RESTORE_GCODE_STATE MOVE=1,
    SET_GCODE_OFFSET MOVE=1) have no known axis: such a line does more than move, and must stay.
    """

    def __init__(self, machine: Machine, *, strict_bounds: bool = True) -> None:
        self.machine = machine
        self.firmware = firmware = machine.firmware
        self._features = _Names()
        self._objects = _Names()
        self.feature_names = self._features.names
        self.object_names = self._objects.names
        self.layer_z_mm: list[float] = []
        self._modal: list[ModalState] = []
        self._limits: list[Limits] = []
        self._saved: dict[str, tuple[NDArray[np.float64], NDArray[np.int64]]] = {}
        self._retraction = firmware.retraction
        self._retracted = False
        self._carry: list[bytes] = []
        self._offset = 0
        self._first_move = 0
        self._layer_style: str | None = None

        self._f = f = np.zeros(lex.F_SIZE)
        self._i = i = np.zeros(lex.I_SIZE, np.int64)
        self._w = np.zeros(26)
        self._buffer = np.zeros(0, np.uint8)
        self._text = b""
        self._allocate(_ROWS)
        self._mod_rows, self._mod_index = _new_table(lex.MODAL_SIZE, 256)
        self._lim_rows, self._lim_index = _new_table(4, 256)
        self._mark_keys = np.zeros(_MARK_SLOTS, np.int64)
        self._mark_values = np.zeros(_MARK_SLOTS, np.int64)
        self._marks = 0
        self._g_table = word_table("G", firmware)
        self._m_table = word_table("M", firmware)

        planner = firmware.planner
        f[lex.F_SPEED] = _DEFAULT_SPEED_MM_S
        f[lex.F_SPEED_FACTOR] = 1.0 / 60.0
        f[lex.F_EXTRUDE_FACTOR] = 1.0
        f[lex.F_ARC_MM] = firmware.arc_resolution_mm
        f[lex.F_LIMITS : lex.F_LIMITS + 4] = (
            planner.max_velocity_mm_s,
            planner.max_accel_mm_s2,
            planner.square_corner_velocity_mm_s,
            planner.minimum_cruise_ratio,
        )
        for k, axis in enumerate("xyz"):
            f[lex.F_LOW + k] = machine.travel[axis].min_mm  # type: ignore[index]
            f[lex.F_HIGH + k] = machine.travel[axis].max_mm  # type: ignore[index]
        i[lex.I_LINE] = 1
        i[lex.I_ABS_XYZ] = i[lex.I_ABS_E] = 1
        i[lex.I_STRICT] = int(strict_bounds)
        i[lex.I_ORIGIN_KNOWN] = 0b111
        i[lex.I_LAYER] = i[lex.I_FEATURE] = i[lex.I_OBJECT] = -1
        if firmware.homed_at_start:
            self._home(0b111, firmware.home_mm or (0.0, 0.0, 0.0))
        self._note_modal()
        self._note_limits()

    def push(self, data: bytes) -> list[ProgramBlock]:
        """Take the next bytes of the file; return what its whole lines say.

        Raises
        ------
        GcodeError
            For a line that the firmware would reject or that leaves the travel.
        """
        cut = data.rfind(b"\n") + 1
        if cut == 0:
            if data:
                self._carry.append(data)
            return []
        text = b"".join((*self._carry, data[:cut]))
        self._carry = [data[cut:]] if cut < len(data) else []
        return self._read(text)

    def flush(self) -> list[ProgramBlock]:
        """Take what is left as the last line; it may lack its newline."""
        text = b"".join(self._carry)
        self._carry = []
        return self._read(text) if text else []

    @property
    def position_mm(self) -> NDArray[np.float64]:
        """Where the firmware believes the tool is: x y z e, shape (4,)."""
        return self._f[lex.F_LAST : lex.F_LAST + 4].copy()

    @property
    def known(self) -> int:
        """Bit 0..2 set: x, y, z are known."""
        return int(self._i[lex.I_KNOWN])

    # Reading

    def _read(self, text: bytes) -> list[ProgramBlock]:
        i = self._i
        self._text = text
        self._buffer = np.frombuffer(text, np.uint8)
        i[lex.I_POS] = 0
        i[lex.I_OFFSET] = self._offset
        blocks: list[ProgramBlock] = []
        begun = 0
        while True:
            status = lex.run(
                self._buffer,
                len(text),
                self._f,
                i,
                self._w,
                self._mf,
                self._mi,
                self._ei,
                self._ef,
                self._lim_rows,
                self._lim_index,
                self._mod_rows,
                self._mod_index,
                self._mark_keys,
                self._mark_values,
                self._g_table,
                self._m_table,
            )
            if status == lex.HANDBACK:
                status = self._carry_out()
                if status == lex.OK:
                    i[lex.I_POS] = i[lex.I_END]
                    i[lex.I_LINE] += 1
                    continue
            if status == lex.GROW:
                self._grow_tables()
            elif status == lex.FULL and i[lex.I_MOVES] == 0 and i[lex.I_EVENTS] == 0:
                self._allocate(int(i[lex.I_NEED]) + 1)
            elif status in (lex.FULL, lex.DONE):
                end = int(i[lex.I_POS])
                blocks.append(self._block(begun, end))
                begun = end
                if status == lex.DONE:
                    break
            else:
                raise self._error(status)
        self._offset += len(text)
        self._text = b""
        return blocks

    def snapshot(self) -> Interpreter:
        """Return an interpreter that goes on from here, whatever this one reads next."""
        other = copy.copy(self)
        # Work space is empty between calls and may be shared; all that is state is copied.
        for name, value in vars(self).items():
            if name in _WORK_SPACE:
                continue
            if isinstance(value, np.ndarray | list | dict):
                setattr(other, name, value.copy())
            elif isinstance(value, _Names):
                setattr(other, name, copy.deepcopy(value))
        other.feature_names = other._features.names
        other.object_names = other._objects.names
        return other

    def _block(self, begun: int, end: int) -> ProgramBlock:
        """Copy the rows out and empty them."""
        i = self._i
        n, m = int(i[lex.I_MOVES]), int(i[lex.I_EVENTS])
        mf, mi, ei = self._mf[:n], self._mi[:n], self._ei[:m]
        while len(self.layer_z_mm) <= i[lex.I_LAYER]:
            self.layer_z_mm.append(math.nan)
        self._note_tables()
        moves = Moves(
            start_mm=mf[:, 0:4].copy(),
            end_mm=mf[:, 4:8].copy(),
            speed_mm_s=mf[:, 8].copy(),
            limits_id=mi[:, lex.M_LIMITS].astype(np.int32),
            modal_id=mi[:, lex.M_MODAL].astype(np.int32),
            known=mi[:, lex.M_KNOWN].astype(np.uint8),
            line=mi[:, lex.M_LINE].copy(),
            byte_start=mi[:, lex.M_START].copy(),
            byte_end=mi[:, lex.M_STOP].copy(),
            layer=mi[:, lex.M_LAYER].astype(np.int32),
            feature=mi[:, lex.M_FEATURE].astype(np.int32),
            object_id=mi[:, lex.M_OBJECT].astype(np.int32),
        )
        events = Events(
            kind=ei[:, lex.E_KIND].astype(np.int8),
            move_index=ei[:, lex.E_MOVE].copy(),
            modal_id=ei[:, lex.E_MODAL].astype(np.int32),
            limits_id=ei[:, lex.E_LIMITS].astype(np.int32),
            dwell_s=self._ef[:m].copy(),
            line=ei[:, lex.E_LINE].copy(),
            byte_start=ei[:, lex.E_START].copy(),
            byte_end=ei[:, lex.E_STOP].copy(),
        )
        block = ProgramBlock(
            first_move=self._first_move,
            moves=moves,
            events=events,
            limits=self._limits,
            modal=self._modal,
            text_offset=self._offset + begun,
            text=self._text[begun:end],
        )
        self._first_move += n
        i[lex.I_MOVES] = i[lex.I_EVENTS] = 0
        if len(self._mf) > _ROWS:
            self._allocate(_ROWS)
        return block

    # Lines that the kernel hands back

    def _carry_out(self) -> int:
        """Carry out the line in hand; return a kernel status."""
        i = self._i
        raw = self._text[int(i[lex.I_POS]) : int(i[lex.I_END])]
        if i[lex.I_LINE] == 1 and raw.startswith(_BOM):
            raw = raw[len(_BOM) :]
        text = raw.decode("utf-8", "replace")
        if len(text) > _LONGEST_COMMAND and len(text.split(";", 1)[0]) > _LONGEST_COMMAND:
            raise self._problem(
                f"the command has more than {_LONGEST_COMMAND} characters; is this G-code?", text
            )
        name = split_line(text).name
        if not name:
            return self._comment(raw, text)
        if name in KERNEL_WORDS and (self.firmware.arcs or name not in ("G2", "G3")):
            return self._classic(name, text)
        handler = _HANDLERS.get(name)
        if handler is None or (name in ("G10", "G11") and self._retraction is None):
            kind = classify(name, self.firmware)
            if kind == EventKind.UNKNOWN:
                i[lex.I_KNOWN] = 0
            return self._event(kind)
        return handler(self, name, text)

    def _classic(self, name: str, text: str) -> int:
        """Do with Python's number reader what the kernel does with its own."""
        mask = 0
        words = split_line(text).words
        for word in words:
            if word[1:] in ("NAN", "INF", "INFINITY") and word[0] in _NEEDED.get(name, ""):
                # Klipper would skip such a word; whoever wrote it meant a coordinate.
                raise GcodeError(
                    f"{word[0]} is {word[1:]}, not a number; write a decimal number",
                    line=int(self._i[lex.I_LINE]),
                    text=text,
                )
        for letter in _NEEDED.get(name, ""):
            if letter in words:
                value = self._number(words[letter], letter, text)
                self._w[ord(letter) - 65] = value
                mask |= 1 << (ord(letter) - 65)
        return self._execute(KERNEL_WORDS[name], mask)

    def _execute(self, action: int, mask: int) -> int:
        return lex.execute(
            action,
            self._w,
            mask,
            self._f,
            self._i,
            self._mf,
            self._mi,
            self._ei,
            self._ef,
            self._lim_rows,
            self._lim_index,
            self._mod_rows,
            self._mod_index,
        )

    def _comment(self, raw: bytes, text: str) -> int:
        """Take note of a slicer's mark, and remember it for the kernel."""
        i = self._i
        at = text.find(";")
        mark = read_mark(text[at:]) if at >= 0 else None
        value = 0
        if mark is not None and mark.kind == MarkKind.STAMP:
            return self._event(EventKind.STAMP)
        if mark is not None and mark.kind in (MarkKind.OFF, MarkKind.ON):
            i[lex.I_KEPT] = KEPT if mark.kind == MarkKind.OFF else 0
            return self._event(EventKind.HARMLESS)
        if mark is not None and mark.kind == MarkKind.LAYER:
            style = text[at : at + 7]
            self._layer_style = self._layer_style or style
            if style == self._layer_style and not self._same_height(mark.text):
                i[lex.I_LAYER] += 1
                self._note_height(mark.text)
                value = lex.MARK_LAYER * lex.MARK_STRIDE
            if mark.text:
                return self._event(EventKind.HARMLESS)
        elif mark is not None and mark.kind == MarkKind.HEIGHT:
            self._note_height(mark.text)
            return self._event(EventKind.HARMLESS)
        elif mark is not None and mark.kind == MarkKind.FEATURE:
            number = self._features.number(mark.text)
            i[lex.I_FEATURE] = number
            value = lex.MARK_FEATURE * lex.MARK_STRIDE + number + 1
        elif mark is not None and mark.kind == MarkKind.OBJECT:
            number = self._objects.number(mark.text)
            i[lex.I_OBJECT] = number
            value = lex.MARK_OBJECT * lex.MARK_STRIDE + number + 1
        pos, end = int(i[lex.I_POS]), int(i[lex.I_END])
        semicolon = raw.find(b";")
        if semicolon >= 0 and self._marks < _MARK_SLOTS // 2:
            start = pos + self._text[pos:end].find(b";")
            stop = end - 1 if self._text[end - 1 : end] == b"\n" else end
            key = lex.mark_hash(self._buffer, start, stop)
            slot = lex.mark_slot(self._mark_keys, key)
            if self._mark_keys[slot] == 0:
                self._mark_keys[slot] = key
                self._mark_values[slot] = value
                self._marks += 1
        return self._event(EventKind.HARMLESS)

    def _same_height(self, text: str) -> bool:
        """Tell whether a layer mark that names its height is the next object's of that layer."""
        try:
            return bool(text and self.layer_z_mm and self.layer_z_mm[-1] == float(text))
        except ValueError:
            return False

    def _note_height(self, text: str) -> None:
        while len(self.layer_z_mm) <= self._i[lex.I_LAYER]:
            self.layer_z_mm.append(math.nan)
        try:
            if self.layer_z_mm and text:
                self.layer_z_mm[-1] = float(text)
        except ValueError:
            pass

    def _velocity_limit(self, name: str, text: str) -> int:
        given = self._extended(name, text)
        f = self._f
        for k, key in enumerate(
            ("VELOCITY", "ACCEL", "SQUARE_CORNER_VELOCITY", "MINIMUM_CRUISE_RATIO")
        ):
            if key not in given:
                continue
            value = self._number(given[key], key, text)
            low = "above 0" if k < 2 else "at least 0" if k == 2 else "at least 0 and below 1"
            if (
                value < 0
                or (k < 2 and value == 0)
                or (k == 3 and value >= 1)
                or value > lex.MAX_VALUE
            ):
                raise self._problem(f"{key}={given[key]} must be {low}", text)
            f[lex.F_LIMITS + k] = value
        self._note_limits()
        return self._event(EventKind.LIMITS)

    def _retract(self, name: str, _text: str) -> int:
        """G10 and G11: an E move of its own speed that the absolute E does not see."""
        facts = self._retraction
        assert facts is not None
        if (name == "G10") == self._retracted:
            return self._event(EventKind.MODE)
        if name == "G10":
            length, speed = -facts.retract_length_mm, facts.retract_speed_mm_s
        else:
            length = facts.retract_length_mm + facts.unretract_extra_length_mm
            speed = facts.unretract_speed_mm_s
        f = self._f
        length = round(length, 5)
        speed_before = f[lex.F_SPEED]
        e_before = f[lex.F_LAST + 3]
        f[lex.F_SPEED] = max(1, int(speed * 60)) * f[lex.F_SPEED_FACTOR]
        f[lex.F_LAST + 3] += length * f[lex.F_EXTRUDE_FACTOR]
        status = self._travel(0)
        f[lex.F_SPEED] = speed_before
        f[lex.F_BASE + 3] += f[lex.F_LAST + 3] - e_before
        self._retracted = name == "G10"
        return self._event(EventKind.MODE) if status == lex.DONE else status

    def _set_retraction(self, name: str, text: str) -> int:
        facts = self._retraction
        if facts is None:
            return self._event(classify(name, self.firmware))
        given = self._extended(name, text)
        changed = {}
        for key in ("RETRACT_LENGTH", "UNRETRACT_EXTRA_LENGTH"):
            if key in given:
                changed[f"{key.lower()}_mm"] = self._at_least(given[key], key, 0.0, text)
        for key in ("RETRACT_SPEED", "UNRETRACT_SPEED"):
            if key in given:
                changed[f"{key.lower()}_mm_s"] = self._at_least(given[key], key, 1.0, text)
        self._retraction = facts.model_copy(update=changed)
        self._retracted = False
        return self._event(EventKind.MODE)

    def _gcode_offset(self, name: str, text: str) -> int:
        given = self._extended(name, text)
        f = self._f
        delta = np.zeros(4)
        for k, axis in enumerate("XYZE"):
            if axis in given:
                offset = self._number(given[axis], axis, text)
            elif f"{axis}_ADJUST" in given:
                offset = self._number(given[f"{axis}_ADJUST"], f"{axis}_ADJUST", text)
                offset += f[lex.F_HOMING + k]
            else:
                continue
            delta[k] = offset - f[lex.F_HOMING + k]
            f[lex.F_BASE + k] += delta[k]
            f[lex.F_HOMING + k] = offset
        self._note_modal()
        if not self._flag(given, text):
            return self._event(EventKind.MODE)
        f[lex.F_LAST : lex.F_LAST + 4] += delta
        return self._travel_at(given, 0, text)

    def _save_state(self, name: str, text: str) -> int:
        key = self._extended(name, text).get("NAME", "default")
        self._saved[key] = (self._f.copy(), self._i.copy())
        return self._event(EventKind.MODE)

    def _restore_state(self, name: str, text: str) -> int:
        given = self._extended(name, text)
        key = given.get("NAME", "default")
        if key not in self._saved:
            raise self._problem(f"no state {key!r} was saved; SAVE_GCODE_STATE it first", text)
        saved, saved_flags = self._saved[key]
        f, i = self._f, self._i
        for slot in (lex.I_ABS_XYZ, lex.I_ABS_E, lex.I_ORIGIN_KNOWN):
            i[slot] = saved_flags[slot]
        for first, count in (
            (lex.F_BASE, 4),
            (lex.F_HOMING, 4),
            (lex.F_SPEED, 4),  # speed, its factor, extrude factor, F
        ):
            f[first : first + count] = saved[first : first + count]
        f[lex.F_BASE + 3] += f[lex.F_LAST + 3] - saved[lex.F_LAST + 3]
        self._note_modal()
        if not self._flag(given, text):
            return self._event(EventKind.MODE)
        f[lex.F_LAST : lex.F_LAST + 3] = saved[lex.F_LAST : lex.F_LAST + 3]
        return self._travel_at(given, 0, text)

    def _home_command(self, _name: str, text: str) -> int:
        words = split_line(text).words
        axes = sum(1 << k for k, axis in enumerate("XYZ") if axis in words) or 0b111
        self._home(axes, self.firmware.home_mm)
        return self._event(EventKind.UNKNOWN)

    def _home(self, axes: int, home: tuple[float, float, float] | None) -> None:
        """Give the axes their G-code origin back and, if the machine says it, their place."""
        f, i = self._f, self._i
        f[lex.F_LAST : lex.F_LAST + 4] = f[lex.F_TOOL : lex.F_TOOL + 4]
        for k in range(3):
            if axes >> k & 1:
                f[lex.F_BASE + k] = f[lex.F_HOMING + k]
                if home is not None:
                    f[lex.F_LAST + k] = f[lex.F_TOOL + k] = home[k]
        i[lex.I_ORIGIN_KNOWN] |= axes
        # Homing an axis may move the others too (safe_z_home).
        i[lex.I_KNOWN] = 0 if home is None else i[lex.I_KNOWN] | axes
        self._note_modal()

    def _object(self, name: str, text: str) -> int:
        i = self._i
        if name == "EXCLUDE_OBJECT_START":
            given = self._extended(name, text)
            i[lex.I_OBJECT] = self._objects.number(given.get("NAME", "").upper())
        elif name == "EXCLUDE_OBJECT_END":
            i[lex.I_OBJECT] = -1
        else:  # M486: S opens an object, S-1 closes it, A names it
            words = split_line(text).words
            if "S" in words:
                number = words["S"]
                closing = number.startswith("-") or not number
                i[lex.I_OBJECT] = -1 if closing else self._objects.number(number)
        return self._event(EventKind.OBJECT)

    # Helpers of the handlers

    def _event(self, kind: EventKind, dwell_s: float = 0.0) -> int:
        lex.put_event(self._i, self._ei, self._ef, int(kind), dwell_s)
        return lex.OK

    def _travel(self, named: int) -> int:
        return lex.travel(self._f, self._i, self._mf, self._mi, named, False)

    def _travel_at(self, given: Mapping[str, str], named: int, text: str) -> int:
        """MOVE=1: go to F_LAST at MOVE_SPEED."""
        f = self._f
        speed_before = f[lex.F_SPEED]
        if "MOVE_SPEED" in given:
            speed = self._number(given["MOVE_SPEED"], "MOVE_SPEED", text)
            if speed <= 0:
                raise self._problem(f"MOVE_SPEED={given['MOVE_SPEED']} must be above 0", text)
            f[lex.F_SPEED] = speed
        status = self._travel(named)
        f[lex.F_SPEED] = speed_before
        return self._event(EventKind.MODE) if status == lex.DONE else status

    def _extended(self, name: str, text: str) -> Mapping[str, str]:
        return extended_parameters(text, name, line=int(self._i[lex.I_LINE]))

    def _flag(self, given: Mapping[str, str], text: str) -> bool:
        try:
            return bool(int(given.get("MOVE", "0")))
        except ValueError:
            raise self._problem(f"MOVE={given['MOVE']} must be 0 or 1", text) from None

    def _number(self, value: str, key: str, text: str) -> float:
        try:
            number = float(value)
        except ValueError:
            raise self._problem(f"{key}{value!r} is not a number; correct it", text) from None
        if not abs(number) <= lex.MAX_VALUE:
            raise self._problem(f"{key} {value} is out of range; correct it", text)
        return number

    def _at_least(self, value: str, key: str, low: float, text: str) -> float:
        number = self._number(value, key, text)
        if number < low:
            raise self._problem(f"{key}={value} must be at least {low:g}", text)
        return number

    def _problem(self, message: str, text: str) -> GcodeError:
        return GcodeError(message, line=int(self._i[lex.I_LINE]), text=text)

    def _error(self, status: int) -> GcodeError:
        i, f = self._i, self._f
        raw = self._text[int(i[lex.I_POS]) : int(i[lex.I_END])]
        value, limit = float(f[lex.F_ERROR]), float(f[lex.F_ERROR + 1])
        axis = "XYZE"[int(i[lex.I_ERROR_AXIS])]
        message = _MESSAGES[status].format(axis=axis, value=value, limit=limit)
        return self._problem(message, raw.decode("utf-8", "replace"))

    # Tables

    def _allocate(self, rows: int) -> None:
        rows = max(rows, _ROWS)
        self._mf = np.empty((rows, 9))
        self._mi = np.empty((rows, 9), np.int64)
        self._ei = np.empty((rows, 7), np.int64)
        self._ef = np.empty(rows)

    def _note_modal(self) -> None:
        lex.note_modal(self._f, self._i, self._mod_rows, self._mod_index)

    def _note_limits(self) -> None:
        lex.note_limits(self._f, self._i, self._lim_rows, self._lim_index)

    def _note_tables(self) -> None:
        """Bring the public tables up to the kernel's."""
        for row in self._mod_rows[len(self._modal) : int(self._i[lex.I_N_MODAL])].tolist():
            absolute_xyz, absolute_e, speed, extrude, x, y, z = row
            self._modal.append(
                ModalState(bool(absolute_xyz), bool(absolute_e), speed, extrude, (x, y, z))
            )
        for row in self._lim_rows[len(self._limits) : int(self._i[lex.I_N_LIMITS])].tolist():
            self._limits.append(Limits(*row))

    def _grow_tables(self) -> None:
        i = self._i
        if i[lex.I_N_MODAL] + 2 > len(self._mod_rows):
            self._mod_rows, self._mod_index = _grown(self._mod_rows, int(i[lex.I_N_MODAL]))
        if i[lex.I_N_LIMITS] + 2 > len(self._lim_rows):
            self._lim_rows, self._lim_index = _grown(self._lim_rows, int(i[lex.I_N_LIMITS]))


def interpret_bytes(
    data: bytes, machine: Machine, *, strict_bounds: bool = True
) -> list[ProgramBlock]:
    """Interpret a whole file.

    Raises
    ------
    GcodeError
        For a line that the firmware would reject or that leaves the travel.
    """
    interpreter = Interpreter(machine, strict_bounds=strict_bounds)
    return [*interpreter.push(data), *interpreter.flush()]


_HANDLERS = {
    "SET_VELOCITY_LIMIT": Interpreter._velocity_limit,
    "SET_GCODE_OFFSET": Interpreter._gcode_offset,
    "SAVE_GCODE_STATE": Interpreter._save_state,
    "RESTORE_GCODE_STATE": Interpreter._restore_state,
    "SET_RETRACTION": Interpreter._set_retraction,
    "EXCLUDE_OBJECT_START": Interpreter._object,
    "EXCLUDE_OBJECT_END": Interpreter._object,
    "M486": Interpreter._object,
    "G10": Interpreter._retract,
    "G11": Interpreter._retract,
    "G28": Interpreter._home_command,
}

_MESSAGES = {
    lex.ERROR_INCHES: "Klipper has no G20 (inches); slice in millimetres",
    lex.ERROR_FEED: "the feedrate F{value:g} must be above 0 and below 1e9 mm/min",
    lex.ERROR_SLOW: "the speed {value:g} mm/s is below {limit:g} mm/s; raise F or M220",
    lex.ERROR_TRAVEL: "{axis} {value:.3f} mm lies outside the machine's travel, which ends at "
    "{limit:.3f} mm; move the model or correct the machine's travel",
    lex.ERROR_RANGE: "{axis} {value:g} is beyond {limit:g} mm; correct it",
    lex.ERROR_ARC_RADIUS: "Klipper's arcs do not take R; slice with I and J",
    lex.ERROR_ARC_RELATIVE: "Klipper has no arcs in relative mode; use G90 before them",
    lex.ERROR_ARC_CENTER: "the arc names no centre; give I and J (G18: I K, G19: J K)",
    lex.ERROR_ARC_LONG: "the arc has {value:.0f} pieces, more than {limit:.0f}; correct its centre",
    lex.ERROR_POSITIVE: "the value {value:g} is out of range; it must be above 0 (P of G4: not "
    "below 0)",
}


def _new_table(columns: int, rows: int) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    return np.zeros((rows, columns)), np.full(4 * rows, -1, np.int32)


def _grown(rows: NDArray[np.float64], count: int) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    larger, index = _new_table(rows.shape[1], 2 * len(rows))
    for number in range(count):
        lex.intern_row(larger, index, number, rows[number])
    return larger, index


class _Names:
    """Names numbered as they come."""

    def __init__(self) -> None:
        self.names: list[str] = []
        self._numbers: dict[str, int] = {"": -1}

    def number(self, name: str) -> int:
        """Return the number of a name, entered if it is new; -1 for the empty name."""
        number = self._numbers.setdefault(name, len(self.names))
        if number == len(self.names):
            self.names.append(name)
        return number
