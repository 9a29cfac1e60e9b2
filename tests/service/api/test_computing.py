"""Everything that computes is a job: a record, a limit, a cancel, another try; one queue."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from tests.service.api.serving import opened, post
from tests.service.test_api import assert_problem
from tests.service.test_server import until

pytestmark = pytest.mark.slow

DESIGN = "/v1/machines/ender3/design?axis=x"
LONG = "/v1/machines/ender3/design?axis=y&robust=minimax&basis=bspline"
CONTROLLERS = "/v1/machines/galvo-40khz/controllers"
FMSDOB = {"method": "fmsdob", "targets_hz": [2000.0]}
AT_ONCE = {"Prefer": "respond-async"}


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    with opened(tmp_path_factory.mktemp("data")) as found:
        yield found


def jobs(client: TestClient, *kinds: str) -> list[dict[str, Any]]:
    return client.get("/v1/jobs", params={"kind": kinds}).json()["jobs"]


def over(client: TestClient, where: str) -> dict[str, Any]:
    def ask() -> dict[str, Any] | None:
        job = client.get(where).json()
        return job if job["state"] not in ("queued", "running") else None

    return until(ask, 120)


def running(client: TestClient, where: str) -> dict[str, Any]:
    def ask() -> dict[str, Any] | None:
        job = client.get(where).json()
        return job if job["state"] == "running" and job["stage"] == "designing" else None

    return until(ask, 60)


def test_who_does_not_wait_gets_the_job_and_asks_again(client: TestClient) -> None:
    answer = client.get(DESIGN, headers=AT_ONCE)
    assert answer.status_code == 202
    where = answer.headers["location"]
    assert answer.json()["kind"] == "design"
    assert answer.json()["links"]["self"] == where
    assert client.get(DESIGN, headers={"Prefer": "wait=0"}).headers["location"] == where
    job = over(client, where)
    assert (job["state"], job["machine"], job["progress"]) == ("done", "ender3", 1.0)
    again = client.get(DESIGN, headers=AT_ONCE)
    assert again.status_code == 200
    result = client.get(job["links"]["result"])
    assert result.headers["content-type"] == "application/json"
    assert result.json() == again.json()
    for page in (
        client.get(DESIGN.replace("?", ".html?")),
        client.get(DESIGN, headers={"Accept": "text/html,*/*;q=0.8"}),
    ):
        assert page.headers["content-type"].startswith("text/html")
        assert "Creality Ender 3, axis X" in page.text
    assert_problem(client.get(f"{where}/report"), 404, "design")
    assert job["links"]["report"] is None
    assert [one["id"] for one in jobs(client, "design")] == [job["id"]]
    assert job["id"] not in [one["id"] for one in jobs(client)]


def test_who_asks_the_same_waits_for_the_same_job(client: TestClient) -> None:
    with ThreadPoolExecutor(3) as pool:
        answers = list(pool.map(lambda _: client.post(CONTROLLERS, json=FMSDOB), range(3)))
    assert [answer.status_code for answer in answers] == [200] * 3
    assert len({answer.text for answer in answers}) == 1
    assert len(jobs(client, "controller")) == 1


def test_an_answer_that_the_disk_has_damaged_is_computed_anew(client: TestClient) -> None:
    asked = FMSDOB | {"targets_hz": [1700.0]}
    whole = client.post(CONTROLLERS, json=asked).json()
    job = jobs(client, "controller")[0]
    folder: Path = client.app.state.settings.data_dir / "jobs"  # type: ignore[attr-defined]
    (answer,) = (folder / job["id"]).glob("*/result/*")
    answer.write_bytes(b"x" * answer.stat().st_size)
    assert_problem(client.post(CONTROLLERS, json=asked), 503, "ask again")
    assert client.post(CONTROLLERS, json=asked).json() == whole


def test_what_is_refused_is_a_failed_job(client: TestClient) -> None:
    bad = FMSDOB | {"targets_hz": [19_999.0]}
    answer = client.post(CONTROLLERS, json=bad)
    assert_problem(answer, 422, "")
    (failed,) = [job for job in jobs(client, "controller") if job["state"] == "failed"]
    assert failed["error"] == answer.json()
    assert failed["error"]["title"] == "Controller not possible"


def test_cancelled_it_ends_and_its_process_is_free(client: TestClient) -> None:
    with ThreadPoolExecutor(1) as pool:
        asked = pool.submit(client.get, LONG)
        where = until(
            lambda: next(
                (j["links"]["self"] for j in jobs(client, "design") if j["state"] == "running"), ""
            )
        )
        running(client, where)
        assert client.post(f"{where}/cancel").json()["state"] == "cancelled"
        assert_problem(asked.result(), 409, "ask again")
    assert client.post(CONTROLLERS, json=FMSDOB | {"targets_hz": [1500.0]}).status_code == 200


def test_a_lost_process_is_another_try(client: TestClient) -> None:
    where = client.get("/v1/machines/ender3/design?axis=y", headers=AT_ONCE).headers["location"]
    running(client, where)
    row = client.app.state.store.get(where.rsplit("/", 1)[1])  # type: ignore[attr-defined]
    os.kill(int(row.worker.rsplit(":", 1)[1]), signal.SIGKILL)
    job = over(client, where)
    assert (job["state"], job["losses"], job["attempt"]) == ("done", 1, 2)


def test_short_jobs_do_not_wait_for_long_ones(client: TestClient) -> None:
    naps = [post(client, f"nap {n}.5".encode()).headers["location"] for n in (600, 601, 602)]
    answer = client.post(CONTROLLERS, json=FMSDOB | {"targets_hz": [1000.0]})
    assert answer.status_code == 200
    states = [client.get(nap).json()["state"] for nap in naps]
    assert "done" not in states
    assert states.count("running") <= 1, "what is kept for short jobs was given to a long one"
    for nap in naps:
        client.delete(nap)


@pytest.mark.skipif(sys.platform != "linux", reason="the system limits no memory")
@pytest.mark.parametrize(
    ("limit", "title"),
    [
        ({"max_computing_s": 0.1}, "STILLPATH_MAX_COMPUTING_S"),
        ({"max_computing_bytes": 64 << 20}, "STILLPATH_MAX_COMPUTING_BYTES"),
    ],
)
def test_limits_are_ordinary_failures(tmp_path: Path, limit: dict[str, Any], title: str) -> None:
    with opened(tmp_path, **limit) as client:
        answer = client.get(LONG)
        assert_problem(answer, 422, title)
        assert "fewer members" in answer.json()["detail"]
        # The compensations have limits of their own.
        assert over(client, post(client, b"nap 1").headers["location"])["state"] == "done"
        (job,) = jobs(client, "design")
        assert (job["state"], job["losses"]) == ("failed", 0)
