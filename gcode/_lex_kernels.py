"""The kernel that reads lines.

One call of `run` walks over whole lines of a buffer and writes rows of moves and events. It stops
early with a status when a line needs Python (`HANDBACK`), when the output is full (`FULL`), when
a table must grow (`GROW`) or when the line is an error.

The last line of the buffer must be followed by `PADDING` bytes that begin with a newline.

Passing rows and tables is costly (a hundred numbers), so functions called for every tenth line
(`plain`, `recall`) are inlined.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from stillpath.gcode._command_kernels import execute
from stillpath.gcode._motion_kernels import move
from stillpath.gcode._plain_kernels import decimal, line_end, may_be_mark, plain
from stillpath.gcode._slots import (
    DONE,
    F_UNIT_MM,
    FULL,
    GROW,
    HANDBACK,
    I_E_RULE,
    I_END,
    I_EVENTS,
    I_EXPONENTS,
    I_FEATURE,
    I_FIRST_WINS,
    I_FOLD_CASE,
    I_HOLD,
    I_KNOWN,
    I_LAYER,
    I_LINE,
    I_LONGEST,
    I_MACROS,
    I_MODAL_WORDS,
    I_MOTION,
    I_MOVES,
    I_N_LIMITS,
    I_N_MODAL,
    I_NEED,
    I_OBJECT,
    I_OBJECTS,
    I_ODD_WORDS,
    I_ONE_COMMAND,
    I_PLAIN,
    I_POS,
    MEMO_EVENT,
    MEMO_FEATURE,
    MEMO_LAYER,
    MEMO_LIMITS,
    MEMO_OBJECT,
    MEMO_STRIDE,
    OK,
    Action,
)
from stillpath.gcode._table_kernels import (
    line_hash,
    memo_slot,
    put_event,
    recall_limits,
    settle,
    settle_limits,
)
from stillpath.models.bytes import byte_at
from stillpath.models.jit import kernel

__all__ = ["PADDING", "run"]

PADDING = 32
_HARMLESS, _LIMITS, _UNKNOWN, _OBJECT = 0, 2, 4, 5
_POWERS = 10.0 ** np.arange(23)
_MOVE, _LAST_MOVE = int(Action.MOVE), int(Action.ARC_CCW)  # G0 and G1, then G2, then G3


@kernel(force_inline=True, allocates=False)
def recall(buf: Any, start: int, stop: int, f: Any, i: Any, rows: Any, tables: Any) -> int:
    """Repeat the remembered effect of a line; HANDBACK if there is none."""
    slot = memo_slot(tables.memo_keys, line_hash(buf, start, stop))
    if tables.memo_keys[slot] == 0:
        return HANDBACK
    what = tables.memo_values[slot] // MEMO_STRIDE
    value = tables.memo_values[slot] % MEMO_STRIDE
    kind = _HARMLESS
    if what == MEMO_LIMITS:
        if f[F_UNIT_MM] != 1.0:
            return HANDBACK
        kind = _LIMITS
        recall_limits(value, f, i, rows, tables)
    elif what == MEMO_EVENT and value != _UNKNOWN:
        kind = value
    else:
        settle(f, i, rows)
        if what == MEMO_EVENT:
            kind = _UNKNOWN
            i[I_KNOWN] = 0
            i[I_MACROS] += 1
        elif what == MEMO_LAYER:
            i[I_LAYER] += 1
        elif what == MEMO_FEATURE:
            i[I_FEATURE] = value - 1
        elif what == MEMO_OBJECT:
            changed = i[I_OBJECT] != value - 1 and i[I_OBJECTS] > 1
            kind = _OBJECT if changed else _HARMLESS
            i[I_OBJECT] = value - 1
        else:
            i[I_OBJECT] = value - 1
            kind = _OBJECT
    put_event(i, rows, kind)
    return OK


@kernel(allocates=False)
def run(buf: Any, stop: int, f: Any, i: Any, w: Any, rows: Any, tables: Any) -> int:
    """Interpret the lines of ``buf[i[I_POS]:stop]``; the last one may lack its newline.

    Returns
    -------
    int
        DONE at the end of the buffer, or why the line at I_POS could not be finished.
    """
    while i[I_POS] < stop:
        if i[I_PLAIN]:
            plain(buf, stop, f, i, rows, tables.m_words)
            if i[I_POS] >= stop:
                break
        if max(i[I_MOVES], i[I_EVENTS]) + 1 > rows.whole.shape[1]:
            i[I_NEED] = 1
            return FULL
        if i[I_N_MODAL] + 2 > len(tables.modal) or i[I_N_LIMITS] + 2 > len(tables.limits):
            return GROW
        if i[I_LAYER] + 2 > len(tables.layer_z):
            return GROW
        begin = i[I_POS]
        p = begin
        # The command letter, after blanks and an N word.
        while buf[p] == 32 or buf[p] == 9 or buf[p] == 13:
            p += 1
        numbered = buf[p] == 78 or (buf[p] == 110 and i[I_FOLD_CASE] != 0)
        if numbered and (buf[p + 1] == 32 or 48 <= buf[p + 1] <= 57):
            p += 1
            while buf[p] == 32 or 48 <= buf[p] <= 57:
                p += 1
        if buf[p] == 10:
            i[I_END] = min(p + 1, stop)
            put_event(i, rows, _HARMLESS)
        elif buf[p] == 59:
            start = p
            p = line_end(buf, p)
            i[I_END] = min(p + 1, stop)
            if byte_at(buf, start + 1) == 90 and byte_at(buf, start + 2) == 58:
                z, next_at = decimal(buf, start + 3)
                if next_at < 0 or next_at != p or i[I_LAYER] < 0:
                    return HANDBACK
                tables.layer_z[i[I_LAYER]] = z
                put_event(i, rows, _HARMLESS)
            elif may_be_mark(buf, start + 1):
                status = recall(buf, start, p, f, i, rows, tables)
                if status != OK:
                    return status
            else:
                put_event(i, rows, _HARMLESS)
        elif i[I_HOLD]:
            i[I_END] = min(line_end(buf, p) + 1, stop)
            return HANDBACK
        else:
            first = p
            letter = buf[p] & 0xDF
            good = i[I_FOLD_CASE] != 0 or buf[p] == letter
            p += 1
            number = 0
            digits = 0
            while 48 <= buf[p] <= 57 and digits < 5:
                number = number * 10 + (buf[p] - 48)
                digits += 1
                p += 1
            # Klipper knows no G01.
            zero_led = digits > 1 and buf[p - digits] == 48 and i[I_E_RULE] == 0
            known = digits > 0 and not zero_led and number < 1024 and buf[p] != 46
            action = -1
            if known and letter == 71:
                action = int(tables.g_words[number])
            elif known and letter == 77:
                action = int(tables.m_words[number])
            elif i[I_MODAL_WORDS] and 88 <= letter <= 90 and i[I_MOTION] >= 0:
                action = _MOVE + max(0, i[I_MOTION] - 1)
                p = first
            good = good and action >= 0
            # Words: single letters with plain decimal numbers; anything else is for Python.
            mask = 0
            tail = p
            while good:
                while buf[p] == 32 or buf[p] == 9 or buf[p] == 13:
                    p += 1
                tail = p
                if buf[p] == 10:
                    break
                if buf[p] == 59:
                    p = line_end(buf, p)
                    break
                key = (buf[p] & 0xDF) - 65 if buf[p] >= 65 else -1
                if buf[p] >= 97 and not i[I_FOLD_CASE]:
                    key = -1
                if buf[p] == 42 and i[I_ONE_COMMAND]:
                    key = 26
                if key < 0 or key > 26 or (key == 26 and buf[p] != 42):
                    good = False
                    break
                if (key == 6 or key == 12) and not i[I_ONE_COMMAND]:
                    good = False
                    break
                if key == 4 and i[I_EXPONENTS] and 48 <= buf[p - 1] <= 57:
                    good = False
                    break
                p += 1
                while buf[p] == 32 or buf[p] == 9 or buf[p] == 13:
                    p += 1
                negative = False
                if buf[p] == 45 or buf[p] == 43:
                    negative = buf[p] == 45
                    p += 1
                mantissa = 0
                seen = 0
                fraction = 0
                dot = False
                while True:
                    c = buf[p]
                    if 48 <= c <= 57:
                        mantissa = mantissa * 10 + (c - 48)
                        seen += 1
                        if dot:
                            fraction += 1
                    elif c == 46 and not dot:
                        dot = True
                    else:
                        break
                    p += 1
                    if seen > 15:
                        break
                # Up to 15 digits the quotient of two exact doubles is the nearest double.
                if seen == 0 or seen > 15:
                    good = False
                    break
                value = mantissa / _POWERS[fraction]
                if key < 26 and not (i[I_FIRST_WINS] and mask & (1 << key)):
                    w[key] = -value if negative else value
                    mask |= 1 << key
            if not good or tail - begin > i[I_LONGEST]:
                p = line_end(buf, first)
                i[I_END] = min(p + 1, stop)
                if action >= _MOVE:
                    return HANDBACK
                status = recall(buf, first, p, f, i, rows, tables)
                if status != OK:
                    return status
            else:
                i[I_END] = min(p + 1, stop)
                if _MOVE <= action <= _LAST_MOVE:
                    if mask & i[I_ODD_WORDS]:
                        return HANDBACK
                    i[I_MOTION] = action - _MOVE + 1 if action > _MOVE else 1
                if action == _MOVE:
                    status = move(w, mask, f, i, rows)
                else:
                    status = execute(action, w, mask, f, i, rows, tables)
                if status != OK:
                    return status
        i[I_POS] = i[I_END]
        i[I_LINE] += 1
    settle(f, i, rows)
    settle_limits(i, rows)
    return DONE
