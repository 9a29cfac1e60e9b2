"""Does items in parallel, on this computer or a server, and keeps what was made."""

from __future__ import annotations

import hashlib
import json
import queue
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from stillpath.cli.batch.items import Item
from stillpath.cli.batch.local_workers import (
    Failure,
    FileResult,
    FileTask,
    LocalWorker,
    Stopped,
    failure_of,
)
from stillpath.cli.batch.output import Outcome, OutputFolder, Scratch
from stillpath.service.storage.base import sha256_of
from stillpath.version import build

if TYPE_CHECKING:
    from stillpath.applications.machines.resolve import PinnedMachine, Resolver
    from stillpath.pipeline.options import Options

__all__ = ["Backend", "Found", "IsFinished", "LocalBackend", "WorkerPool", "worker_pool"]


@dataclass(frozen=True, slots=True)
class Found:
    """A machine as a backend knows it: its own name, and the digest of its document."""

    name: str
    revision: str
    pinned: PinnedMachine | None = None


class Backend(Protocol):
    """Where files are compensated."""

    @property
    def version(self) -> str:
        """Version of the program that does it, with a digest of its code."""

    def machine(self, name: str) -> Found:
        """Return a machine that may be used now.

        Raises
        ------
        ModelError
            If there is no such machine, or it is not approved.
        """

    def do(
        self, source: Path, scratch: Scratch, machine: Found, stopping: threading.Event
    ) -> FileResult:
        """Make result and report in `scratch`.

        Raises
        ------
        Failure, Stopped, and the errors that `failure_of` knows
        """

    def close(self) -> None:
        """End what was started."""


class LocalBackend:
    """Compensates in processes of this computer.

    Parameters
    ----------
    jobs : int
        Processes.
    """

    def __init__(self, machines: Resolver, options: Options, jobs: int) -> None:
        self.version = build()
        self._machines = machines
        self._options = options
        self._workers = [LocalWorker() for _ in range(jobs)]
        self._free: queue.SimpleQueue[LocalWorker] = queue.SimpleQueue()
        for worker in self._workers:
            self._free.put(worker)

    def machine(self, name: str) -> Found:
        """See `Backend`."""
        found = self._machines.for_job(name, files=True)
        return Found(found.machine.name, found.machine.revision, found)

    def do(
        self, source: Path, scratch: Scratch, machine: Found, stopping: threading.Event
    ) -> FileResult:
        """See `Backend`."""
        pinned = machine.pinned
        assert pinned is not None
        task = FileTask(
            source, scratch.result, scratch.report, pinned.machine, self._options, pinned.warnings
        )
        worker = self._free.get()
        try:
            return worker.do(task, stopping)
        finally:
            self._free.put(worker)

    def close(self) -> None:
        """See `Backend`."""
        for worker in self._workers:
            worker.end()


IsFinished = Callable[[Item, Outcome, Outcome], bool]
"""Whether a recorded outcome (second) settles an item, given what it would be now (first)."""


class WorkerPool:
    """Does items in threads; each waits for a process of this computer or for a server."""

    def __init__(self, backend: Backend, output: OutputFolder, options: Options, jobs: int) -> None:
        self._backend = backend
        self._output = output
        self._options = options.model_dump_json()
        self._stopping = threading.Event()
        self._threads = ThreadPoolExecutor(jobs, thread_name_prefix="farm")

    def add(self, item: Item, is_done: IsFinished) -> Future[Outcome]:
        """Do an item when its turn comes; the future raises `Stopped` at most."""
        return self._threads.submit(self._do, item, is_done)

    def stop(self) -> None:
        """Break off what is being done, begin nothing new, and wait until it is quiet."""
        self._stopping.set()
        self._threads.shutdown(cancel_futures=True)
        self._backend.close()

    def _do(self, item: Item, is_done: IsFinished) -> Outcome:
        if self._stopping.is_set():
            raise Stopped
        began = time.monotonic()
        outcome = Outcome(state="failed", source=_shown(item.source), machine=item.machine)
        try:
            machine, outcome = self._planned(item)
            known = self._output.recorded(outcome.output)
            if known is not None and is_done(item, outcome, known):
                state = "failed" if known.state == "failed" else "done before"
                return known.model_copy(update={"state": state, "source": outcome.source})
            outcome = self._made(item, machine, outcome)
        except Stopped:
            raise
        except Exception as error:
            failure = error if isinstance(error, Failure) else failure_of(error)
            outcome = outcome.model_copy(
                update={
                    "state": "failed",
                    "error": " ".join(str(failure).split()),
                    "trouble": failure.trouble,
                }
            )
        return outcome.model_copy(update={"took_s": time.monotonic() - began})

    def _planned(self, item: Item) -> tuple[Found, Outcome]:
        """Return what the outcome will be, as far as it is known before the work."""
        if _shown(item.source) != str(item.source):
            raise Failure("its name is not valid text; rename it", "file")
        if not item.machine:
            raise Failure(
                "no pattern of --machine-map fits, and there is no --machine for the rest",
                "machine",
            )
        machine = self._backend.machine(item.machine)
        digest = sha256_of(item.source)
        return machine, Outcome(
            state="failed",
            source=str(item.source),
            machine=machine.name,
            machine_revision=machine.revision,
            version=self._backend.version,
            source_sha256=digest,
            key=_key(digest, machine.revision, self._options, self._backend.version),
            output=item.output(machine.name),
            report=item.report(machine.name),
        )

    def _made(self, item: Item, machine: Found, outcome: Outcome) -> Outcome:
        if (self._output.root / outcome.output).resolve() == item.source.resolve():
            raise Failure(
                "the result would lie over the file itself; choose another --output", "file"
            )
        began = _signature(item.source)
        scratch = self._output.scratch(outcome.output)
        try:
            made = self._backend.do(item.source, scratch, machine, self._stopping)
            if _signature(item.source) != began or sha256_of(item.source) != outcome.source_sha256:
                raise Failure("it was changed while it was read; submit it again", "computer")
            done = outcome.model_copy(
                update={
                    "state": "done",
                    "output_sha256": sha256_of(scratch.result),
                    "figures": made.figures,
                    "cpu_s": made.cpu_s,
                }
            )
            self._output.keep(scratch, done)
        except BaseException:
            self._output.drop(scratch)
            raise
        return done


@contextmanager
def worker_pool(
    backend: Backend, output: OutputFolder, options: Options, jobs: int
) -> Iterator[WorkerPool]:
    """Yield a worker pool that is quiet when the block ends."""
    made = WorkerPool(backend, output, options, jobs)
    try:
        yield made
    finally:
        made.stop()


def _key(*parts: str) -> str:
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


def _signature(path: Path) -> tuple[int, int, int]:
    found = path.stat()
    return found.st_size, found.st_mtime_ns, found.st_ino


def _shown(path: Path) -> str:
    return str(path).encode("utf-8", "surrogateescape").decode("utf-8", "replace")
