"""Says loudly which part of the evidence was left out."""

from __future__ import annotations

import pytest

__all__ = ["tell"]


def tell(reporter: pytest.TerminalReporter, missing: str, need: str) -> None:
    """Write a line if tests were skipped for a reason that holds `missing`."""
    skipped = [r for r in reporter.getreports("skipped") if missing in str(r.longrepr)]
    if skipped:
        line = f"NOT CHECKED: {len(skipped)} tests need {need}"
        reporter.write_line(line, yellow=True, bold=True)
