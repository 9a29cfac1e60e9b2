"""Deletes what nobody needs: files without a job, attempts that do not count, old jobs."""

from __future__ import annotations

import contextlib
import time
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path

import structlog

from service.jobs.state import Job, JobState
from service.jobs.store import JobStore
from service.storage import Stat, Storage

__all__ = ["forget_expired", "sweep_files", "sweep_incoming"]

_JOBS = "jobs/"
_AT_ONCE = 500
"""Ids in one question to the database."""
_SUBMISSIONS_KEPT_S = 86400.0


def sweep_files(store: JobStore, storage: Storage, *, before: float) -> int:
    """Delete files of jobs that are gone and of attempts that do not count.

    The files are listed first and the rows read then, so a row is never older than what is judged
    by it.

    Parameters
    ----------
    before : float
        Files without a row are younger than this: of uploads whose row is about to be written.

    Returns
    -------
    int
        How many prefixes were deleted.
    """
    found: dict[str, list[Stat]] = defaultdict(list)
    for stat in storage.list(_JOBS):
        found[stat.key.split("/")[1]].append(stat)
    deleted = 0
    ids = sorted(found)
    for start in range(0, len(ids), _AT_ONCE):
        some = ids[start : start + _AT_ONCE]
        jobs = store.many(some)
        for job_id in some:
            job = jobs.get(job_id)
            if job is not None:
                doomed = _dead_attempts(job, found[job_id])
            elif all(stat.modified_at < before for stat in found[job_id]):
                doomed = {f"{_JOBS}{job_id}/"}
            else:
                doomed = set()
            for prefix in sorted(doomed):
                storage.delete(prefix)
                deleted += 1
    if deleted:
        structlog.get_logger("sweep").info("orphans deleted", prefixes=deleted)
    return deleted


def sweep_incoming(folders: Iterable[Path], *, before: float) -> None:
    """Delete files that have not grown since `before`: of uploads that were broken off."""
    for folder in folders:
        with contextlib.suppress(FileNotFoundError):
            for leftover in folder.iterdir():
                with contextlib.suppress(FileNotFoundError):
                    if leftover.is_file() and leftover.stat().st_mtime < before:
                        leftover.unlink()


def forget_expired(store: JobStore, storage: Storage, *, keep_days: float) -> int:
    """Delete jobs that were over long ago, and idempotency keys; return how many jobs."""
    now = time.time()
    old = store.expired(now - keep_days * 86400.0)
    for job in old:
        # The row first: no job whose files are gone is ever shown.
        if store.forget(job.id):
            storage.delete(f"{_JOBS}{job.id}/")
    store.forget_submissions(now - _SUBMISSIONS_KEPT_S)
    return len(old)


def _dead_attempts(job: Job, files: list[Stat]) -> set[str]:
    """Return the prefixes of a job's attempts that will never count.

    One that was given up may still be writing when this looks; the next sweep finds the rest.
    """
    alive = {job.output}
    if job.state is JobState.RUNNING:
        alive.add(f"{_JOBS}{job.id}/{job.attempt}")
    attempts = {
        f"{_JOBS}{job.id}/{part}"
        for part in (stat.key.split("/")[2] for stat in files)
        if part.isdecimal()
    }
    return {f"{prefix}/" for prefix in attempts - alive}
