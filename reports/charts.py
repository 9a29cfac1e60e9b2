"""Line charts as SVG text: bands, lines with their names at their ends, two scales, marks."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from html import escape

__all__ = ["Band", "Chart", "Figure", "Line", "Mark", "captioned", "draw"]

Values = Sequence[float | None]

_LEFT, _TOP = 50.0, 14.0
_LINE = 15.0
"""Distance between two lines of text."""
_CHARACTER = 6.8
_END_GAP = 18.0


@dataclass(frozen=True, slots=True)
class Line:
    """A line; `style` are its CSS classes, `name` stands at its end. None leaves a gap."""

    x: Sequence[float]
    y: Values
    style: str
    name: str = ""


@dataclass(frozen=True, slots=True)
class Band:
    """What lies between two lines, filled; it stands behind all lines."""

    x: Sequence[float]
    low: Sequence[float]
    high: Sequence[float]
    style: str


@dataclass(frozen=True, slots=True)
class Mark:
    """A vertical line with a word on top."""

    x: float
    text: str


@dataclass(frozen=True, slots=True)
class Chart:
    """What is drawn.

    Attributes
    ----------
    about : str
        For those who cannot see it.
    tick : callable
        Text of a number on the x axis; a second line after a line break.
    log, log_x : bool
        Logarithmic y axis, where values that are not positive leave gaps, and x axis, where all
        values must be positive.
    """

    about: str
    x_title: str
    y_title: str
    lines: Sequence[Line]
    tick: Callable[[float], str] = "{:g}".format
    log: bool = False
    marks: Sequence[Mark] = field(default=())
    log_x: bool = False
    bands: Sequence[Band] = field(default=())


@dataclass(frozen=True, slots=True)
class Figure:
    """A chart with its caption, as SVG: `wide` for a screen, `narrow` for a phone, if any."""

    title: str
    note: str
    wide: str
    narrow: str = ""


def captioned(
    title: str,
    note: str,
    chart: Chart,
    wide: tuple[float, float],
    narrow: tuple[float, float] | None = None,
) -> Figure:
    """Return a chart with its caption, drawn in one or two sizes (width, height)."""
    return Figure(title, note, draw(chart, *wide), "" if narrow is None else draw(chart, *narrow))


def draw(chart: Chart, width: float, height: float) -> str:
    """Return the chart as an SVG element; its text is about 12 units high."""
    names = [line.name for line in chart.lines if line.name]
    right = 10.0 + (_END_GAP + _CHARACTER * max(map(len, names)) if names else 0.0)
    points = [
        [(x, y) for x, y in zip(line.x, line.y, strict=True) if y is not None and _shown(y, chart)]
        for line in chart.lines
    ]
    xs = [x for line in chart.lines for x in line.x] or [0.0, 1.0]
    xs += [x for band in chart.bands for x in band.x]
    ys = [y for line in points for _, y in line] or [1.0]
    ys += [y for band in chart.bands for y in (*band.low, *band.high) if _shown(y, chart)]
    ticks = _log_ticks(min(ys), max(ys)) if chart.log else _ticks(min(0.0, *ys), max(0.0, *ys), 5)
    low, high = (f(f(ticks), f(ys)) for f in (min, max))
    scaled: Callable[[float], float] = math.log10 if chart.log_x else float
    left_end, right_end = scaled(min(xs)), scaled(max(xs))
    x_ticks = _x_ticks(min(xs), max(xs), width - _LEFT - right, log=chart.log_x)
    lower = _TOP + _LINE + (_LINE if chart.marks else 0.0)
    bottom = height - _LINE * (1.6 + max(chart.tick(x).count("\n") + 1 for x in x_ticks))

    def at_x(x: float) -> float:
        share = (scaled(x) - left_end) / ((right_end - left_end) or 1.0)
        return _LEFT + share * (width - _LEFT - right)

    def at_y(y: float) -> float:
        a, b, c = (math.log10(v) for v in (low, y, high)) if chart.log else (low, y, high)
        return bottom - (b - a) / ((c - a) or 1.0) * (bottom - lower)

    out = [
        f'<svg viewBox="0 0 {width:g} {height:g}" role="img" aria-label="{escape(chart.about)}">',
        _text(0, _TOP - 2, chart.y_title, "start"),
        _text((_LEFT + width - right) / 2, height - 3, chart.x_title, "middle"),
    ]
    for y in ticks:
        out.append(_stroke("grid", _LEFT, at_y(y), width - right, at_y(y)))
        out.append(_text(_LEFT - 6, at_y(y) + 4, _number(y), "end"))
    for x in x_ticks:
        for row, part in enumerate(chart.tick(x).split("\n")):
            # The last one must not stick out where nothing is written beside the chart.
            edge = at_x(x) > width - 20
            place = at_x(x) + (10.0 if edge else 0.0)
            anchor = "end" if edge else "middle"
            out.append(_text(place, bottom + _LINE * (1.1 + row), part, anchor))
    for band in chart.bands:
        edges = zip([*band.x, *reversed(band.x)], [*band.high, *reversed(band.low)], strict=True)
        around = "L".join(f"{at_x(x):.1f} {at_y(max(y, low)):.1f}" for x, y in edges)
        out.append(f'<path class="{band.style}" d="M{around}Z"/>')
    for mark in chart.marks:
        out.append(_stroke("mark", at_x(mark.x), lower - 4, at_x(mark.x), bottom))
        side = "start" if at_x(mark.x) < width / 2 else "end"
        out.append(_text(at_x(mark.x), lower - 8, mark.text, side))
    ends = []
    for line, found in zip(chart.lines, points, strict=True):
        gaps = [k for k, y in enumerate(line.y) if y is None or not _shown(y, chart)]
        out.append(f'<path class="{line.style}" d="{_path(line, gaps, at_x, at_y)}"/>')
        if line.name and found:
            ends.append((at_y(found[-1][1]), at_x(found[-1][0]), line))
    out += _named_ends(ends, (lower, bottom), width - right)
    return "".join([*out, "</svg>"])


def _x_ticks(low: float, high: float, width: float, *, log: bool) -> list[float]:
    ticks = _log_ticks(low, high) if log else _ticks(low, high, max(2, int(width / 62)))
    return [x for x in ticks if low <= x <= high]


def _named_ends(
    ends: Sequence[tuple[float, float, Line]], room: tuple[float, float], right: float
) -> Iterator[str]:
    """Yield names beside the ends (y, x) of lines, spread so that all are legible."""
    ends = sorted(ends, key=lambda end: end[0])
    places = _spread([end[0] for end in ends], *room)
    for place, (y, x, line) in zip(places, ends, strict=True):
        yield (
            f'<path class="{line.style} lead" d="M{x:.1f} {y:.1f}L{right + 12:.1f} {place:.1f}"/>'
        )
        yield _text(right + _END_GAP - 3, place + 4, line.name, "start")


def _shown(y: float, chart: Chart) -> bool:
    return math.isfinite(y) and (y > 0 or not chart.log)


def _path(
    line: Line,
    gaps: Sequence[int],
    at_x: Callable[[float], float],
    at_y: Callable[[float], float],
) -> str:
    missing, pen, out = set(gaps), "M", []
    for k, (x, y) in enumerate(zip(line.x, line.y, strict=True)):
        if k in missing or y is None:
            pen = "M"
            continue
        out.append(f"{pen}{at_x(x):.1f} {at_y(y):.1f}")
        pen = "L"
    return "".join(out)


def _spread(places: Sequence[float], top: float, bottom: float) -> list[float]:
    """Move rising places apart to a line of text each, as little as is simple."""
    gap = _LINE - 1
    out: list[float] = []
    for place in places:
        out.append(max(place, out[-1] + gap) if out else max(place, top))
    if out and out[-1] > bottom:
        out[-1] = bottom
        for k in range(len(out) - 2, -1, -1):
            out[k] = min(out[k], out[k + 1] - gap)
    return out


def _ticks(low: float, high: float, count: int) -> list[float]:
    raw = ((high - low) or 1.0) / count
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(f * power for f in (1, 2, 5, 10) if f * power >= raw * (1 - 1e-9))
    return [k * step for k in range(math.floor(low / step), math.ceil(high / step - 1e-9) + 1)]


def _log_ticks(low: float, high: float) -> list[float]:
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
    if last - first <= 4:
        # Few decades: 1, 2, 5 (or 1, 3) of each, from the one below to the one above.
        steps = (1, 2, 5) if last - first <= 3 else (1, 3)
        marks = [f * 10.0**k for k in range(first, last + 1) for f in steps]
        below = max(m for m in marks if m <= low * (1 + 1e-9))
        above = min(m for m in marks if m >= high * (1 - 1e-9))
        return [m for m in marks if below <= m <= above]
    step = math.ceil((last - first) / 7)
    return [10.0**k for k in range(first, last + 1, step)]


def _number(value: float) -> str:
    text = f"{value:g}" if abs(value) < 1e4 else f"{value:.0e}"
    if "e" not in text:
        return text
    mantissa, exponent = text.split("e")
    return f"{mantissa}e{int(exponent)}"


def _text(x: float, y: float, text: str, anchor: str) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'


def _stroke(style: str, x1: float, y1: float, x2: float, y2: float) -> str:
    ends = f'x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"'
    return f'<line class="{style}" {ends}/>'
