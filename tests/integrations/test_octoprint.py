"""The plugin in OctoPrint from PyPI, headless, with a real server and the real program."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.checkout import PYTHONPATH
from tests.integrations.octoprint import OctoPrint, install, octoprint_program, until
from tests.integrations.running import Running

pytestmark = pytest.mark.slow

SQUARE = "G21\nG90\nM82\nG28\nG92 E0\nG1 Z0.2 F600\n" + "".join(
    f"G1 X{x} Y{y} E{e:.2f} F3000\n"
    for e, (x, y) in enumerate([(50, 50), (60, 50), (60, 60), (50, 60), (50, 50)], start=1)
)


@pytest.fixture(scope="module")
def restarted(
    tmp_path_factory: pytest.TempPathFactory, running: Running
) -> Iterator[tuple[OctoPrint, dict[str, Any]]]:
    """An OctoPrint that was restarted in the midst of a job, and how the job stood before."""
    program = octoprint_program()
    folder = tmp_path_factory.mktemp("octoprint")
    octoprint = OctoPrint(program, install(program, folder), folder / "base")
    with octoprint.running():
        octoprint.set(server=running.address, machine="ender3")
        octoprint.upload("long.gcode", "nap 5\nG1 X1\n")
        before = octoprint.working("long.gcode")
    with octoprint.running():
        yield octoprint, before


@pytest.fixture
def octoprint(restarted: tuple[OctoPrint, dict[str, Any]], address: str) -> OctoPrint:
    started, _ = restarted
    started.set(
        where="server",
        server=address,
        machine="ender3",
        machines=[],
        method="fbf",
        automatic=True,
        print_after=False,
    )
    return started


def test_what_a_restart_interrupts_goes_on(restarted: tuple[OctoPrint, dict[str, Any]]):
    octoprint, before = restarted
    assert not before["is_over"]
    ended = octoprint.ended("long.gcode")
    assert (ended["state"], ended["id"], ended["job"]) == ("done", before["id"], before["job"])
    assert octoprint.about("long.sp.gcode")


def test_an_upload_gets_a_second_file(octoprint: OctoPrint, running: Running):
    octoprint.analyse("always")
    path = octoprint.upload("größe ß.gcode", SQUARE, folder="my parts")
    ended = octoprint.ended(path)
    assert ended["state"] == "done", ended
    result = octoprint.uploads / "my parts" / "größe ß.sp.gcode"
    assert (octoprint.uploads / path).read_text() == SQUARE
    assert result.read_text() == "; compensated\n" + SQUARE
    assert sorted(p.name for p in result.parent.glob("*.gcode")) == [
        "größe ß.gcode",
        "größe ß.sp.gcode",
    ]
    assert not list(result.parent.glob(".*.part"))
    assert ended["result"] == "my parts/größe ß.sp.gcode"
    assert "contour error" in ended["message"]

    job = running.client.get(f"/v1/jobs/{ended['job']}").json()
    assert (job["source_name"], job["machine"]) == ("größe ß.gcode", "ender3")

    # What OctoPrint shows of it: where it comes from, its report, its time.
    made = octoprint.about(ended["result"])
    assert made["stillpath"]["source"] == path
    assert made["stillpath"]["machine"] == "ender3"
    (link,) = [link["href"] for link in made["links"] if link["rel"] == "web"]
    assert link in made["notes"][0]["text"]
    report = octoprint.client.get(f"/{link}")
    assert report.status_code == 200
    assert report.text.startswith("<!doctype html>")
    assert "sandbox" in report.headers["content-security-policy"]
    figures = running.client.get(f"/v1/jobs/{ended['job']}/report.json").json()
    octoprint.analyse("never")
    analysis = until(lambda: octoprint.about(ended["result"]).get("gcodeAnalysis"))
    assert analysis["estimatedPrintTime"] == figures["time_s"]
    assert analysis["filament"]["tool0"]["length"] == pytest.approx(5.0)
    assert octoprint.about(path)["stillpath"] == {"result": ended["result"]}

    # The result is no upload; and the report is for those who may read files.
    assert octoprint.entry(ended["result"]) is None
    anonymous = octoprint.client.get(f"/{link}", headers={"X-Api-Key": ""})
    assert anonymous.status_code in (401, 403)
    assert octoprint.client.get("/plugin/stillpath/reports/..%2f..%2fconfig").status_code == 404


def test_failures_are_told_with_the_reason(octoprint: OctoPrint):
    ended = octoprint.ended(octoprint.upload("broken.gcode", "bad\nG1\n"))
    assert ended["state"] == "failed"
    assert "line 7: X1e400 is too large" in ended["message"]
    assert not octoprint.about("broken.sp.gcode")

    octoprint.set(machine="")
    ended = octoprint.ended(octoprint.upload("orphan.gcode", SQUARE))
    assert 'no machine is set for the printer profile "Default"' in ended["message"]
    octoprint.set(machines=[{"profile": "Def*", "machine": "voron-v0"}])
    assert octoprint.ask("process", path="orphan.gcode").status_code == 200
    ended = octoprint.ended("orphan.gcode")
    assert (ended["state"], ended["machine"]) == ("done", "voron-v0")

    # Somebody's own file is not written over.
    octoprint.upload("mine.sp.gcode", "G1 X1\n")
    ended = octoprint.ended(octoprint.upload("mine.gcode", SQUARE))
    assert "mine.sp.gcode already exists and was not made by Stillpath" in ended["message"]
    assert (octoprint.uploads / "mine.sp.gcode").read_text() == "G1 X1\n"


def test_cancelled_replaced_and_switched_off(octoprint: OctoPrint, running: Running):
    path = octoprint.upload("cube.gcode", "slow G1\n")
    first = octoprint.working(path)
    octoprint.upload("cube.gcode", "slow G1 X2\n")
    second = until(lambda: (e := octoprint.working(path))["id"] != first["id"] and e)
    assert octoprint.ask("cancel", id=second["id"]).status_code == 200
    assert octoprint.ended(path)["state"] == "cancelled"
    for entry in (first, second):
        job = running.client.get(f"/v1/jobs/{entry['job']}").json()
        assert job["state"] == "cancelled"
    assert octoprint.ask("cancel", id=second["id"]).status_code == 409
    assert not octoprint.about("cube.sp.gcode")

    octoprint.set(automatic=False)
    octoprint.upload("later.gcode", SQUARE)
    assert octoprint.ask("process", path="later.gcode").status_code == 200
    assert octoprint.ended("later.gcode")["state"] == "done"
    assert [e["path"] for e in octoprint.entries()].count("later.gcode") == 1
    for odd in ("../config.yaml", "../../part.gcode", "nothing.gcode", "config.yaml"):
        assert octoprint.ask("process", path=odd).status_code == 404


def test_asked_for_again_at_once(octoprint: OctoPrint):
    octoprint.set(automatic=False)
    path = octoprint.upload("hasty.gcode", "slow G1\n")

    def ask() -> dict[str, Any]:
        return octoprint.ask("process", path=path).json()["entry"]

    first = ask()
    octoprint.working(path)
    assert ask()["id"] == first["id"]
    octoprint.ask("cancel", id=first["id"])
    second = ask()  # the first is not over yet
    assert second["id"] != first["id"]
    until(lambda: (e := octoprint.working(path)) and e["id"] == second["id"])
    octoprint.upload("hasty.gcode", "G1 X3\n")  # while it is worked on
    third = ask()
    ended = octoprint.ended(path)
    assert (ended["id"], ended["state"]) == (third["id"], "done")
    assert [e["state"] for e in octoprint.entries() if e["path"] == path] == [
        *("done", "cancelled", "cancelled")
    ]


def test_printed_afterwards_but_never_onto_another_print(octoprint: OctoPrint):
    octoprint.connect_printer()
    octoprint.set(print_after=True)
    octoprint.upload("part.gcode", "G1 X1\nG1 X2\n")
    ended = octoprint.ended("part.gcode")
    assert (ended["state"], ended["not_printed"]) == ("done", "")
    until(lambda: octoprint.about("part.sp.gcode").get("prints", {}).get("success"))
    assert not octoprint.about("part.gcode").get("prints")

    until(octoprint.is_ready)
    octoprint.upload("next.gcode", "nap 6\nG1 X1\n")
    octoprint.working("next.gcode")
    octoprint.client.post(
        "/api/files/local/part.sp.gcode", json={"command": "select", "print": True}
    )
    ended = octoprint.ended("next.gcode")
    assert (ended["state"], ended["not_printed"]) == ("done", "another print began meanwhile")
    assert not octoprint.about("next.sp.gcode").get("prints")


def test_what_is_printed_is_not_replaced(octoprint: OctoPrint):
    octoprint.connect_printer()
    octoprint.set(print_after=True)
    octoprint.upload("twice.gcode", "G1 X1\nG4 S6\nG1 X2\n")
    first = octoprint.ended("twice.gcode")
    until(lambda: octoprint.job()["job"]["file"]["path"] == first["result"])
    octoprint.upload("twice.gcode", "G1 X9\n")
    until(lambda: "until twice.sp.gcode is printed" in octoprint.entry("twice.gcode")["stage"])
    result = octoprint.uploads / "twice.sp.gcode"
    assert "G4 S6" in result.read_text()
    ended = octoprint.ended("twice.gcode")
    assert ended["state"] == "done", ended
    assert ended["not_printed"] == "the printer was not ready when the file came"
    assert result.read_text() == "; compensated\nG1 X9\n"
    until(octoprint.is_ready)


def test_the_program_on_this_computer(octoprint: OctoPrint, tmp_path: Path):
    program = tmp_path / "my stillpath"
    program.write_text(
        f"#!/bin/sh\nPYTHONPATH={shlex.quote(PYTHONPATH)} exec {shlex.quote(sys.executable)} "
        "-c 'from stillpath.cli.main import main; main()' \"$@\"\n"
    )
    program.chmod(0o755)
    octoprint.set(where="command", command=str(program), method="shaper:zv")
    octoprint.upload("square.gcode", SQUARE)
    ended = octoprint.ended("square.gcode")
    assert ended["state"] == "done", ended
    text = (octoprint.uploads / "square.sp.gcode").read_text()
    assert "; Processed by stillpath " in text
    made = octoprint.about("square.sp.gcode")
    assert made["stillpath"]["method"] == "shaper:zv"

    # What was processed is never sent again, under whatever name it comes.
    refused = octoprint.ask("process", path="square.sp.gcode")
    assert refused.status_code == 409
    assert "already processed" in refused.json()["error"]
    octoprint.set(where="server")
    octoprint.upload("other.gcode", text)
    octoprint.upload("last.gcode", SQUARE)
    assert octoprint.ended("last.gcode")["state"] == "done"
    assert octoprint.entry("other.gcode") is None
