"""`stillpath machines ...`, and jobs that name a machine of the user's store."""

from __future__ import annotations

import configparser
import json
from datetime import date, timedelta
from pathlib import Path

import pytest
from pydantic import ValidationError

from stillpath.applications.machines import settings_file
from stillpath.applications.machines.checks import check_before_job, differences
from stillpath.applications.machines.klipper_config import read_printer_config
from stillpath.applications.machines.store import MachineStore
from stillpath.cli.main import run
from stillpath.models.firmware import Klipper
from stillpath.models.machine import CommandLimits, Machine, MotorLimits
from stillpath.models.store import builtin_machines
from tests.cli.test_cli import compensate, one_line, pipeline, source
from tests.service.machines import make_machine, make_plants

__all__ = ["pipeline", "source"]  # fixtures

CONFIG = """\
[include mainsail.cfg]  # not for us
[mcu]
serial: /dev/serial/by-id/usb-Klipper_stm32
[printer]
kinematics: corexy
max_velocity: 300  # mm/s
max_accel = 4000   ; the old one was [4500]
max_z_velocity: 15
square_corner_velocity: 8
[stepper_x]
position_min: -2
position_max: 250
[stepper_y]
position_max: 255
[stepper_z]
position_max: 240
[Extruder]
nozzle_diameter: 0.6
filament_diameter: 1.75
max_extrude_only_distance: 101
[gcode_arcs]
resolution: 0.1
[gcode_macro START]
gcode:
  [printer]
  max_accel: 1
  G28
[gcode_macro m900]
gcode:
  SET_PRESSURE_ADVANCE ADVANCE={params.K}
[gcode_macro M106]
rename_existing: M106.1
gcode:
  M106.1 S{params.S}
[input_shaper]
shaper_type_x: ei
#*# <---------------------- SAVE_CONFIG ---------------------->
#*# DO NOT EDIT THIS BLOCK OR BELOW. The contents are auto-generated.
#*#
#*# [input_shaper]
#*# shaper_type_x = mzv
#*# shaper_freq_x = 61.2
#*# shaper_type_y = 2hump_ei
#*# shaper_freq_y = 45.0
#*#
#*# [extruder]
#*# pressure_advance = 0.04
"""


@pytest.fixture(autouse=True)
def store(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch):
    folder = tmp_path_factory.mktemp("data")
    monkeypatch.setenv("STILLPATH_DATA_DIR", str(folder))
    return MachineStore(folder / "machines")


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "printer.cfg"
    path.write_text(CONFIG)
    return path


def machines(*arguments: object) -> int:
    return run(["machines", *map(str, arguments)])


def test_the_old_form_still_works(capsys):
    assert machines() == 0
    shown = capsys.readouterr().out
    assert all(name in shown for name in builtin_machines())
    assert machines("ender3") == 0
    document = capsys.readouterr().out
    assert Machine.model_validate_json(document).name == "ender3"
    assert machines("show", "ender3") == 0
    assert capsys.readouterr().out == document
    assert machines("histroy", "ender3") == 2
    assert "'history'" in one_line(capsys)
    assert machines("nope") == 2
    assert "nope" in one_line(capsys)


def test_a_machine_through_its_life(store: MachineStore, tmp_path: Path, capsys):
    file = tmp_path / "m.json"
    file.write_text(make_machine().model_dump_json())
    assert machines("import", file, "--by", "anna") == 0
    file.write_text(make_machine(mesh_slope=0.02).model_dump_json())
    assert machines("put", file, "--by", "anna", "-M", "mesh") == 0
    assert machines("rollback", "mine", 1, "--by", "bob") == 0
    assert machines("approve", "mine", "--revision", 2, "--by", "carl") == 0
    capsys.readouterr()
    assert machines("history", "mine") == 0
    shown = capsys.readouterr().out
    assert all(word in shown for word in ("anna", "bob", "carl", "mesh", "60.0", "50.0"))
    assert machines("diff", "mine", 1, 2) == 0
    assert capsys.readouterr().out == "mesh_slope: 0 -> 0.02\n"
    assert machines("diff", "mine", 1, 3) == 0
    assert capsys.readouterr().out == "no difference\n"
    assert machines("show", "mine", "--revision", 2) == 0
    assert json.loads(capsys.readouterr().out)["mesh_slope"] == 0.02
    assert machines() == 0
    assert "mine" in capsys.readouterr().out
    assert machines("delete", "mine") == 0
    assert machines("import", file) == 0
    assert machines("delete", "mine") == 0
    capsys.readouterr()
    assert machines("restore", "mine", "--number", 1) == 0
    assert "also in the trash: number 1, deleted " in capsys.readouterr().out
    assert store.current("mine").number == 3
    assert store.current("mine").restored == 1


def test_an_old_export_says_that_newer_plants_are_replaced(
    store: MachineStore, tmp_path: Path, capsys
):
    plants = {**make_machine().axes, "y": make_plants(44.0)}
    store.add_revision("mine", make_machine(), author="anna")
    file = tmp_path / "old.json"
    assert machines("export", "mine", "-o", file) == 0
    for revision in (make_machine(axes=plants), make_machine(axes=plants, mesh_slope=0.02)):
        file.write_text(revision.model_dump_json())
        capsys.readouterr()
        assert machines("put", file) == 0
        assert "newer" not in capsys.readouterr().out
    file.write_text(make_machine(mesh_slope=0.03).model_dump_json())
    assert machines("put", file) == 0
    shown = capsys.readouterr().out
    assert "axis Y: the plants are those of revision 1 again" in shown
    assert "machines rollback mine 3" in shown
    assert "axis X" not in shown


def test_export_and_import(store: MachineStore, tmp_path: Path, capsys):
    store.add_revision("mine", make_machine(), author="anna")
    store.add_revision("mine", make_machine(mesh_slope=0.02), author="anna")
    document, old, history = (tmp_path / name for name in ("d.json", "o.json", "h.json"))
    assert machines("export", "mine", "-o", document) == 0
    assert machines("export", "mine", "-o", old, "--revision", 1) == 0
    assert machines("export", "mine", "-o", history, "--history") == 0
    assert Machine.model_validate_json(document.read_text()).mesh_slope == 0.02
    assert Machine.model_validate_json(old.read_text()).mesh_slope == 0.0
    assert machines("import", history) == 2
    assert "--as" in one_line(capsys)
    assert machines("import", history, "--as", "copy") == 0
    assert machines("import", document, "--as", "ender3") == 2
    assert "built-in" in one_line(capsys)
    before = store.history("mine")
    assert machines("delete", "mine") == 0
    assert machines("import", history) == 0
    assert store.history("mine") == before


def test_another_firmware_loses_no_change_made_meanwhile(
    store: MachineStore, tmp_path: Path, capsys, monkeypatch
):
    store.add_revision("mine", make_machine(), author="anna")
    file = tmp_path / "firmware.json"
    file.write_text(make_machine().firmware.model_dump_json())
    original = settings_file.with_firmware_file

    def slowly(*arguments):
        made = original(*arguments)
        store.add_revision("mine", make_machine(mesh_slope=0.02), author="bob")
        return made

    monkeypatch.setattr(settings_file, "with_firmware_file", slowly)
    assert machines("set-firmware", "mine", file) == 2
    assert "is at revision 2, not 1 any more" in one_line(capsys)
    assert store.current("mine").author == "bob"


def test_what_the_shell_of_windows_writes(store: MachineStore, tmp_path: Path, capsys):
    """PowerShell's `>` writes UTF-16 with a byte order mark."""
    store.add_revision("mine", make_machine(), author="anna")
    file = tmp_path / "written.json"
    for command, *arguments in (
        ("export", "mine", "-o", file),
        ("export", "mine", "-o", file, "--history"),
    ):
        assert machines(command, *arguments) == 0
        file.write_text(file.read_text(), encoding="utf-16")
        assert machines("import", file, "--as", f"copy{len(arguments)}") == 0
    firmware = tmp_path / "firmware.json"
    firmware.write_text(make_machine().firmware.model_dump_json(), encoding="utf-16")
    assert machines("set-firmware", "mine", firmware) == 0
    firmware.write_text("echo: M92 X80 Y80 Z400 E93\necho: M203 X500 Y500 Z5 E25\n", "utf-16")
    assert machines("from-m503", firmware, "--name", "new", "--travel", "200x200x200") == 2
    assert "M201" in one_line(capsys)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("history nope", "nope"),
        ("diff mine 1 2", "mine"),
        ("approve ender3", "ender3"),
        ("import {folder}/none.json", "none.json"),
        ("put {folder}/none.json", "none.json"),
        ("from-config {folder}/none.cfg --name ../x", "cannot be a machine's name"),
        ("export nope -o {folder}/x.json", "nope"),
        ("export ender3 -o {folder}/x.json --history --revision 1", "either"),
        ("check ender3 --printer-cfg {folder}/none.cfg", "none.cfg"),
        ("from-config {folder}/none.cfg --name mine", "none.cfg"),
    ],
)
def test_what_is_refused_stores_nothing(
    store: MachineStore, tmp_path: Path, capsys, arguments: str, words: str
):
    assert machines(*arguments.format(folder=tmp_path).split()) == 2
    assert words in one_line(capsys)
    assert list(tmp_path.iterdir()) == []
    assert store.names() == []


@pytest.mark.parametrize(
    ("by", "message", "field"),
    [("", "", "author"), ("a\x1b[31m", "", "author"), ("anna", "x" * 2001, "message")],
)
def test_who_and_why_are_text(store: MachineStore, tmp_path: Path, capsys, by, message, field):
    file = tmp_path / "m.json"
    file.write_text(make_machine().model_dump_json())
    assert machines("import", file, "--by", by, "-M", message) == 2
    assert field in one_line(capsys)
    assert machines("import", file) == 0
    assert machines("approve", "mine", "--by", by, "-M", message) == 2
    assert field in one_line(capsys)
    assert store.approvals("mine") == {}


def test_bad_settings_are_refused(monkeypatch: pytest.MonkeyPatch, capsys):
    monkeypatch.setenv("STILLPATH_REQUIRE_APPROVAL", "perhaps")
    assert machines("ender3") == 2
    assert "STILLPATH_REQUIRE_APPROVAL: must be true or false" in one_line(capsys)


# Klipper's configuration


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_indentation_counts_as_in_configparser(tmp_path: Path, encoding: str):
    file = tmp_path / "printer.cfg"
    file.write_text(
        "[printer]\n  max_velocity:\n    300 # fast\n\n  max_accel: 4000\n[gcode_macro A]\n"
        "gcode:\n\n  [printer]\n  max_accel: 1\n[extruder]\n\tnozzle_diameter: 0.6\n",
        encoding=encoding,
    )
    found = read_printer_config(file)
    theirs = configparser.RawConfigParser(strict=False, inline_comment_prefixes=(";", "#"))
    theirs.read(file, encoding)
    for section in ("printer", "extruder"):
        options = {name: option.value for name, option in found.sections[section].items()}
        assert options == {name: value.strip() for name, value in theirs[section].items()}


def test_a_machine_from_a_printer_cfg(store: MachineStore, config: Path, capsys):
    assert machines("from-config", config, "--name", "mine", "--title", "My Voron") == 0
    assert "note: [include mainsail.cfg] in printer.cfg: not read" in capsys.readouterr().out
    machine = store.current("mine").machine
    assert (machine.title, machine.kinematics) == ("My Voron", "corexy")
    planner, extruder = machine.firmware.planner, machine.firmware.extruder
    assert (planner.max_velocity_mm_s, planner.max_accel_mm_s2) == (300.0, 4000.0)
    assert (planner.max_z_velocity_mm_s, planner.max_z_accel_mm_s2) == (15.0, 4000.0)
    assert (planner.square_corner_velocity_mm_s, planner.minimum_cruise_ratio) == (8.0, 0.5)
    assert (machine.travel["x"].min_mm, machine.travel["x"].max_mm) == (-2.0, 250.0)
    # Klipper's own defaults: 4 d^2, and that over the filament's 2.405 mm^2 times the limits.
    assert extruder.max_extrude_cross_section_mm2 == pytest.approx(1.44)
    assert extruder.max_extrude_only_velocity_mm_s == pytest.approx(300 * 1.44 / 2.40528, rel=1e-5)
    assert extruder.max_extrude_only_accel_mm_s2 == pytest.approx(4000 * 1.44 / 2.40528, rel=1e-5)
    assert machine.pressure_advance_s == 0.04
    assert machine.firmware.arc_resolution_mm == 0.1
    assert machine.firmware.macros == ("M900",)
    assert not machine.firmware.macros_known  # of mainsail.cfg
    shaper = machine.firmware.shaper
    assert shaper is not None
    assert (shaper.type_x, shaper.freq_x_hz, shaper.type_y) == ("ei", 61.2, "2hump_ei")
    plants = machine.axes["x"]
    assert plants.provenance is not None
    assert plants.provenance.kind == "typed in"
    assert plants.nominal.modes[0].f_hz == 61.2  # type: ignore[union-attr]
    assert len(plants.weighted_members()) == 15
    # What it was made from says nothing else; a second machine of that name is refused.
    assert differences(machine, read_printer_config(config)) == []
    assert machines("from-config", config, "--name", "mine") == 2
    assert "already" in one_line(capsys)


def test_what_the_motors_bear_is_derived_from_their_limits(store: MachineStore, config: Path):
    assert machines("from-config", config, "--name", "slow") == 0
    # A diagonal asks one motor for sqrt(2) times what the head does.
    motors = MotorLimits(accel_mm_s2=8486.0)
    slow = CommandLimits(
        velocity_mm_s=1.2 * 300, accel_mm_s2=1.5 * 4000, speed_step_mm_s=45.0, motors=motors
    )
    assert store.current("slow").machine.command == slow
    fast = CONFIG.replace("max_velocity: 300", "max_velocity: 600")
    config.write_text(fast.replace("max_accel = 4000", "max_accel = 30000"))
    assert machines("from-config", config, "--name", "fast") == 0
    command = store.current("fast").machine.command
    assert command.velocity_mm_s == pytest.approx(1.2 * 600)
    assert command.accel_mm_s2 == pytest.approx(1.5 * 30_000)


def test_a_firmware_that_caps_limits_is_recognised(store: MachineStore, config: Path):
    """Elegoo's Centauri Carbon: a file cannot raise speed and acceleration."""
    silent = "max_velocity: 300\nmax_velocity_silent: 200"
    config.write_text(CONFIG.replace("max_velocity: 300", silent))
    assert machines("from-config", config, "--name", "mine") == 0
    machine = store.current("mine").machine
    assert machine.firmware.limits_capped
    motors = MotorLimits(accel_mm_s2=5657.0)
    assert machine.command == CommandLimits(
        velocity_mm_s=300.0, accel_mm_s2=4000.0, speed_step_mm_s=45.0, motors=motors
    )
    assert differences(machine, read_printer_config(config)) == []
    plain = machine.firmware.model_copy(update={"limits_capped": False})
    (found,) = differences(
        machine.model_copy(update={"firmware": plain}), read_printer_config(config)
    )
    assert "max_velocity_silent" in found.text
    assert "firmware.limits_capped" in found.text
    # Its M900 stops the head; users name others besides.
    assert machine.firmware.stopping_macros == ("M900",)
    for names, told in ((("_WAIT", "m900"), 0), (("_WAIT",), 1)):
        other = machine.firmware.model_copy(update={"stopping_macros": names})
        other = machine.model_copy(update={"firmware": other})
        texts = [entry.text for entry in differences(other, read_printer_config(config))]
        assert len(texts) == told
        assert all("the printer has M900, the machine _WAIT" in text for text in texts)


def test_a_fork_that_keeps_its_shaper_elsewhere(store: MachineStore, config: Path, capsys):
    """Snapmaker's, of the U1: a file would write over what it has measured."""
    kept = CONFIG.replace("shaper_type_x: ei", "shaper_type_x: ei\nshaper_freq_x_min: 47.5")
    config.write_text(kept)
    assert machines("from-config", config, "--name", "u1") == 2
    told = capsys.readouterr().err
    assert "shaper_freq_x_min" in told
    assert "input_shaper.json" in told
    assert "u1" not in store.names()


@pytest.mark.parametrize(
    ("more", "told"),
    [
        ("max_accel_to_decel: 1000", "keeps 1000 whatever ACCEL"),
        ("max_accel_to_decel: 1000\nminimum_cruise_ratio: 0.75", ""),
        ("", ""),
    ],
)
def test_an_option_that_older_klippers_understand_otherwise(
    store: MachineStore, config: Path, capsys, more: str, told: str
):
    """Vendors' printers have it and such a Klipper."""
    config.write_text(CONFIG.replace("max_accel = 4000", f"max_accel = 4000\n{more}"))
    assert machines("from-config", config, "--name", "mine") == 0
    notes = [line for line in capsys.readouterr().out.splitlines() if "to_decel" in line]
    assert len(notes) == bool(told)
    assert told in "".join(notes)
    machine = store.current("mine").machine
    assert machine.firmware.kind == "klipper"
    planner = machine.firmware.planner
    assert planner.max_accel_to_decel_mm_s2 == (1000.0 if told else None)
    assert differences(machine, read_printer_config(config)) == []
    # The planner's limit says that it stops at each SET_PRESSURE_ADVANCE, too.
    assert machine.firmware.stopping_macros == ()
    named = machine.firmware.model_copy(update={"stopping_macros": ("SET_PRESSURE_ADVANCE",)})
    machine = machine.model_copy(update={"firmware": named})
    assert differences(machine, read_printer_config(config)) == []


@pytest.mark.parametrize("height_mm", [0.0, 0.4])
def test_a_fork_whose_g10_lifts_the_head(
    store: MachineStore, config: Path, capsys, height_mm: float
):
    """Kalico's: the reports' times lack it."""
    config.write_text(f"[firmware_retraction]\nz_hop_height: {height_mm}\n{CONFIG}")
    assert machines("from-config", config, "--name", "lifts") == 0
    assert ("z_hop_height 0.4: Kalico lifts" in capsys.readouterr().out) is (height_mm > 0.0)
    machines("check", "lifts", "--printer-cfg", config)
    assert ("z_hop_height 0.4: Kalico lifts" in capsys.readouterr().out) is (height_mm > 0.0)


def test_limits_by_axis_of_a_fork_are_told_apart(store: MachineStore, config: Path, capsys):
    by_axis = "kinematics: limited_corexy\nmax_x_accel: 8000\nmax_y_accel: 3000"
    config.write_text(CONFIG.replace("kinematics: corexy", by_axis))
    assert machines("from-config", config, "--name", "heavy") == 2
    told = capsys.readouterr().err
    for words in ("limited_corexy", "kinematics: corexy", "max_accel: 3000", "max_x_accel"):
        assert words in told
    assert "heavy" not in store.names()


def test_constants_of_a_fork(store: MachineStore, config: Path):
    """Kalico's: an option may refer to one of another section, or of its own."""
    constants = "[constants]\nTop_Speed: 300\nkind: core${constants.plane}\nplane: xy\n"
    text = CONFIG.replace("max_velocity: 300", "max_velocity: ${constants.Top_Speed}")
    text = text.replace("kinematics: corexy", "kinematics: ${constants.kind}")
    text = text.replace("position_min: -2", "position_min: -${inset}\ninset: 2")
    assert text.count("${") == 3
    config.write_text(constants + text)
    assert machines("from-config", config, "--name", "mine") == 0
    machine = store.current("mine").machine
    assert machine.firmware.fastest_mm_s == 300.0
    assert (machine.kinematics, machine.travel["x"].min_mm) == ("corexy", -2.0)
    assert machine.firmware.stopping_macros == ("SET_PRESSURE_ADVANCE",)
    assert differences(machine, read_printer_config(config)) == []
    config.write_text(f"[danger_options]\nlog_statistics: False\n{CONFIG}")
    assert machines("from-config", config, "--name", "other") == 0
    firmware = store.current("other").machine.firmware
    assert firmware.stopping_macros == ("SET_PRESSURE_ADVANCE",)


def test_typed_in_resonances(store: MachineStore, config: Path):
    arguments = ["--name", "mine", "--fx", 70, "--fy", 55, "--zeta", 0.1]
    assert machines("from-config", config, *arguments) == 0
    axes = store.current("mine").machine.axes
    modes = [axes[axis].nominal.modes[0] for axis in ("x", "y")]  # type: ignore[index,union-attr]
    assert [(mode.f_hz, mode.zeta) for mode in modes] == [(70.0, 0.1), (55.0, 0.1)]


def test_a_smoother_has_a_frequency_of_its_own(store: MachineStore, config: Path):
    """As in Kalico: what the other kind has left in the file says nothing of it."""
    smooth = CONFIG.replace("type_x: ei", "type_x: smooth_ei\nsmoother_freq_x: 70")
    smooth = smooth.replace("#*# shaper_freq_x = 61.2\n", "#*# shaper_freq_x = 81.2\n")
    config.write_text(smooth.replace("2hump_ei\n", "2hump_ei\n#*# smoother_freq_y = 90\n"))
    assert machines("from-config", config, "--name", "mine") == 0
    machine = store.current("mine").machine
    modes = [machine.axes[axis].nominal.modes[0].f_hz for axis in "xy"]  # type: ignore[union-attr]
    assert modes == [70.0, 45.0]
    shaper = machine.firmware.shaper  # type: ignore[union-attr]
    assert (shaper.type_x, shaper.freq_x_hz) == ("smooth_ei", 70.0)  # type: ignore[union-attr]
    assert not differences(machine, read_printer_config(config))


def test_the_travel_is_that_of_both_carriages(store: MachineStore, config: Path):
    """A second tool prints where the first one's carriage does not go."""
    second = "[dual_carriage]\naxis: X\nposition_min: 40\nposition_max: 310\n[stepper_y]"
    config.write_text(
        CONFIG.replace("[stepper_y]", second).replace("kinematics: corexy", "kinematics: cartesian")
    )
    assert machines("from-config", config, "--name", "mine") == 0
    machine = store.current("mine").machine
    assert [(axis.min_mm, axis.max_mm) for axis in machine.travel.values()] == [
        (-2.0, 310.0),
        (0.0, 255.0),
        (0.0, 240.0),
    ]
    assert not differences(machine, read_printer_config(config))
    config.write_text(config.read_text().replace("position_max: 310", "position_max: 320"))
    (difference,) = differences(machine, read_printer_config(config))
    assert (difference.section, difference.option) == ("dual_carriage", "position_max")


def test_the_shaper_of_two_carriages_is_unknown(store: MachineStore, config: Path):
    """Klipper refuses frequencies in [input_shaper] then: macros set one for each carriage."""
    plain = CONFIG.partition("[input_shaper]")[0].replace("corexy", "cartesian")
    empty, second = "[input_shaper]\nshaper_freq_x: 0.0\n", "[dual_carriage]\naxis: x\n"
    for text, stated in ((empty, True), (empty + second + "position_max: 310\n", False)):
        config.write_text(plain + text)
        name = "one" if stated else "two"
        assert machines("from-config", config, "--name", name) == 0
        machine = store.current(name).machine
        assert (machine.firmware.shaper is not None) is stated  # type: ignore[union-attr]
        assert not differences(machine, read_printer_config(config))
    config.write_text(config.read_text() + "[input_shaper]\nshaper_freq_x: 60\n")
    found = differences(machine, read_printer_config(config))
    assert "shaper_freq_x" in [difference.option for difference in found]


@pytest.mark.parametrize(
    ("more", "known"),
    [
        ("[tool T0]\nafter_change_gcode:\n  M117\n  set_input_shaper SHAPER_FREQ_X=50\n", False),
        ("[tool T0]\nparams_input_shaper_freq_x: 50\n", False),
        ("[delayed_gcode a]\ngcode:\n  {% if 1 %}\n  SET_INPUT_SHAPER SHAPER_FREQ_X=50\n", False),
        ("[gcode_macro STILLPATH_SHAPER_ON]\ngcode:\n  SET_INPUT_SHAPER SHAPER_FREQ_X=0\n", True),
    ],
)
def test_the_shaper_of_a_tool_changer_is_unknown(
    store: MachineStore, config: Path, more: str, known: bool
):
    """Its macros set each tool's: off behind a stretch is not what was in force."""
    plain = CONFIG.partition("[input_shaper]")[0]
    config.write_text(f"{plain}[input_shaper]\n{more}")
    assert machines("from-config", config, "--name", "mine") == 0
    machine = store.current("mine").machine
    assert machine.firmware.kind == "klipper"
    assert (machine.firmware.shaper is not None) is known
    assert differences(machine, read_printer_config(config)) == []
    config.write_text(f"{plain}[input_shaper]\nshaper_freq_y: 40\n{more}")
    assert machines("from-config", config, "--name", "stated") == 0
    firmware = store.current("stated").machine.firmware
    assert firmware.kind == "klipper"
    assert firmware.shaper is not None


def test_a_printer_without_a_shaper(store: MachineStore, config: Path):
    whole = CONFIG.replace("[include mainsail.cfg]", "")
    plain = whole.partition("[input_shaper]")[0]
    texts = {"with": whole, "without": plain, "unread": f"[include mainsail.cfg]\n{plain}"}
    made = {}
    for name, text in texts.items():
        config.write_text(text)
        assert machines("from-config", config, "--name", name) == 0
        made[name] = store.current(name).machine
        firmware = made[name].firmware
        assert firmware.kind == "klipper"
        assert firmware.no_input_shaper is (name == "without")
        assert differences(made[name], read_printer_config(config)) == []
        # A machine from before this was noted does not differ from its printer.
        before = firmware.model_copy(update={"no_input_shaper": False})
        machine = made[name].model_copy(update={"firmware": before})
        assert differences(machine, read_printer_config(config)) == []
    config.write_text(whole)  # now it has one
    found = differences(made["without"], read_printer_config(config))
    assert "shaper_freq_x" in [entry.option for entry in found]
    section = made["without"].firmware.model_dump(mode="json")
    with pytest.raises(ValidationError, match="set no_input_shaper to false"):
        Klipper.model_validate({**section, "shaper": {}})


@pytest.mark.parametrize("hertz", ["inf", "nan", "1e101", "501"])
def test_resonances_that_are_none(store: MachineStore, config: Path, capsys, hertz: str):
    assert machines("from-config", config, "--name", "mine", "--fx", hertz) == 2
    assert "500" in capsys.readouterr().err
    config.write_text(CONFIG + f"[input_shaper]\nshaper_freq_y: {hertz}\n")
    assert machines("from-config", config, "--name", "mine") == 2
    assert "shaper" in one_line(capsys)
    assert store.names() == []


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("max_velocity: 300", "max_velocity: fast", ["line 6", "max_velocity", "fast"]),
        ("max_velocity: 300", "max_velocity: nan", ["line 6", "max_velocity"]),
        (
            "max_accel = 4000",
            "max_accel = 0\nmax_accel_to_decel = 100",
            ["[printer] max_accel: 0 must be above 0"],
        ),
        (
            "filament_diameter: 1.75",
            "filament_diameter: 0",
            ["[extruder] filament_diameter: 0 must be above 0"],
        ),
        ("kinematics: corexy", "", ["[printer] lacks kinematics", "mainsail.cfg", "cat them"]),
        ("max_accel = 4000", "", ["[printer] lacks max_accel", "mainsail.cfg", "was not read"]),
        ("kinematics: corexy", "kinematics: delta", ["kinematics delta: only", "as sliced"]),
        ("[stepper_z]", "[stepper_q]", ["travel", "z"]),
        ("position_max: 250", "position_max: -9", ["travel", "-2.0", "-9.0"]),
        (
            "max_velocity: 300",
            "max_velocity: ${constants.speed}",
            ["line 6: [printer] max_velocity: ${constants.speed} refers to speed of [constants]"],
        ),
        ("max_velocity: 300", "max_velocity: ${max_velocity}", ["'${max_velocity}' is no number"]),
        ("type_x: ei", "type_x: foo", ["[input_shaper] shaper_type_x", "'foo'", "give zv, mzv"]),
    ],
)
def test_bad_configurations(store: MachineStore, config: Path, capsys, old, new, words):
    config.write_text(CONFIG.replace(old, new))
    assert machines("from-config", config, "--name", "mine") == 2
    message = one_line(capsys)
    assert all(word in message for word in ["printer.cfg", *words])
    assert store.names() == []


@pytest.mark.parametrize("content", [b"", b"G28\nG1 X1\n", b"\x00\xff" * 999])
def test_what_is_no_configuration(tmp_path: Path, capsys, content: bytes):
    file = tmp_path / "printer.cfg"
    file.write_bytes(content)
    assert machines("from-config", file, "--name", "mine") == 2
    assert "no [section]" in one_line(capsys)


def test_a_configuration_of_nothing_but_includes(tmp_path: Path, capsys):
    """As Klippain and some vendors have it."""
    file = tmp_path / "printer.cfg"
    file.write_text("[include mainsail.cfg]\n[include x400.cfg]\n#*#\n#*# [extruder]\n#*# a = 1\n")
    assert machines("from-config", file, "--name", "mine") == 2
    message = one_line(capsys)
    assert all(word in message for word in ("mainsail.cfg, x400.cfg", "was not read", "cat them"))


def test_included_files_are_read_as_klipper_reads_them(store: MachineStore, tmp_path: Path, capsys):
    """Vendors keep macros such as M205 in a file beside printer.cfg; a later option wins."""
    folder = tmp_path / "printer [old]"  # no pattern, though it looks like one
    (folder / "macros").mkdir(parents=True)
    config = folder / "printer.cfg"
    config.write_text(
        "[include macros/*.cfg]\n" + CONFIG.replace("# not for us", "") + "[include later.cfg]\n"
    )
    (folder / "mainsail.cfg").write_text(
        "[printer]\nmax_accel: 1\n[include ./macros/../arcs.cfg]\n"
    )
    (folder / "arcs.cfg").write_text("[gcode_arcs]\nresolution: 7\n[stepper_y]\nposition_min: -9\n")
    (folder / "macros" / "a.cfg").write_text("[gcode_macro M205]\ngcode:\n  [printer]\n  M400\n")
    (folder / "macros" / ".old.cfg").write_text("[gcode_macro M203]\ngcode:\n  M400\n")
    (folder / "later.cfg").write_text("[printer]\nmax_velocity: 250\n#*# [extruder]\n#*# a = 1\n")
    assert machines("from-config", config, "--name", "mine") == 0
    assert "note: [include" not in capsys.readouterr().out
    made = store.current("mine")
    assert made.machine.firmware.macros == ("M205", "M900")
    assert made.machine.firmware.macros_known
    # Machines from before that was noted do not differ, and keep their revision.
    before = made.machine.firmware.model_copy(update={"macros_known": False})
    machine = made.machine.model_copy(update={"firmware": before})
    assert differences(machine, read_printer_config(config)) == []
    planner, travel = made.machine.firmware.planner, made.machine.travel
    assert (planner.max_accel_mm_s2, planner.max_velocity_mm_s) == (4000.0, 250.0)
    assert made.machine.firmware.arc_resolution_mm == 0.1
    assert travel["y"].min_mm == -9.0
    names = ["printer.cfg", "a.cfg", "mainsail.cfg", "arcs.cfg", "later.cfg"]
    assert [source.name for source in made.sources] == names
    (folder / "later.cfg").write_text("\n[printer]\nmax_velocity: fast\n")
    assert machines("check", "mine", "--printer-cfg", config) == 2
    assert "later.cfg line 3: [printer] max_velocity: 'fast' is no number" in one_line(capsys)


@pytest.mark.parametrize(
    ("line", "macros"),
    [
        ("ACCEL_TO_DECEL={s/2}", ("M204", "M900")),
        ("ACCEL_TO_DECEL={s*0.5}", ("M204", "M900")),
        ("ACCEL_TO_DECEL={s*0.55}", ("M900",)),
        ("ACCEL_TO_DECEL={s}", ("M900",)),
    ],
)
def test_a_macro_m204_that_halves(store: MachineStore, config: Path, line: str, macros):
    """As in QIDI's gcode_macro.cfg; Creality's passes M204 on."""
    body = "{% set s = params.S|float %}\n\n    SET_VELOCITY_LIMIT ACCEL={s}"
    macro = f"[gcode_macro M204]\nrename_existing: M99204\ngcode:\n    {body}\n"
    config.write_text(f"{macro}    SET_VELOCITY_LIMIT {line}\n{CONFIG}")
    assert machines("from-config", config, "--name", "mine") == 0
    assert store.current("mine").machine.firmware.macros == macros


CORNER_OR = """
  {% if 'X' in params %}
    SET_VELOCITY_LIMIT SQUARE_CORNER_VELOCITY={params.X}
  {% elif 'Y' in params %}
    SET_VELOCITY_LIMIT SQUARE_CORNER_VELOCITY={params.Y}
  {% endif %}
"""
CORNER_MIN = """
  {% if 'X' in params or 'Y' in params %}
    SET_VELOCITY_LIMIT SQUARE_CORNER_VELOCITY="{
      (params.X|default(0)|float, params.Y|default(0)|float)|min}"
  {% else %}
    SET_VELOCITY_LIMIT
  {% endif %}
"""
SPEED = """
    {% set velocity = (params.X|default(params.Y)|float,
                       params.Y|default(params.X)|float)|min %}
    SET_VELOCITY_LIMIT VELOCITY="{velocity}"
"""


@pytest.mark.parametrize(
    ("name", "body", "only"),
    [
        ("M205", CORNER_OR, True),
        ("M205", CORNER_MIN, True),
        ("M203", SPEED, True),
        ("M203", CORNER_OR, False),
        ("M205", CORNER_OR + "    M400\n", False),
        ("M205", CORNER_OR.replace("params.X}", "params.X|float / 2}"), False),
        ("M205", CORNER_OR + "    # long\n    SET_VELOCITY_LIMIT\n" * 250, False),
        ("M205", " M400", False),
    ],
)
def test_a_macro_that_only_sets_a_limit(
    store: MachineStore, config: Path, name: str, body: str, only: bool
):
    """Creality's and Elegoo's: streams need not end before it."""
    config.write_text(f"[gcode_macro {name}]\ndescription: a\ngcode:{body}\n{CONFIG}")
    assert machines("from-config", config, "--name", "mine") == 0
    machine = store.current("mine").machine
    firmware = machine.firmware
    assert firmware.kind == "klipper"
    limits, macros = firmware.limit_macros, firmware.macros
    assert (limits, macros) == (((name,), ("M900",)) if only else ((), (name, "M900")))
    assert differences(machine, read_printer_config(config)) == []


def test_a_configuration_that_includes_itself(tmp_path: Path, capsys):
    file = tmp_path / "printer.cfg"
    file.write_text("[include a.cfg]\n")
    (tmp_path / "a.cfg").write_text("[include printer.cfg]\n")
    assert machines("from-config", file, "--name", "mine") == 2
    assert "[include printer.cfg] in a.cfg includes itself" in one_line(capsys)


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ("max_accel = 4000", "max_accel = 5000", "[printer] max_accel: the printer has 5000, the"),
        ("advance = 0.04", "advance_smooth_time = .03", "smooth_time: the printer has 0.03, the m"),
        ("advance = 0.04", "advance = 0.05", "[extruder] pressure_advance: the printer has 0.05"),
        ("freq_x = 61.2", "freq_x = 58", "[input_shaper] shaper_freq_x: the printer has 58, the"),
        ("type_x: ei", "type_x: mzv (n=4, t=1.0)", "shaper_type_x: the printer has mzv(n=4,t=1.0)"),
        ("type_x: ei", "type_x: zv", "[input_shaper] shaper_type_x: the printer has zv, the mach"),
        ("kinematics: corexy", "kinematics: cartesian", "[printer] kinematics: the printer has c"),
        ("max_accel = 4000", "max_accel = 4000\nmax_accel_to_decel: 1000", "has 0.75, the machin"),
        ("[gcode_arcs]", "[firmware_retraction]\n[x]", "[firmware_retraction] retract_length: t"),
    ],
)
def test_changes_of_the_printer_are_found(config: Path, capsys, old: str, new: str, line: str):
    config.write_text(CONFIG.replace("[include mainsail.cfg]", ""))
    machines("from-config", config, "--name", "mine")
    config.write_text(config.read_text().replace(old, new))
    capsys.readouterr()
    assert machines("check", "mine", "--printer-cfg", config) == 2
    found = capsys.readouterr().out
    assert line in found
    assert "put " in found


def test_a_section_that_is_gone_is_a_change(config: Path, capsys):
    config.write_text(CONFIG.replace("[include mainsail.cfg]", ""))
    machines("from-config", config, "--name", "mine")
    config.write_text(config.read_text().split("[input_shaper]")[0])
    capsys.readouterr()
    machines("check", "mine", "--printer-cfg", config)
    assert "[input_shaper]: the printer has none, the machine type_x ei" in capsys.readouterr().out


def test_check_says_when_all_is_well(store: MachineStore, config: Path, capsys):
    fresh = make_plants(on=date.today())
    config.write_text(CONFIG.replace("[include mainsail.cfg]", ""))
    machines("from-config", config, "--name", "mine")
    measured = store.current("mine").machine.model_copy(update={"axes": {"x": fresh, "y": fresh}})
    store.add_revision("mine", measured, author="anna")
    capsys.readouterr()
    assert machines("check", "mine", "--printer-cfg", config) == 0
    assert capsys.readouterr().out == "mine: no problems found\n"
    config.write_text(CONFIG)  # what is included was not looked at: said, but no difference
    assert machines("check", "mine", "--printer-cfg", config) == 0
    assert "note: [include mainsail.cfg]" in capsys.readouterr().out
    capsys.readouterr()
    # A note for machines whose command is no such multiple; what was typed in is to be measured.
    assert machines("check", "generic-corexy") == 2
    out = capsys.readouterr().out
    assert "axis x of generic-corexy: its plants were typed in, not measured" in out
    assert "note: generic-corexy: a command may ask the motors for 20000" in out
    # Somebody else's printer, and years ago.
    assert machines("check", "ender3") == 2


def test_the_age_of_a_measurement():
    from datetime import UTC, datetime

    now = datetime(2026, 11, 21, tzinfo=UTC)

    def warnings(days: int, limit: float = 180.0) -> list[str]:
        plants = make_plants(on=now.date() - timedelta(days=days))
        machine = make_machine(axes={"x": plants, "y": make_plants(on=now.date())})
        return check_before_job(machine, now, max_age_days=limit)

    assert warnings(180) == []
    (line,) = warnings(181)
    assert line.startswith("axis x of mine: measured on 2026-05-24, 181 days ago, more than 180;")
    assert warnings(181, 200.0) == []


# Jobs


def test_a_job_uses_the_users_machine_and_hears_of_its_age(
    store: MachineStore, pipeline, source, tmp_path, capsys, monkeypatch
):
    old = make_plants(on=date(2020, 1, 31))
    store.add_revision("mine", make_machine(axes={"x": old, "y": old}), author="anna")
    out, report = tmp_path / "out.gcode", tmp_path / "report"
    assert compensate(source, "-o", str(out), "-m", "mine", "--report", str(report)) == 0
    assert pipeline.machine == "mine"
    assert "warning: axis x of mine: measured on 2020-01-31" in capsys.readouterr().out
    written = json.loads((report / "report.json").read_text())["warnings"]
    (warning,) = [text for text in written if "axis x of mine: measured on 2020-01-31" in text]
    assert warning.endswith("days ago, more than 180; measure it again")
    monkeypatch.setenv("STILLPATH_MEASUREMENT_MAX_AGE_DAYS", "1e6")
    assert compensate(source, "-o", str(out), "-m", "mine") == 0
    assert "measured on" not in capsys.readouterr().out


def test_a_job_needs_an_approved_machine_where_that_is_switched_on(
    store: MachineStore, pipeline, source, tmp_path, capsys, monkeypatch
):
    monkeypatch.setenv("STILLPATH_REQUIRE_APPROVAL", "true")
    store.add_revision("mine", make_machine(), author="anna")
    out = tmp_path / "out.gcode"
    assert compensate(source, "-o", str(out), "-m", "mine") == 2
    assert "stillpath machines approve mine --revision 1" in one_line(capsys)
    assert not out.exists()
    assert machines("approve", "mine") == 0
    assert compensate(source, "-o", str(out), "-m", "mine") == 0
    assert compensate(source, "-o", str(out), "-m", "ender3") == 0
