"""Routes of health: alive, and ready."""

from __future__ import annotations

import structlog
from fastapi import APIRouter, Request
from starlette.concurrency import run_in_threadpool

from service.api.problems import Problem, responses
from service.api.schemas import Health
from service.database.engine import StoreError
from service.jobs.store import JobStore
from service.storage.base import Storage, StorageError
from service.version import __version__

__all__ = ["reason_not_ready", "router"]

router = APIRouter(tags=["health"])


@router.get("/healthz", summary="Is the process alive?")
async def healthz() -> Health:
    """Answer as long as the process can."""
    return Health(status="ok", version=__version__)


@router.get("/readyz", responses=responses(503), summary="Are jobs taken and done?")
async def readyz(request: Request) -> Health:
    """Answer `ok` while database, storage and workers are there, else 503 with the reason."""
    found = await run_in_threadpool(reason_not_ready, request)
    if found is not None:
        part, reason = found
        structlog.get_logger("api").warning("not ready", part=part, reason=reason)
        raise Problem(503, "Not ready", f"{part}: {reason}", part=part)
    return Health(status="ok", version=__version__)


def reason_not_ready(request: Request) -> tuple[str, str] | None:
    """Return which part does not answer, and why; None: all do."""
    store: JobStore = request.app.state.store
    storage: Storage = request.app.state.storage
    try:
        store.oldest_queued_at()
    except StoreError as error:
        return "database", str(error)
    try:
        storage.check()
    except StorageError as error:
        return "storage", str(error)
    reason: str | None = request.app.state.work.is_ready
    return None if reason is None else ("workers", reason)
