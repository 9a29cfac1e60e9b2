"""Health, readiness and figures for Prometheus."""

from __future__ import annotations

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families

from stillpath.service.api.metrics import Metrics
from stillpath.service.database.engine import open_database
from stillpath.service.database.errors import DatabaseAway
from stillpath.service.jobs.store import JobStore
from stillpath.service.settings import Settings
from stillpath.service.storage.base import StorageError
from tests.service.api.serving import opened, post
from tests.service.database.examples import finished, make_job
from tests.service.test_api import assert_problem, over, until

_ENDS = ("started", "finished")


def figures(text: str) -> dict[tuple[str, frozenset[tuple[str, str]]], float]:
    return {
        (sample.name, frozenset(sample.labels.items())): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def test_metrics_count_jobs_and_requests_by_route(tmp_path: Path):
    with opened(tmp_path) as client:
        assert client.get("/healthz").json()["status"] == "ok"
        assert client.get("/readyz").json()["status"] == "ok"
        until(client, post(client, b"G1 X1").headers["location"], over)
        until(client, post(client, b"bad").headers["location"], over)
        client.get("/v1/machines/what-a-caller-wrote")
        client.get("/nowhere")
        answer = client.get("/metrics")
        assert answer.headers["content-type"].startswith("text/plain; version=")
        found = figures(answer.text)
        assert found["stillpath_jobs", frozenset({("state", "done")})] == 1
        assert found["stillpath_jobs", frozenset({("state", "failed")})] == 1
        assert found["stillpath_queue_oldest_seconds", frozenset()] == 0
        assert found["stillpath_upload_bytes_total", frozenset()] == 8
        assert found["stillpath_workers", frozenset()] == 2
        assert found["stillpath_sse_watchers", frozenset()] == 0
        assert found["stillpath_database_up", frozenset()] == 1
        labels = {("method", "GET"), ("route", "/v1/machines/{name}"), ("status", "404")}
        assert found["stillpath_http_requests_total", frozenset(labels)] == 1
        labels = {("method", "GET"), ("route", "none"), ("status", "404")}
        assert found["stillpath_http_requests_total", frozenset(labels)] == 1
        assert "what-a-caller-wrote" not in answer.text


@pytest.mark.slow
def test_how_long_jobs_took(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("stillpath.service.api.metrics._SETTLED_S", 0.0)
    with opened(tmp_path) as client:
        made = [post(client, content) for content in (b"nap 1", b"G1 X1", b"bad")]
        jobs = [until(client, answer.headers["location"], over) for answer in made]
        took_s = [seconds_of(job) for job in jobs]
        assert took_s[0] >= 1
        for _ in range(2):  # none is counted twice
            found = figures(client.get("/metrics").text)
            for state, expected in (("done", took_s[:2]), ("failed", took_s[2:])):
                labels = {("state", state)}
                name = "stillpath_job_seconds"
                assert found[f"{name}_count", frozenset(labels)] == len(expected)
                total_s = found[f"{name}_sum", frozenset(labels)]
                assert total_s == pytest.approx(sum(expected), abs=1e-4)
                for limit in (1.0, 10.0, 600.0):
                    bucket = frozenset(labels | {("le", str(limit))})
                    within = sum(seconds <= limit for seconds in expected)
                    assert found[f"{name}_bucket", bucket] == within
                bucket = frozenset(labels | {("le", "+Inf")})
                assert found[f"{name}_bucket", bucket] == len(expected)


def test_a_clock_that_is_set_back_takes_nothing_off(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """A sum that falls is a restart to Prometheus."""
    monkeypatch.setattr("stillpath.service.api.metrics._SETTLED_S", 0.0)
    engine = open_database(Settings(data_dir=tmp_path))
    store = JobStore(engine)
    metrics = Metrics(lambda: store, lambda: None, lambda: 0)
    job = make_job()
    store.add(job)
    running = store.claim(job.id, time.time() + 100, "worker")
    assert running is not None
    assert store.apply(job.id, finished(running, at=time.time())) is not None
    found = figures(metrics.exposition().decode())
    engine.dispose()
    done = frozenset({("state", "done")})
    assert found["stillpath_job_seconds_count", done] == 1
    assert found["stillpath_job_seconds_sum", done] == 0


def seconds_of(job: dict[str, Any]) -> float:
    started, finished = (datetime.fromisoformat(job[f"{name}_at"]) for name in _ENDS)
    return (finished - started).total_seconds()


def test_who_waits_for_a_slow_part_holds_no_thread(tmp_path: Path, monkeypatch):
    with opened(tmp_path) as client, ThreadPoolExecutor(45) as pool:
        go = threading.Event()

        def slow() -> None:
            assert go.wait(30)

        monkeypatch.setattr(client.app.state.storage, "check", slow)
        waiting = [pool.submit(client.get, "/readyz") for _ in range(45)]
        assert client.get("/v1/machines").status_code == 200
        go.set()
        assert {answer.result().status_code for answer in waiting} == {200}


def test_not_ready_says_which_part(tmp_path: Path, monkeypatch):
    monkeypatch.setattr("stillpath.service.api.health._FRESH_S", 0.0)
    with opened(tmp_path) as client:
        state = client.app.state

        def storage_away() -> None:
            raise StorageError("the bucket does not answer")

        def database_away() -> None:
            raise DatabaseAway("the database does not answer")

        with monkeypatch.context() as patch:
            patch.setattr(state.storage, "check", storage_away)
            document = assert_problem(client.get("/readyz"), 503, "storage: see the log")
            assert document["part"] == "storage"
            assert "bucket" not in str(document)  # which may have a name that not all should know
        with monkeypatch.context() as patch:
            for name in ("check", "oldest_queued_at", "counts", "page"):
                patch.setattr(state.store, name, lambda *_, **__: database_away())
            assert_problem(client.get("/readyz"), 503, "database:")
            answer = client.get("/v1/jobs")
            assert_problem(answer, 503, "database")
            assert answer.headers["retry-after"] == "5"
            assert figures(client.get("/metrics").text)["stillpath_database_up", frozenset()] == 0
        assert client.get("/healthz").status_code == 200
