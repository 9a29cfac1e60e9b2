"""Folder and S3 must look the same from outside."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    Bundle,
    RuleBasedStateMachine,
    invariant,
    rule,
    run_state_machine_as_test,
)

from stillpath.service.settings import Settings
from stillpath.service.storage import Storage, StorageError
from stillpath.service.storage.factory import open_storage
from stillpath.service.storage.local import LocalStorage
from stillpath.service.storage.s3 import S3Storage
from tests.service.storage.s3_server import BUCKET, CREDENTIALS, Cable, free_port, s3_server

MIB = 1 << 20


@pytest.fixture(scope="module")
def s3_address() -> Iterator[str]:
    with s3_server() as address, pytest.MonkeyPatch.context() as patch:
        for name, value in CREDENTIALS.items():
            patch.setenv(name, value)
        yield address


@pytest.fixture(params=["local", pytest.param("s3", marks=pytest.mark.slow)])
def storage(request: pytest.FixtureRequest, tmp_path: Path) -> Storage:
    if request.param == "local":
        return LocalStorage(tmp_path / "data")
    address = request.getfixturevalue("s3_address")
    return S3Storage(f"s3://{BUCKET}/{tmp_path.name}?endpoint={address}", tmp_path / "scratch")


def put(storage: Storage, key: str, content: bytes, folder: Path) -> None:
    file = folder / "to put"
    file.write_bytes(content)
    storage.put(key, file)
    assert not file.exists()


def content(storage: Storage, key: str) -> bytes:
    return b"".join(storage.read(key, 0, storage.stat(key).size_bytes))


def test_what_is_put_can_be_read_in_part_and_as_a_file(storage: Storage, tmp_path: Path):
    big = os.urandom(20 * MIB + 3)
    put(storage, "jobs/a/source/part (1).gcode", big, tmp_path)
    key = "jobs/a/source/part (1).gcode"
    assert storage.stat(key).size_bytes == len(big)
    chunks = list(storage.read(key, 5, 19 * MIB))
    assert b"".join(chunks) == big[5 : 19 * MIB]
    assert max(map(len, chunks)) <= MIB
    assert b"".join(storage.read(key, len(big) - 1, len(big) + 99)) == big[-1:]
    assert list(storage.read(key, 7, 7)) == []
    with storage.local(key) as file:
        assert file.name == "part (1).gcode"
        assert file.read_bytes() == big
    assert storage.stat(key).size_bytes == len(big)


def test_several_are_put_at_once(storage: Storage, tmp_path: Path):
    one, two = tmp_path / "one", tmp_path / "two"
    one.write_bytes(b"1")
    two.write_bytes(b"2")
    storage.put_all({"jobs/a/deep/one": one, "jobs/a/two": two})
    assert content(storage, "jobs/a/deep/one") == b"1"
    assert content(storage, "jobs/a/two") == b"2"
    assert not one.exists()
    assert not two.exists()


def test_what_is_missing_is_not_found(storage: Storage):
    with pytest.raises(FileNotFoundError):
        storage.stat("jobs/none/x")
    with pytest.raises(FileNotFoundError):
        next(storage.read("jobs/none/x", 0, 1))
    with pytest.raises(FileNotFoundError), storage.local("jobs/none/x"):
        pass
    assert list(storage.list("jobs/none/")) == []
    storage.delete("jobs/none/")


def test_a_prefix_is_a_folder_and_no_beginning_of_a_name(storage: Storage, tmp_path: Path):
    for key in ("jobs/a/1", "jobs/a/2/3", "jobs/ab/1"):
        put(storage, key, b"x", tmp_path)
    assert {found.key for found in storage.list("jobs/a/")} == {"jobs/a/1", "jobs/a/2/3"}
    storage.delete("jobs/a/")
    assert {found.key for found in storage.list("jobs/")} == {"jobs/ab/1"}


ODD_KEYS = (
    *("../x", "jobs/../../x", "/etc/passwd", "jobs//x", "", "jobs/./x", "a\\b", "C:x", "a\0b"),
    "x" * 999,
)


def test_a_key_never_leads_out(storage: Storage, tmp_path: Path):
    file = tmp_path / "file"
    file.write_bytes(b"x")
    for key in ODD_KEYS:
        with pytest.raises(ValueError, match="not a key"):
            storage.put(key, file)
        with pytest.raises(ValueError, match="not a key"):
            storage.stat(key)
        with pytest.raises(ValueError, match=r"not a key|not a prefix"):
            storage.delete(key + "/")
    assert file.exists()


def test_a_prefix_needs_its_slash(storage: Storage):
    with pytest.raises(ValueError, match="must end with"):
        storage.delete("jobs/a")


def test_a_reader_sees_the_old_file_or_the_new_one(storage: Storage, tmp_path: Path):
    size = 3 * MIB
    put(storage, "jobs/a/file", b"\0" * size, tmp_path)
    done = threading.Event()
    seen: list[bytes] = []

    def look() -> None:
        while not done.is_set():
            with storage.local("jobs/a/file") as file:
                seen.append(file.read_bytes())

    reader = threading.Thread(target=look)
    reader.start()
    for n in range(1, 8):
        put(storage, "jobs/a/file", bytes([n]) * size, tmp_path)
    done.set()
    reader.join()
    assert seen
    assert all(len(found) == size and len(set(found)) == 1 for found in seen)


def test_both_agree_with_a_dict(storage: Storage, tmp_path: Path):
    parts = st.sampled_from(["a", "b", "Ä b", "x.gcode", "..."])
    keys = st.lists(parts, min_size=2, max_size=3).map(lambda p: "jobs/" + "/".join(p))
    is_local = isinstance(storage, LocalStorage)

    class Machine(RuleBasedStateMachine):
        known = Bundle("known")

        def __init__(self) -> None:
            super().__init__()
            storage.delete("jobs/")
            self.files: dict[str, bytes] = {}

        @rule(target=known, key=keys, content=st.binary(max_size=50))
        def put(self, key: str, content: bytes) -> str:
            # In a folder a file cannot be a folder as well; the service has no such keys.
            clash = any(k.startswith(key + "/") or key.startswith(k + "/") for k in self.files)
            if not clash:
                put(storage, key, content, tmp_path)
                self.files[key] = content
            return key

        @rule(key=known)
        def delete(self, key: str) -> None:
            prefix = key.rsplit("/", 1)[0] + "/"
            storage.delete(prefix)
            self.files = {k: v for k, v in self.files.items() if not k.startswith(prefix)}

        @rule(key=known, start=st.integers(0, 60), stop=st.integers(0, 60))
        def read(self, key: str, start: int, stop: int) -> None:
            if key in self.files:
                assert b"".join(storage.read(key, start, stop)) == self.files[key][start:stop]

        @invariant()
        def same(self) -> None:
            found = {stat.key: stat.size_bytes for stat in storage.list("jobs/")}
            assert found == {key: len(content) for key, content in self.files.items()}

    run_state_machine_as_test(
        Machine,
        settings=settings(
            max_examples=40 if is_local else 8,
            stateful_step_count=20 if is_local else 8,
            suppress_health_check=list(HealthCheck),
        ),
    )


def test_nothing_is_left_of_a_put_that_failed(tmp_path: Path):
    storage = LocalStorage(tmp_path / "data")
    (tmp_path / "data" / "jobs").write_bytes(b"a file where a folder should be")
    file = tmp_path / "file"
    file.write_bytes(b"x")
    with pytest.raises(StorageError):
        storage.put("jobs/a/b", file)
    assert file.exists()
    assert not list((tmp_path / "data" / ".fresh").iterdir())


def test_a_file_from_another_disk_is_copied_whole(tmp_path: Path):
    memory = Path("/dev/shm")
    if not memory.is_dir() or memory.stat().st_dev == tmp_path.stat().st_dev:
        pytest.skip("needs two file systems")
    file = memory / f"stillpath-test-{os.getpid()}"
    file.write_bytes(b"x" * MIB)
    storage = LocalStorage(tmp_path / "data")
    storage.put("jobs/a/b", file)
    assert not file.exists()
    assert content(storage, "jobs/a/b") == b"x" * MIB
    assert not list((tmp_path / "data" / ".fresh").iterdir())


@pytest.mark.slow
def test_a_cut_cable_is_an_error_of_the_storage_and_heals(s3_address: str, tmp_path: Path):
    cable = Cable(int(s3_address.rsplit(":", 1)[1]))
    url = f"s3://{BUCKET}/cable?endpoint=http://127.0.0.1:{cable.port}"
    storage = S3Storage(url, tmp_path / "scratch")
    storage.check()
    cable.cut()
    file = tmp_path / "file"
    file.write_bytes(b"x")
    try:
        with pytest.raises(StorageError, match="does not answer") as caught:
            storage.put("jobs/a", file)
        assert "Debug" not in str(caught.value)  # it stands in the job's problem
        assert file.exists()
        cable.mend()
        storage.put("jobs/a", file)
        assert content(storage, "jobs/a") == b"x"
    finally:
        cable.cut()


@pytest.mark.slow
def test_a_bucket_that_is_not_there_is_an_error_of_the_storage(s3_address: str, tmp_path: Path):
    storage = S3Storage(f"s3://nowhere?endpoint={s3_address}", tmp_path)
    with pytest.raises(StorageError, match="NoSuchBucket"):
        storage.check()


def test_the_settings_choose(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    assert isinstance(open_storage(Settings(data_dir=tmp_path)), LocalStorage)
    address = f"http://127.0.0.1:{free_port()}"
    there = Settings(data_dir=tmp_path, storage_url=f"s3://b/p?endpoint={address}&region=eu-1")
    assert isinstance(open_storage(there), S3Storage)
    folder = Settings(data_dir=tmp_path, storage_url=(tmp_path / "else").as_uri())
    open_storage(folder).check()
    assert (tmp_path / "else").is_dir()
    monkeypatch.chdir(tmp_path)
    for wrong in ("ftp://b", "s3://", "s3://b?what=1", "file:relative", "file:", "file://"):
        with pytest.raises(ValueError, match="s3://bucket"):
            open_storage(Settings(data_dir=tmp_path, storage_url=wrong))
    (tmp_path / "plain").write_text("no folder")
    below = Settings(data_dir=tmp_path, storage_url=(tmp_path / "plain" / "jobs").as_uri())
    with pytest.raises(StorageError, match="STILLPATH_STORAGE_URL; make the folder"):
        open_storage(below)


def test_a_disk_that_is_away_is_an_error_and_nothing_goes_to_another(tmp_path: Path):
    """Its folder is empty then, or not there; the first start alone makes it."""
    root, file = tmp_path / "usb", tmp_path / "file"
    chosen = Settings(data_dir=tmp_path / "data", storage_url=root.as_uri())
    put(open_storage(chosen), "jobs/a/b", b"x", tmp_path)
    root.rename(tmp_path / "away")
    storage = open_storage(chosen)
    for mount_point in ("not there", "empty"):
        if mount_point == "empty":
            root.mkdir()
        file.write_bytes(b"x")
        for use in (
            storage.check,
            storage.room,
            lambda: storage.stat("jobs/a/b"),
            lambda: next(storage.read("jobs/a/b", 0, 1)),
            lambda: list(storage.list("jobs/")),
            lambda: storage.put("jobs/a/c", file),
            lambda: storage.delete("jobs/a/"),
            lambda: storage.local("jobs/a/b").__enter__(),
        ):
            with pytest.raises(StorageError, match="is its disk mounted"):
                use()
        assert file.exists()
    root.rmdir()  # nothing is in it
    (tmp_path / "away").rename(root)
    assert content(storage, "jobs/a/b") == b"x"
    elsewhere = chosen.model_copy(update={"storage_url": (tmp_path / "new").as_uri()})
    open_storage(elsewhere).check()


def test_what_a_kill_left_is_deleted_when_it_is_old(tmp_path: Path):
    LocalStorage(tmp_path)
    old, fresh = tmp_path / ".fresh" / "old", tmp_path / ".fresh" / "fresh"
    for path in (old, fresh):
        path.write_text("half")
    os.utime(old, (1.0, 1.0))
    LocalStorage(tmp_path)
    assert (old.exists(), fresh.exists()) == (False, True)
