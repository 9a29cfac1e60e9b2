"""Machines and identifications in a folder and in the database: the same promises."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Literal

import pytest
from sqlalchemy import Engine

from stillpath.applications.machines.documents import DocumentFolder, Documents
from stillpath.applications.machines.revision import Conflict, UnknownMachine
from stillpath.applications.machines.store import MachineStore
from stillpath.service.database.documents import DocumentTable, open_documents
from stillpath.service.database.engine import open_database
from stillpath.service.settings import Settings
from tests.service.at_once import at_once
from tests.service.machines import make_confirmation, make_machine, with_accel

PLACES = ["folder", "sqlite", pytest.param("postgresql", marks=pytest.mark.postgresql)]


@pytest.fixture(params=PLACES)
def documents(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Documents]:
    """A place of each kind."""
    if request.param == "folder":
        yield DocumentFolder(tmp_path / "machines")
        return
    url = request.getfixturevalue("postgres_url") if request.param == "postgresql" else None
    engine = open_database(Settings(data_dir=tmp_path, database_url=url))
    yield DocumentTable(engine, "machines")
    engine.dispose()


def test_a_document_is_written_once(documents: Documents):
    assert documents.folders() == []
    assert documents.names("mine") == []
    with pytest.raises(FileNotFoundError):
        documents.read("mine/1")
    documents.create("mine/1", '{"Größe": "😀\\n"}')
    assert documents.read("mine/1") == '{"Größe": "😀\\n"}'.encode()
    with pytest.raises(FileExistsError):
        documents.create("mine/1", "other")
    assert documents.read("mine/1") != b"other"
    documents.create("mine/2", "two", beside="mine/1")
    with pytest.raises(FileNotFoundError):
        documents.create("mine/4", "four", beside="mine/3")
    with pytest.raises(FileNotFoundError):
        documents.create("yours/2", "two", beside="yours/1")
    documents.create("mine_2/1", "another folder, and no % or _ of a pattern")
    assert documents.names("mine") == ["1", "2"]
    assert documents.names("min_") == documents.names("%") == []
    assert documents.folders() == ["mine", "mine_2"]
    assert "machines" in documents.place("mine/1")


def test_a_folder_moves_as_a_whole(documents: Documents):
    documents.create_folder("mine", {"1": "one", "2": "two"})
    with pytest.raises(FileExistsError):
        documents.create_folder("mine", {"3": "three"})
    documents.move("mine", ".trash/mine/T1")
    with pytest.raises(FileNotFoundError):
        documents.move("mine", ".trash/mine/T2")
    documents.create("mine/1", "new")
    with pytest.raises(FileExistsError):
        documents.move(".trash/mine/T1", "mine")
    assert documents.read("mine/1") == b"new"
    documents.move(".trash/mine/T1", "yours")
    assert documents.names("yours") == ["1", "2"]
    assert documents.read("yours/2") == b"two"
    assert [f for f in documents.folders() if f != ".trash"] == ["mine", "yours"]


def test_a_document_that_may_be_replaced(documents: Documents):
    for text in ("one", "two"):
        documents.replace("0123456789ab.json", text)
        assert documents.read("0123456789ab.json") == text.encode()
    assert documents.folders() == []


def test_two_roots_do_not_meet(engine: Engine):
    one, two = DocumentTable(engine, "machines"), DocumentTable(engine, "identifications")
    one.create("mine/1", "one")
    assert two.folders() == []
    two.create("mine/1", "two")
    assert one.read("mine/1") == b"one"


def test_one_of_many_takes_a_name(documents: Documents):
    for number in range(5):
        taken: list[int] = []

        def take(writer: int, number: int = number, taken: list[int] = taken) -> None:
            with suppress(FileExistsError):
                documents.create(f"mine/{number}", str(writer))
                taken.append(writer)

        assert at_once(*(partial(take, n) for n in range(6))) == [None] * 6
        (winner,) = taken
        assert documents.read(f"mine/{number}") == str(winner).encode()


def test_writers_of_one_machine_lose_nothing(documents: Documents):
    store = MachineStore(documents)
    store.add_revision("mine", make_machine(), author="anna")

    def write(writer: int) -> None:
        for k in range(4):
            machine = with_accel(make_machine(), 1000.0 * (writer + 1) + k)
            store.add_revision("mine", machine, author=f"writer-{writer}")

    assert at_once(*(partial(write, n) for n in range(3))) == [None] * 3
    history = store.history("mine")
    assert [r.number for r in history] == [*range(1, 14)]
    for writer in range(3):
        accel = [
            r.machine.firmware.planner.max_accel_mm_s2
            for r in history
            if r.author == f"writer-{writer}"
        ]
        assert accel == [1000.0 * (writer + 1) + k for k in range(4)]


def test_ring_tests_at_once_do_not_undo_each_other(documents: Documents):
    store = MachineStore(documents)
    store.add_revision("mine", make_machine(), author="anna")

    def test(axis: Literal["x", "y"]) -> None:
        for k in range(3):
            store.confirm("mine", {axis: make_confirmation(5.0 + k)}, author=axis)

    assert at_once(partial(test, "x"), partial(test, "y")) == [None, None]
    last = store.current("mine")
    assert last.number == 7
    assert last.machine.confirmations == dict.fromkeys("xy", make_confirmation(7.0))


def test_writers_beside_somebody_who_deletes(documents: Documents):
    store = MachineStore(documents)

    def write() -> None:
        for k in range(12):
            store.add_revision("mine", with_accel(make_machine(), 1000.0 + k), author="anna")

    def delete() -> None:
        for k in range(12):
            with suppress(UnknownMachine, Conflict):
                store.delete("mine")
                if k % 2:
                    store.restore("mine")

    assert at_once(write, delete) == [None, None]
    history = store.history("mine") if "mine" in store else []
    assert [r.number for r in history] == [*range(1, len(history) + 1)]


def test_where_documents_lie(settings: Settings, engine: Engine):
    documents = open_documents(settings, engine, "machines")
    MachineStore(documents).add_revision("mine", make_machine(), author="anna")
    in_files = (settings.data_dir / "machines" / "mine" / "000001.json").exists()
    assert in_files == (settings.database_url is None)
    assert MachineStore(open_documents(settings, engine, "machines")).names() == ["mine"]
