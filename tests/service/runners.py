"""Stand-ins for the road in the worker process; importable by name from a new process.

What a runner does is told by the first word of the uploaded file.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

from gcode.errors import GcodeError
from service.jobs.worker import Task
from service.pipeline.progress import Progress
from service.reports import write_report
from tests.service.synthetic import make_result

__all__ = ["pretend"]


def pretend(task: Task, progress: Callable[[Progress], None]) -> None:
    text = task.source.read_text()
    word = text.split()[0]
    if word == "bad":
        raise GcodeError("X1e400 is too large", line=7, text="G1 X1e400")
    if word == "crash":
        raise RuntimeError("a secret of the server")
    if word == "die" or (word == "die-once" and _first_time(task.source)):
        os._exit(9)
    if word == "slow":
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline:
            progress(Progress("compensating", 0.5, 10.0, 1.0, 1.0))
            time.sleep(0.02)
    if word == "deaf":
        time.sleep(60)
    progress(Progress("compensating", 0.5, 10.0, 1.0, 1.0))
    task.target.parent.mkdir(parents=True, exist_ok=True)
    task.target.write_text("; compensated\n" + text)
    write_report(make_result(layers=4), task.report)


def _first_time(source: Path) -> bool:
    mark = source.with_name("tried")
    if mark.exists():
        return False
    mark.touch()
    return True
