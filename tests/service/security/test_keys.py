"""Keys: made, found, ended; by routes and by the command line."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from pydantic import SecretStr
from sqlalchemy import Engine, text

from stillpath.service.database.engine import open_database
from stillpath.service.security.audit import AuditLog
from stillpath.service.security.callers import Scope
from stillpath.service.security.keys import (
    KeyRefused,
    KeyStore,
    UnsafeBinding,
    announce_first_key,
    keys_needed,
)
from stillpath.service.settings import Settings
from tests.service.at_once import at_once
from tests.service.jobs.site import STILLPATH


class Clock:
    now = 1_000_000.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def engine(tmp_path: Path) -> Iterator[Engine]:
    opened = open_database(Settings(data_dir=tmp_path))
    yield opened
    opened.dispose()


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def store(engine: Engine, clock: Clock) -> KeyStore:
    return KeyStore(engine, clock=clock)


def test_a_key_is_found_by_itself_and_kept_as_a_digest(store: KeyStore, engine: Engine):
    key, secret = store.create(name="slicer", owner="ada", scopes=[Scope.SUBMIT])
    assert len(secret) == 35
    assert secret.startswith("sp_")
    assert store.find(secret) == key
    for other in ("", "sp_", secret[:-1], secret + "A", secret.swapcase(), "sp_" + "x" * 32):
        assert store.find(other) is None
    with engine.connect() as connection:
        kept = str(connection.execute(text("SELECT * FROM keys")).all())
    assert secret not in kept
    assert secret[3:] not in kept


def test_a_key_ends(store: KeyStore, clock: Clock):
    key, secret = store.create(
        name="k", owner="ada", scopes=[Scope.READ], expires_at=clock.now + 10
    )
    assert key.refusal(clock.now + 9.9) is None
    assert "expired" in (key.refusal(clock.now + 10) or "")
    revoked = store.revoke(key.id)
    assert revoked is not None
    assert store.find(secret) == revoked
    assert "revoked" in (revoked.refusal(clock.now) or "")
    clock.now += 5
    assert store.revoke(key.id) == revoked  # the first moment stays
    assert store.revoke("nobody") is None


def test_the_last_use_is_written_once_a_minute(store: KeyStore, clock: Clock):
    _, secret = store.create(name="k", owner="ada", scopes=[Scope.READ])
    noted = []
    for _ in range(5):
        store.used(store.find(secret))
        noted.append(store.find(secret).used_at)
        clock.now += 25
    start = 1_000_000.0
    assert noted == [start, start, start, start + 75, start + 75]
    clock.now = start - 1000  # it was ahead
    store.used(store.find(secret))
    assert store.find(secret).used_at == start - 1000


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"owner": ""}, "owner"),
        ({"owner": "../x"}, "owner"),
        ({"owner": "a" * 65}, "owner"),
        ({"name": ""}, "name"),
        ({"name": "a\nb"}, "name"),
        ({"name": "a" * 121}, "name"),
        ({"scopes": []}, "scopes"),
        ({"expires_at": 1.0}, "expired"),
    ],
)
def test_what_cannot_be_is_refused(store: KeyStore, change: dict, words: str):
    with pytest.raises(KeyRefused, match=words):
        store.create(**({"name": "k", "owner": "ada", "scopes": [Scope.READ]} | change))
    assert store.list() == []


def test_the_first_key_is_in_a_file_of_its_owner(
    store: KeyStore, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    announce_first_key(store, None, tmp_path)
    (file,) = tmp_path.glob("*first-key*")
    assert os.name != "posix" or file.stat().st_mode & 0o777 == 0o600
    printed = capsys.readouterr().out.splitlines()
    assert printed == [f"stillpath: first key, with all scopes: {file}"]
    found = store.find(file.read_text().strip())
    assert found is not None
    assert found.scopes == frozenset(Scope)
    file.unlink()
    announce_first_key(store, None, tmp_path)
    assert not list(tmp_path.glob("*first-key*"))
    assert capsys.readouterr().out == ""


def test_the_first_key_can_be_given_and_is_not_printed(
    store: KeyStore, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    given = "sp_" + "g" * 32
    announce_first_key(store, SecretStr(given), tmp_path)
    announce_first_key(store, SecretStr("sp_" + "h" * 32), tmp_path)  # only the first one counts
    assert capsys.readouterr().out == ""
    assert not list(tmp_path.glob("*first-key*"))
    assert [store.find(given) is not None, len(store.list())] == [True, 1]


@pytest.mark.parametrize("given", ["", "admin", "sp_short", "x" * 40, "sp_" + "ä" * 40])
def test_a_weak_first_key_is_refused(store: KeyStore, tmp_path: Path, given: str):
    with pytest.raises(KeyRefused, match="FIRST_KEY") as caught:
        announce_first_key(store, SecretStr(given), tmp_path)
    assert not given or given not in str(caught.value)


def test_of_several_processes_one_makes_the_first_key(engine: Engine):
    made = at_once(*[KeyStore(engine).create_first for _ in range(8)])
    assert len([secret for secret in made if secret is not None]) == 1
    assert len(KeyStore(engine).list()) == 1


def test_a_revoked_first_key_does_not_come_back(store: KeyStore):
    secret = store.create_first()
    assert secret is not None
    store.revoke("first")
    assert store.create_first() is None


@pytest.mark.parametrize(
    ("keys", "host", "needed"),
    [
        (None, "127.0.0.1", False),
        (None, "::1", False),
        (None, "localhost", False),
        (None, "0.0.0.0", True),
        (None, "192.168.1.5", True),
        (None, "printer-hub", True),
        (None, "", True),
        (True, "127.0.0.1", True),
        (True, "::", True),
        (False, "127.0.0.1", False),
    ],
)
def test_who_must_show_a_key(tmp_path: Path, keys: bool | None, host: str, needed: bool):
    assert keys_needed(Settings(data_dir=tmp_path, keys=keys), host) is needed


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.5", "example.org", ""])
def test_a_reachable_address_without_keys_is_refused(tmp_path: Path, host: str):
    with pytest.raises(UnsafeBinding, match="STILLPATH_KEYS"):
        keys_needed(Settings(data_dir=tmp_path, keys=False), host)


def test_commands(
    tmp_path: Path, engine: Engine, store: KeyStore, capsys: pytest.CaptureFixture[str]
):
    from stillpath.cli.main import run

    def call(*words: str) -> tuple[int, str, str]:
        code = run([*words, "--data-dir", str(tmp_path)])
        captured = capsys.readouterr()
        return code, captured.out.strip(), captured.err

    for words in (["keys", "list"], ["audit"]):
        assert run([*words, "--data-dir", str(tmp_path / "typo")]) == 2
        assert "there is no database in" in capsys.readouterr().err
    assert not (tmp_path / "typo").exists()
    code, first, _ = call("keys", "first")
    assert code == 0
    assert store.find(first).scopes == frozenset(Scope)
    assert call("keys", "first")[0] == 2
    code, made, said = call("keys", "create", "slicer", "--owner", "ada", "--days", "30")
    assert code == 0
    key = store.find(made)
    assert (key.owner, sorted(key.scopes)) == ("ada", ["read", "submit"])
    assert made not in said
    assert call("keys", "create", "x", "--owner", "a", "--scope", "everything")[0] == 2
    assert call("keys", "create", "x", "--owner", "../a")[0] == 2
    listed = call("keys", "list")[1]
    assert key.id in listed
    assert made not in listed
    assert call("keys", "revoke", key.id)[0] == 0
    assert call("keys", "revoke", "nobody")[0] == 2
    assert store.find(made).revoked_at is not None
    rows = call("audit")[1].splitlines()[1:]
    assert [row.split("\t")[4] for row in rows] == ["key.revoke", "key.create", "key.create"]
    assert [row.action for row in AuditLog(engine).page(action="key.revoke")] == ["key.revoke"]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is full")
@pytest.mark.parametrize("words", ["first", "create slicer --owner ada"])
def test_a_key_that_cannot_be_shown_is_none(
    words: str, tmp_path: Path, engine: Engine, store: KeyStore
):
    """`keys first` would refuse ever after, and nobody would know the key."""
    command = [*STILLPATH, "keys", *words.split(), "--data-dir", str(tmp_path)]
    with Path("/dev/full").open("w") as full:
        ran = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert (ran.returncode, "No space left" in ran.stderr) == (1, True)
    assert store.list() == []
    assert [row.action for row in AuditLog(engine).page()] == ["key.withdraw", "key.create"]
    assert store.create_first() is not None


@pytest.mark.parametrize(
    ("setting", "value", "words"),
    [
        ("STILLPATH_FIRST_KEY", "hunter2", "first key must be"),
        ("STILLPATH_KEYS", "false", "can be reached from other computers"),
        ("STILLPATH_PRINTERS", "/nowhere/printers.toml", "cannot be read"),
    ],
)
def test_a_service_that_would_be_unsafe_does_not_start(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    setting: str,
    value: str,
    words: str,
):
    from stillpath.cli.main import run

    monkeypatch.setenv("STILLPATH_DATA_DIR", str(tmp_path))
    monkeypatch.setenv(setting, value)
    assert run(["serve", "--host", "0.0.0.0", "--port", "0"]) == 2
    said = capsys.readouterr()
    assert words in said.err
    assert said.out == ""
    assert "hunter2" not in said.err
