"""Times of the print as slicers write them: found in a line, and rewritten in the same form.

Forms: M73 (Marlin 2.1 documentation; P R, and Q S for the silent mode, C D to the next stop:
PrusaSlicer 2.9, `GCodeProcessor.cpp`), and comments as they stand in the output of PrusaSlicer,
SuperSlicer, OrcaSlicer, BambuStudio, Cura (Griffin too), ideaMaker, KISSlicer, Kiri:Moto,
Simplify3D and Snapmaker Luban. Luban's number of lines, by which touch screens show the progress,
is found and rewritten like them.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from enum import Enum

__all__ = ["TimeField", "TimeKind", "may_tell_time", "read_times"]


class TimeKind(Enum):
    """What a time counts."""

    TOTAL = "the whole print"
    FIRST_LAYER = "the first layer"
    ELAPSED = "from the start to here"
    REMAINING = "from here to the end"
    UNTIL_STOP = "from here to the next pause or change of colour"
    PERCENT = "share that is done, in per cent"
    LINES = "lines of the file"


@dataclass(frozen=True, slots=True)
class TimeField:
    """A time in a line.

    Attributes
    ----------
    start, end : int
        Bytes of the line that hold the number or duration.
    seconds : float
        What they say; of `PERCENT` the per cent, of `LINES` their number.
    unit_s : float
        Seconds in one of a plain number.
    silent : bool
        Estimated for the printer's silent mode.
    """

    kind: TimeKind
    start: int
    end: int
    text: bytes
    seconds: float
    unit_s: float
    silent: bool = False

    def written(self, seconds: float) -> bytes:
        """Return another time (or per cent) in the same form: units and decimals stay."""
        seconds = max(seconds, 0.0)
        if words := _IN_WORDS.fullmatch(self.text):
            hours, minutes = divmod(math.floor(seconds / 60.0 + 0.5 + 1e-9), 60)
            return b"%d%b%d%b" % (hours, words[1], minutes, words[2])
        if _SPELLED.fullmatch(self.text):
            return _spelled(seconds, self.text)
        return _rounded(seconds / self.unit_s, self.text)


_SPELLED = re.compile(rb"(?:\d+d ?)?(?:\d+h ?)?(?:\d+m ?)?(?:\d+(?:\.\d+)?s)?(?<=[dhms])")
_IN_WORDS = re.compile(rb"\d+( hours? )\d+( minutes?)")
_PARTS = re.compile(rb"(\d+(?:\.\d+)?) ?([dhms])")
_UNITS_S = {b"d": 86_400.0, b"h": 3600.0, b"m": 60.0, b"s": 1.0}

_VALUE = r"(?P<{}>\d+(?:\.\d+)?(?:[dhms] ?(?:\d+(?:\.\d+)?[hms] ?)*(?<=[dhms]))?)"
_END = r"\s*$"
_COMMENTS: tuple[tuple[re.Pattern[bytes], float], ...] = tuple(
    (re.compile((pattern.format(*[_VALUE.format(k) for k in kinds]) + _END).encode()), unit_s)
    for pattern, unit_s, *kinds in (
        (r"(?:; ?)?estimated printing time(?: \((?P<mode>\w+) mode\))? ?= ?{}", 1.0, "total"),
        (
            r"(?:; ?)?estimated first layer printing time(?: \((?P<mode>\w+) mode\))? ?= ?{}",
            1.0,
            "first_layer",
        ),
        (r"; ?model printing time: {}; total estimated time: {}", 1.0, "model", "total"),
        (r"; ?total estimated time: {}", 1.0, "total"),
        (r";TIME: ?{}", 1.0, "total"),
        (r";PRINT\.TIME: ?{}", 1.0, "total"),
        (r";TIME_ELAPSED: ?{}", 1.0, "elapsed"),
        (r";Print Time: ?{}", 1.0, "total"),
        (r";PRINTING_TIME: ?{}", 1.0, "elapsed"),
        (r";REMAINING_TIME: ?{}", 1.0, "remaining"),
        (r"; ?Calculated-during-export Build Time: +{} minutes", 60.0, "total"),
        (r"; ?Estimated-in-GUI Build Time: +{} minutes", 60.0, "total"),
        (r"; --- print time: (?P<total>\d+(?:\.\d+)?)s ---", 1.0),
        (r"; ?estimated_time\(s\): ?{}", 1.0, "total"),
        (r";   Build [Tt]ime: (?P<total>\d+ hours? \d+ minutes?)", 1.0),
        (r";file_total_lines: ?(?P<lines>\d+)", 1.0),
    )
)
_KINDS = {
    "total": TimeKind.TOTAL,
    "model": TimeKind.TOTAL,
    "first_layer": TimeKind.FIRST_LAYER,
    "elapsed": TimeKind.ELAPSED,
    "remaining": TimeKind.REMAINING,
    "lines": TimeKind.LINES,
}
_PROGRESS = re.compile(rb"\s*M73(?![\d.])([^;*\n]*)(?:;.*)?\s*$")
_WORD = re.compile(rb"([PRQSCD])\s*(\d+(?:\.\d+)?)")
_WORDS = {
    b"P": (TimeKind.PERCENT, 1.0, False),
    b"R": (TimeKind.REMAINING, 60.0, False),
    b"Q": (TimeKind.PERCENT, 1.0, True),
    b"S": (TimeKind.REMAINING, 60.0, True),
    b"C": (TimeKind.UNTIL_STOP, 60.0, False),
    b"D": (TimeKind.UNTIL_STOP, 60.0, True),
}
_FIRST = frozenset(b"TPRemfCEB-")
_LONGEST = 200


def may_tell_time(line: bytes) -> bool:
    """Return, at low cost, whether a line may contain times for `read_times`."""
    if line.startswith(b"M73"):
        return True
    if not line.startswith(b";"):
        return line[:1] in b" \t"
    first = line[1:5].lstrip(b" ")
    return bool(first) and first[0] in _FIRST


def read_times(line: bytes) -> list[TimeField]:
    """Return the times in a line, in order; most lines have none.

    A line with a checksum is left alone: its time could not be changed by itself.
    """
    if len(line) > _LONGEST:
        return []
    progress = _PROGRESS.match(line)
    if progress is not None:
        found = []
        for word in _WORD.finditer(progress[1]):
            kind, unit_s, silent = _WORDS[word[1]]
            start = progress.start(1) + word.start(2)
            value = float(word[2]) * unit_s
            end = start + len(word[2])
            found.append(TimeField(kind, start, end, word[2], value, unit_s, silent))
        return found
    for pattern, unit_s in _COMMENTS:
        match = pattern.match(line)
        if match is not None:
            return [
                TimeField(
                    kind=_KINDS[name],
                    start=match.start(name),
                    end=match.end(name),
                    text=match[name],
                    seconds=_seconds(match[name], unit_s),
                    unit_s=unit_s,
                    silent=match.groupdict().get("mode") == b"silent",
                )
                for name in sorted(set(pattern.groupindex) - {"mode"}, key=match.start)
            ]
    return []


def _seconds(text: bytes, unit_s: float) -> float:
    parts = _PARTS.findall(text)
    if not parts:
        return float(text) * unit_s
    return math.fsum(float(number) * _UNITS_S[unit] for number, unit in parts)


def _rounded(value: float, like: bytes) -> bytes:
    """Write a number with as many decimals as another; halves up."""
    decimals = len(like.partition(b".")[2])
    scaled = math.floor(value * 10**decimals + 0.5 + 1e-9)
    return f"{scaled / 10**decimals:.{decimals}f}".encode()


def _spelled(seconds: float, like: bytes) -> bytes:
    """Format a duration like another one: from the largest nonzero unit to its smallest."""
    parts = _PARTS.findall(like)
    last, smallest = parts[-1]
    gap = b" " if b" " in like or len(parts) == 1 else b""
    unit_s = _UNITS_S[smallest]
    rest = float(_rounded(seconds / unit_s, last)) * unit_s
    written: list[bytes] = []
    for unit, in_s in _UNITS_S.items():
        if unit == smallest:
            written.append(_rounded(rest / in_s, last) + unit)
            break
        count = math.floor(rest / in_s + 1e-9)
        rest -= count * in_s
        if count or written:
            written.append(b"%d%s" % (count, unit))
    return gap.join(written)
