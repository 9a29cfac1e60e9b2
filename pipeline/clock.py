"""Measure CPU time by stage."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from typing import TypeVar

from stillpath.pipeline.result import StageTime

__all__ = ["StageClock"]

T = TypeVar("T")


class StageClock:
    """Add up the CPU seconds of named stages.

    Attributes
    ----------
    cpu_s : dict
        Stage to seconds, in the order in which the stages first ran.
    """

    def __init__(self) -> None:
        self.cpu_s: dict[str, float] = {}

    @contextlib.contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Count what runs inside the `with` block."""
        start = time.process_time()
        try:
            yield
        finally:
            self.cpu_s[name] = self.cpu_s.get(name, 0.0) + time.process_time() - start

    def stages(self) -> list[StageTime]:
        """Return the stages for a result."""
        return [StageTime(stage=k, cpu_s=round(v, 4)) for k, v in self.cpu_s.items()]

    def each(self, name: str, items: Iterator[T]) -> Iterator[T]:
        """Yield items, and count the time to obtain each of them."""
        while True:
            with self.stage(name):
                try:
                    item = next(items)
                except StopIteration:
                    return
            yield item
