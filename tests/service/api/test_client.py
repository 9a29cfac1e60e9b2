"""The client, and the command line that uses it, against a real server."""

from __future__ import annotations

import http.server
import json
import os
import signal
import socketserver
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from stillpath.cli import main
from stillpath.service.api.schemas import JobView
from stillpath.service.client import Client, ClientError
from stillpath.service.connection import Connection
from tests.checkout import PYTHONPATH
from tests.integrations.breaking import BODY, TAKES_S, breaking_server
from tests.service.jobs.site import STILLPATH
from tests.service.test_server import PRETEND, server, until


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with server(PRETEND, tmp_path_factory.mktemp("data")) as (http_client, _):
        yield str(http_client.base_url).rstrip("/")


@pytest.fixture
def client(address: str) -> Iterator[Client]:
    with Client(address) as opened:
        yield opened


def part(folder: Path, content: str) -> Path:
    path = folder / "part.gcode"
    path.write_text(content)
    return path


def test_from_file_to_file(client: Client, tmp_path: Path):
    source = part(tmp_path, "nap 1\nG1 X1\n")
    told: list[Any] = []
    made = client.submit(source, machine="ender3", tell=lambda stage, share: told.append(stage))
    assert made.is_new
    states: list[str] = []
    job = client.result_of(made, tell=lambda job: states.append(job.state.value))
    assert states[-1] == "done"
    target = client.fetch(job, tmp_path / "out.gcode", tell=lambda stage, _: told.append(stage))
    assert target.read_text() == "; compensated\nnap 1\nG1 X1\n"
    assert {"sending", "fetching"} <= set(told)
    assert client.report(job.id)["machine"] == "ender3"
    folder = client.save_report(job.id, tmp_path / "report")
    assert {path.name for path in folder.iterdir()} == {"report.html", "report.json"}
    assert not client.submit(source, machine="ender3").is_new
    assert job.id in [each.id for each in client.jobs(state=["done"], limit=1)]
    assert "ender3" in [machine["name"] for machine in client.machines()]
    assert client.machine("ender3")["name"] == "ender3"
    client.delete(job.id)
    client.delete(job.id)
    with pytest.raises(ClientError, match="no job") as caught:
        client.job(job.id)
    assert (caught.value.status, caught.value.is_refused) == (404, True)
    assert {p.name for p in tmp_path.iterdir()} == {"part.gcode", "out.gcode", "report"}


@pytest.mark.parametrize(
    ("content", "machine", "words", "refused"),
    [
        ("bad\n", "ender3", "line 7|X1e400", True),
        ("crash\n", "ender3", "RuntimeError", False),
        ("G1 X1\n", "nope", "nope", True),
        ("", "ender3", "no content", True),
    ],
)
def test_why_it_was_not_done(
    client: Client, tmp_path: Path, content: str, machine: str, words: str, refused: bool
):
    with pytest.raises(ClientError, match=words) as caught:
        client.result_of(client.submit(part(tmp_path, content), machine=machine))
    assert caught.value.is_refused == refused
    assert caught.value.problem["title"]


def test_cancelling_and_giving_up(client: Client, tmp_path: Path):
    made = client.submit(part(tmp_path, "slow\n"), machine="ender3")
    with pytest.raises(ClientError, match="given up"):
        client.wait(made.id, timeout_s=0.5)
    assert client.cancel(made.id).state == "cancelled"
    with pytest.raises(ClientError, match="cancelled"):
        client.result_of(made)
    with pytest.raises(ClientError, match="cancelled"):
        client.fetch(made.id, tmp_path / "out.gcode")
    assert [path.name for path in tmp_path.iterdir()] == ["part.gcode"]

    def interrupt(_: object) -> None:
        raise KeyboardInterrupt

    again = client.submit(part(tmp_path, "slow\n"), machine="ender3")
    with pytest.raises(KeyboardInterrupt):
        client.result_of(again, tell=interrupt)
    assert client.job(again.id).state == "cancelled"


@pytest.mark.parametrize("address", ["nas:8000", "ftp://nas", "", "http://[::1", "http://nas:80a0"])
def test_what_is_no_address(address: str):
    with pytest.raises(ClientError, match="http://127"):
        Client(address)


class Handler(http.server.BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    answer: Callable[[Handler], None]

    def _serve(self) -> None:
        type(self).answer(self)

    do_GET = do_POST = do_DELETE = _serve

    def log_message(self, *_: object) -> None:
        pass

    def give(self, status: int, body: bytes, **headers: str) -> None:
        self.send_response(status)
        self.send_header("Content-Length", headers.pop("length", str(len(body))))
        for name, value in headers.items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        self.wfile.write(body)


@contextmanager
def pretending(answer: Callable[[Handler], None]) -> Iterator[str]:
    """A server that answers as told."""
    kind = type("Told", (Handler,), {"answer": staticmethod(answer)})
    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), kind) as found:
        found.daemon_threads = True
        thread = threading.Thread(target=found.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{found.server_address[1]}"
        finally:
            found.shutdown()
            thread.join()


def read_body(handler: Handler) -> bytes:
    return handler.rfile.read(int(handler.headers.get("Content-Length", 0)))


def job_document(**fields: Any) -> bytes:
    (example,) = JobView.model_config["json_schema_extra"]["examples"]
    return json.dumps(example | fields).encode()


@pytest.mark.parametrize("busy", [False, True])
def test_a_long_upload_that_breaks_off_is_sent_again(tmp_path: Path, busy: bool):
    """Also where it took longer than the patience with a server that is away."""
    source = tmp_path / "part.gcode"
    source.write_bytes(BODY)
    job = json.loads(job_document(state="queued"))
    with (
        breaking_server(job, busy=busy) as (address, keys),
        Client(address, patience_s=0.5 * TAKES_S) as client,
    ):
        assert client.submit(source, machine="ender3").id == job["id"]
    assert len(keys) == 2
    assert len(set(keys)) == 1  # one job all the same


def done_job(result_bytes: int) -> JobView:
    return JobView.model_validate_json(job_document(state="done", result_bytes=result_bytes))


def test_an_upload_is_repeated_with_the_same_key(tmp_path: Path):
    keys: list[str] = []

    def answer(handler: Handler) -> None:
        assert read_body(handler) == b"G1 X1"
        keys.append(handler.headers["Idempotency-Key"])
        if len(keys) == 1:
            handler.close_connection = True  # nobody knows whether it arrived
        elif len(keys) == 2:
            handler.give(503, b"{}", Retry_After="0")
        else:
            handler.give(202, job_document())

    with pretending(answer) as address, Client(address) as client:
        assert client.submit(part(tmp_path, "G1 X1"), machine="ender3").is_new
    assert len(keys) == 3
    assert len(set(keys)) == 1


def test_a_broken_download_is_taken_up_again_or_told(tmp_path: Path):
    content = b"0123456789" * 1000
    tag = '"abc"'
    asked: list[str | None] = []

    def answer(handler: Handler) -> None:
        asked.append(handler.headers.get("Range"))
        if len(asked) == 1:
            handler.give(200, content[:3000], length=str(len(content)), ETag=tag)
            handler.close_connection = True
        else:
            assert handler.headers["If-Range"] == tag
            handler.give(206, content[3000:], ETag=tag)

    with pretending(answer) as address, Client(address) as client:
        client.fetch(done_job(len(content)), tmp_path / "out")
    assert (tmp_path / "out").read_bytes() == content
    assert asked == [None, "bytes=3000-"]

    def damaged(handler: Handler) -> None:
        handler.give(200, content, ETag=f'"{"0" * 64}"')

    with (
        pretending(damaged) as address,
        Client(address) as client,
        pytest.raises(ClientError, match="damaged"),
    ):
        client.fetch(done_job(len(content)), tmp_path / "other")
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_a_page_to_log_in_is_no_result(tmp_path: Path):
    def answer(handler: Handler) -> None:
        if handler.path.endswith("/result"):
            handler.give(200, b"<html>log in", Content_Type="text/html")
        else:
            handler.give(200, job_document(state="done", result_bytes=7000))

    with pretending(answer) as address, Client(address) as client:
        for job in (done_job(7000), "a" * 32):
            with pytest.raises(ClientError, match="12 instead of 7000 bytes"):
                client.fetch(job, tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_an_answer_that_cannot_be_unpacked_is_told():
    def answer(handler: Handler) -> None:
        handler.give(200, b"no gzip", Content_Encoding="gzip")

    with (
        pretending(answer) as address,
        Client(address, patience_s=0.3) as client,
        pytest.raises(ClientError, match="no answer from"),
    ):
        client.machines()


def test_a_server_that_cannot_now_says_why():
    with (
        pretending(lambda handler: handler.give(429, b'{"detail": "Wait 9 s."}')) as address,
        Client(address, patience_s=0.3) as client,
        pytest.raises(ClientError, match=f"{address} could not take the request: Wait 9 s."),
    ):
        client.machines()


def test_it_asks_where_events_do_not_come_through():
    states = iter(["queued", "running", "done"])

    def answer(handler: Handler) -> None:
        if handler.path.endswith("/events"):
            handler.give(200, b"<html>", Content_Type="text/html")
        else:
            handler.give(200, job_document(state=next(states)))

    with pretending(answer) as address, Client(address) as client:
        assert client.wait("a" * 32).state == "done"


def test_a_job_that_only_waits_is_given_up_in_time(monkeypatch: pytest.MonkeyPatch):
    """Comments keep the stream of events alive; they must not keep the caller."""
    monkeypatch.setattr("stillpath.service.connection._SILENCE_S", 0.1)
    whole: list[bool] = []

    def answer(handler: Handler) -> None:
        if not handler.path.endswith("/events"):
            handler.give(200, job_document(state="queued"))
            return
        handler.send_response(200)
        handler.send_header("Content-Type", "text/event-stream")
        handler.end_headers()
        whole.append(False)
        for _ in range(100):
            handler.wfile.write(b": ping\n\n")
            handler.wfile.flush()
            time.sleep(0.03)
        whole[-1] = True

    with (
        pretending(answer) as address,
        Client(address) as client,
        pytest.raises(ClientError, match="still queued; given up"),
    ):
        client.wait("5f2c", timeout_s=1.0)
    assert whole
    assert not any(whole)


def test_strangers_and_redirections():
    def html(handler: Handler) -> None:
        handler.give(200, b"<html>")

    strange, there = "not as a Stillpath server", r"moved to http://elsewhere\.invalid"
    with (
        pretending(html) as address,
        Client(address, "sp_key") as client,
        pytest.raises(ClientError, match=strange),
    ):
        client.machines()

    def moved(handler: Handler) -> None:
        handler.give(301, b"", Location="http://elsewhere.invalid/")

    with (
        pretending(moved) as address,
        Client(address, "sp_key") as client,
        pytest.raises(ClientError, match=there),
    ):
        client.machines()


def test_a_server_that_is_away_is_given_up():
    with pretending(lambda handler: None) as address:
        pass
    with Client(address, patience_s=0.3) as client, pytest.raises(ClientError) as caught:
        client.machines()
    assert caught.value.exit_code == 1
    assert address in str(caught.value)


@pytest.fixture
def run(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, str, str]]:
    """Run a command, and return its exit code, stdout and stderr."""

    def ran(*arguments: object, server: str = "") -> tuple[int, str, str]:
        monkeypatch.setenv("STILLPATH_SERVER", server)
        return main.run([*map(str, arguments)]), *capsys.readouterr()

    return ran


def test_compensate_with_a_server(address: str, run: Callable[..., Any], tmp_path: Path):
    source = part(tmp_path, "G1 X31\n")
    target = tmp_path / "out.gcode"
    chosen = ("compensate", source, "-m", "ender3", "-o", target)
    code, out, err = run(*chosen, "--server", address, "--report", tmp_path / "report")
    assert code == 0, err
    assert target.read_text() == "; compensated\nG1 X31\n"
    assert "contour rms" in out
    assert (tmp_path / "report" / "report.html").exists()
    source.write_text("bad\n")
    code, _, err = run(*chosen, server=address)
    assert (code, "X1e400" in err) == (2, True)
    assert target.read_text() == "; compensated\nG1 X31\n"
    code, _, err = run("jobs", "list", "--server", "nas")
    assert (code, "http://127" in err) == (2, True)


@pytest.mark.parametrize(
    ("kind", "step"), [(Client, "result_of"), (Connection, "download")], ids=["at work", "fetched"]
)
def test_a_file_that_somebody_changes_while_a_server_works(
    kind: type,
    step: str,
    address: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    """Sliced again meanwhile: the new one must not be replaced by what became of the old one."""
    source = part(tmp_path, "G1 X32\n")
    really = getattr(kind, step)

    def meanwhile(*arguments: Any, **named: Any) -> Any:
        answer = really(*arguments, **named)
        source.write_text("G1 X1 ; sliced again\n")
        return answer

    monkeypatch.setattr(kind, step, meanwhile)
    command = ["compensate", str(source), "--in-place", "-m", "ender3", "--server", address]
    assert main.run(command) == 1
    assert "another program changed the file" in capsys.readouterr().err
    assert source.read_text() == "G1 X1 ; sliced again\n"


def test_a_report_that_cannot_be_written_costs_no_result(
    address: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    source, report = part(tmp_path, "G1 X4\n"), tmp_path / "report"
    (report / "report.html").mkdir(parents=True)
    command = ["compensate", str(source), "--in-place", "-m", "ender3", "--server", address]
    assert main.run([*command, "--report", str(report)]) == 0
    assert source.read_text() == "; compensated\nG1 X4\n"
    assert f"{source} is written; no report: {report}" in capsys.readouterr().err


@pytest.mark.parametrize("proxy", ["http:foo", "foo://nas", "socks5://nas:1", "http://[::1"])
def test_proxies_that_are_none_are_named(proxy: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("ALL_PROXY", proxy)
    with pytest.raises(ClientError, match="ALL_PROXY") as caught:
        Client("http://nas")
    assert caught.value.exit_code == 2


def test_the_commands_of_jobs(
    address: str,
    client: Client,
    run: Callable[..., Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
):
    made = client.submit(part(tmp_path, "G1 X41\n"), machine="ender3", batch="cli")
    there = partial(run, server=address)
    assert there("jobs", "wait", made.id)[0] == 0
    listed = there("jobs", "list", "--batch", "cli")[1]
    assert made.id in listed
    assert "part.gcode" in listed
    assert json.loads(there("jobs", "show", made.id)[1])["state"] == "done"
    target = tmp_path / "got.gcode"
    assert there("jobs", "fetch", made.id, "-o", target)[:2] == (0, f"{target}\n")
    assert target.read_text() == "; compensated\nG1 X41\n"
    link = tmp_path / "link.gcode"
    link.symlink_to(target)
    assert there("jobs", "fetch", made.id, "-o", link)[0] == 0
    assert link.is_symlink()
    code, _, err = there("jobs", "fetch", made.id, "-o", tmp_path)
    assert (code, "is a folder; name the file to write" in err) == (2, True)
    monkeypatch.chdir(tmp_path)
    code, named, _ = there("jobs", "fetch", made.id)
    assert (code, Path(named.strip()).read_bytes()) == (0, target.read_bytes())
    code, _, err = there("jobs", "fetch", made.id)
    assert (code, "-o" in err) == (2, True)
    code, _, err = there("jobs", "cancel", made.id)
    assert (code, "nothing to cancel" in err) == (2, True)
    assert there("jobs", "delete", made.id)[0] == 0
    code, _, err = there("jobs", "show", made.id)
    assert (code, "no job" in err) == (2, True)
    assert "STILLPATH_SERVER" in run("jobs", "show", made.id)[2]


@pytest.mark.skipif(os.name != "posix", reason="sends signals")
def test_an_interrupted_command_cancels_its_job(address: str, client: Client, tmp_path: Path):
    source = part(tmp_path, "slow\n")
    command = [*STILLPATH, "compensate", str(source), "-m", "ender3", "-o", str(tmp_path / "out")]
    process = subprocess.Popen(
        [*command, "--server", address],
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": PYTHONPATH},
    )
    job = until(lambda: next(iter(client.jobs(state=["running"])), None))
    process.send_signal(signal.SIGTERM)
    _, said = process.communicate(timeout=300)
    assert process.returncode == 143
    assert "interrupted" in said
    assert until(lambda: client.job(job.id).state == "cancelled")
    assert [path.name for path in tmp_path.iterdir()] == ["part.gcode"]
