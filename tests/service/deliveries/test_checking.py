"""A printer compared with its machine, over HTTP with what Moonraker says."""

from __future__ import annotations

import json
import re
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from stillpath.applications.machines.documents import DocumentFolder
from stillpath.models.machine import Machine
from stillpath.models.store import load_machine
from stillpath.service.api import create_app
from stillpath.service.api.printers import CHECKED_AT_ONCE
from stillpath.service.deliveries.checking import Checker, PrinterUnknown
from stillpath.service.deliveries.printers import Printer
from stillpath.service.settings import Settings
from tests.service.at_once import at_once
from tests.service.deliveries.listeners import (
    Listener,
    Seen,
    moonraker,
    octoprint,
    until,
    uploads,
)
from tests.service.deliveries.places import Place, open_place
from tests.service.deliveries.recorded_printer import status_of
from tests.service.runners import pretend

MACHINE = load_machine("ender3")


def printer_at(server: Listener, **more: Any) -> Printer:
    fields = {"name": "left", "kind": "moonraker", "url": server.url, "machine": "ender3"}
    return Printer(**(fields | more))


def checked(tmp_path: Path, status: dict[str, Any], machine: Machine = MACHINE, **how: Any):
    with moonraker(status=status) as server:
        return Checker(DocumentFolder(tmp_path)).check(printer_at(server), machine, **how)


def settings_of(status: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return status["configfile"]["settings"]


@pytest.mark.parametrize("name", ["ender3", "voron-v24-250"])
def test_a_printer_as_its_machine_says(tmp_path: Path, name: str):
    machine = load_machine(name)
    found = checked(tmp_path, status_of(machine), machine)
    assert (found.findings, found.software) == ([], "v0.13.0-300-g1")
    assert found.machine_revision == machine.revision


def changed(status: dict[str, Any], **values: Any) -> dict[str, Any]:
    """Set what stands at paths like `toolhead__max_accel`."""
    for path, value in values.items():
        *folders, name = path.split("__")
        place = status
        for folder in folders:
            place = place.setdefault(folder, {})
        place[name] = value
    return status


KINEMATICS = {"configfile__settings__printer__kinematics": "limited_cartesian"}
RAISED = {"toolhead__max_accel": 300_000.0}
NOT_WRAPPED = {"gcode__commands__PAUSE__help": "Pause the actual running print"}
OWN_LIMIT_MACRO = {"configfile__config__gcode_macro Set_Velocity_Limit": {}}
OWN_SHAPER_MACRO = {"configfile__config__gcode_macro SET_INPUT_SHAPER": {}}


def set_everywhere(section: str, name: str, value: float, place: str) -> dict[str, float]:
    """In printer.cfg and in force."""
    return {f"configfile__settings__{section}__{name}": value, f"{place}__{name}": value}


def of_old_klipper(status: dict[str, Any], *, in_order: bool) -> dict[str, Any]:
    del status["gcode"]
    macros = status["configfile"]["config"]
    if not in_order:
        macros["gcode_macro PAUSE"] = macros.pop("gcode_macro PAUSE")
    return status


@pytest.mark.parametrize(
    ("change", "place", "words", "unsafe"),
    [
        (KINEMATICS, "[printer] kinematics", "limited_cartesian", True),
        (RAISED, "max_accel", "300000, printer.cfg says", True),
        ({"toolhead__max_accel": 100.0}, "max_accel", "STILLPATH_RESTORE", False),
        (NOT_WRAPPED, "PAUSE", "include stillpath.cfg", False),
        (OWN_LIMIT_MACRO, "SET_VELOCITY_LIMIT", "take it out", True),
        (OWN_SHAPER_MACRO, "SET_INPUT_SHAPER", "on top of", False),
        (
            {"configfile__settings__printer__max_z_accel": 1.0},
            *("[printer] max_z_accel", "no command raises", True),
        ),
        (
            {"configfile__settings__printer__max_z_accel": 1e6},
            *("[printer] max_z_accel", "put ", False),
        ),
        (
            set_everywhere("printer", "max_accel", 1234.0, "toolhead"),
            *("[printer] max_accel", "1234", False),
        ),
        (
            set_everywhere("printer", "square_corner_velocity", 8.0, "toolhead"),
            *("[printer] square_corner_velocity", "8", False),
        ),
        (
            set_everywhere("extruder", "pressure_advance", 0.123, "extruder"),
            *("[extruder] pressure_advance", "0.123", False),
        ),
        ({"extruder__pressure_advance": 0.321}, "pressure_advance", "0.321", False),
        (
            {"configfile__settings__input_shaper__shaper_freq_x": 61.5},
            *("[input_shaper] shaper_freq_x", "61.5", False),
        ),
        (
            {"gcode__commands__M600": {"help": "G-Code macro"}},
            *("M600", "include stillpath-m600.cfg", False),
        ),
        (
            {"configfile__settings__stepper_x__position_max": 100.0},
            *("[stepper_x] position_max", "travel.x.max_mm", False),
        ),
    ],
)
def test_what_differs_is_found(
    tmp_path: Path, change: dict[str, Any], place: str, words: str, unsafe: bool
):
    status = changed(status_of(MACHINE), **change)
    found = {finding.place: finding for finding in checked(tmp_path, status).findings}
    assert place in found, list(found)
    assert words in found[place].text
    assert found[place].unsafe is unsafe


@pytest.mark.parametrize(
    ("in_order", "place", "words"),
    [
        (True, "CANCEL_PRINT", "include stillpath.cfg"),
        (False, "PAUSE, CANCEL_PRINT", "after your own"),
    ],
)
def test_an_old_klipper_shows_no_commands(tmp_path: Path, in_order: bool, place: str, words: str):
    status = of_old_klipper(status_of(MACHINE), in_order=in_order)
    found = {finding.place: finding for finding in checked(tmp_path, status).findings}
    assert (words in found[place].text, found[place].unsafe) == (True, False)


@pytest.mark.parametrize(
    ("software", "kept"),
    [
        ("v0.13.0-630-ge4c4a5b94", False),
        ("v0.13.0-631-gdb10e92e9", True),
        ("v0.13.0-642-g77d5d942e", False),
        ("?", False),
    ],
)
def test_a_klipper_that_cannot_switch_its_shaper_off(tmp_path: Path, software: str, kept: bool):
    status = status_of(MACHINE)
    settings_of(status)["input_shaper"] = {"shaper_freq_x": 0.0, "shaper_freq_y": 41.0}

    def found(method: str) -> dict[str, Any]:
        with moonraker(status=status, software=software) as server:
            checker = Checker(DocumentFolder(tmp_path))
            check = checker.check(printer_at(server), MACHINE, method=method, accept=True)
        return {each.place: each for each in check.findings}

    finding = found("fbf").get("SET_INPUT_SHAPER")
    assert (finding is not None) is kept
    if finding is not None:
        assert finding.unsafe
        assert re.search(rf"{software} .* stays on .*; update Klipper", finding.text)
        advised = found("advise")["SET_INPUT_SHAPER"]
        assert not advised.unsafe
        assert "have no effect" in advised.text
    assert "SET_INPUT_SHAPER" not in found("none")
    settings_of(status)["input_shaper"]["shaper_freq_y"] = 0.0
    assert "SET_INPUT_SHAPER" not in found("fbf")


def test_limits_of_a_print_under_way_are_its_own(tmp_path: Path):
    status = changed(status_of(MACHINE), **RAISED, print_stats__state="paused")
    assert checked(tmp_path, status).findings == []


@pytest.mark.parametrize("method", ["none", "advise"])
def test_a_file_without_a_stream_needs_no_macros(tmp_path: Path, method: str):
    status = changed(status_of(MACHINE), **NOT_WRAPPED, **OWN_LIMIT_MACRO, **OWN_SHAPER_MACRO)
    found = {finding.place for finding in checked(tmp_path, status, method=method).findings}
    assert found <= {"[input_shaper]"}


def test_advice_needs_the_section_of_the_shaper(tmp_path: Path):
    [finding] = checked(tmp_path, status_of(MACHINE), method="advise").findings
    assert (finding.place, finding.unsafe) == ("[input_shaper]", False)


def test_another_firmware(tmp_path: Path):
    text = (Path(__file__).parents[3] / "examples/firmware/marlin.json").read_text()
    document = MACHINE.model_dump(mode="json") | {"firmware": json.loads(text)}
    marlin = Machine.model_validate(document)
    [finding] = checked(tmp_path, status_of(MACHINE), marlin).findings
    assert finding.unsafe
    assert "runs marlin" in finding.text


def test_what_changed_since_the_first_check_until_it_is_accepted(tmp_path: Path):
    status = status_of(MACHINE)
    # As remembered before drivers of second motors were: that they are there is no change.
    assert checked(tmp_path, status).findings == []
    settings_of(status)["tmc2209 stepper_y1"] = {"run_current": 0.6}
    assert checked(tmp_path, status).findings == []
    assert checked(tmp_path, status, accept=True).findings == []
    settings_of(status)["stepper_x"]["rotation_distance"] = 32.0
    settings_of(status)["stepper_x"]["endstop_pin"] = "^PC7"
    settings_of(status)["tmc2209 stepper_x"]["run_current"] = 0.8
    settings_of(status)["tmc2209 stepper_y1"]["run_current"] = 0.8
    first = checked(tmp_path, status)
    assert [finding.place for finding in first.findings] == [
        "[stepper_x] rotation_distance",
        "[tmc2209 stepper_x] run_current",
        "[tmc2209 stepper_y1] run_current",
    ]
    assert "from 40 to 32" in first.findings[0].text
    assert "stillpath printers accept left" in first.findings[0].text
    assert checked(tmp_path, status).findings == first.findings
    assert checked(tmp_path, status, accept=True).findings == []
    assert checked(tmp_path, status).findings == []


def test_a_new_revision_of_the_machine_begins_anew(tmp_path: Path):
    status = status_of(MACHINE)
    checked(tmp_path, status)
    settings_of(status)["stepper_x"]["rotation_distance"] = 32.0
    newer = MACHINE.model_copy(update={"source": "measured again"})
    assert newer.revision != MACHINE.revision
    assert checked(tmp_path, status, newer).findings == []
    assert len(checked(tmp_path, status).findings) == 1


def test_a_damaged_memory_is_named(tmp_path: Path):
    checked(tmp_path, status_of(MACHINE))
    [file] = tmp_path.rglob("*.json")
    file.write_text("{}")
    status = changed(status_of(MACHINE), **KINEMATICS)
    unsafe, damaged = checked(tmp_path, status).findings
    assert unsafe.unsafe  # all the same
    assert re.search(r"left/\w+\.json is damaged; delete it", damaged.text)
    assert checked(tmp_path, status_of(MACHINE), accept=True).findings == []


def test_a_memory_that_cannot_be_written_is_named(tmp_path: Path):
    (tmp_path / "left").write_text("where its folder would be")
    status = changed(status_of(MACHINE), **KINEMATICS)
    unsafe, unwritten = checked(tmp_path, status).findings
    assert unsafe.unsafe
    assert "left cannot be remembered" in unwritten.text
    with pytest.raises(PrinterUnknown, match="cannot be remembered"):
        checked(tmp_path, status, accept=True)


@pytest.mark.parametrize(
    ("state", "words"),
    [("shutdown", r"not ready \(shutdown\)"), ("startup", "startup"), ("away", "not connected")],
)
def test_a_klipper_that_is_not_ready(tmp_path: Path, state: str, words: str):
    with moonraker(status=status_of(MACHINE), state=state) as server:
        checker = Checker(DocumentFolder(tmp_path))
        with pytest.raises(PrinterUnknown, match=words):
            checker.check(printer_at(server), MACHINE)
    assert not list(tmp_path.rglob("*.json"))


@pytest.mark.parametrize(
    "body",
    [b"<html>", b'{"result": {"state": "ready"}}', b"[" * 50_000],
    ids=["page", "half", "deep"],
)
def test_answers_that_are_not_moonrakers(tmp_path: Path, body: bytes):
    with (
        Listener(lambda _: (200, {}, body)) as server,
        pytest.raises(PrinterUnknown, match="left cannot be asked"),
    ):
        Checker(DocumentFolder(tmp_path)).check(printer_at(server), MACHINE)


def test_a_printer_that_is_off_and_an_octoprint(tmp_path: Path):
    with Listener() as server:
        off = printer_at(server)
    checker = Checker(DocumentFolder(tmp_path))
    with pytest.raises(PrinterUnknown, match="cannot be reached"):
        checker.check(off, MACHINE)
    with octoprint(key="k") as server, pytest.raises(PrinterUnknown, match="is an OctoPrint"):
        checker.check(printer_at(server, kind="octoprint"), MACHINE)


def test_a_printer_of_the_other_kind_is_named(tmp_path: Path):
    """It was said to be away, or to be an OctoPrint."""
    checker = Checker(DocumentFolder(tmp_path))
    said = r'kind octoprint, but at http\S+ answers a Moonraker: set kind = "moonraker" in \[pr'
    with moonraker() as server, pytest.raises(PrinterUnknown, match=said):
        checker.check(printer_at(server, kind="octoprint"), MACHINE)
    said = r'kind moonraker, but at http\S+ answers an OctoPrint: set kind = "octoprint"'
    with octoprint(key="k") as server, pytest.raises(PrinterUnknown, match=said):
        checker.check(printer_at(server, api_key="k"), MACHINE)


# When a result is handed over


def delivered(
    tmp_path: Path, status: dict[str, Any] | None, **fields: Any
) -> tuple[Any, list[Any]]:
    with moonraker(status=status, key="k1") as server:
        file = tmp_path / "printers.toml"
        file.write_text(
            f"[printer.m]\nkind = 'moonraker'\nurl = '{server.url}'\napi_key = 'k1'\n"
            "machine = 'ender3'\nstart = true\n"
        )
        with open_place(tmp_path / "data", printers=file) as place:
            job = place.finish(tmp_path, printer="m", **fields)
            with place.sending(checker=_checker(place)):
                return place.settled(job), uploads(server)


def _checker(place: Place) -> Checker:
    return Checker(DocumentFolder(place.settings.data_dir / "printers"))


def test_a_sound_printer_gets_its_file_without_a_word(tmp_path: Path):
    delivery, [upload] = delivered(tmp_path, status_of(MACHINE), print_after=True)
    assert (delivery.state, delivery.error) == ("done", None)
    assert upload.parts()["print"][1] == b"true"


def test_what_differs_is_noted_and_the_print_begins(tmp_path: Path):
    status = changed(status_of(MACHINE), **NOT_WRAPPED)
    delivery, [upload] = delivered(tmp_path, status, print_after=True)
    assert (delivery.state, upload.parts()["print"][1]) == ("done", b"true")
    assert "stillpath.cfg" in delivery.error


def test_what_is_unsafe_is_uploaded_and_not_started(tmp_path: Path):
    status = changed(status_of(MACHINE), **KINEMATICS)
    delivery, [upload] = delivered(tmp_path, status, print_after=True)
    assert (delivery.state, upload.parts()["print"][1]) == ("done", b"false")
    assert delivery.error.startswith("uploaded, but not started, because it may be unsafe; ")
    assert "limited_cartesian" in delivery.error


def test_a_printer_that_does_not_answer_is_sent_its_file_and_nothing_more(tmp_path: Path):
    delivery, [upload] = delivered(tmp_path, None, print_after=True)
    assert (delivery.state, upload.parts()["print"][1]) == ("done", b"false")
    assert "was not compared with its machine" in delivery.error


# Over HTTP, and on the command line


def printers_file(tmp_path: Path, server: Listener) -> Path:
    file = tmp_path / "printers.toml"
    file.write_text(
        f"[printer.left]\nkind = 'moonraker'\nurl = '{server.url}'\nmachine = 'ender3'\n"
        f"[printer.advised]\nkind = 'moonraker'\nurl = '{server.url}'\nmachine = 'ender3'\n"
        "method = 'advise'\n"
        "[printer.octo]\nkind = 'octoprint'\nurl = 'http://127.0.0.1:9'\nmachine = 'ender3'\n"
    )
    return file


@pytest.mark.slow
def test_over_http_and_in_the_report(tmp_path: Path):
    status = status_of(MACHINE)
    with moonraker(status=status) as server:
        settings = Settings(data_dir=tmp_path / "data", printers=printers_file(tmp_path, server))
        app = create_app(settings, runner=pretend)
        with TestClient(app, base_url="http://localhost") as client:
            assert client.get("/v1/printers/left/check").json()["findings"] == []
            settings_of(status)["stepper_y"]["rotation_distance"] = 32.0
            [finding] = client.get("/v1/printers/left/check").json()["findings"]
            assert finding["place"] == "[stepper_y] rotation_distance"
            job = client.post(
                "/v1/jobs", params={"machine": "ender3", "printer": "left"}, content=b"G1 X1\n"
            ).json()
            place = client.app.state.storage
            with place.local(f"jobs/{job['id']}/machine.json") as pinned:
                # The machine's measurement is old as well.
                [warning] = [
                    w for w in json.loads(pinned.read_text())["warnings"] if "days ago" not in w
                ]
            assert warning.startswith("printer left: [stepper_y] rotation_distance has changed")
            until(lambda: client.get(f"/v1/jobs/{job['id']}").json()["state"] == "done", 300)
            until(lambda: uploads(server))
            until(lambda: _delivery(client, job)["state"] == "done")
            assert "rotation_distance has changed" in _delivery(client, job)["error"]
            assert client.post("/v1/printers/left/accept").json()["findings"] == []
            [entry] = client.get("/v1/audit?action=printer.accept").json()["entries"]
            assert entry["subject"] == "left"
            changed(status, **OWN_LIMIT_MACRO)
            for name, unsafe in (("left", [True]), ("advised", [])):
                found = client.get(f"/v1/printers/{name}/check").json()["findings"]
                assert [f["unsafe"] for f in found if f["place"] == "SET_VELOCITY_LIMIT"] == unsafe
            del status["configfile"]["config"]["gcode_macro Set_Velocity_Limit"]
            assert client.get("/v1/printers/left/check").json()["findings"] == []
            for name, code in (("nobody", 404), ("octo", 422)):
                assert client.get(f"/v1/printers/{name}/check").status_code == code


def test_printers_that_do_not_answer_hold_few_threads(tmp_path: Path):
    """All requests share the threads: a printer that hangs would stop the service."""
    held, most, lock = 0, 0, threading.Lock()

    def slowly(_: Seen):
        nonlocal held, most
        with lock:
            held += 1
            most = max(most, held)
        time.sleep(0.5)
        with lock:
            held -= 1
        return 503, {}, b"{}"

    with Listener(slowly) as server:
        settings = Settings(data_dir=tmp_path / "data", printers=printers_file(tmp_path, server))
        app = create_app(settings, runner=pretend)
        with TestClient(app, base_url="http://localhost") as client:
            answers = at_once(*[lambda: client.get("/v1/printers/left/check")] * 20)
    assert {answer.status_code for answer in answers} == {424}
    assert most <= CHECKED_AT_ONCE


def _delivery(client: TestClient, job: dict[str, Any]) -> dict[str, Any]:
    [delivery] = client.get(f"/v1/jobs/{job['id']}").json()["deliveries"]
    return delivery


def test_on_the_command_line(tmp_path: Path, monkeypatch, capsys):
    from stillpath.cli.main import run

    monkeypatch.setenv("STILLPATH_DATA_DIR", str(tmp_path / "data"))
    monkeypatch.delenv("STILLPATH_SERVER", raising=False)
    status = status_of(MACHINE)
    with moonraker(status=status) as server:
        file = printers_file(tmp_path, server)
        command = ["printers", "check", "left", "--printers", str(file)]
        assert run(command) == 0
        assert "as the machine ender3 says" in capsys.readouterr().out
        changed(status, **KINEMATICS)
        assert run(command) == 2
        assert capsys.readouterr().out.startswith("unsafe: [printer] kinematics")
        changed(status, configfile__settings__printer__kinematics="cartesian", **OWN_LIMIT_MACRO)
        assert run(command) == 2
        assert "unsafe: [gcode_macro" in capsys.readouterr().out
        run(["printers", "check", "advised", "--printers", str(file)])
        assert "unsafe" not in capsys.readouterr().out
        accept = ["printers", "accept", "left", "--printers", str(file)]
        assert run(accept) == 0
        # A file on the command line is meant, whatever server the environment names.
        monkeypatch.setenv("STILLPATH_SERVER", "http://127.0.0.1:9")
        assert run(accept) == 0
        assert run(command) == 2
        assert "unsafe: [gcode_macro" in capsys.readouterr().out
        assert run([*command, "--server", "http://127.0.0.1:9"]) == 2
        assert "either --printers FILE or --server URL" in capsys.readouterr().err
        monkeypatch.delenv("STILLPATH_SERVER")
        assert run(["printers", "check", "nobody", "--printers", str(file)]) == 2
        assert "known: advised, left, octo" in capsys.readouterr().err
    assert run(command) == 2
    assert "cannot be reached" in capsys.readouterr().err
    assert run(["printers", "check", "left"]) == 2
    assert "STILLPATH_PRINTERS" in capsys.readouterr().err
