"""Health, readiness and figures for Prometheus."""

from __future__ import annotations

from pathlib import Path

from prometheus_client.parser import text_string_to_metric_families

from service.database.engine import DatabaseAway
from service.storage.base import StorageError
from tests.service.api.test_submitting import opened, post
from tests.service.test_api import assert_problem, over, until


def figures(text: str) -> dict[tuple[str, frozenset[tuple[str, str]]], float]:
    return {
        (sample.name, frozenset(sample.labels.items())): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def test_figures(tmp_path: Path):
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
        assert found["stillpath_workers", frozenset()] == 1
        assert found["stillpath_sse_watchers", frozenset()] == 0
        assert found["stillpath_database_up", frozenset()] == 1
        labels = {("method", "GET"), ("route", "/v1/machines/{name}"), ("status", "404")}
        assert found["stillpath_http_requests_total", frozenset(labels)] == 1
        labels = {("method", "GET"), ("route", "none"), ("status", "404")}
        assert found["stillpath_http_requests_total", frozenset(labels)] == 1
        assert "what-a-caller-wrote" not in answer.text
        assert "stillpath_job_seconds" in answer.text


def test_not_ready_says_why(tmp_path: Path, monkeypatch):
    with opened(tmp_path) as client:
        state = client.app.state

        def storage_away() -> None:
            raise StorageError("the bucket does not answer")

        def database_away() -> None:
            raise DatabaseAway("the database does not answer")

        with monkeypatch.context() as patch:
            patch.setattr(state.storage, "check", storage_away)
            document = assert_problem(client.get("/readyz"), 503, "storage: the bucket")
            assert document["part"] == "storage"
        with monkeypatch.context() as patch:
            for name in ("oldest_queued_at", "counts", "page"):
                patch.setattr(state.store, name, lambda *_, **__: database_away())
            assert_problem(client.get("/readyz"), 503, "database:")
            answer = client.get("/v1/jobs")
            assert_problem(answer, 503, "database")
            assert answer.headers["retry-after"] == "5"
            assert figures(client.get("/metrics").text)["stillpath_database_up", frozenset()] == 0
        assert client.get("/healthz").status_code == 200
