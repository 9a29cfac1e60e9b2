"""Keeps the worker processes alive and the store in step with what they do.

One thread per worker: it claims a job, hands it over, writes down what the worker says, and
starts a new process when the old one dies or does not obey.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import threading
import time
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess

import structlog

from service.jobs.state import Failed, Finished, Job, JobState, Lost, Progressed
from service.jobs.store import JobStore
from service.jobs.worker import Dropped, Runner, Stop, Task, run_task, worker_main

__all__ = ["Supervisor"]

_POLL_S = 0.1


class Supervisor:
    """Runs the jobs of a store in worker processes.

    Parameters
    ----------
    store : JobStore
    workers : int
        Number of processes, each with one job at a time.
    max_attempts : int
        How many workers one job may take down before it fails.
    cancel_grace_s : float
        How long a worker may take to drop a deleted job before its process is ended.
    runner : callable
        Does the work; tests put another in.
    """

    def __init__(
        self,
        store: JobStore,
        *,
        workers: int = 1,
        max_attempts: int = 2,
        cancel_grace_s: float = 10.0,
        runner: Runner = run_task,
    ) -> None:
        self._store = store
        self._max_attempts = max_attempts
        self._cancel_grace_s = cancel_grace_s
        self._runner = runner
        self._wake = threading.Condition()
        self._stopping = threading.Event()
        self._threads = [
            threading.Thread(target=self._serve, name=f"supervisor-{n}") for n in range(workers)
        ]
        self._log = structlog.get_logger("supervisor")

    def start(self) -> None:
        """Take up what an earlier service left, then start working."""
        self._store.sweep()
        for job in self._store.in_state(JobState.RUNNING):
            self._lost(job, "the service stopped", blame=False)
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """End the workers; running jobs go back into the queue for the next start."""
        self._stopping.set()
        self.notify()
        for thread in self._threads:
            if thread.is_alive():
                thread.join()

    def notify(self) -> None:
        """Say that a job was added or deleted."""
        with self._wake:
            self._wake.notify_all()

    @property
    def is_ready(self) -> bool:
        """Whether every supervisor is at work."""
        return not self._stopping.is_set() and all(t.is_alive() for t in self._threads)

    def _serve(self) -> None:
        worker = _Worker(self._runner)
        try:
            while not self._stopping.is_set():
                job = self._store.claim(time.time())
                if job is None:
                    with self._wake:
                        self._wake.wait(timeout=1.0)
                    continue
                self._log.info("job started", job=job.id, attempt=job.attempt)
                self._attend(worker, job)
        finally:
            worker.end()

    def _attend(self, worker: _Worker, job: Job) -> None:
        """Hand one job to the worker and stay with it until it is over."""
        files = self._store.files(job.id)
        task = Task(
            job_id=job.id,
            attempt=job.attempt,
            machine=job.machine,
            machine_file=files.machine,
            options=job.options,
            source=files.source(job.source_name),
            target=files.result(job.result_name),
            report=files.report,
            cache_dir=self._store.cache_dir,
        )
        stopped_at: float | None = None
        try:
            connection = worker.connect()
            connection.send(task)
            while True:
                if self._stopping.is_set():
                    worker.end()
                    self._lost(job, "the service stopped", blame=False)
                    return
                if stopped_at is None and self._store.get(job.id) is None:
                    stopped_at = time.monotonic()
                    connection.send(Stop(job.id, job.attempt))
                if stopped_at and time.monotonic() - stopped_at > self._cancel_grace_s:
                    worker.end()
                    break
                if connection.poll(_POLL_S) and self._note(job, connection.recv()):
                    break
        except (EOFError, BrokenPipeError, ConnectionResetError):
            reason = worker.reason_of_death()
            worker.end()
            self._lost(job, reason, blame=True)
        if self._store.get(job.id) is None:
            self._store.remove_files(job.id)

    def _note(self, job: Job, message: object) -> bool:
        """Write down what the worker says; return whether the attempt is over."""
        if isinstance(message, Dropped):
            return message.attempt == job.attempt
        if not isinstance(message, Progressed | Finished | Failed):
            raise TypeError(f"the worker sent {type(message).__name__}")
        after = self._store.apply(job.id, message)
        over = not isinstance(message, Progressed)
        if over and after is not None:
            self._log.info("job over", job=job.id, state=after.state.value)
        return over

    def _lost(self, job: Job, reason: str, *, blame: bool) -> None:
        after = self._store.apply(
            job.id, Lost(job.attempt, time.time(), reason, self._max_attempts, blame)
        )
        state = "deleted" if after is None else after.state.value
        self._log.warning("worker lost", job=job.id, reason=reason, now=state)


class _Worker:
    """A worker process that is started when it is needed, again and again."""

    def __init__(self, runner: Runner) -> None:
        self._runner = runner
        self._process: SpawnProcess | None = None
        self._connection: Connection | None = None

    def connect(self) -> Connection:
        if self._connection is None or self._process is None or not self._process.is_alive():
            self.end()
            context = multiprocessing.get_context("spawn")
            self._connection, theirs = context.Pipe()
            self._process = context.Process(
                target=worker_main,
                args=(theirs, self._runner),
                name="stillpath-worker",
                daemon=True,
            )
            self._process.start()
            theirs.close()  # so that the worker's death closes the pipe
        return self._connection

    def reason_of_death(self) -> str:
        if self._process is None:
            return "no process"
        self._process.join(timeout=5.0)
        code = self._process.exitcode
        if code is not None and code < 0:
            return f"its process was ended by signal {-code}"
        return f"its process ended with code {code}"

    def end(self) -> None:
        if self._connection is not None:
            with contextlib.suppress(OSError):
                self._connection.close()
        if self._process is not None:
            if self._process.is_alive():
                self._process.terminate()
                self._process.join(timeout=2.0)
            if self._process.is_alive():
                self._process.kill()
            self._process.join()
            self._process.close()
        self._process = self._connection = None
