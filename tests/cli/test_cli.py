"""The command line with a pretended pipeline: options, messages, exit codes, what is left."""

from __future__ import annotations

import errno
import os
import re
import signal
import subprocess
import sys
import time
import types
from contextlib import suppress
from pathlib import Path

import pytest

from stillpath.cli.main import run
from stillpath.compensation.base import DesignError
from stillpath.gcode.errors import GcodeError
from stillpath.pipeline.files import replacing
from stillpath.pipeline.progress import Progress
from stillpath.pipeline.simulate import PlannedTime
from stillpath.version import __version__
from tests.service.synthetic import make_result

TEXT = b"G28\nG1 X10 Y10 F6000\n"


@pytest.fixture
def pipeline(monkeypatch: pytest.MonkeyPatch) -> types.SimpleNamespace:
    """Put a pipeline in place that does what `pipeline.behave` says."""
    seen = types.SimpleNamespace(behave=lambda: None, options=None, machine=None, rate_hz=None)

    def compensate_file(source, target, machine, options, *, cache_dir=None, progress=None, **_):
        seen.machine, seen.options = machine.name, options
        seen.behave()
        if progress is not None:
            progress(Progress("compensating", 0.5, 1.0, 1.0, None))
        target.write_bytes(b"; compensated\n" + source.read_bytes())
        return make_result(layers=2)

    def simulate_file(source, machine, *, plate=None, dialect=None, **_):
        seen.plate, seen.dialect = plate, dialect
        seen.behave()
        return make_result(channels=("before", "shaper"), layers=2)

    def plan_file(
        source, target_npz, machine, *, rate_hz=1000.0, plate=None, dialect=None, progress=None
    ):
        seen.rate_hz, seen.plate, seen.dialect = rate_hz, plate, dialect
        target_npz.write_bytes(b"npz")
        return PlannedTime(12.0, "Slicer", 11.0, ["the file is for Marlin"])

    compensating = types.ModuleType("stillpath.pipeline.compensate")
    compensating.compensate_file = compensate_file
    simulating = types.ModuleType("stillpath.pipeline.simulate")
    simulating.simulate_file, simulating.plan_file = simulate_file, plan_file
    for module in (compensating, simulating):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    return seen


@pytest.fixture
def source(tmp_path: Path) -> Path:
    path = tmp_path / "part.gcode"
    path.write_bytes(TEXT)
    return path


def compensate(source: Path, *more: str) -> int:
    return run(["compensate", str(source), *more])


def one_line(capsys: pytest.CaptureFixture[str]) -> str:
    """Return the error, which must be all that was said beside the progress of a slow machine."""
    error = re.sub(r"(?m)^.* \d+ %(, \d+ s left)?\n", "", capsys.readouterr().err)
    assert error.startswith("stillpath: error: ")
    assert error.count("\n") == 1
    return error


def test_compensate_writes_file_report_and_table(pipeline, source, tmp_path, capsys):
    out, report = tmp_path / "out.gcode", tmp_path / "report"
    code = compensate(source, "-o", str(out), "-m", "ender3", "--report", str(report))
    assert code == 0
    assert out.read_bytes() == b"; compensated\n" + TEXT
    assert sorted(path.name for path in report.iterdir()) == ["report.html", "report.json"]
    assert (pipeline.machine, pipeline.options.method, pipeline.options.tolerance_um) == (
        "ender3",
        "fbf",
        2.0,
    )
    shown = capsys.readouterr().out
    assert "contour rms, extruding" in shown
    assert "reverted" in shown


def test_options_reach_the_pipeline(pipeline, source, tmp_path):
    chosen = [
        *("--method", "shaper:2hump_ei", "--basis", "bspline", "--robust", "minimax"),
        *("--along", ".1", "--tolerance-um", "2", "--plate", "3", "--dialect", "marlin"),
    ]
    assert compensate(source, "-o", str(tmp_path / "o"), "-m", "voron-v0", *chosen) == 0
    assert pipeline.machine == "voron-v0"
    assert pipeline.options.model_dump() == {
        "method": "shaper:2hump_ei",
        "basis": "bspline",
        "robust": "minimax",
        "along": 0.1,
        "plate": 3,
        "tolerance_um": 2.0,
        "times": "new",
        "dialect": "marlin",
    }


def test_in_place(pipeline, source):
    assert compensate(source, "--in-place", "-m", "ender3") == 0
    assert source.read_bytes() == b"; compensated\n" + TEXT


def test_a_link_is_followed(pipeline, source, tmp_path):
    link = tmp_path / "link.gcode"
    link.symlink_to(source)
    assert compensate(link, "--in-place", "-m", "ender3") == 0
    assert link.is_symlink()
    assert source.read_bytes().startswith(b"; compensated")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("-o {out} -m nope", ["nope", "ender3"]),
        ("-o {out} -m {folder}/none.json", ["none.json"]),
        ("-o {out} -m ender3 --method magic", ["magic", "shaper:zv"]),
        ("-o {out} -m ender3 --method shaper:best", ["shaper:best"]),
        ("-o {out} -m ender3 --basis fourier", ["--basis: must be ce-opt, ", "fourier"]),
        (
            "-o {out} -m ender3 --tolerance-um 0.1",
            ["--tolerance-um: must be at least 0.5 µm (given: 0.1)"],
        ),
        ("-o {out} -m ender3 --tolerance-um nan", ["--tolerance-um: must be a finite number"]),
        (
            "-o {out} -m ender3 --tolerance-um wide",
            ["--tolerance-um: must be a number (given: 'wide')"],
        ),
        ("-o {out} -m ender3 --budget-um -1", ["--budget-um: must be at least 0.5 µm (given: -1)"]),
        ("-o {out} -m ender3 --plate 0", ["--plate: must be at least 1 (given: '0')"]),
        ("-o {out} -m ender3 --in-place", ["either"]),
        ("-m ender3", ["either"]),
        ("-o {source} -m ender3", ["is the input", "--in-place"]),
        ("-o {out}", ["machine"]),
        ("-o {folder} -m ender3", ["folder"]),
        ("-o {folder}/no/out.gcode -m ender3", ["does not exist"]),
        ("-o {out} -m ender3 --report {source}", ["--report"]),
        ("-o - -m ender3", ["nothing is written to the standard output; name a file"]),
        ("-o {out} -m ender3 --report {out}", ["would be the report's own"]),
        ("-o {folder}/layers.bin -m ender3 --report {folder}", ["would be the report's own"]),
        # Said of several options, it names them, and none that there is not.
        ("-o {out} -m ender3 --budget-um 9 --where walls", ["error: budget_um makes the whole"]),
        ("-o {out} -m ender3 --colour blue", ["colour"]),
    ],
)
def test_bad_requests(pipeline, source, tmp_path, capsys, arguments, words):
    out = tmp_path / "out.gcode"
    filled = arguments.format(out=out, folder=tmp_path, source=source)
    assert compensate(source, *filled.split()) == 2
    message = one_line(capsys)
    for word in words:
        assert word in message
    assert source.read_bytes() == TEXT
    assert sorted(tmp_path.iterdir()) == [source]


@pytest.mark.parametrize(
    "command",
    [
        "compensate {source} -m {file} -o {file}",
        "remove-advice {file} -o {file}",
        "trajectories {file} -m ender3 -o {file}",
        "identify {file} -o {file}",
        "identify {file}@z=150 -o {file}",
        "coupon -m ender3 --start-gcode {file} -o {file}",
        "tower -m ender3 --axis x --end-gcode {file} -o {file}",
        "ring-test -m {file} -o {file}",
        "motor-test -m {file} -o {file}",
        "klipper export -m {file} -o {file}",
        "controller -m nrr --options {file} --json {file}",
        "scan {source} -m galvo --disturbance {file} -o {file}",
    ],
)
def test_no_input_is_an_output(source, tmp_path, capsys, command):
    file = tmp_path / "mine.csv"
    file.write_text("measured")
    assert run(command.format(source=source, file=file).split()) == 2
    assert f"{file} is an input of this command" in one_line(capsys)
    assert file.read_text() == "measured"


@pytest.mark.parametrize("name", ["missing.gcode", "."])
def test_bad_inputs(pipeline, tmp_path, capsys, name):
    assert compensate(tmp_path / name, "-o", str(tmp_path / "o"), "-m", "ender3") == 2
    one_line(capsys)


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (GcodeError("X is no number", line=7, text="G1 Xnan"), 2, ["line 7", "G1 Xnan"]),
        (DesignError("n is too large"), 2, ["n is too large"]),
        (OSError(28, "No space left on device"), 1, ["No space left"]),
        (OSError(errno.EROFS, "Read-only file system", "/x"), 1, ["another folder"]),
        (OSError(errno.EACCES, "Permission denied", "/x"), 1, ["/x: Perm", "allowed"]),
        (MemoryError(), 1, ["memory"]),
        (KeyboardInterrupt(), 130, ["interrupted"]),
    ],
)
def test_errors_of_the_pipeline(pipeline, source, tmp_path, capsys, error, code, words):
    def fail() -> None:
        raise error

    pipeline.behave = fail
    out = tmp_path / "out.gcode"
    assert compensate(source, "-o", str(out), "-m", "ender3") == code
    message = capsys.readouterr().err
    assert "stillpath: error: " in message
    for word in words:
        assert word in message
    assert not out.exists()


def test_a_bug_is_not_dressed_up_as_a_bad_file(pipeline, source, tmp_path):
    def fail() -> None:
        raise ValueError("ours")

    pipeline.behave = fail
    with pytest.raises(ValueError, match="ours"):
        compensate(source, "-o", str(tmp_path / "o"), "-m", "ender3")


def test_plan_and_simulate(pipeline, source, tmp_path, capsys):
    motion, report = tmp_path / "motion.npz", tmp_path / "report"
    plan = ["plan", str(source), "-m", "ender3"]
    assert run([*plan, "-o", str(motion), "--rate", "500", "--dialect", "klipper"]) == 0
    assert (pipeline.rate_hz, pipeline.dialect) == (500.0, "klipper")
    out, err = capsys.readouterr()
    assert "print time 12.0 s; Slicer says 11 s" in out
    assert "warning: the file is for Marlin" in err
    assert run([*plan, "-o", str(motion), "--dialect", "grbl"]) == 2
    assert "--dialect: must be klipper, " in capsys.readouterr().err
    assert run([*plan, "-o", str(source)]) == 2
    assert source.read_bytes() == TEXT
    assert run([*plan, "-o", str(motion), "--rate", "0"]) == 2
    assert run(["simulate", str(source), "-m", "ender3", "--report", str(report)]) == 0
    assert (report / "report.html").exists()


@pytest.mark.parametrize(
    "arguments", ["serve --host 0.0.0.0", "serve --host printer.lan", "serve --workers 0", "fly"]
)
def test_what_cannot_be_done_is_said_in_one_line(arguments, capsys, monkeypatch, tmp_path):
    monkeypatch.setenv("STILLPATH_DATA_DIR", str(tmp_path))
    monkeypatch.setenv("STILLPATH_KEYS", "false")
    assert run(arguments.split()) == 2
    one_line(capsys)


def test_help_and_version_are_quick_and_light():
    code = (
        "import sys; from stillpath.cli.main import run; run(['--help']); run(['--version']); "
        "sys.exit(any(name in sys.modules for name in ('numpy', 'numba', 'fastapi', 'jinja2')))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert __version__ in done.stdout


def test_a_job_loads_only_what_it_needs():
    """Each of these costs every job a tenth of a second or more."""
    program = (
        "import sys, stillpath.cli.main, stillpath.pipeline.compensate\n"
        "from stillpath.cli.own_machines import open_machines\n"
        "open_machines().for_job('ender3', files=True)\n"
        "heavy = ('scipy.signal', 'scipy.stats', 'pydantic_settings', 'fastapi', 'sqlite3')\n"
        "print([name for name in heavy if name in sys.modules])\n"
    )
    ran = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert ran.stdout.strip() == "[]"


@pytest.mark.skipif(sys.platform == "win32", reason="no named pipes in folders")
def test_pipes_and_devices_are_neither_read_nor_replaced(pipeline, source, tmp_path, capsys):
    pipe, out = tmp_path / "pipe", tmp_path / "out.gcode"
    os.mkfifo(pipe)
    for command in (
        ["compensate", str(pipe), "-m", "ender3", "-o", str(out)],
        ["simulate", str(pipe), "-m", "ender3", "--report", str(tmp_path / "report")],
        ["compensate", str(source), "-m", "ender3", "-o", str(pipe)],
        ["plan", str(source), "-m", "ender3", "-o", str(pipe)],
    ):
        assert run(command) == 2
        assert f"{pipe} is a pipe or a device; " in one_line(capsys)
    with pytest.raises(OSError, match="is not a regular file"), replacing(pipe):
        pass
    assert sorted(path.name for path in tmp_path.iterdir()) == ["part.gcode", "pipe"]


def test_the_longest_name_that_a_file_can_have(tmp_path):
    target = tmp_path / ("ü" * 124 + ".gcode")
    with replacing(target) as temporary:
        temporary.write_bytes(TEXT)
    assert target.read_bytes() == TEXT


@pytest.mark.skipif(os.name != "posix", reason="modes of POSIX")
@pytest.mark.parametrize("platform", ["linux", "darwin"])
def test_a_file_has_the_mode_of_new_ones(platform, tmp_path, monkeypatch):
    """The umask is the whole process's: two threads that change it to read it may lose it."""
    known, private, new = (tmp_path / name for name in ("known", "private", "new"))
    known.write_bytes(TEXT)
    usual = known.stat().st_mode & 0o777
    private.write_bytes(TEXT)
    private.chmod(0o640)
    monkeypatch.setattr(sys, "platform", platform)
    monkeypatch.setattr(os, "umask", lambda _: pytest.fail("changed for all threads"))
    for target, asked, expected in (
        (new, None, usual),
        (private, None, 0o640),
        (new, 0o600, 0o600),
    ):
        with replacing(target, asked) as temporary:
            temporary.write_bytes(TEXT)
        assert target.stat().st_mode & 0o777 == expected
    assert len(list(tmp_path.iterdir())) == 3


def test_a_full_disk_is_told_with_its_place(pipeline, source, tmp_path, capsys):
    target = tmp_path / "out.gcode"

    def full():
        with replacing(target):
            raise OSError(errno.ENOSPC, "No space left on device")

    pipeline.behave = full
    assert compensate(source, "-o", str(target), "-m", "ender3") == 1
    assert f"{target}: No space left on device; make room there" in one_line(capsys)
    assert [path.name for path in tmp_path.iterdir()] == ["part.gcode"]


def test_a_full_disk_is_not_blamed_on_the_source_of_a_copy(tmp_path):
    """As `shutil` does it, which names what it reads first."""
    target = tmp_path / "copy.gcode"
    with pytest.raises(OSError, match="No space left") as caught, replacing(target):
        raise OSError(errno.ENOSPC, "No space left on device", "part.gcode", None, "/proc/7/fd/3")
    assert caught.value.filename == str(target)


def test_a_console_that_knows_only_ascii_gets_what_it_can_show():
    """A result would break at the micro sign, after its file was written."""
    code = (
        "import sys; from stillpath.cli import main as cli\n"
        "cli.run = lambda _: print('0.92 µm ┃') or 3\ncli.main()"
    )
    ascii_only = {**os.environ, "PYTHONIOENCODING": "ascii"}
    ran = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, env=ascii_only
    )
    assert (ran.returncode, ran.stdout, ran.stderr) == (3, "0.92 ?m ?\n", "")


@pytest.mark.skipif(sys.platform == "win32", reason="closes streams as a POSIX shell does")
@pytest.mark.parametrize("closed", ["| true", ">&-", "2>&-", "2>/dev/full"])
def test_what_is_done_counts_though_nobody_listens(closed: str):
    """The file is in its place before figures are printed."""
    program = (
        "import sys; from stillpath.cli import main as cli\n"
        "cli.run = lambda _: print('x' * 100_000) or sys.stderr.write('done\\n') and 0\n"
        "cli.main()"
    )
    shell = ["bash", "-c", f'set -o pipefail; "$0" -c "$1" {closed}', sys.executable, program]
    ran = subprocess.run(shell, stderr=subprocess.PIPE, text=True, check=False)
    assert ran.returncode == 0
    assert ran.stderr == ("" if closed.startswith("2") else "done\n")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is full")
def test_a_full_disk_below_the_output_is_named():
    program = "from stillpath.cli.main import main; main()"
    with Path("/dev/full").open("w") as full:
        ran = subprocess.run(
            [sys.executable, "-c", program, "--version"],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    assert ran.returncode == 1
    assert ran.stderr.startswith("stillpath: error: standard output: No space left on device; ")
    assert ran.stderr.count("\n") == 1


def test_names_are_shown_as_they_are(pipeline, source, tmp_path, capsys, monkeypatch):
    name = "part[bold]:x:[/red].gcode"
    made = make_result(layers=2).model_copy(update={"source_name": name})
    monkeypatch.setattr(
        sys.modules["stillpath.pipeline.compensate"], "compensate_file", lambda *_, **__: made
    )
    assert compensate(source, "-o", str(tmp_path / "out.gcode"), "-m", "ender3") == 0
    assert name in capsys.readouterr().out


def test_a_report_that_cannot_be_written_is_a_warning(pipeline, source, tmp_path, capsys):
    """The file is in its place by then: an error would say that nothing was written."""
    folder = tmp_path / "report"
    pipeline.behave = lambda: (folder / "report.json").mkdir(parents=True)
    assert compensate(source, "--in-place", "-m", "ender3", "--report", str(folder)) == 0
    assert f"warning: {source} is written; no report: " in capsys.readouterr().err
    assert source.read_bytes().startswith(b"; compensated")


def killed(times: int) -> None:
    for _ in range(times):
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0)  # handlers run between two instructions


@pytest.mark.skipif(sys.platform == "win32", reason="sends signals as POSIX does")
@pytest.mark.parametrize(
    ("behave", "words"),
    [
        (lambda: {}["key"], "no report: KeyError: 'key'"),
        (lambda: killed(1), ""),  # it is done in a moment
        (lambda: killed(2), "no report: interrupted"),
    ],
)
def test_once_the_file_is_in_its_place_nothing_is_an_error(
    pipeline, source, tmp_path, capsys, monkeypatch, behave, words
):
    target = tmp_path / "out.gcode"
    monkeypatch.setattr("stillpath.reports.write_report", lambda *_: behave())
    report = ["--report", str(tmp_path / "report")]
    assert compensate(source, "-o", str(target), "-m", "ender3", *report) == 0
    said = capsys.readouterr()
    assert said.err == (f"stillpath: warning: {target} is written; {words}\n" if words else "")
    assert "contour rms, extruding" in said.out
    assert target.exists()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is full")
def test_figures_that_cannot_be_shown_are_a_warning(
    pipeline, source, tmp_path, monkeypatch, capsys
):
    full = Path("/dev/full").open("w", buffering=1)  # noqa: SIM115 - closing it fails, too
    monkeypatch.setattr(sys, "stdout", full)
    assert compensate(source, "-o", str(tmp_path / "out.gcode"), "-m", "ender3") == 0
    with suppress(OSError):
        full.close()
    assert "is written; no figures: No space left on device" in capsys.readouterr().err


@pytest.mark.skipif(sys.platform == "win32", reason="makes symbolic links")
def test_links_in_a_circle(pipeline, source, tmp_path, capsys):
    link = tmp_path / "link"
    link.symlink_to(link)
    for command in (
        ["compensate", str(source), "-m", "ender3", "-o", str(link)],
        ["machines", "export", "ender3", "-o", str(link)],
        ["batch", str(source), "-m", "ender3", "-o", str(link)],
    ):
        assert run(command) in (1, 2)
        assert str(link) in one_line(capsys)


@pytest.mark.skipif(sys.platform == "win32", reason="homes of POSIX users")
def test_a_user_without_a_home(pipeline, source, tmp_path, capsys, monkeypatch):
    def homeless(_: int) -> None:
        raise KeyError

    for name in ("HOME", "XDG_DATA_HOME", "STILLPATH_DATA_DIR"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("pwd.getpwuid", homeless)
    assert compensate(source, "-o", str(tmp_path / "o"), "-m", "ender3") == 1
    assert "set HOME" in one_line(capsys)
