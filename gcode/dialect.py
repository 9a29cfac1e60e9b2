"""The dialect of a firmware: one table of its rules and commands.

The interpreter (`gcode.interpreter`) is shared; a `Dialect` says where firmwares differ. Each
firmware's own is in `gcode/firmware/*/dialect.py`; docs/dialects.md shows them side by side.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode._slots import (
    I_ARC_CIRCLES,
    I_ARC_RULE,
    I_AXES_FACTORS,
    I_DWELL_RULE,
    I_E_RULE,
    I_EXPONENTS,
    I_FACTOR_DEFAULT,
    I_FIRST_WINS,
    I_FOLD_CASE,
    I_LONGEST,
    I_MODAL_WORDS,
    I_ODD_WORDS,
    I_ONE_COMMAND,
    I_ORIGIN_RULE,
    I_ZERO_FEED,
    Action,
    ArcRule,
    DwellRule,
    ExtruderRule,
    OriginRule,
)
from stillpath.gcode.types import EventKind

if TYPE_CHECKING:
    from stillpath.gcode.lexer import Command
    from stillpath.gcode.state import MachineState

__all__ = [
    "FURTHER_WORDS",
    "NEEDED",
    "Action",
    "ArcRule",
    "Dialect",
    "DwellRule",
    "ExtruderRule",
    "Handler",
    "OriginRule",
    "Word",
    "words",
]

Handler: TypeAlias = "Callable[[MachineState, Command], int]"
"""Carries out a command; returns a status of the kernel (0: done)."""

Word: TypeAlias = "EventKind | Action | Handler"
"""Handling of a command: a line that only leaves an event, one executed by the kernel, or by a
Python handler."""

_TABLE_SIZE = 1024
FURTHER_WORDS = "ABCDSUVW"
"""Letters of a move's other axes, and of a laser's power: a stream cannot say them."""
NEEDED: Mapping[str, str] = MappingProxyType(
    # Words whose numbers the kernel's commands need.
    {
        "G0": "XYZEF",
        "G1": "XYZEF",
        "G2": "XYZEFRIJKP",
        "G3": "XYZEFRIJKP",
        "G4": "PS",
        "G5": "XYZEFIJPQ",
        "G92": "XYZE",
        "M220": "S",
        "M221": "S",
    }
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Dialect:
    """Rules and words of one firmware as it is set up on one machine.

    Attributes
    ----------
    name, title : str
        Name in options, and name shown to users.
    words : mapping of str to Word
        Every command that is known to do something, or to do nothing.
    otherwise : function of str to EventKind
        Effect of a command that is not in the table.
    """

    name: str
    title: str
    words: Mapping[str, Word]
    otherwise: Callable[[str], EventKind]

    # How a line is cut into words
    extended_commands: bool = False
    """``NAME KEY=VALUE`` with the quotes of a shell (Klipper)."""
    raw_text: frozenset[str] = frozenset({"M117", "M118", "M23"})
    """Commands whose rest is text."""
    paren_comments: bool = False
    """``( )`` encloses a comment."""
    quoted_text: bool = False
    """``"`` encloses text, ``;`` and ``(`` in it included."""
    expressions: bool = False
    """``{ }`` encloses an expression, a line may be a meta command (RepRapFirmware)."""
    ignores_subcodes: bool = False
    """G28.1 is G28, unless G28.1 has a meaning of its own (Marlin)."""
    one_command: bool = True
    """A second G or M in a line is not a separate command."""
    fold_case: bool = True
    """Lower case is read as upper case."""
    first_wins: bool = False
    """Of repeated words the first counts, not the last."""
    exponents: bool = False
    """An E right after a digit belongs to the number."""
    longest_command: int = 65_536
    """Characters of a command line, the comment not counted."""
    cut_long_commands: bool = False
    """What is longer is cut off (Marlin); otherwise it is an error."""
    modal_words: bool = False
    """A line may leave out the G0 to G3 of the line before it."""

    # What commands do
    extruder: ExtruderRule = ExtruderRule.WITH_AXES
    arc: ArcRule = ArcRule.KLIPPER
    arc_circles: bool = False
    """P of G2 and G3 adds circles (Marlin)."""
    dwell: DwellRule = DwellRule.P_ONLY
    origin: OriginRule = OriginRule.BARE_IS_ZERO
    factor_default: bool = True
    """M220 and M221 without S mean 100 %."""
    factors_need_axes: bool = False
    """M220 and M221 do not apply to moves of the extruder alone."""
    retraction_scaled: bool = True
    """M220 and M221 apply to G10 and G11."""
    zero_feed_passes: bool = False
    """An F of 0 or less is ignored, not refused."""
    bad_words_pass: bool = False
    """A word without a number is ignored, not refused."""
    bad_arcs_pass: bool = False
    """An arc without centre is ignored, not refused."""
    extruder_mode_known: bool = True
    """E is absolute before the first M82 or M83; otherwise moves stay as they are up to it."""
    tool_at_start: bool = True
    """Tool 0 is in use before the first T."""
    odd_words: str = ""
    """Letters that make a move (G0, G1) something special."""
    odd_move: Handler | None = None
    """Executes such a move; returns -1 if it is an ordinary one."""
    needed: Mapping[str, str] = field(default_factory=lambda: NEEDED)
    """Words whose numbers the kernel's commands need."""
    start_speed_mm_s: float = 25.0
    """Speed of a move before the first F."""

    _tables: dict[str, NDArray[np.int8]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    def word(self, name: str) -> Word:
        """Return how a command is handled."""
        found = self.words.get(name)
        if found is None and name[:1] == "T" and (len(name) == 1 or name[1] in "-0123456789"):
            found = self.words.get("T")
        elif name[:1] == "@":
            found = self.words.get("@")
        return self.otherwise(name) if found is None else found

    def table(self, letter: str) -> NDArray[np.int8]:
        """Return what letter + 0 to 1023 are: an `EventKind`, an `Action` or -1 (Python), (1024,).

        Made once; only to be read.
        """
        known = self._tables.get(letter)
        if known is not None:
            return known
        table = np.full(_TABLE_SIZE, -1, np.int8)
        for number in range(_TABLE_SIZE):
            name = f"{letter}{number}"
            word = self.word(name)
            if isinstance(word, EventKind | Action) and name not in self.raw_text:
                table[number] = word
        self._tables[letter] = table
        return table

    def set_rules(self, i: NDArray[np.int64]) -> None:
        """Write the rules that the kernel follows into its state."""
        i[I_E_RULE] = self.extruder
        i[I_ARC_RULE] = self.arc
        i[I_ARC_CIRCLES] = self.arc_circles
        i[I_DWELL_RULE] = self.dwell
        i[I_ORIGIN_RULE] = self.origin
        i[I_ZERO_FEED] = self.zero_feed_passes
        i[I_FACTOR_DEFAULT] = self.factor_default
        i[I_FIRST_WINS] = self.first_wins
        i[I_EXPONENTS] = self.exponents
        i[I_LONGEST] = self.longest_command
        i[I_AXES_FACTORS] = self.factors_need_axes
        i[I_ONE_COMMAND] = self.one_command
        i[I_MODAL_WORDS] = self.modal_words
        i[I_FOLD_CASE] = self.fold_case
        odd = self.odd_words + FURTHER_WORDS
        i[I_ODD_WORDS] = sum(1 << (ord(letter) - 65) for letter in odd)


def words(text: str, word: Word) -> dict[str, Word]:
    """Return a table that makes every command of a text the same."""
    return dict.fromkeys(text.split(), word)
