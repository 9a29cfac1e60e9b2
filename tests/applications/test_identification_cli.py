"""`stillpath identify`: a machine from files, and a store that broken files leave alone."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import pytest

from stillpath.applications.identification.figures import IdentificationReport
from stillpath.applications.identification.run import InputFile
from stillpath.applications.machines.store import MachineStore
from stillpath.cli.main import run
from stillpath.models.machine import Machine
from stillpath.models.plants import PairsSpec
from stillpath.models.store import load_machine
from tests.cli.test_cli import one_line
from tests.models.identification.recordings import (
    BROKEN,
    QUICK_OPTIONS,
    TAZ,
    broken,
    one_mode,
    quick_raw,
    spectrum_file,
)
from tests.models.test_ripple import ripple
from tests.service.machines import make_machine

MINE = make_machine(kinematics="cartesian")
GCODE = """\
M82
G28
G92 E0
G1 Z0.2 F600
G1 X60 Y60 F9000
G1 X100 Y60 E2 F6000
G1 X100 Y100 E4
G1 X60 Y60 E7
"""


@pytest.fixture
def data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("STILLPATH_DATA_DIR", str(tmp_path / "data"))
    return tmp_path / "data"


@pytest.fixture
def store(data: Path) -> MachineStore:
    """With a machine `mine`."""
    store = MachineStore(data / "machines")
    store.add_revision("mine", MINE, author="anna")
    return store


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "files"
    made.mkdir()
    return made


def placed(files: Iterable[InputFile], folder: Path) -> list[str]:
    """Write files, each into a folder of its own, and return the arguments that name them."""
    arguments = []
    for number, file in enumerate(files):
        path = folder / str(number) / file.name
        path.parent.mkdir()
        path.write_bytes(file.content)
        label = file.condition.label
        arguments.append(f"{path}@{label}" if label else str(path))
    return arguments


def identify(*arguments: object, quick: bool = True) -> int:
    return run(["identify", *map(str, arguments), *(QUICK_OPTIONS if quick else [])])


def tree(root: Path) -> dict[str, bytes]:
    return {str(p.relative_to(root)): p.read_bytes() for p in root.rglob("*") if p.is_file()}


def main_hz(machine: Machine, axis: str) -> float:
    plant = machine.axes[axis].nominal  # type: ignore[index]
    assert isinstance(plant, PairsSpec)
    return plant.poles[0].f_hz


@pytest.mark.slow
def test_a_revision_of_ones_own_machine(store: MachineStore, folder: Path, capsys) -> None:
    files = [quick_raw("x"), quick_raw("y")]
    out, report = folder / "machine.json", folder / "report"
    arguments = [*placed(files, folder), "-m", "mine", "-o", out, "--report", report]
    assert identify(*arguments, "--by", "anna", "-M", "belts") == 0
    shown = capsys.readouterr().out
    assert "axis X: raw log, 6 to 64 Hz" in shown
    assert "mine revision 2: content" in shown
    assert "Klipper would recommend" in shown
    made = store.current("mine")
    assert (made.number, made.author, made.message) == (2, "anna", "belts")
    assert made.sources == tuple(file.source for file in files)
    assert main_hz(made.machine, "x") == pytest.approx(42.0, rel=1e-3)
    assert main_hz(made.machine, "y") == pytest.approx(35.0, rel=1e-3)
    # All else is as it was.
    same = ("firmware", "travel", "title", "kinematics")
    before = store.revision("mine", 1).machine
    assert [getattr(made.machine, n) for n in same] == [getattr(before, n) for n in same]
    assert load_machine(out) == made.machine
    assert sorted(p.name for p in report.iterdir()) == [
        "identification.html",
        "identification.json",
    ]
    document = (report / "identification.json").read_text()
    figures = IdentificationReport.model_validate_json(document)
    assert figures.machine_revision == made.machine.revision
    assert figures.base_revision == before.revision
    # The same files again change nothing.
    assert identify(*arguments[:-4]) == 0
    assert store.current("mine").number == 2


def test_one_axis_leaves_the_other(store: MachineStore, folder: Path) -> None:
    assert identify(*placed([quick_raw("y")], folder), "-m", "mine") == 0
    machine = store.current("mine").machine
    assert machine.axes["x"] == MINE.axes["x"]
    assert main_hz(machine, "y") == pytest.approx(35.0, rel=1e-3)
    assert store.current("mine").message == "identified from raw_data_y_20260101_120000.csv"


def test_a_report_without_room_leaves_the_revision_and_is_told(
    store: MachineStore, folder: Path, capsys
) -> None:
    (file,) = placed([quick_raw("y")], folder)
    (folder / "full").write_text("a file where a folder is needed")
    report = folder / "full" / "report"
    assert identify(file, "-m", "mine", "--report", report) == 0
    said = capsys.readouterr()
    assert "mine revision 2: content" in said.out
    assert "stillpath: warning: mine revision 2 is written; no report: " in said.err
    # Nothing else was asked for: then it is a failure.
    assert identify(file, "--report", report) == 1
    assert "Not a directory" in one_line(capsys)


def test_a_new_machine_needs_a_base(store: MachineStore, folder: Path, capsys) -> None:
    (file,) = placed([quick_raw("x")], folder)
    assert identify(file, "-m", "new") == 2
    assert "--base" in one_line(capsys)
    for name, why in (("My Ender", "a-z 0-9"), ("ender3", "built-in")):
        assert identify(file, "-m", name, "--base", "ender3") == 2
        assert why in one_line(capsys)
    assert identify(file, "-m", "mine", "--base", "ender3") == 2
    assert "leave out --base" in one_line(capsys)
    base = load_machine("ender3").model_copy(update={"ripple": {"x": ripple()}})
    (folder / "base.json").write_text(base.model_dump_json())
    arguments = ("-m", "new", "--base", folder / "base.json", "--title", "New one")
    assert identify(file, *arguments) == 0
    machine = store.current("new").machine
    assert (machine.name, machine.title) == ("new", "New one")
    assert machine.source == "travel, limits, axis Y, ripple of X of Creality Ender 3 (ender3)"
    assert machine.firmware == load_machine("ender3").firmware


def test_without_a_name_nothing_is_stored(data: Path, folder: Path, capsys) -> None:
    assert identify(*placed([quick_raw("x")], folder)) == 0
    assert "axis X: raw log" in capsys.readouterr().out
    assert not data.exists()


@pytest.mark.slow
def test_weights_and_places(store: MachineStore, folder: Path, capsys) -> None:
    factor = 1 / math.sqrt(1 + 0.5 / 0.8)
    heavy = one_mode(35.0 * factor, 0.08 * factor)
    runs = [quick_raw("y"), quick_raw("y", heavy, condition="+0.5kg")]
    runs += [quick_raw("x", one_mode(f, 0.06), condition=f"z={z}") for z, f in ((0, 44), (200, 40))]
    (folder / "a").mkdir()
    assert identify(*placed(runs, folder / "a"), "-m", "mine") == 0
    assert "0.5 kg on the bed lowered" in capsys.readouterr().out
    schedules = store.current("mine").machine.schedules
    assert schedules["y"].mass is not None
    assert schedules["y"].mass.moving_mass_kg == pytest.approx(0.8, rel=0.01)
    assert schedules["x"].grid is not None
    assert [node.z_mm for node in schedules["x"].grid.nodes] == [0.0, 200.0]

    # Identified anew: the mass is the machine's and stays, the grid is of former plants and goes.
    (folder / "b").mkdir()
    assert identify(*placed([quick_raw("x"), quick_raw("y")], folder / "b"), "-m", "mine") == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "warning: the plants of 2 places that the machine had for axis x were dropped" in told
    assert "that axis y moves stay: no weight was put on the bed" in told
    after = store.current("mine").machine.schedules
    assert after == {"y": schedules["y"]}


def test_a_weight_on_a_bed_that_does_not_move(store: MachineStore, folder: Path, capsys) -> None:
    runs = [quick_raw("y"), quick_raw("y", one_mode(29.0, 0.06), condition="+0.5kg")]
    assert identify(*placed(runs, folder), "-m", "new", "--base", "voron-v0") == 2
    assert "does not move" in one_line(capsys)
    assert store.names() == ["mine"]


def test_the_mass_stays_with_its_mode(store: MachineStore, folder: Path) -> None:
    """Where another mode comes to lie below it, and with the filament of the machine."""
    document = MINE.model_dump()
    document["axes"]["y"]["nominal"] = one_mode(35.0, 0.08).model_dump()
    mass = {"moving_mass_kg": 0.8, "filament_density_g_cm3": 1.04}
    document["schedules"] = {"y": {"mass": mass}}
    store.add_revision("mine", Machine.model_validate(document), author="anna")
    model = {"kind": "modes", "modes": [{"f_hz": 18, "zeta": 0.1, "gain": 0.2}]}
    model["modes"].append({"f_hz": 34, "zeta": 0.07, "gain": 0.8})  # type: ignore[attr-defined]
    (folder / "model_y.json").write_text(json.dumps(model))
    assert identify(folder / "model_y.json", "-m", "mine") == 0
    kept = store.current("mine").machine.schedules["y"].mass
    assert kept is not None
    assert (kept.moving_mass_kg, kept.modes, kept.filament_density_g_cm3) == (0.8, (1,), 1.04)


def test_a_printed_model(store: MachineStore, folder: Path, capsys) -> None:
    (folder / "taz_x.json").write_text(TAZ)
    before = tree(folder.parent)
    assert identify(folder / "taz_x.json", "-m", "mine", quick=False) == 2
    assert "integrator" in one_line(capsys)
    assert tree(folder.parent) == before
    assert identify(folder / "taz_x.json", "-m", "mine", "--repair-rounding", quick=False) == 0
    assert "-4.54 to -4.53995" in " ".join(capsys.readouterr().out.split())


def test_what_a_model_does_not_say(store: MachineStore, folder: Path, capsys) -> None:
    (folder / "m_x.json").write_text('{"num": [0.013], "den": [1.0, -1.9, 0.91], "dt": true}')
    file = folder / "m_x.json"
    assert identify(file, quick=False) == 2
    assert "give sampling_s" in one_line(capsys)
    assert identify(file, "--sampling-s", "0.001", quick=False) == 2
    assert "give it as dc_gain" in one_line(capsys)
    assert identify(file, "--sampling-s", "0.001", "--dc-gain", "1.3", quick=False) == 0


@pytest.mark.parametrize(
    ("model", "members", "said"),
    [
        ({"kind": "fir", "taps": [0.25, 0.5, 0.25], "dt_s": 0.001}, 1, "designed for it alone"),
        # More damping would make its poles real.
        ({"num": [1e5], "den": [1.0, 1.8 * 1e5**0.5, 1e5]}, 3, ""),
        # No continuous plant has this pole, but commands have the model's own samples.
        ({"num": [1.5], "den": [1.0, 0.5], "dt": 0.001}, 9, ""),
    ],
)
def test_a_model_is_varied_as_far_as_it_can_be(
    store: MachineStore, folder: Path, capsys, model: dict[str, object], members: int, said: str
) -> None:
    (folder / "m_x.json").write_text(json.dumps(model))
    assert identify(folder / "m_x.json", "-m", "mine", quick=False) == 0
    assert said in " ".join(capsys.readouterr().out.split())
    assert len(store.current("mine").machine.axes["x"].weighted_members()) == members


def test_a_model_of_other_samples_than_commands_have(
    store: MachineStore, folder: Path, capsys
) -> None:
    model = {"kind": "fir", "taps": [0.5, 0.5], "dt_s": 0.002}
    (folder / "m_x.json").write_text(json.dumps(model))
    assert identify(folder / "m_x.json", "-m", "mine", quick=False) == 2
    assert "axis X: commands have a sample every 1 ms, and the discrete plant (2 ms)" in (
        one_line(capsys)
    )
    assert store.current("mine").number == 1


# What cannot be used


@pytest.mark.parametrize("what", ["same axis twice", "gap", "of nothing known"])
def test_broken_files_leave_everything_as_it_was(
    what: str, store: MachineStore, folder: Path, capsys
) -> None:
    files = broken(what)
    arguments = placed(files, folder)
    before = tree(folder.parent)
    written = ["-o", folder / "out.json", "--report", folder / "report", "-m", "mine"]
    assert identify(*arguments, *written) == 2
    message = one_line(capsys)
    for word in [files[0].name, *BROKEN[what]]:
        assert word in message
    assert tree(folder.parent) == before
    assert sorted(p.name for p in folder.iterdir()) == sorted(map(str, range(len(files))))
    assert store.current("mine").number == 1


def test_one_broken_file_among_good_ones(store: MachineStore, folder: Path, capsys) -> None:
    files = [quick_raw("x"), *broken("gap")]
    arguments = placed(files, folder)
    before = tree(folder.parent)
    assert identify(*arguments, "-m", "mine", "-o", folder / "out.json") == 2
    assert "gap in time" in one_line(capsys)
    assert tree(folder.parent) == before


@pytest.mark.parametrize("options", ["", "--sensor-turned", "--sensor-axis y"])
def test_a_table_is_not_of_two_axes(
    store: MachineStore, folder: Path, capsys: pytest.CaptureFixture[str], options: str
) -> None:
    """As a K1 writes it after SHAPER_CALIBRATE AXIS=Y; advised options made X the same as Y."""
    table = spectrum_file(one_mode(42.0, 0.06))
    other = InputFile(table.name.replace("_x_", "_y_"), table.content)
    files = placed([table, other], folder)
    before = tree(folder.parent)
    assert run(["identify", *files, "-m", "mine", *options.split()]) == 2
    assert "_y_20260101_120000.csv is a copy of resonances_x_2026" in one_line(capsys)
    assert tree(folder.parent) == before


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("{file} -m ../x --base ender3", "name"),
        ("{file} -m ender3 --base ender3", "built-in"),
        ("{file} -m mine --by", "--by"),
        ("{file} --base nope", "nope"),
        ("{file} -o {folder}/none/out.json", "does not exist; make it first"),
        ("{file} -o {folder}", "name the file to write"),
        ("{file} --report {file}", "--report"),
        ("{folder}/none.csv", "none.csv"),
        ("{folder}", "cannot read"),
        ("{folder}/a@b.csv", "a@b.csv: No such file"),
        ("{file} {file}", "is a copy of raw_data_x_20260101_120000.csv"),
        ("{file}@+0.5lb", "neither a weight"),
        ("{file}@+0.5kg", "every run has a weight"),
        ("{file} --accel-per-hz -1", "--accel-per-hz: must be more than 0"),
        ("{file} --min-freq 90", "min_freq 90"),
        ("{file} --firmware-date 2023", "--firmware-date: a date is written YYYY-MM-DD"),
        ("{file} --sensor-axis z", "another axis was measured"),
        ("{file} --axis z", "axis"),
        ("{file} --columns a,b", "three names"),
        ("{file} --max-order 0", "max-order"),
        ("", "FILE"),
    ],
)
def test_bad_requests(
    store: MachineStore, folder: Path, capsys, arguments: str, words: str
) -> None:
    (file,) = placed([quick_raw("x")], folder)
    before = tree(folder.parent)
    filled = arguments.format(file=file, folder=folder).split()
    if filled[-1:] == ["--by"]:
        filled += [""]
        words = "author"
    assert identify(*filled) == 2
    assert words in one_line(capsys)
    assert tree(folder.parent) == before


def test_a_change_meanwhile_is_not_lost(store: MachineStore, folder: Path, capsys, monkeypatch):
    """Somebody changes the machine while it is measured: refused, and no file is written."""
    import stillpath.applications.identification.run as module

    original = module.identify_files

    def slowly(*arguments, **options):
        found = original(*arguments, **options)
        store.add_revision("mine", make_machine(mesh_slope=0.02), author="bob")
        return found

    monkeypatch.setattr(module, "identify_files", slowly)
    written = ["-o", folder / "out.json", "--report", folder / "report"]
    assert identify(*placed([quick_raw("x")], folder), "-m", "mine", *written) == 2
    assert "revision 2, not 1" in one_line(capsys)
    assert [p.name for p in folder.iterdir()] == ["0"]
    assert store.current("mine").author == "bob"


# The real process


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="sends signals")
def test_ctrl_c_leaves_nothing(store: MachineStore, data: Path, folder: Path) -> None:
    files = [quick_raw("x", seed=seed, condition=f"r{seed}") for seed in range(30)]
    arguments = placed(files, folder)
    before = tree(folder.parent)
    written = ["-o", str(folder / "out.json"), "--report", str(folder / "report"), "-m", "mine"]
    code = (
        "import sys, stillpath.cli.console as console, stillpath.cli.main as cli; "
        "console._PLAIN_EVERY_S = 0.0; sys.exit(cli.run(sys.argv[1:]))"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code, "identify", *arguments, *written, *QUICK_OPTIONS],
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stderr is not None
    first = process.stderr.readline()
    assert first.startswith("stillpath: reading raw_data_x_"), first
    process.send_signal(signal.SIGINT)
    _, rest = process.communicate(timeout=60)
    assert process.returncode == 130
    assert rest.splitlines()[-1] == "stillpath: error: interrupted; nothing was written"
    assert tree(folder.parent) == before


@pytest.mark.slow
def test_the_identified_machine_compensates(store: MachineStore, folder: Path, capsys) -> None:
    """From files to a compensated print, which errs less than the original."""
    assert identify(*placed([quick_raw("x"), quick_raw("y")], folder), "-m", "mine") == 0
    source, out, report = folder / "part.gcode", folder / "out.gcode", folder / "report"
    source.write_text(GCODE)
    assert (
        run(["compensate", str(source), "-o", str(out), "-m", "mine", "--report", str(report)]) == 0
    )
    result = json.loads((report / "report.json").read_text())
    assert result["machine"] == "mine"
    errors = {c["name"]: c["extruding"]["contour_rms_um"] for c in result["channels"]}
    assert errors["after"] < 0.2 * errors["before"]
    assert out.stat().st_size > source.stat().st_size
