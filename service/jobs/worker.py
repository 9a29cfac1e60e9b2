"""One attempt at a job, in a worker process: claim it, run it, store its files, report.

Only the job's id passes through Dask; everything else is read from database and storage. Each
attempt's files have their own prefix, so that attempts never collide, and the row names the prefix
of the valid one.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import json
import os
import pkgutil
import shutil
import socket
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import structlog

from stillpath.pipeline.progress import Progress, StopWork
from stillpath.service.database.engine import DatabaseAway, StoreError, open_database
from stillpath.service.environment import prepare_environment
from stillpath.service.jobs.computations import run_computation
from stillpath.service.jobs.problems import (
    input_damaged,
    input_gone,
    never_fits,
    problem_of,
    storage_away,
    storage_never_fits,
)
from stillpath.service.jobs.state import Event, Failed, Finished, Job, JobKind, Lost, OutOfRoom
from stillpath.service.jobs.store import JobStore
from stillpath.service.jobs.task import Runner, Task
from stillpath.service.jobs.watch import AttemptLimits, Watch, held_bytes
from stillpath.service.logs import configure_logging
from stillpath.service.processes import limit_memory
from stillpath.service.settings import Settings
from stillpath.service.storage import Storage, StorageError, sha256_of
from stillpath.service.storage.disk import DISK_FULL, Disk, Written, written_bytes
from stillpath.service.storage.factory import open_storage

__all__ = ["Workplace", "execute", "run_compensation", "run_job"]

_PATIENCE_S = 180.0
"""Time for which storage and database may be unavailable before an attempt is given up. A request
to S3 alone may take a minute."""
_LONGEST_PAUSE_S = 4.0
_KEPT_BYTES = 256 << 20
_MOST_KEPT_BYTES = 512 << 20
"""Memory after a short job above which the process ends, as it would count for the next job."""

_Given = TypeVar("_Given")


class _InputBroken(Exception):
    """A job's input is gone from the storage or damaged."""

    def __init__(self, found: dict[str, Any]) -> None:
        super().__init__(found["detail"])
        self.problem = found


@dataclass(frozen=True, slots=True)
class Workplace:
    """The environment of a worker.

    Attributes
    ----------
    scratch : Path
        Folder for temporary files.
    interrupted : callable
        Returns why the worker has to give its job back, or None.
    end : callable
        Ends this process with an exit code.
    """

    settings: Settings
    store: JobStore
    storage: Storage
    scratch: Path
    name: str = field(default_factory=lambda: f"{socket.gethostname()}:{os.getpid()}")
    interrupted: Callable[[], str | None] = lambda: None
    end: Callable[[int], object] = os._exit


def run_job(job_id: str, settings: dict[str, Any] | None, runner: str) -> None:
    """Do one job in a Dask worker, unless another worker has claimed it.

    Parameters
    ----------
    settings : dict, optional
        Fields of `Settings`; by default this process reads them from its environment.
    runner : str
        ``module:name`` of a `Runner`.
    """
    from distributed import get_worker
    from distributed.core import Status

    worker = get_worker()

    def interrupted() -> str | None:
        ended = worker.status not in (Status.running, Status.paused)
        return "the worker was stopped" if ended else None

    given = None if settings is None else json.dumps(settings, sort_keys=True)
    own, store, storage = _opened(given)
    workplace = Workplace(
        own, store, storage, Path(worker.local_directory), interrupted=interrupted
    )
    execute(job_id, workplace, pkgutil.resolve_name(runner))


def execute(job_id: str, workplace: Workplace, runner: Runner) -> None:
    """Claim a job, do it, and record its outcome; do nothing if it cannot be claimed."""
    store = workplace.store
    job = _patiently(
        lambda: store.claim(job_id, time.time(), workplace.name), DatabaseAway, time.sleep
    )
    if job is None:
        return
    log = structlog.get_logger("worker")
    settings = workplace.settings
    limits = AttemptLimits.of(job.kind, settings)
    # The watch checks periodically; this limit acts in between, and includes freed memory.
    limit_memory(limits.max_bytes + max(limits.max_bytes // 4, _KEPT_BYTES))
    if job.kind is not JobKind.COMPENSATION:
        runner = run_computation
    disk = Disk(settings.data_dir, settings.disk_reserve_bytes)
    written = Written(_place(job, workplace))

    def has_room() -> bool:
        written.look()
        return disk.lets_jobs_go_on

    watch = Watch(
        store,
        job,
        limits,
        interrupted=workplace.interrupted,
        has_room=has_room,
        no_room=lambda: _no_room(job, workplace, written),
        end=workplace.end,
    )
    with structlog.contextvars.bound_contextvars(job=job.id, attempt=job.attempt):
        log.info("job started", worker=workplace.name)
        with watch:
            event = _attempt(job, workplace, runner, watch, limits, written)
        # A decision of the watch that was not stored yet comes first.
        for said in (watch.verdict, event):
            if said is not None:
                _report(store, job, said)
        _tidy(job, workplace)
        log.info("job over", outcome="dropped" if event is None else type(event).__name__)
    if watch.outgrown or (job.kind.is_short and held_bytes() > _MOST_KEPT_BYTES):
        workplace.end(0)


def run_compensation(task: Task, progress: Callable[[Progress], None]) -> dict[str, Any]:
    """Compensate the task's file and write its report; see `Runner`."""
    from stillpath.pipeline.compensate import compensate_file
    from stillpath.pipeline.options import Options
    from stillpath.reports import headline_figures, write_report
    from stillpath.service.compiling import compiling_reported

    pinned = task.pinned()
    with compiling_reported(progress) as told:
        result = compensate_file(
            task.source,
            task.target,
            pinned.machine,
            Options.model_validate(task.options),
            cache_dir=task.cache_dir,
            progress=told,
            layers=task.report,
        )
    result.warnings.extend(pinned.warnings)
    write_report(result, task.report)
    contour_um = {c.name: c.extruding.contour_rms_um for c in result.channels}
    shown = headline_figures(result.channels)
    return {
        "original_s": result.original_time_s,
        "written_s": result.time_s,
        **{f"{name}_um": contour_um.get(name) for name in ("before", "after", "shaper")},
        "headline_um": {
            name: shown[name] for name in ("before", "after", "range") if shown[name] is not None
        },
        "put_back": len(result.put_back),
        "warnings": len(result.warnings),
    }


def _attempt(
    job: Job,
    workplace: Workplace,
    runner: Runner,
    watch: Watch,
    limits: AttemptLimits,
    written: Written,
) -> Event | None:
    """Return how the attempt ended; None if it was stopped from outside.

    A full disk is not a failure: the job waits for room.
    """
    try:
        with _folder(_place(job, workplace)) as folder:
            try:
                return _work(job, workplace, runner, watch, folder)
            except OSError as error:
                if error.errno not in DISK_FULL:
                    raise
                structlog.get_logger("worker").warning("no room for the job", reason=str(error))
                # Now, while what it has put into the folder still exists.
                if isinstance(error, StorageError) and workplace.settings.storage_url is not None:
                    return _no_room_in_storage(job, workplace)
                return _no_room(job, workplace, written)
    except StopWork:
        return None
    except MemoryError:
        what = "The system refused its process more memory"
        return Failed(job.attempt, time.time(), limits.too_large(what))
    except _InputBroken as error:
        return Failed(job.attempt, time.time(), error.problem)
    except OSError as error:
        if error.errno in DISK_FULL:
            return OutOfRoom(job.attempt, time.time())  # not even for its folder
        _log_crash()
        if isinstance(error, StorageError):
            # Another worker, or a later attempt, may succeed; while nothing is stored, it waits.
            return Lost(
                job.attempt,
                time.time(),
                str(error),
                workplace.settings.max_attempts,
                blame=_answers(workplace.storage),
                problem=storage_away(error),
            )
        return Failed(job.attempt, time.time(), problem_of(error, job.kind))
    except Exception as error:
        found = problem_of(error, job.kind)
        if found["status"] >= 500:
            _log_crash()
        return Failed(job.attempt, time.time(), found)


def _answers(storage: Storage) -> bool:
    with contextlib.suppress(StorageError):
        storage.check()
        return True
    return False


def _no_room(job: Job, workplace: Workplace, written: Written) -> Event:
    """Return the event for a job without disk space, by what it has written."""
    disk = Disk(workplace.settings.data_dir, workplace.settings.disk_reserve_bytes)
    room_bytes = written.look()
    if disk.fits_ever(room_bytes + job.source_bytes):
        return OutOfRoom(job.attempt, time.time(), room_bytes)
    return Failed(job.attempt, time.time(), never_fits(room_bytes, disk.total_bytes()))


def _no_room_in_storage(job: Job, workplace: Workplace) -> Event:
    """Return the event for a job whose result does not fit into the storage."""
    needed = written_bytes(_place(job, workplace))
    room = None
    with contextlib.suppress(StorageError):
        stored = workplace.storage.list(f"{job.attempt_files}/")
        needed += sum(stat.size_bytes for stat in stored)
        room = workplace.storage.room()
    if room is not None and needed + job.source_bytes > room.total_bytes:
        return Failed(job.attempt, time.time(), storage_never_fits(needed, room.total_bytes))
    return OutOfRoom(job.attempt, time.time(), needed)


def _place(job: Job, workplace: Workplace) -> Path:
    return workplace.scratch / f"{job.id}-{job.attempt}"


def _work(job: Job, workplace: Workplace, runner: Runner, watch: Watch, folder: Path) -> Finished:
    storage = workplace.storage
    target, report = folder / "result" / job.result_name, folder / "report"
    target.parent.mkdir()
    with contextlib.ExitStack() as stack:

        def fetch(key: str) -> Path:
            return _patiently(
                lambda: stack.enter_context(storage.local(key)),
                StorageError,
                watch.pause,
            )

        try:
            sources = tuple(fetch(key) for key in job.sources)
        except FileNotFoundError:
            raise _InputBroken(input_gone(job.source_name)) from None
        # What a disk has cut or garbled may still look like G-code: half a print.
        if job.source_sha256 and sha256_of(sources[0]) != job.source_sha256:
            raise _InputBroken(input_damaged(job.source_name))
        try:
            machine = fetch(job.machine_file)
        except FileNotFoundError:
            machine = folder / "machine.json"  # does it need one? `Task.pinned` knows
        cache = workplace.settings.data_dir / "cache"
        cache.mkdir(parents=True, exist_ok=True)
        summary = runner(
            Task(
                machine=job.machine,
                machine_revision=job.machine_revision,
                machine_file=machine,
                options=job.options,
                sources=sources,
                target=target,
                report=report,
                cache_dir=cache,
                kind=job.kind,
                attempt=job.attempt,
            ),
            watch.tell,
        )
    digest = sha256_of(target)
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    result_bytes = target.stat().st_size
    output, output_bytes = job.attempt_files, sum(path.stat().st_size for path in files)
    for path in files:
        key = f"{output}/{path.relative_to(folder).as_posix()}"
        watch.check()
        _patiently(functools.partial(storage.put, key, path), StorageError, watch.pause)
    return Finished(job.attempt, time.time(), output, output_bytes, result_bytes, digest, summary)


def _report(store: JobStore, job: Job, event: Event) -> None:
    # If the database fails after storing the event, the retry is stale and harmless.
    _patiently(lambda: store.apply(job.id, event), DatabaseAway, time.sleep)


def _tidy(job: Job, workplace: Workplace) -> None:
    """Delete the attempt's stored files unless the job's row refers to them.

    The job may have been deleted, cancelled or reassigned meanwhile.
    """
    with contextlib.suppress(DatabaseAway, StorageError):  # otherwise the sweep deletes them
        row = workplace.store.get(job.id)
        if row is None:
            workplace.storage.delete(job.files)
        elif row.output != job.attempt_files:
            workplace.storage.delete(f"{job.attempt_files}/")


def _patiently(
    action: Callable[[], _Given],
    trouble: type[Exception],
    pause: Callable[[float], None],
) -> _Given:
    """Repeat `action` while it raises `trouble`, up to a limit; do not wait for a full disk."""
    deadline = time.monotonic() + _PATIENCE_S
    wait_s = 0.2
    while True:
        try:
            return action()
        except trouble as error:
            full = isinstance(error, OSError) and error.errno in (*DISK_FULL, errno.EFBIG)
            if full or time.monotonic() > deadline:
                raise
            structlog.get_logger("worker").warning("trying again", error=str(error), in_s=wait_s)
        pause(wait_s)
        wait_s = min(2 * wait_s, _LONGEST_PAUSE_S)


@contextlib.contextmanager
def _folder(folder: Path) -> Iterator[Path]:
    folder.mkdir(parents=True)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@functools.lru_cache(maxsize=1)
def _opened(given: str | None) -> tuple[Settings, JobStore, Storage]:
    """Open database and storage, once for each process."""
    prepare_environment()
    configure_logging()
    settings = Settings() if given is None else Settings.model_validate_json(given)
    engine = _patiently(lambda: open_database(settings), StoreError, time.sleep)
    return settings, JobStore(engine), open_storage(settings)


def _log_crash() -> None:
    structlog.get_logger("worker").exception("job broke", pid=os.getpid())
