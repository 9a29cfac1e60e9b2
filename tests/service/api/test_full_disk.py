"""A disk that is really full: what was accepted is done, deleting works, the service says so."""

from __future__ import annotations

import contextlib
import errno
import shutil
import socket
import sqlite3
import sys
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx2
import pytest
from sqlalchemy.exc import OperationalError

from stillpath.service.database.engine import open_database
from stillpath.service.database.errors import DatabaseFull
from stillpath.service.database.transactions import writing
from stillpath.service.settings import Settings
from stillpath.service.storage.disk import Disk, NoRoom
from tests.service.small_disk import small_disk
from tests.service.test_server import PRETEND, server, until

MIB = 1 << 20
SIZE_MIB, RESERVE_MIB = 60, 16


@pytest.fixture(name="small_disk")
def mounted(tmp_path: Path) -> Iterator[Path]:
    with small_disk(tmp_path / "disk", SIZE_MIB) as folder:
        yield folder


def fill(file: Path) -> None:
    with file.open("wb", buffering=0) as opened:
        for size in (MIB, 4096, 1):
            with contextlib.suppress(OSError):
                while opened.write(b"x" * size) == size:
                    pass


def jobs_of(client: httpx2.Client) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = client.get("/v1/jobs?limit=200").json()["jobs"]
    return found


def handed_in(client: httpx2.Client, content: bytes) -> httpx2.Response:
    return client.post("/v1/jobs?machine=ender3", content=content)


def test_what_the_reserve_is_for(small_disk: Path) -> None:
    disk = Disk(small_disk, RESERVE_MIB * MIB)
    disk.hold()
    assert disk.refusal() is None
    free = disk.free_bytes()
    assert SIZE_MIB * MIB - free == 4 * MIB
    with pytest.raises(NoRoom, match=r"15 MiB left after 41 MiB more; 16 MiB stay free .*Delete"):
        disk.check(41 * MIB)
    fill(small_disk / "foreign")
    assert (disk.lets_jobs_begin, disk.lets_jobs_go_on, disk.is_full) == (False, False, True)
    disk.hold()  # changes nothing now
    assert disk.free_bytes() == 0
    disk.give_up()
    assert disk.free_bytes() == 4 * MIB
    assert Disk(small_disk, 0).refusal(1 << 40) is None
    assert disk.fits_ever(44 * MIB)
    assert not disk.fits_ever(45 * MIB)
    assert Disk(small_disk, 0).fits_ever(1 << 40)
    foreign = small_disk / "foreign"
    foreign.unlink()
    assert Disk(small_disk / "new" / "data", RESERVE_MIB * MIB).lets_jobs_go_on


def test_a_reserve_takes_space_where_the_file_system_compresses(tmp_path: Path) -> None:
    held = tmp_path / "disk-reserve"
    held.write_bytes(bytes(MIB))  # as versions before wrote it
    Disk(tmp_path, 4 * MIB).hold()
    assert len(zlib.compress(held.read_bytes(), 1)) > 0.99 * MIB
    before = held.stat()
    Disk(tmp_path, 4 * MIB).hold()
    assert held.stat() == before


def test_a_quota_is_full_where_the_disk_has_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On Btrfs, for instance, only writing tells of a quota; SQLite has no word for it."""

    def refused(**_: Any) -> None:
        raise OSError(errno.EDQUOT, "Disk quota exceeded")

    engine = open_database(Settings(data_dir=tmp_path))
    said = sqlite3.OperationalError("disk I/O error")
    said.sqlite_errorcode = sqlite3.SQLITE_IOERR_WRITE
    monkeypatch.setattr("stillpath.service.storage.disk.tempfile.TemporaryFile", refused)
    with pytest.raises(DatabaseFull, match="or a quota on it, is full"), writing(engine):
        raise OperationalError("DELETE", {}, said)
    engine.dispose()


def test_half_a_reserve_is_not_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(_: int) -> None:
        raise OSError(errno.EDQUOT, "Disk quota exceeded")

    monkeypatch.setattr("stillpath.service.storage.disk.os.fsync", refused)
    Disk(tmp_path, 4 * MIB).hold()
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_full_disk_loses_no_job(small_disk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STILLPATH_DISK_RESERVE_BYTES", str(RESERVE_MIB * MIB))
    monkeypatch.setenv("STILLPATH_WORKERS", "2")
    data = small_disk / "data"
    data.mkdir()
    foreign = small_disk / "foreign"
    with server(PRETEND, data) as (client, _):

        def post(number: int) -> httpx2.Response:
            return handed_in(client, f"nap 0.2 {number}\n".encode().ljust(MIB, b";"))

        answers = [post(number) for number in range(50)]
        accepted = [a.headers["location"] for a in answers if a.status_code == 202]
        refused = [a for a in answers if a.status_code != 202]
        assert len(accepted) > 10
        assert refused
        for answer in refused:
            assert answer.status_code == 507
            assert "16 MiB stay free" in answer.json()["detail"]
            assert "Delete finished jobs" in answer.json()["detail"]

        assert until(lambda: client.get("/readyz").json().get("part") == "disk", 60)
        fill(foreign)
        until(lambda: all(job["state"] != "running" for job in jobs_of(client)), 60)
        states = {job["id"]: job["state"] for job in jobs_of(client)}
        assert set(states.values()) <= {"queued", "done"}
        assert "queued" in states.values()

        first, second, *others = accepted
        assert client.delete(first).status_code == 204
        assert client.delete(second).status_code == 204
        assert client.get(first).status_code == 404

        foreign.unlink()

        def fetch_and_delete() -> bool:
            for job in jobs_of(client):
                assert job["state"] in ("queued", "running", "done")
                if job["state"] == "done":
                    where = job["links"]["self"]
                    assert client.get(f"{where}/result").status_code == 200
                    assert client.delete(where).status_code == 204
                    others.remove(where)
            return not others

        assert until(fetch_and_delete, 120)
        assert until(lambda: client.get("/readyz").status_code == 200, 60)
        assert post(99).status_code == 202


@pytest.mark.slow
def test_a_job_too_large_for_the_disk_is_told_so(
    small_disk: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STILLPATH_DISK_RESERVE_BYTES", str(RESERVE_MIB * MIB))
    data = small_disk / "data"
    data.mkdir()
    foreign = small_disk / "foreign"

    def post(content: bytes) -> httpx2.Response:
        return handed_in(client, content)

    def figure(name: str) -> float:
        text = client.get("/metrics").text
        return next(float(line.split()[1]) for line in text.splitlines() if line.startswith(name))

    with server(PRETEND, data) as (client, _):
        # Upload and result would never fit: refused before the body is read.
        answer = post(b"nap 0.1\n".ljust(25 * MIB, b";"))
        assert answer.status_code == 507
        assert "50 MiB for the upload and its result" in answer.json()["detail"]

        # What grows beyond the whole disk fails, and says why.
        where = post(b"long 100").headers["location"]
        job = until(lambda: (j := client.get(where).json())["state"] == "failed" and j, 60)
        assert job["error"]["title"] == "The job is larger than the disk"
        assert "60 MiB in all" in job["error"]["detail"]
        assert "Limit the size of the result (max_mb)" in job["error"]["detail"]
        assert client.delete(where).status_code == 204

        # What would fit without a neighbour waits, says for how much, and holds nobody up.
        assert until(lambda: shutil.disk_usage(small_disk).free > 40 * MIB, 60)
        foreign.write_bytes(bytes(25 * MIB))
        where = post(b"long 34").headers["location"]
        job = until(lambda: (j := client.get(where).json())["room_bytes"] and j, 60)
        assert job["state"] == "queued"
        assert 10 * MIB < job["room_bytes"] <= 31 * MIB
        assert job["stage"].startswith("waiting for room on the disk: more than ")
        assert figure("stillpath_jobs_waiting_for_room ") == 1
        assert figure("stillpath_room_wanted_bytes ") == job["room_bytes"]
        assert 0 < figure("stillpath_disk_free_bytes ") < 60 * MIB
        other = post(b"G1 X1").headers["location"]
        until(lambda: client.get(other).json()["state"] == "done", 60)
        assert client.get(where).json()["attempt"] == 1
        foreign.unlink()
        until(lambda: client.get(where).json()["state"] == "done", 90)
        assert client.get(where).json()["room_bytes"] is None


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="limits the size of files")
@pytest.mark.parametrize(
    ("head", "limit"),
    [("Content-Length: 67108864", "file"), ("Transfer-Encoding: chunked", "upload")],
)
def test_who_only_reads_after_sending_all_hears_why_he_was_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, head: str, limit: str
) -> None:
    command = PRETEND
    if limit == "file":
        command = ["sh", "-c", 'ulimit -f 20000 && exec "$0" "$@"', *PRETEND]  # of 512 bytes
    else:
        monkeypatch.setenv("STILLPATH_MAX_UPLOAD_BYTES", str(10 * MIB))
    chunk = b";" * MIB
    with server(command, tmp_path) as (client, _):
        address = ("127.0.0.1", client.base_url.port)
        with socket.create_connection(address, timeout=90) as sender:
            start = f"POST /v1/jobs?machine=ender3 HTTP/1.1\r\nHost: localhost\r\n{head}\r\n\r\n"
            sender.sendall(start.encode())
            for _ in range(64):
                sender.sendall(b"100000\r\n%s\r\n" % chunk if "chunked" in head else chunk)
            if "chunked" in head:
                sender.sendall(b"0\r\n\r\n")
            with sender.makefile("rb") as answer:
                text = answer.read().decode()
        assert text.startswith("HTTP/1.1 507 " if limit == "file" else "HTTP/1.1 413 ")
        assert "application/problem+json" in text
        assert '"title": "File too large"' in text
        assert not list((tmp_path / "incoming").iterdir())


@pytest.mark.slow
def test_a_database_without_room_says_so_where_nothing_is_reserved(
    small_disk: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STILLPATH_DISK_RESERVE_BYTES", "0")
    data = small_disk / "data"
    data.mkdir()
    foreign = small_disk / "foreign"
    with server(PRETEND, data) as (client, _):
        where = handed_in(client, b"G1 X1").headers["location"]
        until(lambda: client.get(where).json()["state"] == "done", 60)
        fill(foreign)
        answer = client.delete(where)
        assert (answer.status_code, answer.json()["title"]) == (507, "No space left")
        assert client.get(f"{where}/result").status_code == 200
        foreign.unlink()
        assert client.delete(where).status_code == 204
