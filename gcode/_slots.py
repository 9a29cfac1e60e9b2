"""Where the interpreter's state lies in its arrays, and what its numbers mean.

Python and kernels share two small arrays: `f` (float64, slots ``F_``) and `i` (int64, ``I_``).
"""

from __future__ import annotations

from enum import IntEnum

# Float state: positions are x y z e.
F_LAST = 0  # where the G-code says the tool is
F_BASE = 4  # origin of the G-code coordinates
F_TOOL = 8  # where the planner was last sent; differs from F_LAST by skipped tiny moves
F_HOMING = 12  # offset that stays through homing (Klipper's SET_GCODE_OFFSET)
F_SPEED = 16  # mm/s
F_SPEED_FACTOR = 17  # mm/s per mm/min of F
F_EXTRUDE_FACTOR = 18
F_UNIT_MM = 19  # 1, or 25.4 after G20
F_LOW = 20  # travel of x y z
F_HIGH = 23
F_UNIT_E_MM = 26  # mm of filament per unit of E (inches, cubic millimetres)
F_RUN = 27  # where the first of the moves starts that `settle` has not filled yet
F_ERROR = 31  # value, limit
F_ARC_MM = 33  # longest piece of an arc
F_ARC_LEAST_MM = 34  # shortest piece
F_ARC_PER_CIRCLE = 35  # at least so many pieces in a circle
F_ARC_PER_S = 36  # pieces per second at the most; 0: no rule
F_ARC_DEVIATION_MM = 37  # sagitta; 0: no rule
F_LIMITS = 40  # the firmware's limits in force, a row of its `Limits`
MAX_LIMITS = 32
F_SIZE = F_LIMITS + MAX_LIMITS

I_POS = 0  # next line starts here
I_LINE = 1  # its number
I_MOVES = 2  # rows written
I_EVENTS = 3
I_TOTAL_MOVES = 4  # of the whole file
I_ABS_XYZ = 5
I_ABS_E = 6
I_KNOWN = 7  # bit per axis
I_LIMITS_ID = 8
I_MODAL_ID = 9
I_N_LIMITS = 10
I_N_MODAL = 11
I_LAYER = 12
I_FEATURE = 13
I_OBJECT = 14
I_PLANE = 15
I_STRICT = 16
I_END = 17  # end of the line in hand
I_ERROR_AXIS = 18
I_OFFSET = 19  # file offset of the buffer
I_NEED = 20  # move rows that the line in hand needs
I_ORIGIN_KNOWN = 21  # bit per axis: F_BASE holds in the machine's axes
I_KEPT = 22  # `gcode.types.KEPT` where moves must stay as they are, else 0
I_TOOL = 23
I_FILLED_MOVES = 24  # rows whose slow columns `settle` has filled
I_FILLED_EVENTS = 25
I_PLAIN = 26  # the kernel of plain lines may run
I_MOTION = 27  # last of G0 to G3, for lines without a command; -1: none
I_LIMITED_MOVES = 28  # rows whose limits `settle_limits` has filled
I_LIMITED_EVENTS = 29
# Rules of the dialect
I_E_RULE = 30
I_ARC_RULE = 31
I_DWELL_RULE = 32
I_ORIGIN_RULE = 33
I_ZERO_FEED = 34  # an F of 0 or less is ignored
I_FACTOR_DEFAULT = 35  # M220 and M221 without S set 100 %
I_FIRST_WINS = 36  # of repeated words
I_EXPONENTS = 37  # an E right after a digit belongs to the number
I_LONGEST = 38  # characters of a command that are read
I_AXES_FACTORS = 39  # M220 and M221 apply only to moves of X, Y or Z
I_ONE_COMMAND = 40  # a second G or M in a line is not a separate command
I_MODAL_WORDS = 41  # a line may leave out its G
I_FOLD_CASE = 42  # lower case is read
I_ODD_WORDS = 43  # bit per letter: a move or an arc with that word is Python's
I_HOLD = 44  # every command is Python's: it may not be carried out at all
I_APART = 45  # not every move of the rows starts where the one before it ends
I_OBJECTS = 46  # objects that were named so far
I_ARC_CIRCLES = 47  # P of an arc adds circles
I_MACROS = 48  # lines so far that may have been macros, or moved the head unseen
I_SIZE = 49

# Rows of the integer columns: of moves (M_) and of events (E_), each sort of number by itself.
M_LINE, M_START, M_STOP, E_MOVE, E_LINE, E_START, E_STOP = range(7)
M_LIMITS, M_MODAL, M_LAYER, M_FEATURE, M_OBJECT, M_TOOL, E_LIMITS, E_MODAL = range(8)
M_KNOWN, E_KIND = range(2)

OK, DONE, HANDBACK, FULL, GROW = 0, 1, 2, 3, 4
ERROR_INCHES, ERROR_FEED, ERROR_TRAVEL, ERROR_RANGE = 10, 11, 12, 13
ERROR_ARC_RADIUS, ERROR_ARC_RELATIVE, ERROR_ARC_CENTER, ERROR_ARC_LONG = 14, 15, 16, 17
ERROR_POSITIVE, ERROR_SLOW, ERROR_ARC_SHORT, ERROR_ARC_ENDS, ERROR_ARC_SAME = 18, 19, 20, 21, 22
ERROR_ARC_TURNS = 23

MODAL_SIZE = 7

# What a remembered line does: MEMO_EVENT * MEMO_STRIDE + kind, MEMO_LIMITS * MEMO_STRIDE + row, ...
MEMO_EVENT, MEMO_LAYER, MEMO_FEATURE, MEMO_OBJECT, MEMO_LIMITS, MEMO_MARKED = range(6)
MEMO_STRIDE = 1 << 32

MAX_VALUE = 1e9  # no coordinate or feedrate of a printer is larger
MIN_SPEED_MM_S = 1e-4
MIN_VALUE = 1e-9
MAX_ARC_PIECES = 200_000
SMALLEST_MOVE_MM = 1e-9


class Action(IntEnum):
    """What the kernel does with a command itself; above every `EventKind`."""

    MOVE = 20
    ARC_CW = 21
    ARC_CCW = 22
    DWELL = 23
    PLANE_XY = 24
    PLANE_XZ = 25
    PLANE_YZ = 26
    INCHES = 27
    ABSOLUTE = 28
    RELATIVE = 29
    SET_POSITION = 30
    ABSOLUTE_E = 31
    RELATIVE_E = 32
    MILLIMETRES = 33
    SPEED_FACTOR = 34
    EXTRUDE_FACTOR = 35
    CURVE = 36
    REFUSED = 37


class ExtruderRule(IntEnum):
    """When E is relative."""

    WITH_AXES = 0
    """After M83, and after G91 (Klipper)."""
    FOLLOWS_AXES = 1
    """As the last of G90, G91, M82, M83 says (Marlin)."""
    APART = 2
    """After M83 only (RepRapFirmware)."""


class ArcRule(IntEnum):
    """How G2 and G3 are read."""

    KLIPPER = 0
    MARLIN_2_0 = 1
    MARLIN_2_1 = 2
    REPRAP = 3


class DwellRule(IntEnum):
    """What G4 looks at."""

    P_ONLY = 0
    S_OR_P = 1
    S_OR_P_OR_NOTHING = 2


class OriginRule(IntEnum):
    """What G92 does."""

    BARE_IS_ZERO = 0
    """Moves the origin; without words, to where the tool is (Klipper)."""
    OFFSET = 1
    """Moves the origin; without words nothing (Marlin)."""
    POSITION = 2
    """Tells the machine where its axes are, after a stop (RepRapFirmware)."""
