"""Add-on controllers over HTTP."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from stillpath.applications.controllers.design import design_controller
from stillpath.applications.controllers.figures import ControllerReport
from stillpath.applications.controllers.options import read_options
from stillpath.models.loops import builtin_loops, load_loop
from stillpath.service.api import create_app
from stillpath.service.settings import Settings
from tests.service.runners import pretend
from tests.service.test_api import assert_problem

FMSDOB = {"method": "fmsdob", "targets_hz": [2000.0]}
WHERE = "/v1/machines/galvo-40khz/controllers"


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    app = create_app(Settings(data_dir=tmp_path_factory.mktemp("data")), runner=pretend)
    with TestClient(app, base_url="http://localhost", raise_server_exceptions=False) as opened:
        yield opened


def test_loops(client: TestClient) -> None:
    found = client.get("/v1/loops").json()
    assert [loop["name"] for loop in found] == builtin_loops()
    assert all(loop["methods"] for loop in found)


def test_same_figures_as_the_command(client: TestClient) -> None:
    answer = client.post(WHERE, json=FMSDOB)
    assert answer.status_code == 200
    expected = design_controller(load_loop("galvo-40khz"), read_options(FMSDOB))
    assert ControllerReport.model_validate(answer.json()) == ControllerReport.model_validate_json(
        expected.report.model_dump_json()
    )
    header = client.post(WHERE, json=FMSDOB, params={"format": "c"})
    assert header.text == expected.controller.to_c_header()
    for asked in ({"headers": {"Accept": "text/html"}}, {"params": {"format": "html"}}):
        page = client.post(WHERE, json=FMSDOB, **asked)
        assert page.headers["content-type"].startswith("text/html")
        assert page.text.startswith("<!doctype html>")


def test_machine_in_the_body(client: TestClient) -> None:
    own = load_loop("galvo-40khz").model_dump(mode="json", exclude_none=True) | {"name": "mine"}
    body = FMSDOB | {"loop": own}
    answer = client.post("/v1/machines/mine/controllers", json=body)
    assert answer.json()["machine"] == "mine"
    assert_problem(client.post(WHERE, json=body), 422, "'mine'")
    unstable = own | {"loop": own["loop"] | {"den": [1, -1.2]}}
    answer = client.post("/v1/machines/mine/controllers", json=FMSDOB | {"loop": unstable})
    assert_problem(answer, 422, "unstable")


@pytest.mark.parametrize(
    ("change", "words", "reason"),
    [
        ({"uncertainty": 2.0}, "1/|T|", "small gain"),
        ({"targets_hz": [2000.0] * 9}, "at most 8", None),
        ({"method": "magic"}, "magic", None),
    ],
)
def test_a_refused_design_says_why(
    client: TestClient, change: dict[str, Any], words: str, reason: str | None
) -> None:
    answer = client.post(WHERE, json=FMSDOB | change)
    assert_problem(answer, 422, words)
    assert answer.json().get("reason") == reason


def test_a_disturbance_without_end(client: TestClient) -> None:
    slow = {"kind": "periodic", "f_hz": 1e-90, "amplitudes": [1.0]}
    assert_problem(client.post(WHERE, json=FMSDOB | {"disturbance": slow}), 422, "0.001 Hz")


def test_options_that_are_not_sent_as_json(client: TestClient) -> None:
    sent = client.post(WHERE, content=b'{"method": "fmsdob"}')
    document = assert_problem(sent, 422, "a JSON object, sent as application/json")
    assert "fmsdob" not in document["detail"]


def test_no_file_is_reached(client: TestClient, tmp_path: Path) -> None:
    file = tmp_path / "x.json"
    file.write_text(load_loop("galvo-40khz").model_dump_json())
    body = {"method": "rc-multirate", "fundamental_hz": 1000, "fast": str(file)}
    assert_problem(client.post(WHERE, json=body), 422)
    assert_problem(client.post("/v1/machines/x.json/controllers", json=FMSDOB), 404, "x.json")
    assert_problem(client.post("/v1/machines/ender3/controllers", json=FMSDOB), 404, "ender3")
