"""Routes of machines and health."""

from __future__ import annotations

from fastapi import APIRouter, Request

from models.machine import Machine
from models.store import builtin_machines, load_machine
from service.api.problems import Problem, responses
from service.api.schemas import Health, MachineSummary
from service.jobs.supervisor import Supervisor
from service.version import __version__

__all__ = ["router"]

router = APIRouter()


@router.get("/v1/machines", tags=["machines"], summary="List the machines")
def list_machines() -> list[MachineSummary]:
    """Return the machines a job can name."""
    return [_summary(load_machine(name)) for name in builtin_machines()]


@router.get(
    "/v1/machines/{name}", tags=["machines"], responses=responses(404), summary="Show one machine"
)
def read_machine(name: str) -> Machine:
    """Return the whole document of a machine: travel, limits, firmware, plants."""
    # A name only: a path must not reach the loader from outside.
    if name not in builtin_machines():
        known = ", ".join(builtin_machines())
        raise Problem(404, "Unknown machine", f"No machine is called {name!r}. Known: {known}.")
    return load_machine(name)


@router.get("/healthz", tags=["health"], summary="Is the process alive?")
def healthz() -> Health:
    """Answer as long as the process can."""
    return Health(status="ok", version=__version__)


@router.get("/readyz", tags=["health"], responses=responses(503), summary="Are jobs being done?")
def readyz(request: Request) -> Health:
    """Answer `ok` while workers take jobs, else 503."""
    supervisor: Supervisor = request.app.state.supervisor
    if not supervisor.is_ready:
        raise Problem(503, "Not ready", "No worker takes jobs; the service's log says why.")
    return Health(status="ok", version=__version__)


def _summary(machine: Machine) -> MachineSummary:
    return MachineSummary(
        name=machine.name,
        title=machine.title,
        kinematics=machine.kinematics,
        revision=machine.revision,
        source=machine.source,
    )
