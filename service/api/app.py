"""The application: settings in, ASGI application out. Nothing is global or started at import."""

from __future__ import annotations

import threading
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from typing import Any

from anyio import CapacityLimiter
from fastapi import Depends, FastAPI
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import State

from stillpath.applications.identification.archive import Archive
from stillpath.applications.machines.resolve import Resolver
from stillpath.applications.machines.store import MachineStore
from stillpath.service.api import (
    controllers,
    designs,
    documentation,
    events,
    frequency,
    health,
    identifications,
    jobs,
    keys,
    live,
    machine_settings,
    machines,
    metrics,
    octoprint,
    pages,
    printers,
    problems,
    report_schema,
    results,
    trajectories,
)
from stillpath.service.api.computing import StillRunning, still_running
from stillpath.service.api.file_responses import Verified
from stillpath.service.api.guard import Guard, hosts_of
from stillpath.service.api.hub import Hub
from stillpath.service.api.intake import Intake
from stillpath.service.api.limits import CallerLimits
from stillpath.service.api.parameters import refuse_unknown_parameters
from stillpath.service.api.proxies import Proxies
from stillpath.service.database.documents import open_documents
from stillpath.service.database.engine import open_database
from stillpath.service.deliveries.checking import Checker
from stillpath.service.deliveries.printers import load_printers
from stillpath.service.deliveries.sender import Sender
from stillpath.service.jobs.store import JobStore
from stillpath.service.jobs.task import Runner
from stillpath.service.jobs.worker import run_compensation
from stillpath.service.jobs.workforce import Workforce
from stillpath.service.security.audit import AuditLog
from stillpath.service.security.keys import KeyStore, announce_first_key
from stillpath.service.settings import Settings
from stillpath.service.storage.disk import Disk
from stillpath.service.storage.factory import open_storage
from stillpath.version import __version__

__all__ = ["create_app"]

_DESCRIPTION = """\
Hand in a sliced file, name the machine, and fetch a file that keeps the nozzle on its path,
with a report whose figures were measured on the written file.

    curl -sS --data-binary @part.gcode 'http://localhost:8000/v1/jobs?machine=ender3&name=part.gcode'

Errors are `application/problem+json` (RFC 9457).
"""


class _App(FastAPI):
    """FastAPI builds the document without a lock, so two threads would see it half built."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self._describing = threading.Lock()

    def openapi(self) -> dict[str, Any]:
        """Return the OpenAPI document."""
        with self._describing:
            return super().openapi()


def create_app(
    settings: Settings, *, keys_required: bool = False, runner: Runner = run_compensation
) -> FastAPI:
    """Return the HTTP application.

    The database is opened and the workers are started with the application's lifespan and end
    with it.

    Parameters
    ----------
    keys_required : bool
        Whether callers must show a key (`service.security.keys.keys_needed`).
    runner : callable
        Does the work of a job in the worker process; replaceable in tests.
    """

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        async with AsyncExitStack() as stack:
            await _open(app, settings, runner, stack)
            yield

    app = _App(
        title="Stillpath",
        version=__version__,
        description=_DESCRIPTION,
        license_info={"name": "Apache-2.0", "identifier": "Apache-2.0"},
        lifespan=lifespan,
        redoc_url=None,
        docs_url=None,
    )
    _prepare(app.state, settings, keys_required=keys_required)
    app.add_middleware(
        Guard, allowed_hosts=hosts_of(settings, keys_required), trusts_all=not keys_required
    )
    app.add_middleware(metrics.RequestMetrics, metrics=app.state.metrics)
    app.add_middleware(Proxies, trusted=settings.trusted_proxies)
    problems.install(app)
    app.add_exception_handler(StillRunning, still_running)
    _include_routes(app)
    return app


def _prepare(state: State, settings: Settings, *, keys_required: bool) -> None:
    """Set what needs neither database nor workers."""
    state.settings = settings
    state.keys_required = keys_required
    state.limits = CallerLimits(settings.requests_per_minute)
    state.readiness = health.Readiness()
    state.printers = load_printers(settings.printers)
    state.unshared = set()  # ids of jobs that only the caller who made them knows
    state.metrics = metrics.Metrics(
        lambda: state.store,
        lambda: state.workforce.workers,
        lambda: state.hub.watchers,
        lambda: state.disk.free_bytes() if settings.disk_reserve_bytes else None,
    )


def _include_routes(app: FastAPI) -> None:
    app.include_router(health.router)
    app.include_router(pages.router)
    app.include_router(documentation.router)
    for part in (
        jobs,
        events,
        results,
        trajectories,
        report_schema,
        machines,
        machine_settings,
        frequency,
        designs,
        live,
        identifications,
        controllers,
        printers,
        keys,
    ):
        app.include_router(
            part.router,
            dependencies=[Depends(refuse_unknown_parameters)],
            responses=problems.responses(401, 403, 422, 429, 503),
        )
    for others in (octoprint, metrics):  # what slicers and collectors add is theirs
        app.include_router(others.router, responses=problems.responses(401, 403, 422, 429, 503))


async def _open(app: FastAPI, settings: Settings, runner: Runner, stack: AsyncExitStack) -> None:
    """Open and start everything; the stack closes it in reverse order."""
    state = app.state
    engine = await run_in_threadpool(open_database, settings)
    stack.callback(engine.dispose)
    storage = await run_in_threadpool(open_storage, settings)
    state.store = JobStore(engine)
    state.storage = storage
    state.disk = Disk(settings.data_dir, settings.disk_reserve_bytes)
    state.keys = KeyStore(engine)
    state.audit = AuditLog(engine)
    if state.keys_required:
        await run_in_threadpool(
            announce_first_key, state.keys, settings.first_key, settings.data_dir
        )
    state.machines = Resolver(
        MachineStore(open_documents(settings, engine, "machines")),
        require_approval=settings.require_approval,
        max_age_days=settings.measurement_max_age_days,
    )
    state.identifications = Archive(open_documents(settings, engine, "identifications"))
    state.layers = results.Layers(storage)
    state.verified = Verified(storage)
    state.checker = Checker(open_documents(settings, engine, "printers"))
    state.printer_checks = CapacityLimiter(printers.CHECKED_AT_ONCE)
    state.intake = Intake(
        settings,
        state.store,
        storage,
        state.machines,
        state.printers,
        state.audit,
        state.checker,
        state.disk,
    )
    await run_in_threadpool(state.intake.prepare)
    state.deliveries = Sender(engine, state.store, storage, settings, state.printers, state.checker)
    await run_in_threadpool(state.deliveries.start)
    stack.push_async_callback(run_in_threadpool, state.deliveries.stop)
    state.workforce = Workforce(settings, state.store, storage, runner=runner)
    await run_in_threadpool(state.workforce.start)
    stack.push_async_callback(run_in_threadpool, state.workforce.stop)
    state.hub = Hub(state.store)
    await state.hub.start()
    stack.push_async_callback(state.hub.stop)
