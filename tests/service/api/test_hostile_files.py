"""Hostile files at every route that computes: the API stays small and answers, jobs go on."""

from __future__ import annotations

import contextlib
import socket
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx2
import psutil
import pytest

from tests.service.api.hostile_requests import (
    MEASUREMENTS,
    SENDER,
    hostile_requests,
    spectrum,
    watched,
)
from tests.service.test_server import PRETEND, finished, post, server, until

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="the system limits no memory"),
]

MIB = 1 << 20
HELD_UP_S = 0.5
"""Of CPU in the API's own thread between a question and its answer, however busy the computer is.
How quick the API is on a quiet one, says `benchmarks/hostile_service.py`."""
STUCK_S = 5.0
"""What an API takes to answer that waits for something, or computes elsewhere and holds the
interpreter."""


BUSY = """
import sys, time, uvicorn
async def app(scope, receive, send):
    if scope["path"] == "/busy":
        until = time.thread_time() + 1.0
        while time.thread_time() < until:
            pass
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": b""})
uvicorn.run(app, port=int(sys.argv[1]), lifespan="off", log_level="error")
"""
"""An API that computes in its own thread, for a second."""


def answer_to(ask: Callable[[], httpx2.Response]) -> httpx2.Response:
    """Ask again while the answer takes longer than a request waits."""
    for _ in range(5):
        answer = ask()
        if answer.status_code != 202:
            break
    return answer


def test_hostile_files_at_all_routes_that_compute(tmp_path: Path) -> None:
    import resource

    with server(PRETEND, tmp_path) as (client, process), ThreadPoolExecutor(24) as pool:
        assert client.post(MEASUREMENTS, **spectrum(100)).status_code in (200, 422)
        done = finished(client, post(client, b"stamp"))
        # 170 MB of libraries, and 40 threads with 8 MB of stack each, before any request.
        resource.prlimit(process.pid, resource.RLIMIT_DATA, (750 * MIB,) * 2)
        with watched(client, process) as seen:
            job = post(client, b"nap 5")
            asked = hostile_requests(client, done["links"]["trajectories"])
            answers = [one.result() for one in [pool.submit(answer_to, ask) for ask in asked]]
            other = finished(client, job)
    for answer in answers:
        assert answer.status_code in (200, 422, 429), answer.text
    assert other["state"] == "done"
    assert seen.failures == []
    assert "at most 2500 are read" in answers[0].text
    assert "at most 2500 are read" in answers[1].text
    assert seen.largest_bytes < 300 * MIB
    assert seen.busiest_s < HELD_UP_S
    assert seen.slowest_s < STUCK_S


def test_six_large_logs_at_once(tmp_path: Path) -> None:
    with server(PRETEND, tmp_path) as (client, process):
        port = client.base_url.port
        with watched(client, process) as seen:
            job = post(client, b"nap 5")
            senders = [
                subprocess.Popen(
                    [*SENDER, str(port), MEASUREMENTS, "190"], stdout=subprocess.PIPE, text=True
                )
                for _ in range(6)
            ]
            said = [sender.communicate()[0] for sender in senders]
            other = finished(client, job)
        left = list((tmp_path / "incoming").iterdir())
    assert left == []
    for text in said:
        assert "at most 1000000 samples are read" in text
    assert other["state"] == "done"
    assert seen.failures == []
    assert seen.largest_bytes < 300 * MIB
    assert seen.busiest_s < HELD_UP_S
    assert seen.slowest_s < STUCK_S


def test_a_caller_who_hangs_up_ends_the_computation(tmp_path: Path) -> None:
    where = "/v1/machines/ender3/design?axis=x&robust=minimax"
    with server(PRETEND, tmp_path) as (client, process):
        finished(client, post(client, b"G1 X1"))  # the workers are there
        before = family(process)
        with pytest.raises(httpx2.ReadTimeout), httpx2.Client(base_url=client.base_url) as hasty:
            hasty.get(where, timeout=2.0)
        assert until(lambda: family(process) <= before, 20)


def test_it_goes_on_for_somebody_else(tmp_path: Path) -> None:
    """Who was told that the job goes on has not lost it."""
    where = "/v1/machines/ender3/design?axis=x&robust=minimax"
    with server(PRETEND, tmp_path) as (client, _):
        with socket.create_connection(("127.0.0.1", client.base_url.port)) as first:
            first.sendall(f"GET {where} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
            (job,) = until(lambda: client.get("/v1/jobs?kind=design").json()["jobs"])
            told = client.get(where, headers={"Prefer": "respond-async"})
            assert (told.status_code, told.json()["id"]) == (202, job["id"])
        until(lambda: state_of(client, job) not in ("queued", "running"), 120)
        assert state_of(client, job) == "done"


def state_of(client: httpx2.Client, job: dict[str, Any]) -> str:
    return client.get(job["links"]["self"]).json()["state"]


def family(process: subprocess.Popen[str]) -> set[int]:
    return {child.pid for child in psutil.Process(process.pid).children(recursive=True)}


def test_an_api_that_computes_is_seen() -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with (
        subprocess.Popen([sys.executable, "-c", BUSY, str(port)], text=True) as process,
        httpx2.Client(base_url=f"http://127.0.0.1:{port}", timeout=60) as client,
    ):

        def answers() -> bool:
            with contextlib.suppress(httpx2.TransportError):
                return client.get("/healthz").status_code == 200
            return False

        try:
            assert until(answers, 30)
            with watched(client, process) as seen:
                for _ in range(3):
                    client.get("/busy")
        finally:
            process.terminate()
    assert seen.failures == []
    assert seen.busiest_s > HELD_UP_S
