"""The store of machines: revisions, approvals, rollback, several writers, kills, damage."""

from __future__ import annotations

import errno
import hashlib
import json
import multiprocessing
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest

from stillpath.applications.machines.diff import diff
from stillpath.applications.machines.resolve import PinnedMachine, Resolver
from stillpath.applications.machines.revision import (
    Conflict,
    NotApproved,
    UnknownMachine,
    identified_from,
    source_file,
)
from stillpath.applications.machines.settings import user_data_dir
from stillpath.applications.machines.store import MachineStore
from stillpath.applications.machines.transfer import export_history, import_file
from stillpath.cli.main import run
from stillpath.models.errors import ModelError
from stillpath.models.store import builtin_machines, load_machine
from stillpath.service.database.documents import DocumentTable
from stillpath.service.database.engine import open_database
from stillpath.service.settings import Settings
from tests.applications.store_writers import write_many
from tests.checkout import PYTHONPATH
from tests.service.machines import make_confirmation, make_machine, with_accel

ROOT = Path(__file__).resolve().parents[2]
MARCH = datetime(2026, 3, 2, 12, 0, tzinfo=UTC)


@pytest.fixture
def store(tmp_path: Path) -> MachineStore:
    return MachineStore(tmp_path / "machines")


@pytest.fixture(
    params=["folder", "sqlite", pytest.param("postgresql", marks=pytest.mark.postgresql)]
)
def any_store(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[MachineStore]:
    """A store of each kind: in files, and in both databases."""
    if request.param == "folder":
        yield MachineStore(tmp_path / "machines")
        return
    url = request.getfixturevalue("postgres_url") if request.param == "postgresql" else None
    engine = open_database(Settings(data_dir=tmp_path, database_url=url))
    yield MachineStore(DocumentTable(engine, "machines"))
    engine.dispose()


def files_of(store_root: Path) -> list[str]:
    return sorted(str(p.relative_to(store_root)) for p in store_root.rglob("*") if p.is_file())


@pytest.mark.parametrize("count", [1, 8, 40])
def test_a_revision_may_come_of_many_files_with_any_names(store: MachineStore, count: int):
    """Of an identification that took minutes: it must not be thrown away for its message."""
    sources = [source_file(f"{k}\x01\n" + "x" * 240, b"") for k in range(count)]
    message = identified_from(sources)
    made = store.add_revision(
        "mine", make_machine(), author="anna", message=message, sources=sources
    )
    assert made.message.startswith("identified from 0??xxx")
    assert made.message.endswith(" and 32 more") == (count == 40)
    assert len(made.sources) == count


def test_a_revision_remembers_who_when_why_and_from_what(any_store: MachineStore):
    source = source_file("raw_data_x.csv", b"#time,accel_x\n")
    made = any_store.add_revision(
        "mine", make_machine(), author="anna", message="first", sources=[source], when=MARCH
    )
    assert any_store.current("mine") == made
    assert (made.number, made.parent, made.author, made.message) == (1, None, "anna", "first")
    assert made.when == MARCH
    # Of `printf '#time,accel_x\n' | sha256sum`.
    assert made.sources[0].sha256.startswith("7ebf24107606")
    assert made.machine == make_machine()
    assert any_store.names() == ["mine"]


def test_the_same_machine_again_is_no_change(any_store: MachineStore):
    first = any_store.add_revision("mine", make_machine(), author="anna")
    assert any_store.add_revision("mine", make_machine(), author="bob") == first
    assert len(any_store.history("mine")) == 1


def test_a_change_on_an_old_state_is_refused(any_store: MachineStore):
    any_store.add_revision("mine", make_machine(), author="anna", expected=0)
    with pytest.raises(Conflict, match="already"):
        any_store.add_revision("mine", make_machine(), author="bob", expected=0)
    any_store.add_revision("mine", with_accel(make_machine(), 3e3), author="bob", expected=1)
    with pytest.raises(Conflict, match=r"revision 2, not 1 .* diff mine 1 2"):
        any_store.add_revision("mine", with_accel(make_machine(), 4e3), author="eve", expected=1)
    assert len(any_store.history("mine")) == 2


def test_a_confirmation_leaves_everything_else(any_store: MachineStore):
    any_store.add_revision("mine", with_accel(make_machine(), 7777.0), author="anna")
    before = any_store.current("mine").machine
    said = make_confirmation(5.0)
    after = any_store.confirm("mine", {"x": said}, author="bob", message="ring test").machine
    assert after.confirmations == {"x": said}
    assert {change.place.split(".")[0] for change in diff(before, after)} == {"confirmations"}
    with pytest.raises(UnknownMachine, match="other"):
        any_store.confirm("other", {"x": said}, author="bob")
    assert any_store.names() == ["mine"]


def test_names_of_built_in_machines_are_reserved(any_store: MachineStore):
    for name in builtin_machines():
        with pytest.raises(Conflict, match="built-in"):
            any_store.add_revision(name, load_machine(name), author="anna")


def test_what_cannot_be_a_name(any_store: MachineStore):
    for name in ("", "..", "../x", "a/b", "Mine", "x" * 65, ".trash", "mine\n"):
        assert name not in any_store
        with pytest.raises(ModelError, match="cannot be a machine's name"):
            any_store.add_revision(name, make_machine(), author="anna")
        with pytest.raises(UnknownMachine):
            any_store.current(name)


def test_a_machine_keeps_its_name(any_store: MachineStore):
    with pytest.raises(ModelError, match="'mine', not 'yours'"):
        any_store.add_revision("yours", make_machine("mine"), author="anna")
    assert any_store.names() == []


def test_approval(any_store: MachineStore):
    any_store.add_revision("mine", with_accel(make_machine(), 3e3), author="anna")
    any_store.add_revision("mine", with_accel(make_machine(), 4e3), author="anna")
    assert any_store.usable("mine", require_approval=False).number == 2
    with pytest.raises(NotApproved, match=r"approve mine --revision 2"):
        any_store.usable("mine", require_approval=True)
    made = any_store.approve("mine", 1, author="bob", when=MARCH)
    assert any_store.approve("mine", 1, author="eve") == made
    assert any_store.usable("mine", require_approval=True).number == 1
    any_store.approve("mine", 2, author="bob")
    any_store.add_revision("mine", with_accel(make_machine(), 5e3), author="anna")
    assert any_store.usable("mine", require_approval=True).number == 2
    with pytest.raises(UnknownMachine, match="no revision 9; it has 1 to 3"):
        any_store.approve("mine", 9, author="bob")


def test_an_approval_holds_for_the_very_machine_only(store: MachineStore, tmp_path: Path):
    store.add_revision("mine", with_accel(make_machine(), 3e3), author="anna")
    store.approve("mine", 1, author="bob")
    (tmp_path / "machines" / "mine" / "000001.json").unlink()
    store.add_revision("mine", with_accel(make_machine(), 9e3), author="eve")
    with pytest.raises(ModelError, match=r"000001\.json: not the machine that was approved"):
        store.usable("mine", require_approval=True)


def test_delete_can_be_undone(any_store: MachineStore):
    for accel in (3e3, 4e3):
        any_store.add_revision("mine", with_accel(make_machine(), accel), author="anna", when=MARCH)
    any_store.approve("mine", 1, author="bob")
    history, approvals = any_store.history("mine"), any_store.approvals("mine")
    any_store.delete("mine")
    assert any_store.names() == []
    with pytest.raises(UnknownMachine):
        any_store.current("mine")
    assert any_store.restore("mine") == history[-1]
    assert (any_store.history("mine"), any_store.approvals("mine")) == (history, approvals)


def test_what_was_deleted_comes_back_the_last_one_first(any_store: MachineStore):
    for author in ("anna", "bob"):
        any_store.add_revision("mine", make_machine(), author=author)
        any_store.delete("mine")
    assert any_store.restore("mine").author == "bob"
    with pytest.raises(Conflict, match=r"already; .*delete mine.*restore mine --number 1`"):
        any_store.restore("mine")
    any_store.delete("mine")
    assert any_store.restore("mine", 1).author == "anna"
    assert len(any_store.trash("mine")) == 1
    with pytest.raises(UnknownMachine, match=r"number 2 is in the trash: 1 \(deleted 2"):
        any_store.restore("mine", 2)
    with pytest.raises(UnknownMachine, match="trash"):
        any_store.restore("other")


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda text: text[: len(text) // 2], "not JSON"),
        (lambda text: "", "not JSON"),
        (lambda text: "[]", "damaged"),
        (lambda text: text.replace("500.0", "600.0"), "content_sha256"),
        (lambda text: text.replace('"number": 1', '"number": 2'), "revision 2"),
        (lambda text: text.replace('"anna"', "7"), "author"),
    ],
)
def test_damage_names_the_file(store: MachineStore, tmp_path: Path, spoil, words: str):
    store.add_revision("mine", make_machine(), author="anna")
    file = tmp_path / "machines" / "mine" / "000001.json"
    file.write_text(spoil(file.read_text()))
    for read in (store.current, store.history, lambda n: store.usable(n, require_approval=False)):
        with pytest.raises(ModelError, match=r"000001\.json: damaged") as caught:
            read("mine")
        assert words in str(caught.value)
    assert store.names() == ["mine"]


def test_a_revision_that_is_missing_is_named(store: MachineStore, tmp_path: Path):
    for title in ("one", "two", "three"):
        machine = make_machine().model_copy(update={"title": title})
        store.add_revision("mine", machine, author="A", message=title)
    (found,) = tmp_path.rglob("000002.json")
    found.unlink()
    assert store.current("mine").number == 3
    for needs_it in (lambda: store.history("mine"), lambda: store.revision("mine", 2)):
        with pytest.raises(ModelError, match=r"000002\.json: damaged: it is missing"):
            needs_it()
    with pytest.raises(UnknownMachine, match="it has 1 to 3"):
        store.revision("mine", 4)


def test_documents_of_an_earlier_version_stay_readable(store: MachineStore, tmp_path: Path):
    """A field with a default that the version that wrote the file did not know."""
    made = store.add_revision("mine", make_machine(), author="anna")
    file = tmp_path / "machines" / "mine" / "000001.json"
    document = json.loads(file.read_text())
    machine = document["machine"]
    del machine["mesh_slope"]
    text = json.dumps(machine, sort_keys=True, separators=(",", ":"))
    document["content_sha256"] = hashlib.sha256(text.encode()).hexdigest()
    file.write_text(json.dumps(document))
    assert store.current("mine").machine == made.machine


def test_a_full_disk_leaves_the_old_state(
    store: MachineStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    store.add_revision("mine", make_machine(), author="anna")
    before = files_of(tmp_path)

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        store.add_revision("mine", with_accel(make_machine(), 3e3), author="anna")
    monkeypatch.undo()
    assert files_of(tmp_path) == before
    assert store.current("mine").number == 1


def test_a_file_system_without_hard_links_is_named(
    store: MachineStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def refused(*_: object, **__: object) -> None:
        raise OSError(errno.EOPNOTSUPP, "Operation not supported")

    monkeypatch.setattr(os, "link", refused)
    with pytest.raises(OSError, match="no hard links: put STILLPATH_DATA_DIR on a local disk"):
        store.add_revision("mine", make_machine(), author="anna")
    assert files_of(tmp_path) == []
    assert not (tmp_path / "machines" / "mine").exists()


# Several writers


def run_together(*tasks: tuple) -> None:
    context = multiprocessing.get_context("spawn")
    processes = [context.Process(target=target, args=args) for target, *args in tasks]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    assert [process.exitcode for process in processes] == [0] * len(processes)


@pytest.mark.slow
def test_two_writers_lose_nothing(store: MachineStore, tmp_path: Path):
    root = tmp_path / "machines"
    run_together((write_many, root, 1, 20), (write_many, root, 2, 20))
    history = store.history("mine")
    assert [revision.number for revision in history] == [*range(1, 41)]
    assert [revision.parent for revision in history] == [None, *range(1, 40)]
    for writer in (1, 2):
        mine = [r for r in history if r.author == f"writer-{writer}"]
        accel = [r.machine.firmware.planner.max_accel_mm_s2 for r in mine]
        assert accel == [1000.0 + 1000.0 * writer + k for k in range(20)]
    assert not [name for name in files_of(root) if name.endswith(".part")]


@pytest.mark.slow
def test_a_killed_writer_leaves_a_readable_store(store: MachineStore, tmp_path: Path):
    root = tmp_path / "machines"
    code = (
        "import sys; from pathlib import Path; "
        "from tests.applications.store_writers import write_many; "
        "print('go', flush=True); write_many(Path(sys.argv[1]), int(sys.argv[2]), 900)"
    )
    chance = random.Random(4)
    for round_ in range(4):
        command = [sys.executable, "-c", code, str(root), str(round_)]
        writer = subprocess.Popen(
            command, stdout=subprocess.PIPE, cwd=ROOT, env=os.environ | {"PYTHONPATH": PYTHONPATH}
        )
        assert writer.stdout is not None
        writer.stdout.readline()
        written = len(list(root.rglob("*.json")))
        while len(list(root.rglob("*.json"))) == written and writer.poll() is None:
            time.sleep(0.005)
        time.sleep(0.1 * chance.random())
        writer.send_signal(signal.SIGKILL)
        writer.wait()
        writer.stdout.close()
        history = store.history("mine") if "mine" in store else []
        assert [r.number for r in history] == [*range(1, len(history) + 1)]
    made = store.add_revision("mine", with_accel(make_machine(), 123.0), author="anna")
    assert made.number == len(history) + 1
    assert made.number > 4


def test_what_a_killed_writer_left_is_swept_later(store: MachineStore, tmp_path: Path):
    store.add_revision("mine", make_machine(), author="anna")
    folder = tmp_path / "machines" / "mine"
    old, young = folder / ".000002.json.old.part", folder / ".000002.json.new.part"
    old.write_text("{")
    young.write_text("{")
    os.utime(old, (time.time() - 7200,) * 2)
    store.add_revision("mine", with_accel(make_machine(), 3e3), author="anna")
    assert (old.exists(), young.exists()) == (False, True)


# In files, and by name


def test_history_survives_a_journey(store: MachineStore, tmp_path: Path):
    store.add_revision("mine", with_accel(make_machine(), 3e3), author="anna", when=MARCH)
    store.add_revision("mine", make_machine(), author="bob")
    store.approve("mine", 2, author="bob")
    file = tmp_path / "history.json"
    file.write_text(export_history(store, "mine"))
    other = MachineStore(tmp_path / "other")
    import_file(other, file, author="carl")
    assert other.history("mine") == store.history("mine")
    assert other.approvals("mine") == {}  # whoever runs this store approves himself
    with pytest.raises(Conflict, match=r"already; take another name \(--as\)"):
        import_file(other, file, author="carl")
    copied = import_file(other, file, author="carl", name="copy")
    assert (copied.number, copied.machine.name) == (1, "copy")
    assert diff(copied.machine, make_machine("copy")) == ()
    assert other.names() == ["copy", "mine"]
    assert not [name for name in files_of(tmp_path / "other") if "incoming" in name]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "not JSON"),
        ("[]", "document"),
        ('{"revisions": []}', "name"),
        ('{"name": "mine", "revisions": []}', "no revision"),
        ('{"name": "mine", "revisions": [{"number": 1}]}', "revisions.0"),
    ],
)
def test_broken_imports_change_nothing(store: MachineStore, tmp_path: Path, text, words):
    file = tmp_path / "broken.json"
    file.write_text(text)
    with pytest.raises(ModelError, match=r"broken\.json") as caught:
        import_file(store, file, author="anna")
    assert words in str(caught.value)
    assert store.names() == []


def test_a_name_is_found_wherever_it_is(store: MachineStore, tmp_path: Path):
    resolver = Resolver(store)
    store.add_revision("mine", make_machine(), author="anna")
    assert resolver.for_job("mine").number == 1
    assert resolver.for_job("ender3").number is None
    with pytest.raises(UnknownMachine, match="did you mean mine"):
        resolver.for_job("mime")
    file = tmp_path / "file.json"
    file.write_text(make_machine("file").model_dump_json())
    assert resolver.for_job(str(file), files=True).machine.name == "file"
    with pytest.raises(UnknownMachine):
        resolver.for_job(str(file))


def test_a_user_s_machine_is_not_shadowed_by_one_built_in_later(
    store: MachineStore,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    with monkeypatch.context() as earlier:  # a version whose library had no such machine
        earlier.setattr("stillpath.applications.machines.store.builtin_machines", list)
        store.add_revision("ender3", make_machine("ender3"), author="anna")
    monkeypatch.setenv("STILLPATH_DATA_DIR", str(tmp_path))
    assert run(["machines"]) == 0
    listed = [line for line in capsys.readouterr().out.splitlines() if line.startswith("ender3 ")]
    assert len(listed) == 1
    assert "built in" not in listed[0]
    resolver = Resolver(store)
    assert resolver.for_job("ender3").number == 1
    assert resolver.names().count("ender3") == 1
    with pytest.raises(NotApproved):
        Resolver(store, require_approval=True).for_job("ender3")


def test_where_approval_is_required(store: MachineStore, tmp_path: Path):
    resolver = Resolver(store, require_approval=True)
    store.add_revision("mine", make_machine(), author="anna")
    assert resolver.for_job("ender3").machine.name == "ender3"
    assert resolver.to_look_at("mine").number == 1
    with pytest.raises(NotApproved, match="approve mine"):
        resolver.for_job("mine")
    with pytest.raises(NotApproved, match="import"):
        resolver.for_job(str(tmp_path / "file.json"), files=True)
    store.approve("mine", 1, author="bob")
    store.add_revision("mine", with_accel(make_machine(), 3e3), author="eve")
    assert resolver.for_job("mine").number == 1


def test_no_other_machine_of_the_name_stands_in_for_a_pinned_one(tmp_path: Path):
    file, none, revision = tmp_path / "machine.json", tmp_path / "none", make_machine().revision
    refused = rf"no longer has machine '\w+' as it was .*revision {revision}.* submit it again"
    for name in ("mine", "ender3"):
        with pytest.raises(ModelError, match=refused):
            PinnedMachine.read(none, name, revision)
    file.write_text("{")
    with pytest.raises(ModelError, match=refused):
        PinnedMachine.read(file, "mine", revision)
    PinnedMachine(machine=with_accel(make_machine(), 3e3)).write(file)
    with pytest.raises(ModelError, match=refused):
        PinnedMachine.read(file, "mine", revision)


@pytest.mark.skipif(sys.platform in ("win32", "darwin"), reason="the XDG convention")
def test_the_users_folder(tmp_path: Path):
    assert user_data_dir({"XDG_DATA_HOME": str(tmp_path)}) == tmp_path / "stillpath"
    assert user_data_dir({}) == Path.home() / ".local" / "share" / "stillpath"
