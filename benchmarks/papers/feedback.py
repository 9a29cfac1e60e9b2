"""Published numbers of feedback and repetitive control (papers 000, 001, 002, 004).

    python benchmarks/papers/feedback.py [--only 000 001 002 004] [--json FILE]

prints quantity, published number, ours, verdict and remark. A published number whose inputs are not
printed is shown with the reason, not forced; a row that misses its tolerance says MISS. With
--json the rows of a file in `benchmarks/results` are replaced by these.
"""

from __future__ import annotations

import argparse
import importlib
import json
import time
from collections.abc import Sequence
from pathlib import Path

PAPERS = ("000", "001", "002", "004")


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=PAPERS, default=list(PAPERS))
    parser.add_argument("--json", type=Path, metavar="FILE", help="results whose rows to replace")
    options = parser.parse_args(arguments)
    lines = []
    for paper in options.only:
        start = time.perf_counter()
        section = importlib.import_module(f"feedback_{paper}")
        print(f"\npaper {paper}: {section.__doc__.splitlines()[0]}")
        for row in section.rows():
            cells = (row.quantity, row.published, row.ours, row.verdict, row.remark or None)
            print(f"| {' | '.join(cell or '-' for cell in cells)} |", flush=True)
            lines.append(json.dumps([paper, *cells], ensure_ascii=False))
        print(f"({time.perf_counter() - start:.0f} s)", flush=True)
    if options.json:
        replace_rows(options.json, lines)


def replace_rows(path: Path, lines: Sequence[str]) -> None:
    """Write rows, one a line, in place of those of a file; the rest keeps its form."""
    head, begin, rest = path.read_text(encoding="utf-8").partition(' "rows": [\n')
    _, end, tail = rest.partition("\n ],\n")
    path.write_text(head + begin + "  " + ",\n  ".join(lines) + end + tail, encoding="utf-8")


if __name__ == "__main__":
    main()
