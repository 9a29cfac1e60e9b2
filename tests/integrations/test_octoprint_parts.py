"""What the plugin for OctoPrint is made of, without OctoPrint: names, the list, server, program."""

from __future__ import annotations

import importlib
import json
import logging
import re
import sys
import tomllib
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stillpath.gcode.slicers.marks import MarkKind, read_mark
from stillpath.pipeline.options import Options
from stillpath.version import __version__
from tests.integrations.breaking import BODY, TAKES_S, breaking_server
from tests.integrations.octoprint import PLUGIN
from tests.integrations.running import Running
from tests.service.test_server import until

FOLDER = PLUGIN / "octoprint_stillpath"


def _part(name: str) -> Any:
    """Import a module of the plugin, but not what imports OctoPrint."""
    package = types.ModuleType("octoprint_stillpath")
    package.__path__ = [str(FOLDER)]
    sys.modules.setdefault("octoprint_stillpath", package)
    return importlib.import_module(f"octoprint_stillpath.{name}")


choices = _part("choices")
client = _part("client")
compensators = _part("compensators")
ledger = _part("ledger")
reports = _part("reports")
worker = _part("worker")


# Names, settings


@given(st.text(min_size=1).filter(lambda t: "." not in t), st.sampled_from(choices._SUFFIXES))
def test_results_are_told_by_their_names(stem: str, suffix: str):
    made = choices.result_name(stem + suffix)
    assert made == f"{stem}.sp{suffix}"
    assert choices.is_taken(made)
    assert choices.is_result(made)
    assert not choices.is_result(stem + suffix)


@given(
    st.lists(
        st.sampled_from(
            [
                "G1 X1 ",
                ";",
                "; ",
                "stillpath",
                "stillpath_off",
                " advise",
                ":",
                "Processed by stillpath ",
                "a",
                "\n",
            ]
        ),
        max_size=8,
    ).map("".join)
)
def test_stamps_are_seen_where_the_service_sees_them(tmp_path_factory: Any, text: str):
    path = tmp_path_factory.getbasetemp() / "stamped.gcode"
    path.write_text(text)
    comments = [";" + line.partition(";")[2] for line in text.split("\n") if ";" in line]
    marks = [read_mark(comment) for comment in comments]
    assert choices.is_stamped(path) == any(m and m.kind is MarkKind.STAMP for m in marks)


def test_the_profile_chooses_the_machine():
    rows = [
        {"profile": "Prusa *", "machine": "prusa"},
        {"profile": "Prusa MK3", "machine": " mk3 "},
        {"profile": "", "machine": "nobody"},
        {"profile": "Voron", "machine": ""},
        "nonsense",
    ]
    chosen = [choices.machine_for(p, rows, "other") for p in ("Prusa MK3", "Prusa Mini", "Voron")]
    assert chosen == ["mk3", "prusa", "other"]
    assert choices.machine_for("x", []) == ""


def test_settings_become_options_that_stillpath_knows():
    options = choices.options_of(choices.DEFAULTS)
    assert Options(**options) == Options()
    for method, _ in choices.METHODS:
        asked = choices.options_of({**choices.DEFAULTS, "method": method, "robust": "minimax"})
        assert Options(**asked).method == method
        assert ("robust" in asked) == (method == "fbf")
    for robust, _ in choices.ROBUST:
        assert Options(robust=robust)
    asked = choices.options_of({"tolerance_um": "2,5", "budget_um": "25"})
    assert asked == {"tolerance_um": 2.5, "budget_um": 25.0}
    with pytest.raises(client.Failure, match="Budget is 'much'"):
        choices.options_of({"budget_um": "much"})
    with pytest.raises(client.Failure, match="1 to 86400"):
        choices.timeout_of({"timeout_s": "-3"})


def test_reports_are_named_by_entries_only(tmp_path: Path):
    kept = reports.Reports(tmp_path / "reports")
    kept.add("a" * 32, b"page")
    assert kept.path("a" * 32).read_bytes() == b"page"
    (tmp_path / "secret.html").write_text("no")
    for odd in ("../secret", "a" * 31, "b" * 32, "A" * 32, "", "a" * 32 + "\n"):
        assert kept.path(odd) is None
    kept.keep_only({"b" * 32})
    assert kept.path("a" * 32) is None


# The list


def test_the_list_survives_and_remembers_what_was_under_way(tmp_path: Path):
    book = ledger.Ledger(tmp_path / "files.json")
    first, second = (ledger.Entry(f"{n}.gcode", "ender3", {"method": "fbf"}) for n in "ab")
    for entry in (first, second):
        book.add(entry)
    assert book.begin(first)
    book.change(first, job="17", is_ours=True)
    book.cancel(second)
    assert not book.begin(second)
    again = ledger.Ledger(tmp_path / "files.json")
    assert again.entries() == [first, second]
    assert [entry.id for entry in again.open()] == [first.id]
    assert (second.state, again.trouble) == ("cancelled", "")
    again.forget()
    assert again.entries() == [first]


def test_the_list_forgets_what_is_long_over_and_nothing_else(tmp_path: Path):
    book = ledger.Ledger(tmp_path / "files.json")
    waiting = ledger.Entry("waiting.gcode", "m", {})
    book.add(waiting)
    for number in range(40):
        book.add(ledger.Entry(f"{number}.gcode", "m", {}, state="done"))
    assert len(book.entries()) == 21
    assert book.entries()[0] == waiting
    assert book.entries()[-1].path == "39.gcode"


@pytest.mark.parametrize("text", ["{", "[]", '{"entries": [1]}', '{"entries": [{}]}', "\xff"])
def test_a_list_that_cannot_be_read_is_put_aside(tmp_path: Path, text: str):
    path = tmp_path / "files.json"
    path.write_bytes(text.encode("latin-1"))
    book = ledger.Ledger(path)
    assert book.entries() == []
    assert "files.unreadable" in book.trouble
    assert (tmp_path / "files.unreadable").exists()


def test_a_list_that_cannot_be_written_stays_in_memory(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    (tmp_path / "a folder").mkdir()
    assert "cannot be read" in ledger.Ledger(tmp_path / "a folder").trouble
    caplog.clear()
    book = ledger.Ledger(tmp_path / "no such folder" / "files.json")
    book.add(ledger.Entry("a.gcode", "m", {}))
    book.add(ledger.Entry("b.gcode", "m", {}))
    assert len(book.entries()) == 2
    assert "cannot be written" in book.trouble
    assert caplog.messages == [book.trouble]


# The worker, with a real server


class OnBusyServer(compensators.OnServer):
    """Waits long for each answer, as on a busy computer, and soon gives up what is broken."""

    _FIRST_PATIENCE_S = 1.0

    def _open(self, *request: Any, timeout_s: float | None = None) -> Any:
        return super()._open(*request, timeout_s=60.0)


class Bench(worker.Host):
    """A folder instead of OctoPrint."""

    def __init__(self, folder: Path, address: str, key: str = "", command: str = "") -> None:
        self.folder, self.address, self.key, self.command = folder, address, key, command
        self.files = folder / "files"
        self.files.mkdir(exist_ok=True)
        self.stages: set[str] = set()
        self.wait_for = ""
        self.book = ledger.Ledger(folder / "list.json")
        self.begin()

    def begin(self) -> None:
        logger = logging.getLogger("test")
        self.worker = worker.Worker(self.book, self, self.folder / "work", logger)
        self.worker.start()

    def add(self, name: str, text: str, machine: str = "ender3") -> Any:
        (self.files / name).write_text(text)
        where = "command" if self.command else "server"
        entry = ledger.Entry(name, machine, {"method": "fbf"}, where=where, server=self.address)
        self.book.add(entry)
        return entry

    def ended(self, entry: Any) -> Any:
        until(lambda: entry.is_over)
        return entry

    def source(self, entry: Any) -> Path | None:
        path = self.files / entry.path
        return path if path.exists() else None

    def busy_with(self, entry: Any) -> str:
        return self.wait_for

    def compensator(self, entry: Any, tell: Callable, note: Callable) -> Any:
        if self.command:
            return compensators.ByCommand(entry, self.command, tell)
        return OnBusyServer(entry, self.key, 1.0, tell, note)

    def occupied(self, entry: Any) -> str:
        return ""

    def deliver(self, entry: Any, made: Any) -> None:
        target = self.files / choices.result_name(entry.path)
        target.write_bytes(made.path.read_bytes())
        self.book.change(entry, result=target.name, message=made.sentence)

    def show(self, entry: Any) -> None:
        self.stages.add(entry.stage)


@pytest.fixture
def bench(tmp_path: Path, address: str) -> Iterator[Callable[..., Bench]]:
    made: list[Bench] = []

    def make(**more: Any) -> Bench:
        made.append(Bench(tmp_path, **{"address": address, **more}))
        return made[-1]

    yield make
    for each in made:
        each.worker.stop(60)


def test_one_after_the_other(bench: Callable[..., Bench], running: Running):
    here = bench()
    good, bad, next_ = (here.add(n, t) for n, t in (("a.gcode", "G1 X1\n"), ("b.gcode", "bad\n"),
                                                    ("c.gcode", "G1 X2\n")))  # fmt: skip
    assert here.ended(good).state == "done", good
    assert (here.files / "a.sp.gcode").read_text() == "; compensated\nG1 X1\n"
    assert here.ended(bad).state == "failed"
    assert "line 7: X1e400 is too large" in bad.message
    assert here.ended(next_).state == "done"
    assert not list((here.folder / "work").iterdir())
    # The same file again is the same job, and it is nobody's to cancel.
    again = here.ended(here.add("a.gcode", "G1 X1\n"))
    assert (again.job, again.is_ours, good.is_ours) == (good.job, False, True)
    assert running.client.get(f"/v1/jobs/{good.job}").json()["source_name"] == "a.gcode"


@pytest.mark.parametrize(
    ("more", "machine", "words"),
    [
        ({}, "no such", ("no such", "ender3")),
        ({}, "../jobs", ("../jobs",)),
        ({"key": "wrong", "odd": "key"}, "ender3", ("key", "401")),
        ({"odd": "moved"}, "ender3", ("moved to http://elsewhere.invalid/",)),
        ({"address": "http://127.0.0.1:9"}, "ender3", ("no answer from http://127.0.0.1:9",)),
        ({"address": "nas"}, "ender3", ("'nas' is not the address of a server",)),
    ],
)
def test_what_is_wrong_is_said(bench: Any, address: str, more: dict, machine: str, words: tuple):
    odd = more.pop("odd", "")
    here = bench(**{"address": f"{address}/{odd}".rstrip("/"), **more})
    entry = here.ended(here.add("a.gcode", "G1 X3\n", machine))
    assert entry.state == "failed"
    for word in words:
        assert word in entry.message
    assert not (here.files / "a.sp.gcode").exists()
    assert (here.files / "a.gcode").read_text() == "G1 X3\n"


def test_a_result_without_its_report(bench: Callable[..., Bench], address: str):
    here = bench(address=f"{address}/unreported")
    entry = here.ended(here.add("a.gcode", "G1 X6\n"))
    assert entry.state == "done", entry
    assert "warning: no report: The report is gone." in entry.message
    assert (here.files / "a.sp.gcode").read_text() == "; compensated\nG1 X6\n"


def test_a_file_that_changes_or_goes_meanwhile(bench: Callable[..., Bench]):
    here = bench()
    here.wait_for = "a print"
    changed, gone = here.add("a.gcode", "nap 1\n"), here.add("b.gcode", "G1\n")
    until(lambda: changed.stage == "a print")
    here.wait_for = ""
    until(lambda: changed.job)
    (here.files / "a.gcode").write_text("G1 X9\n")
    (here.files / "b.gcode").unlink()
    assert "changed meanwhile" in here.ended(changed).message
    assert "gone" in here.ended(gone).message


def test_what_was_interrupted_is_taken_up(bench: Callable[..., Bench], running: Running):
    here = bench()
    entry = here.add("a.gcode", "nap 2\nG1 X4\n")
    until(lambda: entry.job)
    here.worker.stop(60)
    assert not entry.is_over
    there = bench()
    (again,) = there.book.open()
    assert there.ended(again).state == "done"
    assert again.job == entry.job
    # The file was replaced while nobody looked: what was made of the old one is not its result.
    here = bench()
    stale = ledger.Entry("a.gcode", "ender3", {}, server=here.address, state="working", tries=1)
    stale.job = again.job
    (here.files / "a.gcode").write_text("G1 X5\n")
    here.book.add(stale)
    assert here.ended(stale).state == "done"
    assert stale.job != again.job
    assert "G1 X5" in (here.files / "a.sp.gcode").read_text()
    # The server has forgotten the job: it is sent once more.
    here = bench()
    lost = ledger.Entry("a.gcode", "ender3", {}, server=here.address, state="working", tries=1)
    lost.job = "0" * 32
    here.book.add(lost)
    assert here.ended(lost).state == "done"
    assert lost.tries == 2


@pytest.mark.parametrize("job_is_known", [True, False])
def test_a_cancel_outlives_a_restart(
    bench: Callable[..., Bench], running: Running, job_is_known: bool
):
    """It is kept, and ends the job on the server though nobody waits for that yet."""
    here = bench()
    entry = here.add("a.gcode", "slow G1 X6\n")
    until(lambda: entry.job)
    here.worker.stop(60)
    job = entry.job
    if job_is_known:
        here.book.cancel(entry)
    else:
        # Killed between the server's answer and its note: the same request is the same job.
        here.book.change(entry, job="", is_ours=False)
    there = bench()
    (again,) = there.book.open()
    if not job_is_known:
        until(lambda: again.job)
        assert (again.job, again.tries) == (job, entry.tries)
        there.book.cancel(again)
    assert there.ended(again).state == "cancelled"
    if job_is_known:
        until(lambda: running.client.get(f"/v1/jobs/{job}").json()["state"] == "cancelled")


# The program


def _program(folder: Path, text: str) -> str:
    path = folder / "my stillpath"
    path.write_text(f"#!{sys.executable}\nimport sys, time, pathlib, json\n{text}")
    path.chmod(0o755)
    return str(path)


_WORKS = """
arguments = sys.argv[1:]
after = lambda name: arguments[arguments.index(name) + 1]
sys.stderr.write("stillpath: compensating 42 %, 3 s left\\n")
sys.stderr.flush()
time.sleep(0.6)
pathlib.Path(after("-o")).write_text(" ".join(arguments[2:3] + arguments[6:]))
report = pathlib.Path(after("--report"))
report.mkdir()
(report / "report.html").write_text("page")
(report / "report.json").write_text(json.dumps({"time_s": 3.5, "warnings": ["mind"]}))
"""


def test_a_program_does_the_work(bench: Callable[..., Bench], tmp_path: Path):
    here = bench(command=_program(tmp_path, _WORKS))
    entry = here.ended(here.add("a.gcode", "G1\n"))
    assert entry.state == "done", entry
    assert entry.message == "warning: mind"
    words = (here.files / "a.sp.gcode").read_text()
    assert words == "-o --machine ender3 --method fbf"
    assert "compensating" in here.stages


def test_what_freezes_the_computer_is_not_begun_for_ever(
    bench: Callable[..., Bench], tmp_path: Path
):
    """Somebody switches it off and on; the list is then as it was in the middle of the work."""
    slow = _program(tmp_path, "time.sleep(60)")
    here = bench(command=slow)
    entry = here.add("a.gcode", "G1\n")
    kept = tmp_path / "list.json"
    for number in (1, 2, 3):
        told = f'"begun": {number}'
        until(lambda told=told: told in kept.read_text())
        frozen = kept.read_text()
        here.worker.stop(60)
        assert entry.begun == 0  # an orderly end
        kept.write_text(frozen)
        here = bench(command=slow)
        (entry,) = here.book.entries()
    assert here.ended(entry).state == "failed"
    assert "went down 3 times while it was processed" in entry.message


def test_a_result_without_a_report_is_kept(bench: Callable[..., Bench], tmp_path: Path):
    """As the program does it where there is no room for the report: exit code 0."""
    here = bench(command=_program(tmp_path, _WORKS.partition("report =")[0]))
    entry = here.ended(here.add("a.gcode", "G1\n"))
    assert entry.state == "done", entry
    assert entry.message.startswith("warning: no report: ")
    assert (here.files / "a.sp.gcode").exists()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("sys.stderr.write('line 7: too large\\n'); sys.exit(2)", ("line 7: too large", "code 2")),
        ("sys.exit(1)", ("does not say why", "exit code 1")),
        ("", ("FileNotFoundError",)),
    ],
)
def test_a_program_that_fails(bench: Any, tmp_path: Path, text: str, words: tuple):
    here = bench(command=_program(tmp_path, text))
    entry = here.ended(here.add("a.gcode", "G1\n"))
    assert entry.state == "failed"
    for word in words:
        assert word in entry.message


def test_a_program_ends_with_its_job(bench: Callable[..., Bench], tmp_path: Path):
    pid = tmp_path / "pid"
    text = f"import os\npathlib.Path({str(pid)!r}).write_text(str(os.getpid()))\ntime.sleep(600)"
    here = bench(command=_program(tmp_path, text))
    entry = here.add("a.gcode", "G1\n")
    until(lambda: pid.exists() and pid.read_text())
    here.book.cancel(entry)
    assert here.ended(entry).state == "cancelled"
    assert not Path(f"/proc/{pid.read_text()}").exists()
    for command, words in (
        ("/gone/stillpath", "/gone/stillpath cannot be run"),
        ("~/gone/stillpath", f"{Path.home()}/gone/stillpath cannot be run"),
        ("'/gone/stillpath", "a quote is not closed"),
    ):
        here = bench(command=command)
        assert words in here.ended(here.add("a.gcode", "G1\n")).message
        here.worker.stop(60)


def test_a_long_upload_that_breaks_off_is_sent_again(tmp_path: Path):
    """Also where it took longer than the patience with a server that is silent."""
    part = tmp_path / "part.gcode"
    part.write_bytes(BODY)
    noted: dict[str, Any] = {}
    with breaking_server({"id": "7"}) as (address, keys):
        entry = ledger.Entry(part.name, "ender3", {"method": "fbf"}, server=address)
        told = lambda *_: None  # noqa: E731
        server = compensators.OnServer(entry, "", 0.5 * TAKES_S, told, lambda **n: noted.update(n))
        server._submit(part, part.name)
    assert (noted["job"], noted["is_ours"]) == ("7", True)
    assert keys == [f"{entry.id}-0"] * 2


# The package


def test_versions_are_the_same():
    project = tomllib.loads((PLUGIN / "pyproject.toml").read_text())["project"]
    assert project["version"] == __version__
    assert project["entry-points"]["octoprint.plugin"] == {"stillpath": "octoprint_stillpath"}


def test_every_setting_stands_in_the_dialogue():
    dialogue = (FOLDER / "templates" / "stillpath_settings.jinja2").read_text()
    for name in choices.DEFAULTS:
        assert re.search(rf"(value|checked|foreach): {name}\b", dialogue), name
    json.dumps(choices.DEFAULTS)
