"""Frequency responses of machines: against the models' own, and over HTTP."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from fastapi import FastAPI
from starlette.testclient import TestClient

from stillpath.applications.machines.frequency import axis_responses
from stillpath.applications.machines.resolve import Resolver
from stillpath.applications.machines.store import MachineStore
from stillpath.models.plants import frequency_response
from stillpath.models.store import builtin_machines, load_machine
from stillpath.service.api import access, frequency, problems
from stillpath.service.security.callers import LOCAL
from tests.service.machines import make_machine


@pytest.mark.parametrize("name", builtin_machines())
def test_curves_are_the_plants_own(name: str):
    machine = load_machine(name)
    for found in axis_responses(machine):
        plants = machine.axes[found.axis]
        curve = found.nominal
        truth = frequency_response(plants.nominal, curve.f_hz)
        np.testing.assert_allclose(curve.magnitude, np.abs(truth), rtol=2e-3)  # five digits
        turned = np.exp(1j * np.radians(curve.phase_deg))
        np.testing.assert_allclose(turned, truth / np.abs(truth), atol=2e-2)
        assert len(found.members) <= 15
        assert all(m.f_hz == curve.f_hz for m in found.members)
        # Every resonance is in the plot.
        assert all(curve.f_hz[0] < mode.f_hz < curve.f_hz[-1] for mode in found.modes)


@pytest.fixture
def client(tmp_path: Path) -> Iterator[TestClient]:
    app = FastAPI()
    problems.install(app)
    app.state.machines = Resolver(MachineStore(tmp_path), require_approval=False, max_age_days=180)
    app.include_router(frequency.router)
    app.dependency_overrides[access._reader] = lambda: LOCAL
    with TestClient(app) as opened:
        yield opened


def test_revisions_have_responses_of_their_own(client: TestClient):
    store = client.app.state.machines.store  # type: ignore[attr-defined]
    first, second = make_machine(), make_machine(axes=load_machine("ender3").model_dump()["axes"])
    store.add_revision("mine", first, author="anna", message="", expected=0)
    store.add_revision("mine", second, author="anna", message="", expected=1)

    def modes(**query: int) -> list[float]:
        answer = client.get("/v1/machines/mine/response", params=query)
        assert answer.status_code == 200, answer.text
        x, _ = answer.json()
        return [mode["f_hz"] for mode in x["modes"]]

    assert modes(revision=1) == [60.0]
    assert modes() == modes(revision=2) != modes(revision=1)


@pytest.mark.parametrize("where", ["nobody/response", "mine/response?revision=3"])
def test_what_is_not_there_is_said(client: TestClient, where: str):
    answer = client.get(f"/v1/machines/{where}")
    assert answer.status_code == 404
    assert answer.headers["content-type"] == "application/problem+json"
