"""Summary of a batch: a table on the terminal, summary.json, .csv and .html."""

from __future__ import annotations

import csv
import io
import json
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from stillpath.cli.batch.output import Outcome

__all__ = ["counted", "print_summary", "write_summary"]

_COLUMNS = (
    "source", "machine", "machine_revision", "state", "output", "report", "before_um", "shaper_um",
    "after_um", "original_s", "written_s", "put_back", "warnings", "error",
)  # fmt: skip
_FORMULA = ("=", "+", "-", "@", "\t", "\r")


def write_summary(outcomes: Sequence[Outcome], root: Path) -> None:
    """Write summary.json, summary.csv and summary.html, each whole or not at all.

    Raises
    ------
    OSError
    """
    from stillpath.reports.pages import rendered, style_of, write_texts

    package = "stillpath.cli.batch"
    rows = [_row(outcome) for outcome in outcomes]
    page = rendered(
        package,
        "summary.html.j2",
        style_of((package, "summary.css")),
        {"um": _um, "link": quote, "change": _change, "count": _count},
        outcomes=outcomes,
        counted=counted(outcomes),
        failed=[outcome for outcome in outcomes if outcome.state == "failed"],
    )
    document = {"counts": Counter(outcome.state for outcome in outcomes), "files": rows}
    texts = {
        "summary.json": json.dumps(document, indent=1, ensure_ascii=False) + "\n",
        "summary.csv": _csv(rows),
        "summary.html": page,
    }
    write_texts(root, texts)


def print_summary(outcomes: Sequence[Outcome]) -> None:
    """Print one line for each file, and how many there were of each kind."""
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    table.add_column("file", overflow="fold")
    table.add_column("machine")
    for name in ("before, µm", "shaper, µm", "after, µm", "time"):
        table.add_column(name, justify="right")
    table.add_column("", overflow="fold")
    for outcome in outcomes:
        figures = outcome.figures
        table.add_row(
            Path(outcome.source).name,
            outcome.machine,
            _um(figures.before_um),
            _um(figures.shaper_um),
            _um(figures.after_um),
            _change(outcome),
            outcome.error or outcome.state,
        )
    # A file, a log, has no width: there a row is a line.
    width = None if sys.stdout.isatty() else 200
    console = Console(highlight=False, markup=False, width=width)
    console.print(table)
    console.print(counted(outcomes))


def counted(outcomes: Sequence[Outcome]) -> str:
    """Return how many were done, done before, and failed."""
    counts = Counter(outcome.state for outcome in outcomes)
    parts = [f"{counts[state]} {state}" for state in ("done", "done before", "failed")]
    return ", ".join(part for part in parts if not part.startswith("0 ")) or "nothing to do"


def _row(outcome: Outcome) -> dict[str, Any]:
    values = {**outcome.model_dump(), **outcome.figures.model_dump()}
    return {name: values[name] for name in _COLUMNS}


def _csv(rows: Sequence[dict[str, Any]]) -> str:
    text = io.StringIO(newline="")
    table = csv.DictWriter(text, _COLUMNS, lineterminator="\n")
    table.writeheader()
    for row in rows:
        cells = row | {"warnings": " | ".join(row["warnings"])}
        table.writerow({name: _cell(value) for name, value in cells.items()})
    return text.getvalue()


def _cell(value: Any) -> Any:
    """Keep spreadsheets from taking a file's name for a formula."""
    return f"'{value}" if isinstance(value, str) and value.startswith(_FORMULA) else value


def _um(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"


def _change(outcome: Outcome) -> str:
    before, after = outcome.figures.original_s, outcome.figures.written_s
    return "" if not before or after is None else f"{100 * (after / before - 1):+.2f} %"


def _count(number: int | None) -> str:
    return "" if number is None else str(number)
