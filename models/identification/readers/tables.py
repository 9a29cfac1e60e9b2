"""Tables of numbers as text: delimiter, header, rows with their line numbers."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from stillpath.models.arrays import Array
from stillpath.models.errors import ModelError

__all__ = ["MOST_ROWS", "Table", "as_table", "check_size"]

MOST_ROWS = 1_000_000
"""A test of 135 s with a sensor of 6.6 kHz has 900 000 samples; most have half as many."""
_MOST_COMMENTS = 1000
_LONGEST_LINE = 20_000
_LARGEST = 1e30
"""Nothing measured is larger; beyond it, squares and sums would overflow."""


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """Rows of one text file, not yet turned into numbers.

    Attributes
    ----------
    names : tuple of str
        Column names in lower case; empty if the file has no header.
    rows, lines : list
        The text of each row, and its line number from 1.
    delimiter : str or None
        None: white space.
    comments : tuple of str
        Lines that begin with # and are not the header.
    first_line : str
        For messages.
    """

    source: str
    names: tuple[str, ...]
    rows: list[str]
    lines: list[int]
    delimiter: str | None
    comments: tuple[str, ...] = ()
    first_line: str = ""
    notes: tuple[str, ...] = field(default=())

    def index(self, column: str | int) -> int:
        """Return the position of a column, which may be told by its number (also as a text).

        Raises
        ------
        ModelError
            If there is none.
        """
        if isinstance(column, str) and column.lower() in self.names:
            return self.names.index(column.lower())
        if isinstance(column, str) and not column.isdecimal():
            listed = ", ".join(self.names) or "none named"
            raise ModelError(
                f"{self.source}: column {column!r} is missing; there are: {listed:.300}"
            )
        width = len(self.names) or (len(self.split(self.rows[0])) if self.rows else 0)
        if int(column) < width:
            return int(column)
        raise ModelError(f"{self.source}: no column {column}, counted from 0; it has {width}")

    def numbers(self, columns: Sequence[str | int]) -> Array:
        """Return the columns as numbers, shape (rows, columns).

        Raises
        ------
        ModelError
            Naming the line of the first row that is too short, not a number or not finite.
        """
        wanted = [self.index(column) for column in columns]
        self._check_widths()
        try:
            values = np.loadtxt(
                self.rows, delimiter=self.delimiter, usecols=wanted, ndmin=2, comments=None
            )
        except (ValueError, IndexError):
            raise self._first_bad(wanted) from None
        if values.size and not np.abs(values).max() < _LARGEST:
            raise self._first_bad(wanted)
        return values

    def texts(self, column: str | int) -> list[str]:
        """Return a column as it stands, without the blanks around."""
        at = self.index(column)
        self._check_widths()
        return [self.split(row)[at].strip() for row in self.rows]

    def split(self, row: str) -> list[str]:
        """Return the fields of a row."""
        return row.split(self.delimiter)

    def without_last(self, note: str) -> Table:
        """Return the table without its last row, which the note explains."""
        return replace(self, rows=self.rows[:-1], lines=self.lines[:-1], notes=(*self.notes, note))

    def picked(self, rows: NDArray[np.intp]) -> Table:
        """Return the table of the rows at the given positions."""
        return replace(self, rows=[self.rows[i] for i in rows], lines=[self.lines[i] for i in rows])

    def at(self, row: int, text: str) -> ModelError:
        """Return an error at a row."""
        return ModelError(f"{self.source}, line {self.lines[row]}: {text}")

    def _check_widths(self) -> None:
        if not self.rows:
            raise ModelError(f"{self.source}: there is a header but no row of numbers")
        expected = len(self.names) or len(self.split(self.rows[0]))
        for i, row in enumerate(self.rows):
            width = len(row.split()) if self.delimiter is None else row.count(self.delimiter) + 1
            if width != expected:
                raise self.at(
                    i, f"{width} fields where {expected} are expected; remove or complete the line"
                )

    def _first_bad(self, wanted: Sequence[int]) -> ModelError:
        for i, row in enumerate(self.rows):
            fields = self.split(row)
            for column in wanted:
                value = _number(fields[column])
                if value is None or not abs(value) < _LARGEST:
                    name = self.names[column] if self.names else f"column {column}"
                    remedy = "remove the line or measure again"
                    if "," in fields[column]:
                        remedy = "decimal commas are not read: export the file with points"
                    return self.at(
                        i,
                        f"{name} is {fields[column].strip()!r:.60}, not a finite number; {remedy}",
                    )
        return ModelError(f"{self.source}: the rows cannot be read as numbers")


def check_size(content: bytes, source: str) -> None:
    """Raise ModelError if a text has more lines than anything measured, or longer ones.

    What is refused here costs nothing; what is read takes memory and time in proportion.
    """
    lines = max(content.count(b"\n"), content.count(b"\r"))
    if lines > MOST_ROWS + _MOST_COMMENTS:
        raise ModelError(
            f"{source}: {lines} lines, at most {MOST_ROWS} samples are read: a resonance test of "
            "135 s has 432000 at 3200 Hz; cut the file to the test, or record with a lower rate"
        )
    at = 0
    while at + _LONGEST_LINE < len(content):
        end = max(content.rfind(mark, at, at + _LONGEST_LINE) for mark in (b"\n", b"\r"))
        if end < 0:
            line = content.count(b"\n", 0, at) + 1
            raise ModelError(
                f"{source}, line {line}: longer than {_LONGEST_LINE} characters, the limit; export "
                "the file again, a row for each sample"
            )
        at = end + 1


def as_table(text: str, source: str) -> Table:
    """Find delimiter, header and rows of a text.

    The header is the first line that is neither a comment nor numbers, otherwise the last
    comment above the rows that has as many fields as they. A last line that was cut off in
    writing is left out, with a note.
    """
    listed = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    # Of a million lines every list counts: only the places of rows, and the rows.
    lines = [
        i for i, line in enumerate(listed, 1) if line and line[0] != "#" and not line.isspace()
    ]
    rows = [listed[i - 1] for i in lines]
    comments = [line for line in listed if line.startswith("#")]
    first = next((line for line in listed if line and not line.isspace()), "")
    header = ""
    if rows and not _numeric_start(rows[0]):
        header = rows.pop(0)
        lines.pop(0)
    if rows and '"' in rows[0]:
        # A spreadsheet may quote every field.
        rows = [row.replace('"', "") for row in rows]
    delimiter = _delimiter(rows[0] if rows else header)
    if delimiter == "," and "," not in header:
        # Commas within numbers: the header tells what is between them.
        width = len(rows[0].split(";")) if rows else 0
        delimiter = _delimiter(header or _commented_header(comments, ";", width)) or delimiter
    if not header and rows:
        header = _commented_header(comments, delimiter, len(rows[0].split(delimiter)))
    table = Table(
        source=source,
        names=_names(header, delimiter),
        rows=rows,
        lines=lines,
        delimiter=delimiter,
        comments=tuple(line for line in comments if line != header),
        first_line=first,
    )
    return table if not listed[-1] else _without_cut_line(table)


def _numeric_start(line: str) -> bool:
    for delimiter in (",", ";", None):
        fields = line.split(delimiter)
        if fields and _number(fields[0]) is not None:
            return True
    return False


def _delimiter(line: str) -> str | None:
    return next((mark for mark in (",", ";", "\t") if mark in line), None)


def _commented_header(comments: list[str], delimiter: str | None, width: int) -> str:
    for line in reversed(comments):
        if not line.startswith("##") and len(_names(line, delimiter)) == width:
            return line
    return ""


def _names(header: str, delimiter: str | None) -> tuple[str, ...]:
    text = header.lstrip("#").strip()
    if not text:
        return ()
    if delimiter is None:
        return tuple(text.lower().split())
    try:
        fields = next(csv.reader([text], delimiter=delimiter))
    except csv.Error:
        fields = text.split(delimiter)
    # A spreadsheet may have put the whole name in quotes: "#time".
    return tuple(name.strip().lstrip("#").lower() for name in fields)


def _without_cut_line(table: Table) -> Table:
    """Leave out a last line without line end if it is shorter than the others."""
    if len(table.rows) < 3 or table.rows[-1][:1].isalpha():
        return table
    earlier, before, last = (table.split(row) for row in table.rows[-3:])
    short = len(last) < len(before) or (
        _number(last[-1]) is None and _number(before[-1]) is not None
    )
    same = _decimals(earlier[-1]) == _decimals(before[-1])
    if short or (same and _decimals(last[-1]) < _decimals(before[-1])):
        return table.without_last(f"line {table.lines[-1]}, the last, is cut off and left out")
    return table


def _decimals(number: str) -> int:
    return len(number.strip().partition(".")[2])


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None
