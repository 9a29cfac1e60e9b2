"""A server process of its own on a free port: streaming, kills and restarts, the real pipeline."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import httpx2
import psutil
import pytest

from tests.checkout import PYTHONPATH
from tests.service.jobs.site import STILLPATH, until

ROOT = Path(__file__).resolve().parents[2]
PRETEND = [sys.executable, str(Path(__file__).with_name("pretend_server.py"))]
REAL = [*STILLPATH, "serve", "--port", "0", "--data-dir"]


@contextmanager
def server(
    command: list[str], data_dir: Path, *more: str, log: Path | None = None
) -> Iterator[tuple[httpx2.Client, subprocess.Popen]]:
    stack = ExitStack()
    process = subprocess.Popen(
        [*command, str(data_dir), *more],
        stdout=subprocess.PIPE,
        stderr=None if log is None else stack.enter_context(log.open("wb")),
        text=True,
        env=os.environ | {"PYTHONPATH": PYTHONPATH},
        cwd=data_dir,
    )
    try:
        assert process.stdout is not None
        base = process.stdout.readline().removeprefix("stillpath: ").strip()
        assert base, "the server did not start"
        with httpx2.Client(base_url=base, timeout=180) as client:
            until(lambda: _answers(client))
            yield client, process
    finally:
        process.terminate()
        process.wait(timeout=180)
        if process.stdout is not None:
            process.stdout.close()
        stack.close()


def _answers(client: httpx2.Client) -> bool:
    try:
        return client.get("/readyz").status_code == 200
    except httpx2.TransportError:
        return False


def finished(client: httpx2.Client, where: str, seconds: float = 300.0) -> dict[str, Any]:
    def ask() -> dict[str, Any] | None:
        job = client.get(where).json()
        return job if job["state"] in ("done", "failed", "cancelled") else None

    return until(ask, seconds)


def post(client: httpx2.Client, content: Any, machine: str = "ender3") -> str:
    answer = client.post("/v1/jobs", params={"machine": machine}, content=content)
    assert answer.status_code == 202, answer.text
    return answer.headers["location"]


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="reads /proc")
def test_an_upload_goes_to_disk_and_not_into_memory(tmp_path: Path):
    size = 96 << 20
    big = tmp_path / "big.gcode"
    with big.open("wb") as file:
        file.write(b"slow ")
        file.truncate(size)
    data = tmp_path / "data"
    data.mkdir()
    with server(PRETEND, data) as (client, process):
        finished(client, post(client, b"G1 X1"))  # now all is imported that ever will be
        before = _peak_kb(process.pid)
        for form in (False, True):
            with big.open("rb") as file:
                sent = {"files": {"file": ("big.gcode", file)}} if form else {"content": file}
                answer = client.post("/v1/jobs", params={"machine": "ender3"}, **sent)
            assert answer.status_code == 202
            assert answer.json()["source_bytes"] == size
            assert _peak_kb(process.pid) - before < 24 << 10
            assert client.delete(answer.headers["location"]).status_code == 204


@pytest.mark.slow
def test_a_killed_server_finishes_its_jobs_after_the_next_start(tmp_path: Path):
    with server(PRETEND, tmp_path) as (client, process):
        running = post(client, b"slow-once")
        waiting = post(client, b"G1 X1")
        until(lambda: client.get(running).json()["state"] == "running")
        process.kill()
        process.wait()
    (tmp_path / "incoming" / "half").write_text("half an upload")
    with server(PRETEND, tmp_path) as (client, _):
        assert finished(client, running)["state"] == "done"
        assert finished(client, waiting)["state"] == "done"
        assert not (tmp_path / "incoming" / "half").exists()
        result = client.get(f"{running}/result")
        assert result.text == "; compensated\nslow-once"


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="counts processes of Linux")
def test_logs_are_json_whatever_is_killed(tmp_path: Path):
    log, data = tmp_path / "log", tmp_path / "data"
    data.mkdir()
    with server(PRETEND, data, log=log) as (client, process):
        finished(client, post(client, b"G1 X1"))
        job = post(client, b"slow-once")
        until(lambda: client.get(job).json()["state"] == "running")
        for child in psutil.Process(process.pid).children(recursive=True):
            if "resource_tracker" not in " ".join(child.cmdline()):
                child.kill()
        assert finished(client, job)["state"] == "done"
        client.get("/v1/machines/ender3/design?axis=x", headers={"Prefer": "wait=1"})
    lines = log.read_text().splitlines()
    assert len(lines) > 5
    assert all("event" in json.loads(line) for line in lines)
    assert "Traceback" not in log.read_text()


@pytest.mark.slow
def test_a_download_that_stalls_does_not_keep_a_server_from_its_end(tmp_path: Path):
    log, data = tmp_path / "log", tmp_path / "data"
    data.mkdir()
    with server(PRETEND, data, log=log) as (client, process):
        where = post(client, b"long 20")
        assert finished(client, where)["state"] == "done"
        with client.stream("GET", f"{where}/result") as answer:
            next(answer.iter_raw())
            process.send_signal(signal.SIGTERM)
            process.wait(timeout=60)
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    assert not any("exception" in line for line in lines)


@pytest.mark.slow
def test_a_deleted_data_directory_is_told_and_nothing_is_accepted(tmp_path: Path):
    data = tmp_path / "data"
    data.mkdir()
    with server(PRETEND, data) as (client, _):
        shutil.rmtree(data, ignore_errors=True)
        for answer in (
            client.post("/v1/jobs?machine=ender3", content=b"G1"),
            client.get("/v1/jobs"),
        ):
            assert answer.status_code == 503
            assert answer.json()["title"] == "Database unavailable"
        until(lambda: client.get("/readyz").json().get("part") == "database")


@pytest.mark.slow
def test_a_real_file_through_the_real_road(tmp_path: Path):
    """Its worker is killed once."""
    source = ROOT / "examples" / "ps_ender3_pauses_hept24f.gcode"
    with server(REAL, tmp_path) as (client, process):
        where = post(client, source.read_bytes())
        until(lambda: client.get(where).json()["stage"] == "compensating")
        for child in psutil.Process(process.pid).children(recursive=True):
            if "resource_tracker" not in " ".join(child.cmdline()):
                child.kill()
        bad = [post(client, text) for text in (b"\x00\xff" * 999, b"G1 X1e400\n", b"; nothing\n")]
        job = finished(client, where, 900)
        assert (job["state"], job["attempt"], job["losses"]) == ("done", 2, 1), job
        written = client.get(f"{where}/result")
        assert "attachment" in written.headers["content-disposition"]
        assert len(written.content) > 1000
        figures = client.get(f"{where}/report.json").json()
        rms = {c["name"]: c["extruding"]["contour_rms_um"] for c in figures["channels"]}
        assert rms["after"] < rms["before"]
        assert figures["written_bytes"] == len(written.content)
        assert "<!doctype html>" in client.get(f"{where}/report").text
        for failing in bad:
            job = finished(client, failing)
            assert job["error"]["status"] == 422, job
            assert client.get(f"{failing}/result").status_code == 409


def _peak_kb(pid: int) -> int:
    (line,) = [
        line
        for line in Path(f"/proc/{pid}/status").read_text().splitlines()
        if line.startswith("VmHWM")
    ]
    return int(line.split()[1])


@pytest.mark.slow
def test_a_second_service_on_the_same_data_is_refused(tmp_path: Path):
    with server(REAL, tmp_path) as (client, process):
        second = subprocess.run(
            [*REAL, str(tmp_path)], capture_output=True, text=True, cwd=ROOT, check=False
        )
        assert second.returncode == 1
        assert "another service works with this data directory" in second.stderr
        assert second.stderr.count("\n") == 1
        assert client.get("/readyz").status_code == 200
        process.kill()
        process.wait(timeout=180)
    # The system lets go of what a killed one kept.
    with server(REAL, tmp_path) as (client, _):
        assert client.get("/readyz").status_code == 200
