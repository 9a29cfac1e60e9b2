"""Backup and restore from outside: what was kept comes back, and nothing is harmed."""

from __future__ import annotations

import gzip
import os
import random
import shutil
import tarfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from sqlalchemy import Engine

from stillpath.cli.main import run
from stillpath.service.backup import archive
from stillpath.service.backup.archive import BackupError, back_up, restore
from stillpath.service.database.engine import open_database
from stillpath.service.database.errors import StoreError
from stillpath.service.deliveries.rows import deliveries_of
from stillpath.service.instance_lock import exclusive
from stillpath.service.jobs.state import JobKind, JobState
from stillpath.service.jobs.store import JobStore
from stillpath.service.security.keys import KeyStore, announce_first_key
from stillpath.service.settings import Settings
from stillpath.service.storage.disk import Disk
from tests.service.database.examples import finished, make_job


@pytest.fixture
def data(tmp_path: Path) -> Path:
    return tmp_path / "data"


@pytest.fixture
def engine(data: Path) -> Iterator[Engine]:
    opened = open_database(Settings(data_dir=data))
    yield opened
    opened.dispose()


@pytest.fixture
def store(engine: Engine) -> JobStore:
    return JobStore(engine)


def add_done(store: JobStore, data: Path, text: str = "G28\n") -> str:
    job = make_job()
    write(data / f"jobs/{job.id}/source/part.gcode", text)
    write(data / f"jobs/{job.id}/machine.json", "{}")
    store.add(job)
    running = store.claim(job.id, 1500.0, "w")
    write(data / f"jobs/{job.id}/1/result/part.stillpath.gcode", "; compensated\n" + text)
    write(data / f"jobs/{job.id}/1/report/report.html", "<p>")
    store.apply(job.id, finished(running))
    return job.id


def write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def tree(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and "sqlite3" not in path.name and path.name != "service.lock"
    }


def jobs(data: Path) -> dict[str, JobState]:
    engine = open_database(Settings(data_dir=data))
    page = JobStore(engine).page("anna", limit=1000)
    engine.dispose()
    return {job.id: job.state for job in page.jobs}


@pytest.mark.parametrize("name", ["backup.tar", "backup.tar.gz"])
def test_what_was_kept_comes_back(name, engine, store, data, tmp_path):
    ids = [add_done(store, data, f"G28 ; {n}\n") for n in range(3)]
    write(data / "machines/mine/1.json", "{}")
    expected = tree(data)
    write(data / "incoming/half", "passing")
    write(data / "cache/shaper.json", "passing")
    announce_first_key(KeyStore(engine), None, data)
    Disk(data, 4 << 20).hold()
    assert {"first-key", "disk-reserve"} <= {path.name for path in data.iterdir()}
    target = tmp_path / name
    with exclusive(data):  # a service is at work
        assert run(["backup", str(target), "--data-dir", str(data)]) == 0
    assert os.name == "nt" or target.stat().st_mode & 0o777 == 0o600
    assert run(["restore", str(target), "--data-dir", str(tmp_path / "new")]) == 0
    assert tree(tmp_path / "new") == expected
    assert jobs(tmp_path / "new") == dict.fromkeys(ids, JobState.DONE)


def test_what_a_killed_backup_left_goes_with_the_next_one(store, data, tmp_path):
    folders = [tmp_path / f"backups/.stillpath-backup-{name}" for name in ("killed", "at-work")]
    for folder in folders:
        write(folder / "stillpath.sqlite3", "a copy")
    os.utime(folders[0], (0, 0))
    back_up(data, tmp_path / "backups/b.tar")
    assert {path.name for path in (tmp_path / "backups").iterdir()} == {"b.tar", folders[1].name}


def test_running_jobs_can_be_taken_up(store, data, tmp_path):
    job = make_job()
    write(data / f"jobs/{job.id}/source/part.gcode", "G28\n")
    store.add(job)
    store.claim(job.id, 1500.0, "w")
    write(data / f"jobs/{job.id}/1/result/part.stillpath.gcode", "; half")
    back_up(data, tmp_path / "b.tar")
    restore(tmp_path / "b.tar", tmp_path / "new")
    assert jobs(tmp_path / "new") == {job.id: JobState.RUNNING}
    assert list(tree(tmp_path / "new")) == [f"jobs/{job.id}/source/part.gcode"]


def test_jobs_without_an_upload_come_back(store, data, tmp_path):
    """Designs and the like, done and queued, but none whose result is lost."""
    done, queued, lost = (
        make_job(kind=JobKind.DESIGN, source_name="", source_bytes=0, result_name="design.json")
        for _ in range(3)
    )
    for job in (done, lost, queued):
        write(data / f"jobs/{job.id}/machine.json", "{}")
        store.add(job)
    for job in (done, lost):
        store.apply(job.id, finished(store.claim(job.id, 1500.0, "w")))
    write(data / f"jobs/{done.id}/1/result/design.json", "{}")
    back_up(data, tmp_path / "b.tar")
    restore(tmp_path / "b.tar", tmp_path / "new")
    assert jobs(tmp_path / "new") == {done.id: JobState.DONE, queued.id: JobState.QUEUED}
    shutil.rmtree(data / f"jobs/{lost.id}")
    assert tree(tmp_path / "new") == tree(data)


@pytest.mark.parametrize("starts", [True, False])
def test_a_restore_starts_no_print_and_replaces_no_file_of_a_printer(store, data, tmp_path, starts):
    waiting, done = (make_job(printer="left", print_after=starts) for _ in range(2))
    for job in (waiting, done):
        write(data / f"jobs/{job.id}/source/part.gcode", "G28\n")
        store.add(job)
    write(data / f"jobs/{done.id}/1/result/part.stillpath.gcode", "G28\n")
    store.apply(done.id, finished(store.claim(done.id, 1500.0, "w")))
    back_up(data, tmp_path / "b.tar")
    restore(tmp_path / "b.tar", tmp_path / "first")
    back_up(tmp_path / "first", tmp_path / "again.tar")
    restore(tmp_path / "again.tar", tmp_path / "new")
    engine = open_database(Settings(data_dir=tmp_path / "new"))
    restored = JobStore(engine)
    assert restored.get(waiting.id).print_after is False
    # What is done only now may be older than what the printer has.
    restored.apply(waiting.id, finished(restored.claim(waiting.id, 1500.0, "w")))
    for (delivery,) in deliveries_of(engine, [done.id, waiting.id]).values():
        assert (delivery.state, "held back" in delivery.error) == ("failed", True)
    engine.dispose()


def test_while_jobs_come_and_go(store, data, tmp_path):
    """No row of a backup is without its files, whatever is added and deleted meanwhile."""
    stop = threading.Event()
    ids = [add_done(store, data) for _ in range(20)]

    def churn() -> None:
        rng = random.Random(3)
        while not stop.is_set():
            gone = ids.pop(rng.randrange(len(ids)))
            store.forget(gone)
            shutil.rmtree(data / "jobs" / gone)
            ids.append(add_done(store, data))

    thread = threading.Thread(target=churn)
    thread.start()
    try:
        for n in range(5):
            back_up(data, tmp_path / f"{n}.tar")
    finally:
        stop.set()
        thread.join()
    for n in range(5):
        new = tmp_path / f"new{n}"
        restore(tmp_path / f"{n}.tar", new)
        found = jobs(new)
        assert 10 < len(found) <= 21
        for job_id, state in found.items():
            assert (new / f"jobs/{job_id}/source/part.gcode").exists()
            result = new / f"jobs/{job_id}/1/result/part.stillpath.gcode"
            assert result.exists() == (state is JobState.DONE)
        assert {path.name for path in (new / "jobs").iterdir()} == set(found)


def test_a_damaged_archive_changes_nothing(store, data, tmp_path):
    add_done(store, data, "G28 " * 3000)
    target = tmp_path / "b.tar"
    back_up(data, target)
    whole = target.read_bytes()
    rng = random.Random(5)
    for n in range(12):
        broken = bytearray(whole)
        if n % 2:
            del broken[rng.randrange(len(broken) - 8000) :]
        else:
            at = whole.index(b"G28 G28") + rng.randrange(10_000)
            broken[at] ^= 1
        target.write_bytes(broken)
        with pytest.raises(BackupError):
            restore(target, tmp_path / "new")
        assert [path.name for path in (tmp_path / "new").iterdir()] == ["service.lock"]
    compressed = gzip.compress(whole)
    scrambled = bytes(byte ^ 0xFF for byte in compressed[500:520])
    for broken in (compressed[:-600], compressed[:500] + scrambled + compressed[520:]):
        target.write_bytes(broken)
        with pytest.raises(BackupError):
            restore(target, tmp_path / "new")
    target.write_bytes(b"no archive")
    assert run(["restore", str(target), "--data-dir", str(tmp_path / "new")]) == 2


@pytest.mark.parametrize(
    "name", ["../evil", "/evil", "a/../../evil", "..\\evil", "backups/evil", "service.lock/evil"]
)
def test_an_archive_writes_nowhere_else(name, tmp_path):
    (tmp_path / "x").write_text("x")
    with tarfile.open(tmp_path / "b.tar", "w") as tar:
        entry = tarfile.TarInfo(name)
        entry.size = 1
        with (tmp_path / "x").open("rb") as file:
            tar.addfile(entry, file)
    with pytest.raises(BackupError, match="does not belong"):
        restore(tmp_path / "b.tar", tmp_path / "new")
    assert not list(tmp_path.rglob("*evil*"))


def test_a_link_is_refused(tmp_path):
    with tarfile.open(tmp_path / "b.tar", "w") as tar:
        entry = tarfile.TarInfo("link")
        entry.type, entry.linkname = tarfile.SYMTYPE, "/etc/passwd"
        tar.addfile(entry)
    with pytest.raises(BackupError, match="does not belong"):
        restore(tmp_path / "b.tar", tmp_path / "new")


def test_a_restore_never_writes_over_data(store, data, tmp_path):
    add_done(store, data)
    back_up(data, tmp_path / "b.tar")
    before = tree(data)
    with pytest.raises(BackupError, match="is not empty"):
        restore(tmp_path / "b.tar", data)
    assert tree(data) == before
    with exclusive(tmp_path / "new"), pytest.raises(OSError, match="another service works"):
        restore(tmp_path / "b.tar", tmp_path / "new")


@pytest.mark.parametrize("step", range(5))
def test_a_restore_that_was_killed_begins_anew(step, store, data, tmp_path, monkeypatch):
    add_done(store, data)
    write(data / "machines/mine/1.json", "{}")
    back_up(data, tmp_path / "b.tar")
    new = tmp_path / "new"
    left = step

    class Killed(BaseException):
        pass

    def killed(act):
        def counted(*arguments):
            nonlocal left
            left -= 1
            if left < 0:
                raise Killed
            return act(*arguments)

        return counted

    with monkeypatch.context() as patched:
        patched.setattr(archive.Path, "replace", killed(Path.replace))
        patched.setattr(archive.shutil, "rmtree", lambda path: None)
        try:
            restore(tmp_path / "b.tar", new)
        except Killed:
            assert step < 3
    if step < 3:
        with pytest.raises(StoreError, match="run stillpath restore again"):
            jobs(new)
        restore(tmp_path / "b.tar", new)
    assert tree(new) == tree(data)
    assert len(jobs(new)) == 1
    assert not (new / ".restoring").exists()


@pytest.mark.parametrize("made", ["database", "machine"])
def test_a_restore_clears_nothing_that_was_made_since(made, store, data, tmp_path):
    """As by a service, or the command line, after a restore was broken off."""
    back_up(data, tmp_path / "b.tar")
    new = tmp_path / "new"
    if made == "database":
        open_database(Settings(data_dir=new)).dispose()
    write(new / ".restoring/machines/mine/1.json", "{}")
    if made == "machine":
        write(new / ".restoring/printers/left/1.json", "{}")
        (new / ".restoring/machines").rename(new / "machines")
        measured = new / "machines/measured/1.json"
        write(measured, "{}")
        later_s = time.time() + 1.0  # file systems tell times of some milliseconds only
        os.utime(measured, (later_s, later_s))
    before = tree(new)
    with pytest.raises(BackupError, match=r"move (it|them) away"):
        restore(tmp_path / "b.tar", new)
    assert tree(new) == before


def test_backups_in_the_data_directory_are_not_in_the_next_one(store, data, tmp_path):
    """In a container nothing else can be written to, and nothing else be restored from."""
    add_done(store, data)
    expected = tree(data)
    for name in ("1.tar", "2.tar"):
        assert run(["backup", str(data / "backups" / name), "--data-dir", str(data)]) == 0
    new = tmp_path / "new"
    kept = {f"backups/{name}": content for name, content in tree(data / "backups").items()}
    shutil.copytree(data / "backups", new / "backups")
    write(new / ".restoring/machines/mine/1.json", "of a restore that was broken off")
    for _ in range(2):
        assert run(["restore", str(new / "backups/2.tar"), "--data-dir", str(new)]) == 0
        assert tree(new) == expected | kept
        shutil.rmtree(new / "jobs")
        for file in new.glob("stillpath.sqlite3*"):
            file.unlink()


@pytest.mark.parametrize("name", ["b.tar", "jobs/b.tar", "backups"])
def test_a_restore_never_deletes_its_archive(name, store, data, tmp_path, capsys):
    back_up(data, tmp_path / "b.tar")
    new = tmp_path / "new"
    write(new / ".restoring/machines/mine/1.json", "of a restore that was broken off")
    (new / name).parent.mkdir(exist_ok=True)
    shutil.copy(tmp_path / "b.tar", new / name)
    before = tree(new)
    assert run(["restore", str(new / name), "--data-dir", str(new)]) == 2
    assert str(new / "backups") in capsys.readouterr().err
    assert tree(new) == before


@pytest.mark.parametrize("left", [None, b"", b"scrambled" * 1000])
def test_a_backup_without_its_jobs_is_refused(left, data, tmp_path, capsys):
    """A night later the last good one may be deleted."""
    write(data / "jobs/0123/source/part.gcode", "G28\n")
    if left is not None:
        (data / "stillpath.sqlite3").write_bytes(left)
    assert run(["backup", str(tmp_path / "b.tar"), "--data-dir", str(data)]) == 2
    assert "restore an earlier backup" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["data"]


def test_a_backup_never_replaces_a_file(store, data, tmp_path, monkeypatch, capsys):
    (tmp_path / "there.tar").write_text("mine")
    for target in ("there.tar", "data/b.tar", "data/backups", "no such folder/"):
        assert run(["backup", f"{tmp_path}/{target}", "--data-dir", str(data)]) == 2
    assert run(["backup", str(tmp_path / "b.tar"), "--data-dir", str(tmp_path / "no")]) == 2
    assert (tmp_path / "there.tar").read_text() == "mine"
    monkeypatch.setenv("STILLPATH_DATABASE_URL", "postgresql://localhost/x")
    assert run(["backup", str(tmp_path / "b.tar"), "--data-dir", str(data)]) == 2
    assert "pg_dump" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["data", "there.tar"]
