"""Do jobs in a worker process: claim one, attempt it, report how it ended.

Only the job's id passes through Dask; everything else is read from database and storage.
"""

from __future__ import annotations

import contextlib
import functools
import json
import pkgutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import structlog

from stillpath.pipeline.progress import Progress, StopWork
from stillpath.service.database.engine import open_database
from stillpath.service.database.errors import DatabaseAway, StoreError
from stillpath.service.environment import prepare_environment
from stillpath.service.jobs.attempt import Attempt, WorkerContext
from stillpath.service.jobs.computations import run_computation
from stillpath.service.jobs.patience import patiently
from stillpath.service.jobs.state import Event, JobKind
from stillpath.service.jobs.store import JobStore
from stillpath.service.jobs.task import Runner, Task
from stillpath.service.jobs.watch import AttemptLimits, Watch, held_bytes
from stillpath.service.logs import configure_logging
from stillpath.service.processes import limit_memory
from stillpath.service.settings import Settings
from stillpath.service.storage import Storage
from stillpath.service.storage.factory import open_storage

__all__ = ["execute", "run_compensation", "run_job"]

_KEPT_BYTES = 256 << 20
_MOST_KEPT_BYTES = 512 << 20
"""Memory after a short job above which the process ends, as it would count for the next job."""


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
    context = WorkerContext(
        own, store, storage, Path(worker.local_directory), interrupted=interrupted
    )
    execute(job_id, context, pkgutil.resolve_name(runner))


def execute(job_id: str, context: WorkerContext, runner: Runner) -> None:
    """Claim a job, do it, and record its outcome; do nothing if it cannot be claimed."""
    store = context.store
    job = patiently(lambda: store.claim(job_id, time.time(), context.name), DatabaseAway)
    if job is None:
        return
    log = structlog.get_logger("worker")
    limits = AttemptLimits.of(job.kind, context.settings)
    # The watch checks periodically; this limit acts in between, and includes freed memory.
    limit_memory(limits.max_bytes + max(limits.max_bytes // 4, _KEPT_BYTES))
    if job.kind is not JobKind.COMPENSATION:
        runner = run_computation
    attempt = Attempt(job, context, limits)
    watch = Watch(
        store,
        job,
        limits,
        interrupted=context.interrupted,
        has_room=attempt.has_room,
        no_room=attempt.no_room,
        end=context.end,
    )
    with structlog.contextvars.bound_contextvars(job=job.id, attempt=job.attempt):
        log.info("job started", worker=context.name)
        with watch:
            event = attempt.run(runner, watch)
        # A decision of the watch that was not stored yet comes first.
        with contextlib.suppress(StopWork):
            for said in (watch.verdict, event):
                if said is not None:
                    _record(job.id, said, context)
        attempt.tidy()
        log.info("job over", outcome="dropped" if event is None else type(event).__name__)
    if watch.outgrown or (job.kind.is_short and held_bytes() > _MOST_KEPT_BYTES):
        context.end(0)


def _record(job_id: str, event: Event, context: WorkerContext) -> None:
    """Record what became of a job, however long the database is away: it may have taken hours.

    Raises
    ------
    StopWork
        If the worker has to end.
    """

    def pause(seconds: float) -> None:
        time.sleep(seconds)
        if context.interrupted() is not None:
            raise StopWork

    # If the database fails after storing the event, the retry is stale and harmless.
    apply = functools.partial(context.store.apply, job_id, event)
    patiently(apply, DatabaseAway, pause, for_ever=True)


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


@functools.lru_cache(maxsize=1)
def _opened(given: str | None) -> tuple[Settings, JobStore, Storage]:
    """Open database and storage, once for each process."""
    prepare_environment()
    configure_logging()
    settings = Settings() if given is None else Settings.model_validate_json(given)
    engine = patiently(lambda: open_database(settings), StoreError)
    return settings, JobStore(engine), open_storage(settings)
