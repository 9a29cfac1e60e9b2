"""Make docs/benchmarks.md, and the figures of README.md, from benchmarks/results/*.json.

Each file there is one table of one benchmark: what it asks, the command that printed it, the date
and the code, the columns with units, the rows, and what they mean. After a new run change the file
and run this script; `--check` changes nothing and ends with 1 if a page is not what would be
written. The fields of a file are those of `Result`.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from statistics import geometric_mean

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
PAGE = ROOT / "docs" / "benchmarks.md"
README = ROOT / "README.md"
BEGIN, END = "<!-- FIGURES: made by benchmarks/page.py -->", "<!-- END FIGURES -->"

SECTIONS = (
    "The closed chain",
    "Written files",
    "Interrupted prints",
    "Design",
    "Speed budget",
    "Without changing a move",
    "Print times",
    "Speed and memory",
    "Hostile input",
    "Service",
    "Published numbers",
)
"""Sections of the page, in order."""

HEAD = """\
# Benchmarks

<!-- Made by benchmarks/page.py from benchmarks/results/*.json: change those, then run it. -->

Every table comes from a script in `benchmarks/`. Run it from the root of a checkout with the
package installed; `--help` lists its options. Shared data is found under `$STILLPATH_SHARED`,
`--shared` or `../shared`; any G-code file (also `.gz`) and any machine's JSON document can be given
instead. A table may show only some of its rows; `benchmarks/results/` has them all, as data.

**No figure here was measured on a printer yet.** The first section counts most: plants
that the design has not seen. What did not work is on [a page of its own](tried.md).

Other figures are on the pages of their subjects: [identified models](identification.md#figures),
[proof prints](proof.md#the-coupon), [a bed that grows heavier](scheduling.md), [ripple](ripple.md),
[containers](containers.md), [Marlin](marlin.md), [RepRapFirmware](reprapfirmware.md),
[the filter inside Klipper](klipper-live.md#the-filter), and
[lines that ask the host something during motion](emission.md#klipper).
"""

Cell = str | int | float | None


@dataclass(frozen=True)
class Column:
    """One column: its name, its unit, and decimals if all rows shall have the same number."""

    name: str
    unit: str = ""
    digits: int | None = None

    def head(self) -> str:
        return f"{self.name}, {self.unit}" if self.unit else self.name

    def cell(self, value: Cell) -> str:
        if value is None:
            return ""
        if isinstance(value, int | float) and self.digits is not None:
            return f"{value:.{self.digits}f}"
        return str(value).replace("|", "\\|")


@dataclass(frozen=True)
class Result:
    """One table of one benchmark.

    `show` names, for some columns, the values of the rows that the page shows. `code` is the
    commit, or what is known of it. `order` is the place within `section`. `means` and
    `falls_short` are paragraphs; in a file a single one may be a string.
    """

    title: str
    section: str
    order: int
    asks: str
    script: str
    command: str
    date: str
    code: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]
    means: tuple[str, ...]
    show: dict[str, list[Cell]] = field(default_factory=dict)
    falls_short: tuple[str, ...] = ()
    name: str = ""

    def column(self, head: str) -> int:
        """Return the index of the first column with this name or head."""
        for k, column in enumerate(self.columns):
            if head in (column.name, column.head()):
                return k
        raise ValueError(f"{self.name}.json: there is no column {head!r}")

    def shown(self) -> list[tuple[Cell, ...]]:
        """Return the rows that the page shows."""
        chosen = [(self.column(head), values) for head, values in self.show.items()]
        return [row for row in self.rows if all(row[k] in values for k, values in chosen)]


def read(path: Path) -> Result:
    """Return the result in a file; raise ValueError, which names file and field."""
    data = json.loads(path.read_text(encoding="utf-8"))
    known = {f.name for f in fields(Result)} - {"name"}
    needed = known - {"show", "falls_short"}
    if set(data) - known or needed - set(data):
        raise ValueError(
            f"{path.name}: unknown fields {sorted(set(data) - known)}, "
            f"missing fields {sorted(needed - set(data))}"
        )
    if data["section"] not in SECTIONS:
        raise ValueError(f"{path.name}: section {data['section']!r} is none of {SECTIONS}")
    for key in ("means", "falls_short"):
        text = data.get(key, [])
        data[key] = (text,) if isinstance(text, str) else tuple(text)
    data["columns"] = tuple(Column(**column) for column in data["columns"])
    data["rows"] = tuple(tuple(row) for row in data["rows"])
    for number, row in enumerate(data["rows"], 1):
        if len(row) != len(data["columns"]):
            raise ValueError(
                f"{path.name}: row {number} has {len(row)} cells, not {len(data['columns'])}"
            )
    return Result(**data, name=path.stem)


def read_all() -> list[Result]:
    """Return all results in the order of the page."""
    found = [read(path) for path in sorted(RESULTS.glob("*.json"))]
    return sorted(found, key=lambda r: (SECTIONS.index(r.section), r.order, r.name))


def table(columns: Sequence[Column], rows: Sequence[Sequence[Cell]]) -> str:
    """Return a Markdown table."""
    lines = [" | ".join(column.head() for column in columns), "|".join("---" for _ in columns)]
    lines += [
        " | ".join(c.cell(value) for c, value in zip(columns, row, strict=True)) for row in rows
    ]
    head, rule, *body = lines
    return "\n".join([f"| {head} |", f"|{rule}|", *(f"| {line} |" for line in body)])


def described(result: Result) -> str:
    """Return one result as it stands on the page."""
    rows = result.shown()
    code = "" if result.code.startswith(result.date) else f", code {result.code}"
    ran = f"`{result.command}` ({result.date}{code})."
    if len(rows) < len(result.rows):
        ran += f" {len(rows)} of {len(result.rows)} rows, from `results/{result.name}.json`:"
    parts = [f"### {result.title}", result.asks, ran, table(result.columns, rows), *result.means]
    if len(result.falls_short) == 1:
        parts.append(f"**Falls short.** {result.falls_short[0]}")
    elif result.falls_short:
        parts.append("**Falls short.**")
        parts.append("\n".join(f"- {text}" for text in result.falls_short))
    return "\n\n".join(parts)


def page(results: Sequence[Result]) -> str:
    """Return docs/benchmarks.md."""
    parts = [HEAD.rstrip()]
    for section in SECTIONS:
        parts.append(f"## {section}")
        parts += [described(result) for result in results if result.section == section]
    return "\n\n".join(parts) + "\n"


def readme_figures(results: Sequence[Result]) -> str:
    """Return what stands in README.md between the marks: the twins and the virtual printers."""
    by_name = {result.name: result for result in results}
    twins, others, chain = (by_name[name] for name in ("twins", "other_twins", "closed_chain"))
    ratios = [
        float(str(row[k]))
        for row in twins.rows
        for k, column in enumerate(twins.columns)
        if column.unit == "× best shaper"
    ]
    mean = geometric_mean(ratios)
    worse = [ratio for ratio in ratios if ratio > 1.01]

    def said(row: int, head: str) -> str:
        return f"{chain.rows[row][chain.column(head)]:.2f}"

    def goal(row: int) -> str:
        return f"{chain.rows[row][chain.column('goal')]}"

    mean_head, worst_head = "geometric mean, × shaper", "worst, × shaper"
    beaten = (
        f"Geometric mean of the {len(ratios)} ratios: {mean:.2f}. In {len(worse)} of them the "
        f"shaper is better by more than 1 %, by {100 * (max(ratios) - 1):.0f} % at most."
    )
    head = next(c.head() for c in others.columns if c.unit == "× best shaper")
    elsewhere = [float(str(row[others.column(head)])) for row in others.rows]
    head = next(c.head() for c in others.columns if c.unit == "× recommended shaper")
    recommended = [float(str(row[others.column(head)])) for row in others.rows]
    more = (
        f"**On {len(elsewhere)} plants fitted to other tables** of such printers: "
        f"{geometric_mean(recommended):.2f} of the error with the shapers\nthat Klipper's rules "
        f"recommend from those tables (worst {max(recommended):.2f}), and "
        f"{geometric_mean(elsewhere):.2f} of that with the best shaper."
    )
    virtual = (
        "**On virtual printers** (motors, belts, dry friction, frames; measured, identified, "
        "compensated, printed),\nagainst the shaper that Klipper's rules recommend: from resonance "
        f"tables {said(0, mean_head)} of its error\n(geometric mean; worst {said(0, worst_head)}) "
        f"and at most {said(0, 'worst, × none')} of the error without compensation; "
        f"from raw logs\n{said(2, mean_head)} of the shaper's (worst {said(2, worst_head)}). "
        f"The goals for the mean were {goal(0)} and {goal(2)}:\n"
        "[what falls short, and why](docs/benchmarks.md#the-closed-chain)."
    )
    return "\n\n".join([table(twins.columns, twins.rows), beaten, more, virtual])


def with_figures(readme: str, figures: str) -> str:
    """Return README.md with these figures between its marks."""
    head, begin, rest = readme.partition(BEGIN)
    _, end, tail = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"README.md: the marks {BEGIN} and {END} are not both there")
    return f"{head}{BEGIN}\n{figures}\n{END}{tail}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Write both pages, or check them."""
    parser = argparse.ArgumentParser(description=str(__doc__).split("\n\n")[0])
    parser.add_argument("--check", action="store_true", help="change nothing; 1 if a page differs")
    check = parser.parse_args(arguments).check
    results = read_all()
    readme = README.read_text(encoding="utf-8")
    wanted = {PAGE: page(results), README: with_figures(readme, readme_figures(results))}
    status = 0
    for path, text in wanted.items():
        if path.is_file() and path.read_text(encoding="utf-8") == text:
            continue
        if check:
            name = path.relative_to(ROOT)
            print(
                f"{name} is not what benchmarks/page.py makes of the results: run it",
                file=sys.stderr,
            )
            status = 1
        else:
            path.write_text(text, encoding="utf-8")
    return status


if __name__ == "__main__":
    sys.exit(main())
