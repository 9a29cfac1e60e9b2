"""Handing in when names are long, and when the database breaks off."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from service.database.engine import DatabaseAway
from tests.service.api.serving import post
from tests.service.api.test_submitting import folders
from tests.service.test_api import assert_problem, over, until


def test_a_commit_whose_answer_was_lost(
    client: TestClient, data_dir: Path, monkeypatch: pytest.MonkeyPatch
):
    """The connection broke behind the commit: the job is there, and so must be its file."""
    store, add = client.app.state.store, client.app.state.store.add

    def lost(*args: Any, **more: Any) -> None:
        add(*args, **more)
        raise DatabaseAway("the connection broke")

    monkeypatch.setattr(store, "add", lost)
    header = {"Idempotency-Key": "lost-answer"}
    assert_problem(post(client, b"G1 X77", **header), 503)
    monkeypatch.undo()
    again = post(client, b"G1 X77", **header)
    assert again.status_code == 200
    assert until(client, f"/v1/jobs/{again.json()['id']}", over)["state"] == "done"

    def never(*_: Any, **__: Any) -> None:
        raise DatabaseAway("it is away")

    before = folders(data_dir)
    monkeypatch.setattr(store, "add", never)
    assert_problem(post(client, b"G1 X78"), 503)
    assert folders(data_dir) == before


def test_long_names_are_kept_short(client: TestClient):
    long = "\u3042" * 80
    job = post(client, b"G1 X79", f"&name={long}.gcode.3mf").json()
    assert job["source_name"].endswith("\u3042.gcode.3mf")
    found = until(client, f"/v1/jobs/{job['id']}", over)
    assert found["state"] == "done"
    assert client.get(f"/v1/jobs/{job['id']}/result").status_code == 200
