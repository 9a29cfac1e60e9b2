"""One server for all tests here; and which programs were not there, said loudly."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.integrations.klipper_host import NO_KLIPPER
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


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    tell(terminalreporter, NOT_HERE, "a slicer (tests/integrations/get-slicers)")
    tell(terminalreporter, NO_OCTOPRINT, "OctoPrint (tests/get-tools)")
    tell(terminalreporter, NO_MOONRAKER, "Moonraker (tests/get-tools)")
    tell(terminalreporter, NO_KLIPPER, "Klipper's host (tests/get-tools)")
