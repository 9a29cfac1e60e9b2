"""Results to printers, as Moonraker and OctoPrint take them."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from stillpath.service.deliveries import sender
from stillpath.service.deliveries.http_requests import Reply
from stillpath.service.deliveries.printers import PrinterFileError, load_printers, printer_for
from stillpath.service.deliveries.rows import Delivery, claim, settle
from stillpath.service.deliveries.targets import TargetRefused
from stillpath.service.jobs.state import Job
from tests.service.deliveries.listeners import Listener, Seen, moonraker, octoprint, until, uploads
from tests.service.deliveries.places import RESULT, SECRET, Place, open_place

ROOT = Path(__file__).resolve().parents[3]


def printer(name: str, kind: str, url: str, **more: object) -> str:
    rows = {"kind": kind, "url": url, "machine": "ender3", **more}
    return f"[printer.{name}]\n" + "".join(f"{k} = {json.dumps(v)}\n" for k, v in rows.items())


def at(tmp_path: Path, text: str):
    file = tmp_path / "printers.toml"
    file.write_text(text)
    return open_place(tmp_path / "data", printers=file)


def delivered(
    folder: Path, server: Listener, kind: str = "moonraker", *, prints: bool, **of_printer: Any
) -> tuple[Job, Delivery]:
    """Finish a job and send its result to a printer."""
    url = server.url + ("/octo" if kind == "octoprint" else "/")
    with at(folder, printer("m", kind, url, **of_printer)) as place:
        job = place.finish(folder, printer="m", print_after=prints)
        with place.sending():
            return job, place.settled(job)


@pytest.mark.parametrize("prints", [False, True])
def test_moonraker_gets_the_whole_file_and_checks_it(tmp_path: Path, prints: bool):
    with moonraker(key="k1") as server:
        job, delivery = delivered(tmp_path, server, prints=prints, api_key="k1", start=True)
    assert (delivery.state, delivery.error) == ("done", None)
    [seen] = uploads(server)
    parts = seen.parts()
    assert parts["file"] == (job.result_name, RESULT)
    assert parts["root"][1] == b"gcodes"
    assert parts["checksum"][1].decode() == job.result_sha256
    assert parts["print"][1] == (b"true" if prints else b"false")


@pytest.mark.parametrize("prints", [False, True])
def test_octoprint_gets_it_below_a_prefix(tmp_path: Path, prints: bool):
    how = {"prints": prints, "api_key": "k2", "start": True}
    with octoprint(key="k2") as server:
        job, delivery = delivered(tmp_path, server, "octoprint", **how)
    assert delivery.state == "done"
    [seen] = uploads(server)
    parts = seen.parts()
    assert parts["file"] == (job.result_name, RESULT)
    word = b"true" if prints else b"false"
    assert (parts["print"][1], parts["select"][1]) == (word, word)


@pytest.mark.parametrize("kind", ["moonraker", "octoprint"])
def test_a_result_that_the_disk_has_damaged_goes_to_no_printer(tmp_path: Path, kind: str):
    with (
        (moonraker if kind == "moonraker" else octoprint)(key="k") as server,
        at(tmp_path, printer("p", kind, server.url, api_key="k", start=True)) as place,
    ):
        job = place.finish(tmp_path, printer="p", print_after=True)
        (place.settings.data_dir / job.result).write_bytes(RESULT[:-7])
        with place.sending():
            delivery = place.settled(job)
    assert delivery.state == "failed"
    assert "damaged; submit the file again" in (delivery.error or "")
    assert not uploads(server)


def test_a_late_upload_replaces_no_later_file(tmp_path: Path):
    """As after a printer was off: what was tried more often waits longer."""
    with moonraker() as server, at(tmp_path, printer("p", "moonraker", server.url)) as place:
        earlier = place.finish(tmp_path, printer="p", created_at=1000.0)
        later = place.finish(tmp_path, printer="p", created_at=2000.0)
        until_s = time.time() + 600
        claims = [claim(place.engine, now=time.time(), until=until_s) for _ in range(2)]
        of_earlier, of_later = (found[0] for found in claims if found)
        assert settle(place.engine, of_earlier, "waiting", next_at=0.0)
        others = [
            place.finish(tmp_path, printer="p", created_at=1000.0, result_name="other.gcode"),
            # The clock was set back.
            place.finish(tmp_path, printer="p", created_at=500.0, finished_at=600.0),
        ]
        with place.sending():
            until(lambda: place.delivery(earlier).error)
            assert "on its way" in (place.delivery(earlier).error or "")
            assert [place.settled(job).state for job in others] == ["done", "done"]
            assert settle(place.engine, of_later, "waiting", next_at=0.0)
            assert place.settled(later).state == "done"
            slow = place.finish(tmp_path, printer="p", created_at=1500.0)  # the later outran it
            found = [place.settled(job) for job in (earlier, slow)]
    for delivery in found:
        assert delivery.state == "failed"
        assert "has a later part.stillpath.gcode already" in (delivery.error or "")
    assert len(uploads(server)) == 3


def test_a_later_upload_waits_for_an_earlier_one_on_its_way(tmp_path: Path):
    """Side by side the earlier one, if it is larger, would arrive last and stay."""
    with moonraker() as server, at(tmp_path, printer("p", "moonraker", server.url)) as place:
        place.finish(tmp_path, printer="p", created_at=1000.0)
        claimed = claim(place.engine, now=time.time(), until=time.time() + 60)
        assert claimed is not None
        later = place.finish(tmp_path, printer="p", created_at=2000.0)
        other = place.finish(tmp_path, printer="p", result_name="other.gcode")
        with place.sending():
            assert place.settled(other).state == "done"
            assert (place.delivery(later).state, len(uploads(server))) == ("sending", 1)
            assert settle(place.engine, claimed[0], "done", next_at=0.0)
            assert place.settled(later).state == "done"
    assert len(uploads(server)) == 2


def test_a_wrong_key_is_told_and_not_repeated(tmp_path: Path):
    with moonraker(key="right") as server:
        _, delivery = delivered(tmp_path, server, prints=False, api_key="wrong")
    assert (delivery.state, len(uploads(server))) == ("failed", 1)
    assert "401" in (delivery.error or "")
    assert "wrong" not in (delivery.error or "")


@pytest.mark.parametrize("kind", ["moonraker", "octoprint", "moonraker, no .gcode"])
def test_a_printer_that_does_not_begin_is_told(tmp_path: Path, kind: str):
    """Of files such as .bgcode, Moonraker says nothing about a print."""
    kind, _, silent = kind.partition(", ")
    busy = moonraker if kind == "moonraker" else octoprint
    with busy(key="k", can_print=False) if not silent else Listener(_stored) as server:
        _, delivery = delivered(tmp_path, server, kind, prints=True, api_key="k", start=True)
    assert delivery.state == "done"
    assert "did not begin" in (delivery.error or "")


def test_a_moonraker_in_the_place_of_an_octoprint_tells_in_its_own_words(tmp_path: Path):
    """Its octoprint_compat takes uploads to /api/files/local, as slicers send them."""
    said = {"item": {"path": "part.gcode", "root": "gcodes"}, "action": "create_file"}

    def delivered_where(began: bool) -> Delivery:
        answer = json.dumps(said | {"print_started": began, "print_queued": False}).encode()
        with Listener(lambda _: (201, {}, answer)) as server:
            folder = tmp_path / str(began)
            folder.mkdir()
            return delivered(folder, server, "octoprint", prints=True, start=True)[1]

    assert "did not begin" in (delivered_where(False).error or "")
    assert delivered_where(True).error is None


def _stored(_: Seen):
    return 201, {}, b'{"item": {"path": "part.bgcode"}, "action": "create_file"}'


@pytest.mark.parametrize(("kind", "status"), [("moonraker", 403), ("octoprint", 409)])
@pytest.mark.parametrize("prints", [False, True])
def test_a_start_that_a_busy_printer_refused_is_not_tried_again(
    tmp_path: Path, kind: str, status: int, prints: bool
):
    """As while it prints a file of that name: the retry would start it once more."""

    def refuses_once(_: Seen):
        if len(uploads(server)) == 1:
            return status, {}, b'{"error": "File is loaded, upload not permitted"}'
        return _stored(_)

    with Listener(refuses_once) as server:
        _, delivery = delivered(tmp_path, server, kind, prints=prints, start=True)
    if prints:
        assert (delivery.state, len(uploads(server))) == ("failed", 1)
        assert "upload not permitted" in (delivery.error or "")
        assert "not tried again" in (delivery.error or "")
    else:
        assert (delivery.state, len(uploads(server))) == ("done", 2)


def test_a_page_is_no_answer_of_a_printer(tmp_path: Path):
    """As a proxy answers that wants a login, or a page that listens at a wrong port."""
    with (
        Listener(lambda _: (200, {"Content-Type": "text/html"}, b"<html>log in")) as server,
        at(tmp_path, printer("m", "moonraker", server.url)) as place,
    ):
        job = place.finish(tmp_path, printer="m")
        with place.sending(attempts=2, first_wait_s=0.01):
            delivery = place.settled(job)
    assert (delivery.state, len(uploads(server))) == ("failed", 2)
    assert "not as moonraker does; check url in [printer.m]" in (delivery.error or "")


def test_a_printer_that_must_not_be_started_is_not(tmp_path: Path):
    with moonraker() as server:
        _, delivery = delivered(tmp_path, server, prints=True)
    assert (delivery.state, server.seen) == ("failed", [])
    assert "start = true" in (delivery.error or "")


def test_a_print_that_comes_late_is_not_started(tmp_path: Path):
    with (
        moonraker() as server,
        at(tmp_path, printer("m", "moonraker", server.url, start=True)) as place,
    ):
        job = place.finish(tmp_path, printer="m", print_after=True)
        with place.sending(start_within_s=0.0):
            delivery = place.settled(job)
    assert delivery.state == "done"
    assert "not started" in (delivery.error or "")
    assert uploads(server)[0].parts()["print"][1] == b"false"


def test_a_print_that_was_held_back_is_told(tmp_path: Path):
    """No service ran for days before the job was done."""
    with (
        moonraker() as server,
        at(tmp_path, printer("m", "moonraker", server.url, start=True)) as place,
    ):
        job = place.finish(tmp_path, printer="m", print_after=True, held_back=True)
        with place.sending():
            delivery = place.settled(job)
    assert delivery.state == "done"
    assert "not started: for an hour or more the job could not be done" in (delivery.error or "")
    assert uploads(server)[0].parts()["print"][1] == b"false"


def test_a_printer_that_is_off_gets_it_when_it_is_on(tmp_path: Path):
    with Listener() as server:
        port = server.port
    with at(tmp_path, printer("m", "moonraker", f"http://127.0.0.1:{port}", start=True)) as place:
        job = place.finish(tmp_path, printer="m", print_after=True)
        with place.sending(attempts=1000, first_wait_s=0.01):
            until(lambda: place.delivery(job).attempts >= 2)
            with Listener(lambda _: (201, {}, b"{}"), port=port) as server:
                assert place.settled(job).state == "done"
    [seen] = uploads(server)
    assert seen.parts()["file"][1] == RESULT


@pytest.mark.parametrize("answer", ["silence", "502", "page"])
def test_a_print_is_not_started_twice(tmp_path: Path, answer: str):
    """Nobody knows whether the first upload began to print: it is left to a person."""

    def answers(_: Seen):
        if answer == "silence":
            raise ConnectionResetError
        if answer == "page":
            return 200, {"Content-Type": "text/html"}, b"<html>log in"
        return 502, {}, b"bad gateway"

    with Listener(answers) as server:
        _, delivery = delivered(tmp_path, server, prints=True, start=True)
    assert (delivery.state, len(uploads(server))) == ("failed", 1)
    assert "may or may not have started" in (delivery.error or "")


@pytest.mark.parametrize("prints", [False, True])
def test_a_sender_that_breaks_starts_no_second_print(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, prints: bool
):
    """The printer has the file; then something happens that nobody has foreseen."""
    judge, replies = sender._judged, []

    def breaks_once(reply: Reply) -> tuple[str, str | None]:
        replies.append(reply)
        if len(replies) == 1:
            raise RuntimeError("unforeseen")
        return judge(reply)

    monkeypatch.setattr(sender, "_judged", breaks_once)
    with Listener(lambda _: (201, {}, b"{}")) as server:
        _, delivery = delivered(tmp_path, server, prints=prints, start=True)
    if prints:
        assert (delivery.state, len(uploads(server))) == ("failed", 1)
        assert "may or may not have started" in (delivery.error or "")
    else:
        assert (delivery.state, len(uploads(server))) == ("done", 2)


@pytest.mark.slow
def test_a_sender_killed_in_between(tmp_path: Path):
    """An upload that starts a print is not done again."""
    holding = [True]

    def answer(_: Seen):
        while holding[0]:
            time.sleep(0.02)
        return 201, {}, b"{}"

    with (
        Listener(answer) as server,
        at(tmp_path, printer("m", "moonraker", server.url, start=True)) as place,
    ):
        job = place.finish(tmp_path, printer="m", print_after=True)
        _kill_in_between(place, server)
        assert place.delivery(job).state == "sending"
        holding[0] = False
        with place.sending():
            delivery = place.settled(job)
    assert (delivery.state, len(uploads(server))) == ("failed", 1)
    assert "check the printer" in (delivery.error or "")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[printer.a]\nkind = 'duet'\nurl = 'http://h'\nmachine = 'x'", "printer.a. kind"),
        ("[printer.a]\nkind = 'moonraker'\nmachine = 'x'", "url"),
        ("[printer.a]\nkind = 'moonraker'\nurl = 'http://u:p@h'\nmachine = 'x'", "user name"),
        ("[printer.a]\nkind = 'moonraker'\nurl = 'file:///x'\nmachine = 'x'", "https://HOST"),
        ("[printer.a]\nkind = 'moonraker'\nurl = 'http://h?k=1'\nmachine = 'x'", "query"),
        ("[printer.'a/b']\nkind = 'moonraker'\nurl = 'http://h'\nmachine = 'x'", "name"),
        (printer("a", "moonraker", "http://h", method="magic"), "method"),
        (printer("a", "moonraker", "http://h", tolerance_um=0), "tolerance_um"),
        (printer("a", "moonraker", "http://h", budget_um=0), "budget_um"),
        (printer("a", "moonraker", "http://h", apikey="sesame"), "apikey"),
        ("printer = 1", "sections"),
        ("[printer]\na = 1", "not a section"),
        ("[other]\na = 1", "sections"),
        ("not toml", "cannot be read"),
    ],
)
def test_a_bad_file_of_printers_says_where(tmp_path: Path, text: str, words: str):
    file = tmp_path / "printers.toml"
    file.write_text(text)
    with pytest.raises(PrinterFileError, match=words) as caught:
        load_printers(file)
    assert "sesame" not in str(caught.value)


def test_a_file_of_a_windows_editor(tmp_path: Path):
    file = tmp_path / "printers.toml"
    file.write_text(printer("a", "moonraker", "http://h"), encoding="utf-8-sig")
    assert set(load_printers(file)) == {"a"}


def test_no_file_no_printers(tmp_path: Path):
    assert load_printers(None) == {}
    with pytest.raises(PrinterFileError, match="gone"):
        load_printers(tmp_path / "gone.toml")
    with pytest.raises(TargetRefused, match="known: none"):
        printer_for({}, "m")


def _kill_in_between(place: Place, server: Listener) -> None:
    settings = place.settings.model_dump_json(exclude={"webhook_secret"}, exclude_defaults=True)
    given = json.dumps(json.loads(settings) | {"webhook_secret": SECRET})
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.service.deliveries.sender_process", given, "1"], cwd=ROOT
    )
    try:
        until(lambda: server.seen)
    finally:
        process.kill()
        process.wait()
