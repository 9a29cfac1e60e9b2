"""The state of the firmware while it reads, which commands change.

Kernels and Python share it; the numbers are in two arrays (see `gcode._slots`). Commands that the
kernel does not know are functions of this state, one module of them per firmware.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode import _slots as at
from stillpath.gcode._motion_kernels import travel
from stillpath.gcode._table_kernels import (
    Rows,
    Tables,
    line_hash,
    memo_slot,
    note_limits,
    note_modal,
    put_event,
    settle,
    settle_limits,
)
from stillpath.gcode.dialect import Dialect, OriginRule
from stillpath.gcode.errors import GcodeError
from stillpath.gcode.lexer import Command, extended_parameters
from stillpath.gcode.tables import MOST_MEMOS, are_large, begun_anew, grown, new_tables
from stillpath.gcode.types import KEPT, OF_STATE, EventKind, Limits
from stillpath.models.firmware import FirmwareFacts, FirmwareRetraction, Marlin, RepRapFirmware
from stillpath.models.machine import Machine

__all__ = ["EXTRUDER_MODE", "MachineState", "Names", "Retraction", "Saved"]

EXTRUDER_MODE = "extruder mode"
"""Why moves are held that feed filament before the file says M82 or M83."""


@dataclass(frozen=True, slots=True)
class Retraction:
    """What G10 and G11 do at the moment."""

    length_mm: float
    speed_mm_s: float
    extra_mm: float
    return_speed_mm_s: float
    hop_mm: float = 0.0

    @classmethod
    def of(cls, facts: FirmwareRetraction) -> Retraction:
        """Return the retraction of the machine's document."""
        return cls(
            facts.retract_length_mm,
            facts.retract_speed_mm_s,
            facts.unretract_extra_length_mm,
            facts.unretract_speed_mm_s,
        )


@dataclass(frozen=True, slots=True)
class Saved:
    """A state or a place that the file has saved."""

    f: NDArray[np.float64]
    i: NDArray[np.int64]


class MachineState:
    """The firmware's state, and the rows that are being written.

    Attributes
    ----------
    f, i, w : ndarray
        Numbers, with slots in `gcode._slots`; the words of the command in hand, A to Z.
    rows, tables : Rows, Tables
        The block that is being written, and what its rows refer to.
    buffer, span : ndarray, (int, int)
        The text that is being read, and where the line in hand begins (after blanks and its
        number) and ends in it.
    limits_type, limits_names : type, tuple of str
        The firmware's `Limits`, and its fields in the order of a row.
    initial_limits : tuple of float
        The row that is in force before the first line.
    features, objects : Names
        Names behind the `feature` and `object_id` columns.
    saved : dict of str to Saved
        States and places by the command and number, or the name, that they were saved with.
    workspaces, workspace : dict of int to origin, int
        Origins of G54 (0) to G59.3 (8), and which one is in use; -1: the machine's own.
    retraction : Retraction, optional
        What G10 and G11 do; None: the machine states none.
    retracted, retracted_at : dict of int
        Whether each tool is retracted, and I_MACROS when that was known; Klipper has one for all.
    hop_mm : float
        How much G10 has lifted Z.
    settings : dict of str to float
        What commands have set that has no slot and is no limit, by names of their handlers.
    tool_known : bool
        Whether it is known which tool is in use.
    conditional_indent : int
        Indentation of the ``if`` or ``while`` whose block is being read; -1: none.
    layer_style : str, optional
        Beginning of the first layer mark; others do not count layers.
    held : dict of str to bool
        Why moves stay as they are (`hold`).
    laser_mode : bool
        The machine is one with a laser (M452).
    cutter_on : bool
        A spindle or laser is on (M3, M4), or may be at any move (`laser_mode`).
    macro_ran, states_acceleration : bool
        The file has called what may be a macro of the printer; it has set an acceleration.
    first_macro : tuple of str and int, optional
        The first one of an unknown name, and its line.
    remembers : bool
        The line in hand is one command (`remember`).
    warnings : dict of str to int
        What the firmware skips or what is unknown, with the line of first occurrence.
    notes : dict of str to int
        The same of what only some printers of this kind do not skip.
    """

    _passed_on = 0

    def __init__(self, machine: Machine, dialect: Dialect, limits: Limits, *, strict: bool) -> None:
        self.machine = machine
        self.firmware: FirmwareFacts = machine.firmware
        self.dialect = dialect
        self.limits_type = type(limits)
        self.limits_names = tuple(limits.__dataclass_fields__)
        self.features = Names()
        self.objects = Names()
        self.saved: dict[str, Saved] = {}
        self.workspaces: dict[int, tuple[float, float, float]] = {}
        self.workspace = 0 if dialect.expressions else -1
        facts = self.firmware.retraction
        self.retraction = None if facts is None else Retraction.of(facts)
        self.retracted: dict[int, bool] = {}
        self.retracted_at: dict[int, int] = {}
        self.hop_mm = 0.0
        self.settings: dict[str, float] = {}
        self.macro_ran = self.states_acceleration = False
        self.first_macro: tuple[str, int] | None = None
        self.held: dict[str, bool] = {}
        self.laser_mode = self.cutter_on = False
        self.tool_known = dialect.tool_at_start
        self.conditional_indent = -1
        self.warnings: dict[str, int] = {}
        self.notes: dict[str, int] = {}
        self.layer_style: str | None = None
        self.buffer = np.zeros(0, np.uint8)
        self.span = (0, 0)
        self.remembers = True
        self._memos = self._memo_limits = 0

        self.f = f = np.zeros(at.F_SIZE)
        self.i = i = np.zeros(at.I_SIZE, np.int64)
        self.w = np.zeros(26)
        self.initial_limits = row = limits.as_row()
        if len(row) > at.MAX_LIMITS:
            raise ValueError(f"{len(row)} limits, more than {at.MAX_LIMITS}")
        self.rows = Rows.empty(0)
        self.tables = new_tables(len(row), dialect)
        f[at.F_SPEED] = dialect.start_speed_mm_s
        f[at.F_SPEED_FACTOR] = 1.0 / 60.0
        f[at.F_EXTRUDE_FACTOR] = f[at.F_UNIT_MM] = f[at.F_UNIT_E_MM] = 1.0
        f[at.F_LIMITS : at.F_LIMITS + len(row)] = row
        _set_arcs(f, self.firmware)
        for k, axis in enumerate("xyz"):
            f[at.F_LOW + k] = machine.travel[axis].min_mm  # type: ignore[index]
            f[at.F_HIGH + k] = machine.travel[axis].max_mm  # type: ignore[index]
        dialect.set_rules(i)
        i[at.I_LINE] = 1
        i[at.I_ABS_XYZ] = i[at.I_ABS_E] = i[at.I_PLAIN] = 1
        i[at.I_STRICT] = int(strict)
        i[at.I_ORIGIN_KNOWN] = 0b111
        i[at.I_LAYER] = i[at.I_FEATURE] = i[at.I_OBJECT] = i[at.I_MOTION] = -1
        if self.firmware.homed_at_start:
            self.home(0b111, self.firmware.home_mm or (0.0, 0.0, 0.0))
        self.note_modal()
        self.note_limits()

    def snapshot(self) -> MachineState:
        """Return an independent copy of the state."""
        other = copy.copy(self)
        for name, value in vars(self).items():
            if isinstance(value, np.ndarray | dict | Names):
                setattr(other, name, value.copy())
        other.rows = Rows.empty(0)
        copies = {name: table.copy() for name, table in self.tables._asdict().items()}
        other.tables = Tables(**copies)
        return other

    @property
    def moves(self) -> int:
        """Number of moves so far."""
        return self._passed_on + int(self.i[at.I_MOVES])

    # What a line does

    def called(self, name: str) -> None:
        """Note what may be a macro of the printer."""
        self.macro_ran = True
        if self.first_macro is None and name not in self.dialect.words:
            self.first_macro = name, int(self.i[at.I_LINE])

    def event(self, kind: EventKind, dwell_s: float = 0.0) -> int:
        """Write the line in hand as an event."""
        if kind == EventKind.UNKNOWN:
            self.forget()
            self.i[at.I_MACROS] += 1
        put_event(self.i, self.rows, int(kind))
        if dwell_s:
            self.settle()
            self.rows.dwell[int(self.i[at.I_EVENTS]) - 1] = dwell_s
        return at.OK

    def forget(self, axes: int = 0b111, *, origin: bool = False) -> None:
        """Mark the positions of axes as unknown and, with `origin`, also their origins."""
        self.settle()
        self.i[at.I_KNOWN] &= ~axes
        if origin:
            self.i[at.I_ORIGIN_KNOWN] &= ~axes

    def hold(self, reason: str, on: bool) -> None:
        """Let moves stay as they are for a reason, or no longer for this one."""
        self.settle()
        self.held[reason] = on
        self.i[at.I_KEPT] = KEPT if any(self.held.values()) else 0

    def travel(self) -> int:
        """Go to F_LAST for a line that does more than move, and must stay."""
        return travel(self.f, self.i, 0, False, self.rows)

    def travel_to_kept(self) -> int:
        """Go to F_LAST for a line that depends on the printer's stored state, such as its F."""
        move = int(self.i[at.I_MOVES])
        status = self.travel()
        if status == at.DONE:
            return self.event(EventKind.STATE)
        self.settle()
        self.rows.tiny[at.M_KNOWN, move : int(self.i[at.I_MOVES])] |= OF_STATE
        return status

    def moved(self, status: int) -> int:
        """Turn the status of `travel` into that of a line: without a move, write an event."""
        return self.event(EventKind.MODE) if status == at.DONE else status

    def home(self, axes: int, home_mm: tuple[float, float, float] | None) -> None:
        """Restore the G-code origin of axes and, if the machine states it, their place."""
        f, i = self.f, self.i
        self.settle()
        f[at.F_LAST : at.F_LAST + 4] = f[at.F_TOOL : at.F_TOOL + 4]
        # RepRapFirmware's workspaces outlast homing.
        lasting = self.dialect.origin == OriginRule.POSITION
        for k in range(3):
            if axes >> k & 1:
                if not lasting:
                    f[at.F_BASE + k] = f[at.F_HOMING + k]
                if home_mm is not None:
                    f[at.F_LAST + k] = f[at.F_TOOL + k] = home_mm[k]
        i[at.I_ORIGIN_KNOWN] |= axes
        # Homing an axis may move the others too (safe_z_home, homex.g).
        i[at.I_KNOWN] = 0 if home_mm is None else axes
        self.settle()
        self.note_modal()

    def settle(self) -> None:
        """Fill the rows before a value shared by many rows changes."""
        settle(self.f, self.i, self.rows)
        settle_limits(self.i, self.rows)

    def note_modal(self) -> None:
        """Enter the modes that have changed."""
        self.settle()
        note_modal(self.f, self.i, self.tables)

    def note_limits(self) -> None:
        """Enter the limits that have changed."""
        note_limits(self.f, self.i, self.rows, self.tables)

    def limit(self, name: str) -> float:
        """Return a limit in force."""
        return float(self.f[at.F_LIMITS + self.limits_names.index(name)])

    def set_limits(
        self,
        command: Command,
        values: Mapping[str, float],
        *,
        remember: bool = True,
        kind: EventKind = EventKind.LIMITS,
    ) -> int:
        """Set limits by name, and remember that this line does so in millimetres."""
        row = np.full(len(self.limits_names), np.nan)
        self.states_acceleration |= "accel_mm_s2" in values
        for name, value in values.items():
            row[self.limits_names.index(name)] = value
        limits = self.f[at.F_LIMITS : at.F_LIMITS + len(row)]
        remember = remember and kind == EventKind.LIMITS and self.f[at.F_UNIT_MM] == 1.0
        if remember and self._memo_limits < len(self.tables.memo_limits):
            self.tables.memo_limits[self._memo_limits] = row
            if self.remember(command, at.MEMO_LIMITS, self._memo_limits):
                self._memo_limits += 1
        limits[:] = np.where(np.isnan(row), limits, row)
        note_limits(self.f, self.i, self.rows, self.tables)
        return self.event(kind)

    def limits_kind(self, command: Command, letters: str) -> EventKind:
        """Return the effect of a line of limits, of which a stream holds back those of `letters`.

        Its further words (another axis) would be lost with it.
        """
        return EventKind.STATE if command.words.keys() - set(letters) else EventKind.LIMITS

    def remember(self, command: Command, what: int, value: int) -> bool:
        """Let the kernel repeat this effect whenever the line recurs."""
        known_whole = self.remembers and self.conditional_indent < 0 and not command.dropped
        if self._memos >= MOST_MEMOS or not known_whole:
            return False
        key = line_hash(self.buffer, *self.span)
        slot = memo_slot(self.tables.memo_keys, key)
        if self.tables.memo_keys[slot] != 0:
            return False
        self.tables.memo_keys[slot] = key
        self.tables.memo_values[slot] = what * at.MEMO_STRIDE + value
        self._memos += 1
        return True

    # Reading values

    def extended(self, command: Command) -> Mapping[str, str]:
        """Return the ``KEY=VALUE`` pairs of a line."""
        return extended_parameters(command.text, command.name, line=int(self.i[at.I_LINE]))

    def number(self, value: str, key: str, command: Command) -> float:
        """Read a number.

        Raises
        ------
        GcodeError
            It is none, or beyond all reason.
        """
        try:
            number = float(value)
        except ValueError:
            raise self.problem(f"{key} is {value!r}, not a number; correct it", command) from None
        if not abs(number) <= at.MAX_VALUE:
            raise self.problem(f"{key} {value} is out of range; correct it", command)
        return number

    def numbers(self, command: Command, letters: str) -> dict[str, float]:
        """Read the words of a classic command that are among `letters`.

        A word without a number is left out or refused, as the dialect does.
        """
        found = {}
        for letter in letters:
            if letter not in command.words:
                continue
            value = command.words[letter]
            if self.dialect.bad_words_pass and not value:
                continue
            if not self.dialect.extended_commands:
                # A list of numbers stands for several extruders; the first is the one in use.
                value = value.split(":", 1)[0]
            found[letter] = self.number(value, letter, command)
        return found

    def at_least(self, value: str, key: str, low: float, command: Command) -> float:
        """Read a number that must not be below `low`.

        Raises
        ------
        GcodeError
            It is none, or below.
        """
        number = self.number(value, key, command)
        if number < low:
            raise self.problem(f"{key}={value} must be at least {low:g}", command)
        return number

    def problem(self, message: str, command: Command) -> GcodeError:
        """Return an error at the line in hand."""
        return GcodeError(message, line=int(self.i[at.I_LINE]), text=command.text)

    def warn(self, message: str) -> None:
        """Record a warning with the first line at which it occurs."""
        self._record(self.warnings, message)

    def note(self, message: str) -> None:
        """Record a note with the first line at which it occurs."""
        self._record(self.notes, message)

    def _record(self, found: dict[str, int], message: str) -> None:
        if len(found) < 100:
            found.setdefault(message, int(self.i[at.I_LINE]))

    def change_retraction(self, **changes: float) -> None:
        """Change what G10 and G11 do."""
        assert self.retraction is not None
        self.retraction = replace(self.retraction, **changes)

    # Room

    def allocate(self, count: int) -> None:
        """Allocate new rows; the previous ones have been passed on."""
        self._passed_on = self.moves
        self.rows = Rows.empty(count)
        i = self.i
        i[at.I_MOVES] = i[at.I_EVENTS] = i[at.I_FILLED_MOVES] = i[at.I_FILLED_EVENTS] = 0
        i[at.I_LIMITED_MOVES] = i[at.I_LIMITED_EVENTS] = i[at.I_APART] = 0

    def grow_tables(self) -> None:
        """Make the tables larger that are full."""
        self.tables = grown(self.tables, self.i)

    def forget_rows(self) -> bool:
        """Begin new tables of modes and limits if these are large; rows 0 are those in force.

        All that was written must have been handed over. Return whether it was so.
        """
        if not are_large(self.i):
            return False
        self.tables = begun_anew(self.tables, self.i)
        return True


class Names:
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

    def copy(self) -> Names:
        """Return the same names, to go on from."""
        other = Names()
        other.names, other._numbers = self.names.copy(), self._numbers.copy()
        return other


def _set_arcs(f: NDArray[np.float64], firmware: FirmwareFacts) -> None:
    """Set how finely the firmware cuts arcs."""
    f[at.F_ARC_MM] = firmware.arc_resolution_mm
    if isinstance(firmware, Marlin):
        f[at.F_ARC_LEAST_MM] = firmware.min_arc_segment_mm
        f[at.F_ARC_PER_CIRCLE] = firmware.min_circle_segments
        if firmware.variant == "prusa":
            # MAX_ARC_SEGMENT_MM, MIN_ARC_SEGMENTS_PER_SEC, MAX_ARC_DEVIATION of all its printers.
            f[at.F_ARC_MM], f[at.F_ARC_PER_S], f[at.F_ARC_DEVIATION_MM] = 2.0, 50.0, 0.02
    elif isinstance(firmware, RepRapFirmware):
        f[at.F_ARC_LEAST_MM] = firmware.arc_least_mm
        f[at.F_ARC_PER_S] = firmware.arc_segments_per_s
        f[at.F_ARC_DEVIATION_MM] = firmware.arc_deviation_mm
