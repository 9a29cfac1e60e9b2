"""A service that starts before its database, and one that is killed: what its logs say."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import tempfile
import time
from pathlib import Path

import psutil
import pytest

from tests.checkout import PYTHONPATH
from tests.service.database.postgres import PostgresServer
from tests.service.test_server import PRETEND, finished, post, server, until

pytestmark = [pytest.mark.slow, pytest.mark.skipif(os.name != "posix", reason="kills processes")]


@pytest.mark.postgresql
def test_a_service_waits_for_postgresql(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = Path(tempfile.mkdtemp(prefix="sp-pg-"))
    folder.chmod(0o755)
    database = PostgresServer(folder / "server")
    database.start()
    url = database.new_database()
    database.stop()
    monkeypatch.setenv("STILLPATH_DATABASE_URL", url)
    starting = subprocess.Popen(
        [*PRETEND, str(tmp_path)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": PYTHONPATH},
    )
    try:
        assert starting.stderr is not None
        lines = iter(starting.stderr.readline, "")
        assert any("waiting for the database" in line for line in lines)
        time.sleep(1.0)
        assert starting.poll() is None
        database.start()
        assert any("data directory" in line for line in lines)  # it goes on
        starting.terminate()
        starting.communicate(timeout=60)
        with server(PRETEND, tmp_path) as (client, _):
            assert finished(client, post(client, b"G1 X1"))["state"] == "done"
    finally:
        if starting.poll() is None:
            starting.kill()
        database.stop()
        shutil.rmtree(folder, ignore_errors=True)


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGKILL])
def test_an_end_leaves_nothing_but_logs(tmp_path: Path, how: signal.Signals) -> None:
    said = tmp_path / "stderr"
    data = tmp_path / "data"
    data.mkdir()
    with said.open("w") as file:
        process = subprocess.Popen(
            [*PRETEND, str(data)],
            stdout=subprocess.DEVNULL,
            stderr=file,
            env=os.environ | {"PYTHONPATH": PYTHONPATH},
        )
        until(lambda: "jobs are processed again" in said.read_text(), 60)
        family = psutil.Process(process.pid).children(recursive=True)
        assert family
        process.send_signal(how)
        process.wait(60)
        psutil.wait_procs(family, timeout=60)
    lines = said.read_text().splitlines()
    assert lines
    for line in lines:
        assert isinstance(json.loads(line), dict), line
