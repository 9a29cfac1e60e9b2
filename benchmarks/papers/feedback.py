"""Published numbers of feedback and repetitive control (papers 000, 001, 002, 004).

    python benchmarks/papers/feedback.py [--only 000 001 002 004]

prints quantity, paper, ours and the tolerance with its verdict, or why there is none: a published
number whose inputs are not printed is shown with the reason, not forced.
"""

from __future__ import annotations

import argparse
import importlib
import time
from collections.abc import Sequence
from pathlib import Path

HERE = Path(__file__).resolve().parent
PAPERS = ("000", "001", "002", "004")


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=PAPERS, default=list(PAPERS))
    options = parser.parse_args(arguments)
    for paper in options.only:
        name = f"feedback_{paper}"
        if not (HERE / f"{name}.py").exists():
            print(f"\n{name}.py is not in this checkout")
            continue
        start = time.perf_counter()
        section = importlib.import_module(name)
        print(f"\npaper {paper}: {section.__doc__.splitlines()[0]}")
        for quantity, published, ours, note in section.rows():
            print(f"| {quantity:58} | {published:>20} | {ours:>26} | {note}", flush=True)
        print(f"({time.perf_counter() - start:.0f} s)", flush=True)


if __name__ == "__main__":
    main()
