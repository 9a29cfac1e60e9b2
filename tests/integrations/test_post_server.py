"""The program for slicers with a server: the real one, in a process of its own, mostly with a
pretended pipeline."""

from __future__ import annotations

import http.server
import os
import signal
import socket
import stat
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest
import stillpath_post

from tests.integrations.breaking import BODY, TAKES_S, breaking_server
from tests.integrations.posting import PROGRAM, finish, post, start
from tests.integrations.running import Running
from tests.service.test_server import PRETEND, server, until

TEXT = b"G28\nG1 X10 Y10 F6000\n"
DONE = b"; compensated\n" + TEXT


@pytest.fixture
def part(tmp_path: Path) -> Path:
    folder = tmp_path / "prints"
    folder.mkdir()
    path = folder / "part.gcode"
    path.write_bytes(TEXT)
    return path


def assert_untouched(path: Path, content: bytes = TEXT) -> None:
    assert path.read_bytes() == content
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def assert_reason(done: subprocess.CompletedProcess[str], code: int, *words: str) -> None:
    assert done.returncode == code, done
    assert done.stderr.startswith("stillpath-post: ")
    assert done.stderr.count("\n") == 1, done.stderr
    for word in words:
        assert word in done.stderr


def test_the_file_is_replaced_and_the_report_lies_beside_it(
    running: Running, part: Path, tmp_path: Path
):
    part.chmod(0o640)
    done = post(*running.arguments, part, home=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert part.read_bytes() == DONE
    assert stat.S_IMODE(part.stat().st_mode) == 0o640
    report = part.with_name("part.stillpath.html")
    assert report.read_text().startswith("<!doctype html>")
    assert {p.name for p in part.parent.iterdir()} == {part.name, report.name}
    until(lambda: not running.job_ids())  # nothing of the print stays on the server


def test_a_link_stays_a_link(running: Running, part: Path, tmp_path: Path):
    link = tmp_path / "link.gcode"
    link.symlink_to(part)
    assert post(*running.arguments, "--no-report", link, home=tmp_path).returncode == 0
    assert link.is_symlink()
    assert part.read_bytes() == DONE


@pytest.mark.parametrize(
    ("content", "code", "words"),
    [
        (b"bad\n", 2, ("line 7: X1e400 is too large",)),
        (b"crash\n", 1, ("RuntimeError",)),
        pytest.param(b"die\n", 1, (), marks=pytest.mark.slow),
    ],
)
def test_what_the_server_cannot_do_leaves_the_file(
    running: Running, part: Path, tmp_path: Path, content: bytes, code: int, words: tuple[str, ...]
):
    part.write_bytes(content)
    done = post(*running.arguments, part, home=tmp_path)
    assert_reason(done, code, *words)
    assert "secret" not in done.stderr
    assert_untouched(part, content)


def test_what_is_wrong_with_the_request_is_told_before_a_long_upload(
    running: Running, part: Path, tmp_path: Path
):
    content = TEXT + b";" + bytes(20 << 20)
    part.write_bytes(content)
    done = post("--server", running.address, "--machine", "nope", part, home=tmp_path)
    assert_reason(done, 2, "nope", "ender3")
    done = post(*running.arguments, "--method", "magic", part, home=tmp_path)
    assert_reason(done, 2, "method", "magic")
    assert_untouched(part, content)


def test_a_server_that_is_down(part: Path, tmp_path: Path):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    address = f"http://127.0.0.1:{port}"
    arguments = ("--server", address, "--timeout", "0.5", "--machine", "ender3")
    done = post(*arguments, part, home=tmp_path)
    assert_reason(done, 1, address, "refused")
    assert_untouched(part)


@pytest.mark.slow
def test_a_server_that_dies_at_work(part: Path, tmp_path: Path):
    part.write_bytes(b"slow\n")
    data = tmp_path / "server"
    data.mkdir()
    with server(PRETEND, data) as (client, process):
        there = Running(client, data)
        posting = start(*there.arguments, "--timeout", "3", part, home=tmp_path)
        there.running_job()
        process.kill()
        assert_reason(finish(posting), 1, "no answer")
    assert_untouched(part, b"slow\n")


@pytest.mark.slow
def test_a_server_that_comes_back_goes_on(part: Path, tmp_path: Path):
    part.write_bytes(b"slow-once\n")
    data = tmp_path / "server"
    data.mkdir()
    with server(PRETEND, data) as (client, process):
        there = Running(client, data)
        posting = start(*there.arguments, "--timeout", "300", part, home=tmp_path)
        there.running_job()
        process.kill()
        process.wait()
    port = there.address.rsplit(":", 1)[1]
    code = f"""
import sys
sys.argv = ["pretend_server.py", {str(data)!r}]
from stillpath.service import server
real = server.serve_forever
server.serve_forever = lambda settings, host, _, **more: real(settings, host, {port}, **more)
import runpy
runpy.run_path({PRETEND[1]!r}, run_name="__main__")
"""
    with server([sys.executable, "-c", code], data):
        assert finish(posting).returncode == 0
    assert part.read_bytes() == b"; compensated\nslow-once\n"


def test_a_server_that_is_something_else(part: Path, tmp_path: Path):
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), http.server.BaseHTTPRequestHandler) as s:
        threading.Thread(target=s.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{s.server_port}/"
        done = post("--server", address, "--machine", "ender3", part, home=tmp_path)
        s.shutdown()
    assert_reason(done, 1, "501")
    for address in (
        "nas:8000",
        "ftp://nas",
        "http://",
        "http://[::1",
        "http://nas:80a0",
        "http://ä/ö",
    ):
        done = post("--server", address, "--machine", "ender3", part, home=tmp_path)
        assert_reason(done, 2, address, "http://127.0.0.1:8000")
    assert_untouched(part)


@pytest.mark.parametrize(
    "job",
    [
        '{"source_bytes": 1}',
        '{"id": "7", "source_bytes": SIZE, "error": "boom"}',
        '{"id": "7", "source_bytes": SIZE, "state": "done", "result_bytes": 1e999}',
        '{"id": "7", "source_bytes": SIZE, "state": "running", "progress": "half"}',
        100_000 * "[",
    ],
)
def test_a_server_that_talks_nonsense(part: Path, tmp_path: Path, monkeypatch, capsys, job: str):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    answer = job.replace("SIZE", str(part.stat().st_size)).encode()
    monkeypatch.setattr(stillpath_post.Service, "_ask", lambda *_, **__: answer)
    monkeypatch.setattr(stillpath_post.Service, "_forget", lambda *_: None)
    assert stillpath_post.main(["--server", "http://nas", "--machine", "ender3", str(part)]) == 1
    said = capsys.readouterr().err
    assert said == "stillpath-post: http://nas answers, but not as a Stillpath server\n"
    assert_untouched(part)


def test_a_job_that_is_cancelled_on_the_server(running: Running, part: Path, tmp_path: Path):
    part.write_bytes(b"slow\n")
    posting = start(*running.arguments, part, home=tmp_path)
    assert running.client.delete(f"/v1/jobs/{running.running_job()}").status_code == 204
    assert_reason(finish(posting), 2, "cancelled on the server")
    assert_untouched(part, b"slow\n")


def test_a_job_that_takes_too_long(running: Running, part: Path, tmp_path: Path):
    part.write_bytes(b"slow\n")
    done = post(*running.arguments, "--wait", "0.5", part, home=tmp_path)
    assert_reason(done, 1, "not done within")
    assert_untouched(part, b"slow\n")
    until(lambda: not running.job_ids())


@pytest.mark.skipif(os.name != "posix", reason="sends signals")
@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130), (signal.SIGKILL, -9)]
)
def test_being_stopped(running: Running, part: Path, tmp_path: Path, number: int, code: int):
    if signal.getsignal(number) == signal.SIG_IGN:
        pytest.skip("whoever runs the tests ignores this signal, and so do their children")
    part.write_bytes(b"slow\n")
    posting = start(*running.arguments, "--on-error", "keep", part, home=tmp_path)
    job = running.running_job()
    posting.send_signal(number)
    done = finish(posting)
    assert done.returncode == code
    assert_untouched(part, b"slow\n")
    if number == signal.SIGKILL:
        running.client.delete(f"/v1/jobs/{job}")
    else:
        assert "interrupted" in done.stderr
    until(lambda: not running.job_ids())


@pytest.mark.skipif(os.name != "posix", reason="limits the size of files")
def test_what_a_killed_run_left_is_deleted(running: Running, part: Path, tmp_path: Path):
    folder = tmp_path / "temporary"
    for name, days in (("stillpath-post-old", 8), ("stillpath-post-new", 6), ("other", 8)):
        (folder / name).mkdir(parents=True)
        (folder / name / "result").write_bytes(b"G1 X1")
        at = time.time() - days * 86400
        os.utime(folder / name, (at, at))
    kept, left = (part.with_name(f".{part.name}.{n}.stillpath.part") for n in "ab")
    for path, hours in ((kept, 0.5), (left, 2)):
        path.write_bytes(b"G1")
        os.utime(path, (time.time() - hours * 3600,) * 2)
    done = post(*running.arguments, part, home=tmp_path, TMPDIR=str(folder))
    assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in folder.iterdir()) == ["other", "stillpath-post-new"]
    assert (kept.exists(), left.exists()) == (True, False)


def test_a_full_disk(running: Running, part: Path, tmp_path: Path):
    content = TEXT * 200
    part.write_bytes(content)
    # -B: halves of compiled modules would be kept, too.
    limited = ["sh", "-c", 'ulimit -f 1; exec "$@"', "sh", sys.executable, "-B", str(PROGRAM)]
    done = post(*running.arguments, part, home=tmp_path, command=limited)
    assert_reason(done, 1, "large")
    assert "result: File too large" in done.stderr  # where
    assert_untouched(part, content)


def test_wrong_keys_are_refused_and_never_shown(running: Running, part: Path, tmp_path: Path):
    arguments = running.odd("key")
    for wrong in ((), ("--key", "guessed")):
        done = post(*arguments, *wrong, part, home=tmp_path)
        assert_reason(done, 2, "does not accept the key (401): This key is unknown here.")
        assert "guessed" not in done.stderr + done.stdout
    for garbled in ("gues\nsed", "gues–sed"):
        done = post(*arguments, part, home=tmp_path, STILLPATH_KEY=garbled)
        assert_reason(done, 2, "the key holds characters that no key has")
        assert "gues" not in done.stderr + done.stdout
    assert_untouched(part)
    assert post(*arguments, "--key", "secret", part, home=tmp_path).returncode == 0
    part.write_bytes(TEXT)
    assert post(*arguments, part, home=tmp_path, STILLPATH_KEY="secret\n").returncode == 0
    part.write_bytes(TEXT)
    settings = tmp_path / "settings.toml"
    settings.write_text(f'server = "{arguments[1]}"\nkey = "secret"\nmachine = "ender3"\n')
    assert post("--config", settings, part, home=tmp_path).returncode == 0
    assert part.read_bytes() == DONE


@pytest.mark.parametrize(
    ("oddity", "code", "word"),
    [
        ("short", 1, "bytes came"),
        ("login", 1, "bytes came"),
        ("lost", 1, "arrived"),
        ("moved", 2, "http://elsewhere.invalid/"),
        ("full", 1, "/full could not take the request: 'ada' has 1000 unfinished jobs."),
        ("damaged", 2, "The result is damaged."),
    ],
)
def test_broken_transfers(
    running: Running, part: Path, tmp_path: Path, monkeypatch, capsys, oddity: str, code: int, word
):
    real = stillpath_post.Service._open

    def patient(self: Any, *request: Any, timeout_s: float = 0.0) -> Any:
        return real(self, *request, timeout_s=60.0)  # a busy computer answers late

    monkeypatch.setattr(stillpath_post.Service, "_open", patient)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    arguments = [*running.odd(oddity), "--timeout", "1", str(part)]
    assert stillpath_post.main(arguments) == code
    said = capsys.readouterr().err
    assert said.startswith("stillpath-post: ")
    assert said.count("\n") == 1
    assert word in said
    assert "cancelled" not in said
    assert_untouched(part)
    until(lambda: not running.job_ids())


def test_a_result_that_breaks_off_goes_on(running: Running, part: Path, tmp_path: Path):
    done = post(*running.odd("cut"), "--no-report", part, home=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert_untouched(part, DONE)


def test_a_busy_server_is_asked_again(running: Running, part: Path, tmp_path: Path):
    done = post(*running.odd("busy"), "--no-report", part, home=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert part.read_bytes() == DONE


def test_a_result_without_its_report(running: Running, part: Path, tmp_path: Path):
    done = post(*running.odd("unreported"), part, home=tmp_path)
    assert_reason(done, 0, "warning: no report: The report is gone.")
    assert_untouched(part, DONE)
    part.write_bytes(TEXT)
    done = post(*running.odd("unreported"), "--no-report", part, home=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert_untouched(part, DONE)


@pytest.mark.parametrize("busy", [False, True])
def test_a_long_upload_that_breaks_off_is_sent_again(tmp_path: Path, busy: bool):
    """Also where it took longer than the patience with a server that is silent."""
    part = tmp_path / "part.gcode"
    part.write_bytes(BODY)
    with breaking_server({"id": "7"}, busy=busy) as (address, keys):
        service = stillpath_post.Service(address, timeout_s=0.5 * TAKES_S)
        assert service._send(part, {"machine": "ender3", "name": part.name}) == "7"
    assert len(keys) == 2
    assert len(set(keys)) == 1  # one job all the same


def test_a_file_that_somebody_else_changes_meanwhile(
    running: Running, part: Path, tmp_path: Path, monkeypatch, capsys
):
    real = stillpath_post.Service.compensate

    def compensate(self: Any, source: Path, *rest: Any, **named: Any) -> bytes:
        page = real(self, source, *rest, **named)
        source.write_bytes(b"G1 X1\n")
        return page

    monkeypatch.setattr(stillpath_post.Service, "compensate", compensate)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    assert stillpath_post.main([*running.arguments, str(part)]) == 1
    assert "changed by somebody else" in capsys.readouterr().err
    assert_untouched(part, b"G1 X1\n")


def test_keeping_what_was_sliced(running: Running, part: Path, tmp_path: Path):
    part.write_bytes(b"bad\n")
    log = tmp_path / "post.log"
    done = post(*running.arguments, "--on-error", "keep", "--log", log, part, home=tmp_path)
    assert done.returncode == 0
    assert "NOT compensated" in done.stderr
    assert "line 7" in done.stderr
    assert "line 7" in log.read_text()
    assert_untouched(part, b"bad\n")


def test_a_log_that_cannot_be_written_stops_nothing(running: Running, part: Path, tmp_path: Path):
    done = post(*running.arguments, "--log", tmp_path, part, home=tmp_path)
    assert done.returncode == 0
    assert done.stderr.count("no log") == 1
    assert part.read_bytes() == DONE


def test_a_report_that_cannot_be_written_stops_nothing(
    running: Running, part: Path, tmp_path: Path
):
    blocked = tmp_path / "file"
    blocked.touch()
    done = post(
        *running.arguments, "--reports", blocked, part, home=tmp_path, SLIC3R_PP_HOST="OctoPrint"
    )
    assert done.returncode == 0
    assert "no report" in done.stderr
    assert part.read_bytes() == DONE


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (stillpath_post.Stopped(15), "interrupted; the file is compensated"),
        (KeyError("x"), "a bug"),
    ],
)
def test_a_report_that_cannot_be_made_stops_nothing(
    part: Path, tmp_path: Path, monkeypatch, capsys, error: BaseException, words: str
):
    """The file is replaced by then: "the file is as it was" would be wrong."""

    def page() -> str:
        raise error

    def compensate_in_place(path: Path, *_: object, **__: object) -> object:
        path.write_bytes(DONE)
        return page

    monkeypatch.setattr("stillpath.cli.post.compensate_in_place", compensate_in_place)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    assert stillpath_post.main(["--local", "--machine", "ender3", str(part)]) == 0
    assert f"stillpath-post: warning: no report: {words}" in capsys.readouterr().err
    assert part.read_bytes() == DONE


@pytest.mark.slow
def test_progress_goes_to_stdout_while_the_server_is_busy(
    running: Running, part: Path, tmp_path: Path, monkeypatch, capsys
):
    part.write_bytes(b"nap 2\n")
    monkeypatch.setattr(stillpath_post, "_SAID_EVERY_S", 0.2)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    assert stillpath_post.main([*running.arguments, "--no-report", str(part)]) == 0
    assert "compensating 50 %" in capsys.readouterr().out
    until(lambda: not running.job_ids())
