"""Stand-in for a process that compensates; what it does is told by the first word of the file."""

from __future__ import annotations

import os
import threading
import time

from stillpath.cli.batch.local_workers import Failure, FileResult, FileTask, Stopped, failure_of
from stillpath.cli.batch.output import Figures
from stillpath.gcode.errors import GcodeError

__all__ = ["PretendedWorker"]

DELAY_S = float(os.environ.get("PRETENDED_DELAY_S", "0"))


class PretendedWorker:
    """Does files in this process."""

    tries = 0

    def do(self, task: FileTask, stopping: threading.Event) -> FileResult:
        PretendedWorker.tries += 1
        word = task.source.read_text().split()[0]
        deadline = time.monotonic() + (600 if word == "slow" else DELAY_S)
        while time.monotonic() < deadline:
            if stopping.is_set():
                raise Stopped
            time.sleep(0.01)
        if word == "bad":
            raise failure_of(GcodeError("X1e400 is too large", line=7, text="G1 X1e400"))
        if word == "full":
            raise Failure("the disk is full", "computer")
        if word == "huge":
            raise failure_of(MemoryError())
        task.result.write_text(f"; compensated for {task.machine.name}\n{task.source.read_text()}")
        task.report.mkdir()
        (task.report / "report.html").write_text("<p>report")
        figures = Figures(
            original_s=100, written_s=100.1, before_um=20, shaper_um=8, after_um=1, put_back=0
        )
        return FileResult(figures, 0.5)

    def end(self) -> None:
        pass
