"""Routes of health."""

from __future__ import annotations

from fastapi import APIRouter, Request

from service.api.problems import Problem, responses
from service.api.schemas import Health
from service.jobs.supervisor import Supervisor
from service.version import __version__

__all__ = ["router"]

router = APIRouter(tags=["health"])


@router.get("/healthz", summary="Is the process alive?")
def healthz() -> Health:
    """Answer as long as the process can."""
    return Health(status="ok", version=__version__)


@router.get("/readyz", responses=responses(503), summary="Are jobs being done?")
def readyz(request: Request) -> Health:
    """Answer `ok` while workers take jobs, else 503."""
    supervisor: Supervisor = request.app.state.supervisor
    if not supervisor.is_ready:
        raise Problem(503, "Not ready", "No worker takes jobs; the service's log says why.")
    return Health(status="ok", version=__version__)
