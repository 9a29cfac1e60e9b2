"""The worker process: takes one job after the other from a pipe and tells how it goes.

Messages to the worker are `Task` (do this) and `Stop` (drop this attempt); messages from it are
events of `service.jobs.state`, and `Dropped`. A closed pipe ends the worker.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import structlog

from service.environment import prepare_environment
from service.jobs.problems import problem_of
from service.jobs.state import Failed, Finished, Progressed
from service.logs import configure_logging
from service.pipeline.progress import Cancelled, Progress

__all__ = ["Dropped", "Runner", "Stop", "Task", "run_task", "worker_main"]

_REPORT_EVERY_S = 0.2


@dataclass(frozen=True, slots=True)
class Task:
    """One attempt at a job; `machine_file` holds the machine that it was accepted with."""

    job_id: str
    attempt: int
    machine: str
    machine_file: Path
    options: dict[str, Any]
    source: Path
    target: Path
    report: Path
    cache_dir: Path


@dataclass(frozen=True, slots=True)
class Stop:
    """Drop the attempt."""

    job_id: str
    attempt: int


@dataclass(frozen=True, slots=True)
class Dropped:
    """The attempt was dropped; nothing of it is left."""

    attempt: int


Runner = Callable[[Task, Callable[[Progress], None]], None]
"""Does the work of a task; importable by name, because it travels to a new process."""


def run_task(task: Task, progress: Callable[[Progress], None]) -> None:
    """Compensate the task's file and write its report.

    The report is made beside its place and moved there whole; the result likewise (see
    `service.pipeline.road`).
    """
    from service.machines.resolve import PinnedMachine
    from service.pipeline.options import Options
    from service.pipeline.road import compensate_file
    from service.reports import write_report

    # A worker that was killed may have left half a file.
    shutil.rmtree(task.target.parent, ignore_errors=True)
    task.target.parent.mkdir(parents=True)
    pinned = PinnedMachine.read(task.machine_file, task.machine)
    result = compensate_file(
        task.source,
        task.target,
        pinned.machine,
        Options.model_validate(task.options),
        cache_dir=task.cache_dir,
        progress=progress,
    )
    result.warnings.extend(pinned.warnings)
    fresh = task.report.with_name(f"{task.report.name}.{task.attempt}.part")
    write_report(result, fresh)
    shutil.rmtree(task.report, ignore_errors=True)
    fresh.rename(task.report)


def worker_main(connection: Connection, runner: Runner = run_task) -> None:
    """Serve tasks until the pipe is closed. The entry point of the worker process."""
    prepare_environment()
    configure_logging()
    # Ctrl-C goes to the whole terminal group; the service ends its workers itself.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):
        while True:
            message = connection.recv()
            if isinstance(message, Task):
                _serve(connection, message, runner)


def _serve(connection: Connection, task: Task, runner: Runner) -> None:
    last = 0.0

    def tell(progress: Progress) -> None:
        nonlocal last
        while connection.poll():
            message = connection.recv()  # a closed pipe raises EOFError, which ends the worker
            if isinstance(message, Stop) and message.attempt == task.attempt:
                raise Cancelled
        now = time.monotonic()
        if now - last >= _REPORT_EVERY_S:
            last = now
            connection.send(
                Progressed(task.attempt, progress.stage, progress.fraction, progress.eta_s)
            )

    try:
        runner(task, tell)
    except Cancelled:
        connection.send(Dropped(task.attempt))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        raise
    except Exception as error:
        found = problem_of(error)
        if found["status"] >= 500:
            _log_crash(task)
        connection.send(Failed(task.attempt, time.time(), found))
    else:
        connection.send(Finished(task.attempt, time.time()))


def _log_crash(task: Task) -> None:
    structlog.get_logger("worker").exception(
        "job broke", job=task.job_id, attempt=task.attempt, pid=os.getpid()
    )
