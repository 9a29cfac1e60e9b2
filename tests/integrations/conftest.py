"""What all tests here share: a server, a Klipper; and which programs were not there."""

from __future__ import annotations

import copy
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from stillpath.applications.live.export import write_export
from stillpath.models.store import load_machine
from tests.integrations.klipper_host import NO_KLIPPER, klipper_with_extra
from tests.integrations.moonraker import NO_MOONRAKER
from tests.integrations.octoprint import NO_OCTOPRINT
from tests.integrations.running import Running
from tests.integrations.slicers import NOT_HERE
from tests.missing import tell
from tests.service.test_server import server

_ODD_SERVER = Path(__file__).with_name("odd_server.py")


@pytest.fixture(scope="session")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    """The server with the pretended pipeline, a process of its own."""
    data = tmp_path_factory.mktemp("server")
    with server([sys.executable, str(_ODD_SERVER)], data) as (client, _):
        yield Running(client, data)


@pytest.fixture
def address(running: Running) -> str:
    """Its address."""
    return running.address


@pytest.fixture(autouse=True)
def alone(request: pytest.FixtureRequest) -> Iterator[None]:
    """Leave no jobs on the server that all share: another test would find them."""
    yield
    if "running" in request.fixturenames:
        running: Running = request.getfixturevalue("running")
        for job in running.job_ids():
            running.client.delete(f"/v1/jobs/{job}")


@pytest.fixture(scope="session")
def klipper_live(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Klipper's host with the extra."""
    return klipper_with_extra(tmp_path_factory.mktemp("klipper"))


@pytest.fixture(scope="session")
def export(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], dict[str, Any]]:
    """The export of a built-in machine, designed once."""
    folder, made = tmp_path_factory.mktemp("exports"), {}

    def of(name: str) -> dict[str, Any]:
        if name not in made:
            made[name] = write_export(load_machine(name), folder / f"{name}.json")
        return copy.deepcopy(made[name])

    return of


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    tell(terminalreporter, NOT_HERE, "a slicer (tests/integrations/get-slicers)")
    tell(terminalreporter, NO_OCTOPRINT, "OctoPrint (tests/get-tools)")
    tell(terminalreporter, NO_MOONRAKER, "Moonraker (tests/get-tools)")
    tell(terminalreporter, NO_KLIPPER, "Klipper's host (tests/get-tools)")
