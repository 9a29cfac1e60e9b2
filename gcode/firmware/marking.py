"""Keep the mark of a stream in lines of the file that stand where the shaper is off."""

from __future__ import annotations

import numpy as np

from stillpath.gcode.firmware.base import StreamCommands
from stillpath.gcode.pieces import VerbatimPart
from stillpath.gcode.types import EventKind, Limits

__all__ = ["marked_text"]

_LIMITS = (EventKind.LIMITS, EventKind.STATE)


def marked_text(verbatim: VerbatimPart, commands: StreamCommands, marked: Limits | None) -> bytes:
    """Return the text of a part, with the mark set again behind lines that remove it.

    Parameters
    ----------
    marked : Limits, optional
        Limits with the mark; None: it is not in force.
    """
    if marked is None:
        return verbatim.text
    events, parts, done = verbatim.events, [], 0
    for row in np.flatnonzero(np.isin(events.kind, _LIMITS)).tolist():
        line = verbatim.line(events, row)
        if not (line.endswith(b"\n") and commands.unmarks(line)):
            continue
        end = int(events.byte_end[row]) - verbatim.text_offset
        own = verbatim.limits[int(events.limits_id[row])]
        parts += [verbatim.text[done:end], commands.limits(commands.in_stream(own))]
        done = end
    return b"".join([*parts, verbatim.text[done:]])
