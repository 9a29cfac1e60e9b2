"""Processes of this computer that compensate, one file after the other each."""

from __future__ import annotations

import errno
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import TYPE_CHECKING

from stillpath.cli.batch.output import Figures, Trouble
from stillpath.service.processes import loaded_context

if TYPE_CHECKING:
    from stillpath.models.machine import Machine
    from stillpath.pipeline.options import Options

__all__ = ["Failure", "FileResult", "FileTask", "LocalWorker", "Stopped", "failure_of"]

_POLL_S = 0.2
_END_S = 5.0


@dataclass(frozen=True, slots=True)
class FileTask:
    """What a process is to do; `result` and the folder `report` are made by it."""

    source: Path
    result: Path
    report: Path
    machine: Machine
    options: Options
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class FileResult:
    """What it found, and the seconds of its processor."""

    figures: Figures
    cpu_s: float


class Failure(Exception):
    """A file that could not be done, and whose fault it is."""

    def __init__(self, text: str, trouble: Trouble) -> None:
        super().__init__(text)
        self.trouble = trouble

    def __reduce__(self) -> tuple[type[Failure], tuple[str, Trouble]]:
        return Failure, (str(self), self.trouble)


class Stopped(Exception):
    """The work was broken off because somebody asked for it."""


class LocalWorker:
    """One process; it is started when it is needed, and again if it dies."""

    def __init__(self) -> None:
        self._process: BaseProcess | None = None
        self._connection: Connection | None = None

    def do(self, task: FileTask, stopping: threading.Event) -> FileResult:
        """Do one file.

        Raises
        ------
        Failure
            Also if the process died.
        Stopped
        """
        connection = self._connect()
        try:
            connection.send(task)
            while not connection.poll(_POLL_S):
                if stopping.is_set():
                    self.end()
                    raise Stopped
            answer = connection.recv()
        except (EOFError, BrokenPipeError, ConnectionResetError):
            reason = self._reason_of_death()
            self.end()
            if stopping.is_set():
                raise Stopped from None
            raise Failure(
                f"{reason}; most often it ran out of memory: take fewer --jobs, or try again",
                "work",
            ) from None
        if isinstance(answer, Failure):
            raise answer
        assert isinstance(answer, FileResult)
        return answer

    def end(self) -> None:
        """End the process, whatever it is doing."""
        if self._connection is not None:
            self._connection.close()
        if self._process is not None:
            self._process.terminate()
            self._process.join(_END_S)
            if self._process.is_alive():
                self._process.kill()
            self._process.join()
            self._process.close()
        self._process = self._connection = None

    def _connect(self) -> Connection:
        if self._connection is None or self._process is None or not self._process.is_alive():
            self.end()
            context = loaded_context()
            self._connection, theirs = context.Pipe()
            with theirs:  # closed here, so that its death closes the pipe
                process = context.Process(
                    target=_serve, args=(theirs,), name="stillpath-farm", daemon=True
                )
                process.start()
            self._process = process
        return self._connection

    def _reason_of_death(self) -> str:
        if self._process is None:
            return "its process could not be started"
        self._process.join(_END_S)
        code = self._process.exitcode
        if code is not None and code < 0:
            return f"its process was ended by signal {-code}"
        return f"its process ended with code {code}"


def failure_of(error: Exception) -> Failure:
    """Tell an error as a failure: in full where the user can solve it, else with its kind."""
    from stillpath.compensation.base import DesignError
    from stillpath.gcode.errors import GcodeError
    from stillpath.models.errors import ModelError

    match error:
        case GcodeError():
            return Failure(str(error), "file")
        case ModelError() | DesignError():
            return Failure(str(error), "machine")
        case MemoryError():
            return Failure("out of memory; take fewer --jobs", "work")
        case OSError():
            place = f"{error.filename}: " if error.filename else ""
            if error.errno == errno.ENAMETOOLONG:
                return Failure(f"{place}{error.strerror}; rename the file", "file")
            return Failure(f"{place}{error.strerror or error}", "computer")
        case _:
            return Failure(f"an error of the program: {type(error).__name__}: {error}", "work")


def compensate(task: FileTask) -> FileResult:
    """Do one file in this process.

    Raises
    ------
    GcodeError, ModelError, DesignError, OSError
    """
    from stillpath.pipeline.compensate import compensate_file
    from stillpath.reports import write_report

    began = time.process_time()
    result = compensate_file(task.source, task.result, task.machine, task.options)
    result.warnings.extend(task.warnings)
    write_report(result, task.report)
    rms_um = {channel.name: channel.extruding.contour_rms_um for channel in result.channels}
    figures = Figures(
        original_s=result.original_time_s,
        written_s=result.time_s,
        before_um=rms_um.get("before"),
        shaper_um=rms_um.get("shaper"),
        after_um=rms_um.get("after"),
        put_back=len(result.put_back),
        warnings=result.warnings,
    )
    return FileResult(figures, time.process_time() - began)


def _serve(connection: Connection, work: Callable[[FileTask], FileResult] = compensate) -> None:
    """Serve tasks until the pipe is closed. The entry point of the process."""
    from stillpath.service.environment import prepare_environment

    prepare_environment()
    # Ctrl-C goes to the whole terminal group; the first process ends the others itself.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    while True:
        try:
            task = connection.recv()
        except (EOFError, ConnectionResetError):
            return
        try:
            answer: FileResult | Failure = work(task)
        except Exception as error:
            answer = failure_of(error)
        try:
            connection.send(answer)
        except (BrokenPipeError, ConnectionResetError):
            return


def _end_with_parent() -> None:
    """Leave nothing working for a parent that was killed: the next one does the file again."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
