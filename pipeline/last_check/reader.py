"""A small G-code reader that tracks a file's own coordinates and the filament fed.

It knows plain moves, arcs, modes, units and origins. After any other command that may move the head
the position is unknown until the file names the next absolute one; an unknown position is never an
error. Positions are in the file's own coordinates, so that its origin does not matter.
"""

from __future__ import annotations

import re
from enum import IntEnum
from functools import lru_cache
from typing import Any

import numpy as np

from stillpath.pipeline.last_check import _reader_kernels as at
from stillpath.pipeline.last_check.rules import Rules

__all__ = ["NAN", "Kind", "Reader", "code_of", "is_same"]

NAN = float("nan")
_STILL_MM = 1e-6
_BEHIND_NAME = re.compile(rb"[ \t]*(?:[A-Z_*].*)?")
_NUMBER = rb"-?(?:\d+\.?\d*|\.\d+)"
_WORD = re.compile(rb"[ \t]*([A-Z])(" + _NUMBER + rb")")
_WORDS = re.compile(rb"(?:" + _WORD.pattern + rb")*[ \t]*")
_NAME = re.compile(rb"([GMT])(\d+)((?:\.\d+)?)(?![\d.])")
_LONG_NAME = re.compile(rb"[A-Z_]{2,}[A-Z0-9_]*")
_LINE_NUMBER = re.compile(rb"N[ \t]*\d+[ \t]*(?![\d.])")
_FLOW = re.compile(rb"S(" + _NUMBER + rb")")
_FURTHER = re.compile(rb"[GM]-?\d|\{|\x00")
_CONDITION = re.compile(rb"(?:IF|ELIF|ELSE|WHILE)(?![A-Z0-9_])")
_STATE_NAME = re.compile(rb"NAME=([A-Z0-9_]+)(?!\S)")
_MAY_MOVE = re.compile(
    rb"G[ \t]*-?0*[01235](?!\d)|[XYZEIJK][ \t]*[-+.\d]|.*[\s\d]G-?0*[01235](?!\d)"
)
_TEXT = (b"M117", b"M118", b"M23")
_BARE_TEXT = (b"M117", b"M23")
"""Those whose rest RepRapFirmware takes as text, if it has no quotes."""
_AXES = b"XYZEF"
_NO_WORDS = np.zeros(at.WORD_COUNT)
_MOST_HARMLESS = 1 << 10


class Kind(IntEnum):
    """What the written file may make of a line."""

    COMMENT = 0
    """No command."""
    STAYS = 1
    """It must be in the written file."""
    RESTS = 2
    """It must be in the written file, and is a plain move without X and Y."""
    MOVES = 3
    """It moves X or Y: a stream may replace it."""
    PERHAPS = 4
    """It may or may not move X or Y."""


class Reader:
    """Follow one file.

    Parameters
    ----------
    shortest_mm : float
        Shorter moves of X and Y may be merged into the next one, and left unchanged.

    Attributes
    ----------
    state : float array
        See `pipeline.last_check._reader_kernels`.
    lost : bytes
        The last line after which the position was unknown.
    """

    def __init__(self, rules: Rules, shortest_mm: float = 0.0) -> None:
        self.rules, self.shortest_mm = rules, max(shortest_mm, _STILL_MM)
        self.state = np.full(at.SIZE, NAN)
        self.state[[at.E, at.FED, at.RELATIVE, at.WAITS]] = 0.0
        self.state[at.UNIT] = 1.0
        self.state[at.RELATIVE_E] = self._says_relative_e = rules.relative_e
        self.lost = b""
        self.least_flow = 1.0
        """The smallest flow factor so far (M221), with which E is scaled to the filament fed."""
        # Never changed in place, so that `keep` need not copy them.
        self._saved: dict[bytes, tuple[float, ...]] = {}
        self._pushed: tuple[tuple[float, ...], ...] = ()
        self._harmless_lines: set[bytes] = set()
        self._in_plane_xy = True
        self._condition = -1
        """Indentation of the condition that encloses the lines; -1: none."""

    def keep(self) -> tuple[Any, ...]:
        """Return a snapshot for `restore`."""
        return (
            self.state.copy(),
            self._says_relative_e,
            self.lost,
            self._saved,
            self._pushed,
            self._in_plane_xy,
            self._condition,
        )

    def restore(self, kept: tuple[Any, ...]) -> None:
        """Restore a snapshot of `keep`."""
        (
            state,
            self._says_relative_e,
            self.lost,
            self._saved,
            self._pushed,
            self._in_plane_xy,
            self._condition,
        ) = kept
        self.state[:] = state

    @property
    def knows_arcs(self) -> bool:
        """Return whether arcs in the XY plane are executed here."""
        return self._in_plane_xy and len(self.rules.arcs) > 0

    def leaves_alone(self, line: bytes) -> bool:
        """Return whether a line is known to change neither position nor modes."""
        return line in self._harmless_lines

    def carry_out(self, line: bytes) -> tuple[Kind, int]:
        """Execute a line of `code_of`, without its newline.

        Returns
        -------
        (Kind, int)
            The kind, and for a plain move the mask of its words X Y Z E F (bits 0 to 4).
        """
        if line in self._harmless_lines:
            return Kind.STAYS, 0
        rules = self.rules
        code = line.split(b";", 1)[0]
        if rules.several and not self._is_unconditional(code):
            return self._forget(code, modes=True), 0
        code = code.strip(b" \t\r")
        if rules.checks_sums and b"*" in code and code != code.upper():
            return self._forget(code), 0  # the sum is of what stands there
        if rules.folds_case:
            code = code.upper()
        elif code[:1].islower():
            return Kind.STAYS, 0  # an unknown command, skipped by the firmware
        cut = _cut(code, rules)
        if cut is None:
            return Kind.STAYS, 0
        name, rest = cut
        if name in (b"G0", b"G1"):
            return self._move(code, rest)
        if name == b"M221" and (flow := _FLOW.search(rest)) is not None:
            self.least_flow = min(self.least_flow, max(0.01 * float(flow[1]), 1e-9))
        if name in rules.harmless or name in _TEXT:
            # Where a line may hold several commands, the result depends on its context.
            if not (rules.several or rules.stacks) and len(self._harmless_lines) < _MOST_HARMLESS:
                self._harmless_lines.add(line)
            return self._harmless(code, name, rest), 0
        return self._command(code, name, rest), 0

    def _is_unconditional(self, code: bytes) -> bool:
        """Return whether a line is executed unconditionally."""
        indent = len(code) - len(code.lstrip(b" \t"))
        if self._condition >= 0 and indent > self._condition:
            return False
        self._condition = indent if _CONDITION.match(code.strip().upper()) else -1
        return self._condition < 0

    def _harmless(self, code: bytes, name: bytes, rest: bytes) -> Kind:
        is_text = name in _BARE_TEXT and not rest.lstrip().startswith(b'"')
        if self.rules.several and not is_text and _FURTHER.search(rest):
            return self._forget(code, modes=True)
        if self.rules.stacks and name == b"G10" and rest.strip():
            return self._forget(code)  # offsets of a tool or a workspace
        return Kind.STAYS

    def _move(self, code: bytes, rest: bytes) -> tuple[Kind, int]:
        words = _plain_words(rest, self.rules)
        if words is None or not words.keys() <= {*_AXES, ord("S"), ord("P")}:
            return self._forget(code, modes=self.rules.several), 0
        if words.get(ord("F"), 1.0) <= 0.0 and self.rules.skips_low_feed:
            del words[ord("F")]
        values, mask = _NO_WORDS.copy(), 0
        for k, letter in enumerate(_AXES):
            if letter in words:
                values[k] = words[letter]
                mask |= 1 << k
        z_mm, fed_mm = self.state[[at.Z, at.FED]]
        way_mm = float(at.way_xy_mm.py_func(self.state, values, mask))  # type: ignore[attr-defined]
        at.move.py_func(self.state, values, mask)  # type: ignore[attr-defined]
        if not mask & at.WORDS:
            return Kind.STAYS, mask
        waited = self.state[at.WAITS] == 1.0
        at.settle.py_func(self.state, way_mm, self.shortest_mm, z_mm, fed_mm)  # type: ignore[attr-defined]
        if way_mm == 0.0 and not waited:
            return Kind.RESTS, mask
        return Kind.MOVES if way_mm > self.shortest_mm else Kind.PERHAPS, mask

    def _arc(self, code: bytes, rest: bytes) -> Kind:
        words = _plain_words(rest, self.rules)
        if words is None or not self._is_plain_arc(words):
            return self._forget(code)
        for k, letter in enumerate(_AXES):
            if letter in words and not (letter == _AXES[4] and words[letter] <= 0.0):
                values = _NO_WORDS.copy()
                values[k] = words[letter]
                at.move.py_func(self.state, values, 1 << k)  # type: ignore[attr-defined]
        if self.rules.divides_extruder and ord("E") in words and self.state[at.RELATIVE_E] != 1.0:
            self.state[[at.E, at.FED]] = NAN
        return Kind.PERHAPS

    def _is_plain_arc(self, words: dict[int, float]) -> bool:
        """Return whether an arc ends where its words say: Marlin skips one of zero length."""
        if not self._in_plane_xy or not words.keys() <= set(b"XYZEFIJR"):
            return False
        turned = any(words.get(letter, 0.0) != 0.0 for letter in b"IJ")
        values = np.array([words.get(letter, 0.0) for letter in b"XYZEFIJ"])
        mask = sum(1 << k for k, letter in enumerate(b"XYZEFIJ") if letter in words)
        if ord("R") not in words:
            if self.rules.divides_extruder:
                return turned
            nothing = at.may_be_no_arc.py_func(self.state, values, mask)  # type: ignore[attr-defined]
            return turned and not nothing
        mask &= 3
        way_mm = at.way_xy_mm.py_func(self.state, values, mask)  # type: ignore[attr-defined]
        return not turned and words[ord("R")] != 0.0 and way_mm > _STILL_MM

    def _command(self, code: bytes, name: bytes, rest: bytes) -> Kind:
        """Execute a command that changes modes or position, or forget the state."""
        rules, state = self.rules, self.state
        if not name:  # malformed: it may be executed or not
            return self._forget(code, modes=_FURTHER.search(code) is not None)
        if rules.several and _FURTHER.search(rest):
            return self._forget(code, modes=True)
        if name in rules.arcs:
            return self._arc(code, rest)
        if name in (b"G90", b"G91"):
            state[at.RELATIVE] = float(name == b"G91")
            if rules.positioning_sets_extruder:
                self._says_relative_e = float(name == b"G91")
        elif name in (b"M82", b"M83"):
            self._says_relative_e = float(name == b"M83")
        elif name == b"G92":
            return self._set_position(code, rest)
        elif name in (b"G17", b"G18", b"G19"):
            self._in_plane_xy = name == b"G17"
        elif name == b"G21" or (name == b"G20" and rules.inches):
            state[at.UNIT] = 1.0 if name == b"G21" else 25.4
        elif rules.restores and name == b"SAVE_GCODE_STATE":
            self._saved = self._saved | {_state_name(rest): self._modes()}
        elif rules.restores and name == b"RESTORE_GCODE_STATE":
            saved = self._saved.get(_state_name(rest))
            self._forget(code, modes=saved is None)
            if saved is not None:
                self._set_modes(saved)
        elif rules.stacks and name == b"M120":
            self._pushed = (*self._pushed, self._modes())
        elif rules.stacks and name == b"M121":
            if self._pushed:
                reads = state[at.E]
                self._set_modes(self._pushed[-1])
                self._pushed = self._pushed[:-1]
                state[at.E] = reads
        elif name in (b"G28", b"G29", b"G30", b"G32"):
            state[at.X : at.Z + 1] = NAN
            self.lost = code
        else:
            return self._forget(code)
        self._settle()
        return Kind.STAYS

    def _set_position(self, code: bytes, rest: bytes) -> Kind:
        words = _plain_words(rest, self.rules)
        if words is None or not words.keys() <= set(b"XYZE"):
            return self._forget(code)
        if not words and self.rules.bare_set_position:
            words = dict.fromkeys(b"XYZE", 0.0)
        for k, letter in enumerate(b"XYZE"):
            if letter in words:
                self.state[k] = words[letter] * self.state[at.UNIT]
        return Kind.STAYS

    def _forget(self, code: bytes, *, modes: bool = False) -> Kind:
        """Forget all but the modes until the file states it again."""
        self.state[[at.X, at.Y, at.Z, at.E, at.FED, at.F]] = NAN
        if modes:
            self.state[at.RELATIVE] = self._says_relative_e = NAN
            self._settle()
        self.lost = code
        code = code.strip(b" \t\r").upper()
        found = _cut(code, self.rules)
        is_odd = found is not None and not found[0]
        return Kind.PERHAPS if is_odd or _MAY_MOVE.match(code) else Kind.STAYS

    def _modes(self) -> tuple[float, ...]:
        state = self.state
        kept = (at.RELATIVE, at.UNIT, at.F, at.E)
        return (self._says_relative_e, *(float(state[k]) for k in kept))

    def _set_modes(self, modes: tuple[float, ...]) -> None:
        self._says_relative_e = modes[0]
        self.state[[at.RELATIVE, at.UNIT, at.F, at.E]] = modes[1:]
        self._settle()

    def _settle(self) -> None:
        """Determine whether E is relative."""
        relative = self._says_relative_e
        if self.rules.relative_rules_extruder and relative != 1.0:
            relative = float(relative + self.state[at.RELATIVE])  # nan: unknown
        self.state[at.RELATIVE_E] = relative


def code_of(line: bytes) -> bytes:
    """Return a line without trailing blanks, or nothing if it contains no command.

    Leading blanks are kept: they show whether it depends on a condition (RepRapFirmware).
    """
    line = line.rstrip()
    code = line.lstrip()
    if code[:1] in (b"", b";", b"*"):
        return b""  # a checksum without a command
    if code[:1] in (b"N", b"n"):
        found = _LINE_NUMBER.match(code.upper())
        if found is not None and code[found.end() : found.end() + 1] in (b"", b";"):
            return b""
    return line


def is_same(code: bytes, expected: bytes) -> bool:
    """Return whether a line equals the original's, apart from the new times of M73."""
    return code == expected or code.lstrip()[:3] == expected.lstrip()[:3] == b"M73"


@lru_cache(maxsize=1024)  # slicers repeat themselves
def _cut(code: bytes, rules: Rules) -> tuple[bytes, bytes] | None:
    """Split a line into command and words; None: dropped by the firmware. Malformed: no name."""
    begin = code
    numbered = _LINE_NUMBER.match(code)
    if numbered is not None:
        code = code[numbered.end() :]
    if b"*" in code and not code.startswith(_TEXT):
        code, _, given = code.partition(b"*")
        if not given.strip().isdigit():
            return b"", begin
        if rules.checks_sums:
            if numbered is None or len(given.strip()) > 3:
                return b"", begin
            value = 0
            for byte in begin.partition(b"*")[0]:
                value ^= byte
            if value != int(given):
                return None
    if len(code) > rules.longest or b"\\" in code or b"\r" in code or b"\x00" in code:
        return b"", begin
    found = _NAME.match(code)
    if found is not None and rules.leading_zeros | bool(_BEHIND_NAME.fullmatch(code, found.end())):
        number = found[2]
        if rules.leading_zeros:
            number = number.lstrip(b"0") or b"0"
        name = found[1] + number + found[3]
        if rules.ignores_subcodes and name not in rules.harmless:
            name = found[1] + number
        return name, code[found.end() :]
    found = _LONG_NAME.match(code)
    return (found[0], code[found.end() :]) if found is not None else (b"", begin)


def _plain_words(rest: bytes, rules: Rules) -> dict[int, float] | None:
    """Return letters and numbers of well-formed words: no inner blanks, no repeated letter."""
    if _WORDS.fullmatch(rest) is None:
        return None
    if rules.exponents and re.search(rb"[\d.]E", rest):
        return None
    found = _WORD.findall(rest)
    words = {letter[0]: float(number) for letter, number in found}
    return words if len(words) == len(found) else None


def _state_name(rest: bytes) -> bytes:
    """Return the name of a saved state; empty if malformed."""
    found = _STATE_NAME.search(rest)
    return found[1] if found is not None else b"" if b"NAME" in rest else b"DEFAULT"
