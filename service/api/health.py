"""Routes of health: alive, and ready."""

from __future__ import annotations

import asyncio
import time

import structlog
from fastapi import APIRouter, Request
from starlette.concurrency import run_in_threadpool

from stillpath.service.api.problems import Problem, not_ready, responses
from stillpath.service.api.schemas import Health
from stillpath.service.database.errors import StoreError
from stillpath.service.jobs.store import JobStore
from stillpath.service.storage.base import Storage, StorageError
from stillpath.service.storage.disk import Disk
from stillpath.version import __version__, build

__all__ = ["Readiness", "router"]

_FRESH_S = 2.0

router = APIRouter(tags=["health"])


@router.get("/healthz", summary="Liveness probe")
async def healthz() -> Health:
    """Return `ok` while the process runs."""
    return Health(status="ok", version=__version__, build=build())


@router.get("/readyz", responses=responses(503), summary="Readiness probe")
async def readyz(request: Request) -> Health:
    """Return `ok` if database, storage, disk and workers respond; otherwise 503 and what does not.

    No key is needed and requests are not limited: the parts are asked at most once in two seconds.
    The reason, which may name other computers, is in the log.
    """
    part = await request.app.state.readiness.missing(request)
    if part is not None:
        raise Problem(503, "Not ready", not_ready(part), part=part)
    return Health(status="ok", version=__version__, build=build())


class Readiness:
    """Which part of the service does not answer, as of a moment ago."""

    def __init__(self) -> None:
        self._lock = asyncio.Lock()  # those who wait hold no thread: a part may take its time
        self._asked_at = -_FRESH_S
        self._missing: str | None = None

    async def missing(self, request: Request) -> str | None:
        """Return `database`, `storage`, `disk` or `workers`; None: all are well."""
        async with self._lock:
            if time.monotonic() - self._asked_at >= _FRESH_S:
                found = await run_in_threadpool(_reason, request)
                if found is not None:
                    part, reason = found
                    structlog.get_logger("api").warning("not ready", part=part, reason=reason)
                self._missing = found and found[0]
                self._asked_at = time.monotonic()
            return self._missing


def _reason(request: Request) -> tuple[str, str] | None:
    """Return which part does not answer, and why; None: all do."""
    store: JobStore = request.app.state.store
    storage: Storage = request.app.state.storage
    try:
        store.check()
    except StoreError as error:
        return "database", str(error)
    try:
        storage.check()
    except StorageError as error:
        return "storage", str(error)
    disk: Disk = request.app.state.disk
    full = disk.refusal()
    if full is not None:
        return "disk", full
    reason: str | None = request.app.state.workforce.not_ready_reason
    return None if reason is None else ("workers", reason)
