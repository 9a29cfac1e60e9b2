"""How a service that cannot start says so, and how one that starts ends."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
from pathlib import Path
from urllib.parse import urlsplit

import psutil
import pytest

from stillpath.service import server
from stillpath.service.server import serve_forever
from stillpath.service.settings import Settings
from tests.checkout import PYTHONPATH
from tests.service.jobs.site import STILLPATH
from tests.service.test_server import REAL

pytestmark = pytest.mark.slow


def start(data_dir: Path, **settings: str) -> subprocess.Popen[str]:
    given = {f"STILLPATH_{name.upper()}": value for name, value in settings.items()}
    return subprocess.Popen(
        [*REAL, str(data_dir)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": PYTHONPATH} | given,
    )


@pytest.mark.parametrize(
    ("settings", "code", "said"),
    [
        ({"storage_url": "ftp://somewhere"}, 2, "neither s3://bucket/prefix nor"),
        ({}, 1, "restore a backup"),
    ],
    ids=["storage", "database-broken"],
)
def test_a_service_that_cannot_start_says_why_in_one_line(
    tmp_path: Path, settings: dict[str, str], code: int, said: str
):
    database = tmp_path / "stillpath.sqlite3"
    database.write_text("not a database" * 1000)
    database.chmod(0o600)  # else a line says that it was made private
    process = start(tmp_path, **settings)
    _, errors = process.communicate(timeout=600)
    assert process.returncode == code, errors
    assert errors.startswith("stillpath: error: ")
    assert said in errors
    assert errors.count("\n") == 1


def test_a_taken_port_is_named_with_the_remedy(tmp_path: Path):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(OSError, match=f"{port}; .*--port"):
            serve_forever(Settings(data_dir=tmp_path), "127.0.0.1", port)


def test_a_scheduler_names_a_taken_port_in_one_line():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        command = [*STILLPATH, "scheduler", "--host", "127.0.0.1", "--port", port]
        told = subprocess.run(command, capture_output=True, text=True, check=False)
    assert told.returncode == 1
    assert f"127.0.0.1:{port} (Address already in use); choose another --port" in told.stderr
    assert told.stderr.count("\n") == 1


@pytest.mark.skipif(os.name != "posix", reason="sends signals")
@pytest.mark.parametrize("dual", [True, False])
@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0", "::1", "::"])
def test_the_address_that_is_named_first_answers(
    monkeypatch: pytest.MonkeyPatch, host: str, dual: bool
):
    if not socket.has_ipv6 and ":" in host:
        pytest.skip("no IPv6")
    if not dual:
        monkeypatch.setattr(socket, "has_dualstack_ipv6", lambda: False)
    with server._listening(host, 0) as listener:
        first = urlsplit(server._addresses(host, listener.getsockname()[1])[0])
        socket.create_connection((first.hostname, first.port), timeout=60).close()


def test_other_computers_are_given_an_address_without_a_name():
    with server._listening("0.0.0.0", 0) as listener:
        port = listener.getsockname()[1]
        hosts = [urlsplit(address).hostname for address in server._addresses("0.0.0.0", port)]
        numbers = [host for host in hosts if host and host.replace(".", "").isdecimal()]
        for host in numbers:
            socket.create_connection((host, port), timeout=60).close()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))
        except OSError:
            pytest.skip("no network")
    assert len(numbers) == 2


def test_a_service_ends_before_its_workers_are_up(tmp_path: Path):
    process = start(tmp_path)
    assert process.stdout is not None
    assert process.stdout.readline().startswith("stillpath: http://")
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=600)
    assert process.returncode in (0, -signal.SIGTERM)
    assert "Traceback" not in errors
    assert "jobs are processed again" not in errors
    assert not any(
        str(tmp_path) in " ".join(p.info["cmdline"] or []) for p in psutil.process_iter(["cmdline"])
    )
