"""Moonraker from PyPI with our component, and the real server."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx2
import pytest

from stillpath.applications.machines.documents import DocumentFolder
from stillpath.models.store import load_machine
from stillpath.service.deliveries.checking import Checker, PrinterUnknown
from stillpath.service.deliveries.printers import Printer
from tests.integrations.klippy import klippy
from tests.integrations.moonraker import RealMoonraker
from tests.integrations.running import Running
from tests.service.deliveries.recorded_printer import status_of
from tests.service.test_server import until

pytestmark = pytest.mark.slow

PART = "nap 1 stamp\nG28\nG1 X10 Y10 F6000\n"


@pytest.fixture
def printer(tmp_path: Path, running: Running) -> Iterator[RealMoonraker]:
    settings = {"server": running.address, "machine": "ender3"}
    made = RealMoonraker(tmp_path, **settings, print_after="True")
    yield made
    made.close()


def upload(client: httpx2.Client, name: str, text: str) -> None:
    files = {"file": (name, text.encode())}
    answer = client.post("/server/files/upload", files=files, data={"root": "gcodes"})
    assert answer.status_code == 201, answer.text


def jobs(client: httpx2.Client) -> dict[str, dict[str, Any]]:
    told = client.get("/server/stillpath/status").json()["result"]["jobs"]
    return {job["file"]: job for job in told}


def over(client: httpx2.Client, name: str) -> dict[str, Any]:
    def found() -> dict[str, Any] | None:
        job = jobs(client).get(name, {"state": "queued"})
        return job if job["state"] not in ("queued", "running") else None

    return until(found)


def metadata(client: httpx2.Client, name: str) -> dict[str, Any] | None:
    answer = client.get("/server/files/metadata", params={"filename": name})
    return answer.json()["result"] if answer.status_code == 200 else None


def test_from_an_upload_to_two_files_with_metadata(tmp_path: Path, printer: RealMoonraker):
    with printer.running() as client:
        info = client.get("/server/info").json()["result"]
        assert (info["failed_components"], info["warnings"]) == ([], [])
        upload(client, "größe 1.gcode", PART)
        job = over(client, "größe 1.gcode")
        assert (job["state"], job["result"]) == ("done", "größe 1.sp.gcode"), job
        made = until(lambda: metadata(client, "größe 1.sp.gcode"))
        assert made["file_processors"] == ["stillpath"]
        original = metadata(client, "größe 1.gcode")
        assert original is not None
        assert original["file_processors"] == []
        # Whatever Moonraker reads again: finished files, and those they are of, are left alone.
        client.post("/server/files/metascan", params={"filename": "größe 1.sp.gcode"})
        client.post("/server/files/metascan", params={"filename": "größe 1.gcode"})
        upload(client, "bad.gcode", "bad stamp\n")
        assert "line 7: X1e400" in over(client, "bad.gcode")["reason"]
        assert list(jobs(client)) == ["größe 1.gcode", "bad.gcode"]
        store = client.get("/server/gcode_store").json()["result"]["gcode_store"]
        told = "\n".join(entry["message"] for entry in store)
        assert "größe 1.gcode is compensated: größe 1.sp.gcode" in told
        page = client.get("/server/files/stillpath/größe 1.stillpath.html")
        assert page.headers["content-type"].startswith("text/html")
        refused = client.post("/server/stillpath/process", json={"filename": "../moonraker.conf"})
        assert refused.status_code == 400
        left = Printer(name="left", kind="moonraker", url=printer.url, machine="ender3")
        checker = Checker(DocumentFolder(tmp_path / "memory"))
        with pytest.raises(PrinterUnknown, match="left cannot be asked: Klipper is not connected"):
            checker.check(left, load_machine("ender3"))
    assert (printer.gcodes / "größe 1.gcode").read_text() == PART
    assert (printer.gcodes / "größe 1.sp.gcode").read_text().endswith("; compensated\n" + PART)


def test_a_restart_in_between(printer: RealMoonraker, running: Running):
    with printer.running() as client:
        upload(client, "a.gcode", "nap 4 stamp\n")
        running.running_job()
        until(lambda: metadata(client, "a.gcode"))
    with printer.running() as client:
        assert over(client, "a.gcode")["state"] == "done"
        # Moonraker may hang if it is stopped while it reads metadata.
        until(lambda: metadata(client, "a.sp.gcode"))
    assert running.job_ids() == []


def test_with_a_klipper_it_is_compared_and_the_result_printed(
    tmp_path: Path, printer: RealMoonraker
):
    machine = load_machine("ender3")
    status = status_of(machine)
    status |= {name: {} for name in ("virtual_sdcard", "display_status", "pause_resume")}
    status["webhooks"] = {"state": "ready", "state_message": "Printer is ready"}
    left = Printer(name="left", kind="moonraker", url=printer.url, machine="ender3")
    checker = Checker(DocumentFolder(tmp_path / "memory"))
    with klippy(printer.klippy, status) as scripts, printer.running() as client:
        until(lambda: client.get("/server/info").json()["result"]["klippy_state"] == "ready", 90)
        found = checker.check(left, machine)
        assert (found.findings, found.software) == ([], "v0.13.0-300-g1")
        status["configfile"]["settings"]["printer"]["kinematics"] = "corexy"
        status["toolhead"]["max_accel"] = 300_000.0
        places = [finding.place for finding in checker.check(left, machine).unsafe]
        assert places == ["[printer] kinematics", "max_accel"]
        upload(client, "a.gcode", PART)
        until(lambda: [each for each in scripts if "SDCARD_PRINT_FILE" in each])
        until(lambda: metadata(client, "a.sp.gcode"))
    [started] = [each for each in scripts if "SDCARD_PRINT_FILE" in each]
    assert started == 'SDCARD_PRINT_FILE FILENAME="a.sp.gcode"'
