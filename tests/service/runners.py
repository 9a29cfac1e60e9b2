"""Stand-ins for the pipeline in the worker process; importable by name from a new process.

What a runner does is told by the first word of the uploaded file. With `stamp` in its first line
the result says that it was compensated, as real ones do.
"""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable
from typing import Any

from stillpath.gcode.errors import GcodeError
from stillpath.pipeline.files import replacing
from stillpath.pipeline.progress import Progress
from stillpath.service.jobs.task import Task
from stillpath.service.processes import METHOD

__all__ = ["light", "load_little", "pretend"]

SUMMARY: dict[str, Any] = {
    "original_s": 10.0,
    "written_s": 9.5,
    "before_um": 100.0,
    "after_um": 20.0,
    "shaper_um": 40.0,
    "put_back": 0,
    "warnings": 0,
}


def load_little() -> None:
    """Let the workers of this process load what the runners here need, and no pipeline."""
    from stillpath.service.jobs import cluster

    def loaded_context(*_: str) -> Any:
        context: Any = multiprocessing.get_context(METHOD)
        if METHOD == "forkserver":
            dask = ["distributed", "stillpath.service.jobs.worker"]
            context.set_forkserver_preload(["tests.service.pretended", *dask])
        return context

    cluster.loaded_context = loaded_context  # type: ignore[assignment]


def pretend(task: Task, progress: Callable[[Progress], None]) -> dict[str, Any]:
    """Do as told, with a real report."""
    from stillpath.reports import write_report
    from tests.service.synthetic import make_result

    _act(task, progress)
    write_report(make_result(layers=4), task.report)
    return SUMMARY


def light(task: Task, progress: Callable[[Progress], None]) -> dict[str, Any]:
    """Do as told, and import nothing heavy."""
    _act(task, progress)
    task.report.mkdir()
    (task.report / "report.json").write_text("{}")
    return SUMMARY


def _act(task: Task, progress: Callable[[Progress], None]) -> None:
    text = task.source.read_text()
    word, _, rest = text.partition(" ")
    word = word.split("\n")[0]
    if word == "bad":
        raise GcodeError("X1e400 is too large", line=7, text="G1 X1e400")
    if word == "crash":
        raise RuntimeError("a secret of the server")
    if word == "die" or (word == "die-once" and task.attempt == 1):
        os._exit(9)
    if word == "slow" or (word == "slow-once" and task.attempt == 1):
        _take(60.0, progress)
    if word == "nap":
        _take(float(rest.split()[0]), progress)
    if word == "deaf":
        time.sleep(600)
    if word == "grow":
        _grow(int(rest.split()[0]) << 20, progress)
    progress(Progress("compensating", 0.5, 10.0, 1.0, 1.0))
    stamp = "; Processed by stillpath 0 pretended\n" if "stamp" in text.split("\n")[0] else ""
    # As the pipeline does: without a name until it is complete.
    with replacing(task.target) as temporary, temporary.open("w") as file:
        file.write(stamp + "; compensated\n" + text)
        if word == "long":
            for _ in range(int(rest.split()[0])):
                file.write("; " + "x" * ((1 << 20) - 3) + "\n")
                time.sleep(0.1)
                progress(Progress("compensating", 0.6, 10.0, 1.0, 1.0))


def _take(seconds: float, progress: Callable[[Progress], None]) -> None:
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        progress(Progress("compensating", 0.5, 10.0, 1.0, 1.0))
        time.sleep(0.02)


def _grow(size: int, progress: Callable[[Progress], None]) -> None:
    kept = bytearray(b"x") * size
    while kept:
        progress(Progress("compensating", 0.5, 10.0, 1.0, 1.0))
        time.sleep(0.02)
