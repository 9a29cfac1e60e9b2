"""Handing in when names are long, the database breaks off, or the storage is slow."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from stillpath.service.database.errors import DatabaseAway
from tests.service.api.serving import post
from tests.service.api.test_submitting import folders
from tests.service.test_api import assert_problem, over, until


def test_a_commit_whose_answer_was_lost(
    client: TestClient, data_dir: Path, monkeypatch: pytest.MonkeyPatch
):
    """The connection broke after the commit: the job is there, and so must be its file."""
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


def test_a_slow_storage_leaves_threads_to_others(
    client: TestClient, monkeypatch: pytest.MonkeyPatch
):
    put_all, goes_on = client.app.state.storage.put_all, threading.Event()
    waiting = threading.Semaphore(0)

    def slow(files: Mapping[str, Path]) -> None:
        waiting.release()
        goes_on.wait()
        put_all(files)

    monkeypatch.setattr(client.app.state.storage, "put_all", slow)
    with ThreadPoolExecutor(30) as threads:
        answers = [threads.submit(post, client, b"G1 X%d" % n, "&fresh=true") for n in range(30)]
        try:
            for _ in range(12):
                assert waiting.acquire(timeout=120)
            assert not waiting.acquire(timeout=1)
            assert client.get("/v1/jobs").status_code == 200
        finally:
            goes_on.set()
        assert {answer.result().status_code for answer in answers} == {202}
