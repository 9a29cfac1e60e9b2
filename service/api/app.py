"""The application: settings in, ASGI application out. Nothing is global or started at import."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from fastapi import FastAPI
from starlette.concurrency import run_in_threadpool
from starlette.responses import FileResponse

from service.api import controllers, designs, health, identifications, jobs, machines, problems
from service.api.guard import Guard
from service.identification.archive import Archive
from service.jobs.store import JobStore
from service.jobs.supervisor import Supervisor
from service.jobs.worker import Runner, run_task
from service.machines.resolve import Resolver
from service.machines.store import MachineStore
from service.settings import Settings
from service.version import __version__

__all__ = ["create_app"]

_PAGE = Path(__file__).with_name("page.html")
# The pages hold their own script and style; nothing may be fetched from anywhere else.
_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
    "img-src data:; connect-src 'self'; form-action 'none'; base-uri 'none'; frame-ancestors 'none'"
)
_DESCRIPTION = """\
Hand in a sliced file, name the machine, and fetch a file that keeps the nozzle on its path,
with a report whose figures were measured on the written file.

    curl -sS --data-binary @part.gcode 'http://localhost:8000/v1/jobs?machine=ender3&name=part.gcode'

Errors are `application/problem+json` (RFC 9457).
"""


def create_app(settings: Settings, *, runner: Runner = run_task) -> FastAPI:
    """Return the HTTP application.

    The database is opened and the workers are started with the application's lifespan and end
    with it.

    Parameters
    ----------
    settings : Settings
    runner : callable
        Does the work of a job in the worker process; tests put another in.
    """

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        store = JobStore(settings.data_dir)
        supervisor = Supervisor(
            store,
            workers=settings.workers,
            max_attempts=settings.max_attempts,
            cancel_grace_s=settings.cancel_grace_s,
            runner=runner,
        )
        app.state.store = store
        app.state.supervisor = supervisor
        supervisor.start()
        try:
            yield
        finally:
            await run_in_threadpool(supervisor.stop)
            store.close()

    app = FastAPI(
        title="Stillpath",
        version=__version__,
        description=_DESCRIPTION,
        license_info={"name": "Apache-2.0", "identifier": "Apache-2.0"},
        lifespan=lifespan,
        redoc_url=None,
        docs_url=None,
    )
    app.state.settings = settings
    app.state.designs = designs.Designs()
    app.state.controllers = controllers.Controllers()
    app.state.identifications = identifications.Identifications(
        Archive(settings.data_dir / "identifications")
    )
    app.state.machines = Resolver(
        MachineStore(settings.data_dir / "machines"),
        require_approval=settings.require_approval,
        max_age_days=settings.measurement_max_age_days,
    )
    app.add_middleware(Guard, allow_remote=settings.allow_remote)
    problems.install(app)
    app.include_router(jobs.router)
    app.include_router(machines.router)
    app.include_router(designs.router)
    app.include_router(identifications.router)
    app.include_router(controllers.router)
    app.include_router(health.router)

    @app.get("/", include_in_schema=False)
    def page() -> FileResponse:
        return FileResponse(
            _PAGE,
            media_type="text/html",
            headers={"Content-Security-Policy": _POLICY, "X-Content-Type-Options": "nosniff"},
        )

    return app
