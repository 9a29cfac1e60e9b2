"""Machines with another firmware than Klipper: the examples, and how a machine gets one."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from stillpath.applications.machines.checks import differences
from stillpath.applications.machines.klipper_config import PrinterConfig, read_printer_config
from stillpath.cli.main import run
from stillpath.models.errors import ModelError
from stillpath.models.machine import Machine
from stillpath.models.store import load_machine, read_machine
from tests.compensating import compensated

EXAMPLES = Path(__file__).parents[2] / "examples" / "firmware"
KINDS = ("marlin", "reprapfirmware")
RING = "G1 X80 Y60 E.8 F3000\nG1 X80 Y80 E.8\nG1 X60 Y80 E.8\nG1 X60 Y60 E.8\n"
TRAVELS = f"G28\nM83\nG1 Z1 F600\nG1 X60 Y60 F9000\n{RING}G1 X140 Y140 F9000\nG1 X60 Y60\n{RING}"


@pytest.fixture(autouse=True)
def data_dir(tmp_path, monkeypatch):
    monkeypatch.setenv("STILLPATH_DATA_DIR", str(tmp_path / "data"))


def stillpath(capsys, *words) -> tuple[int, str, str]:
    code = run([str(word) for word in words])
    out, err = capsys.readouterr()
    return code, out, err


@pytest.mark.parametrize("kind", KINDS)
def test_examples_are_machines(capsys, kind: str) -> None:
    code, out, err = stillpath(
        capsys, "machines", "set-firmware", "ender3", EXAMPLES / f"{kind}.json", "--as", "mine"
    )
    assert (code, err) == (0, "")
    code, out, _ = stillpath(capsys, "machines", "mine")
    machine = read_machine(out)
    assert machine.firmware.kind == kind
    assert machine.axes == load_machine("ender3").axes
    for section in json.loads((EXAMPLES / f"{kind}.json").read_text()):
        assert section in machine.firmware.model_fields_set


def test_next_revision_of_an_own_machine(capsys) -> None:
    marlin, reprap = (EXAMPLES / f"{kind}.json" for kind in KINDS)
    stillpath(capsys, "machines", "set-firmware", "ender3", marlin, "--as", "mine")
    code, out, _ = stillpath(capsys, "machines", "set-firmware", "mine", reprap)
    assert code == 0
    assert out.startswith("mine: revision 2")
    _, out, _ = stillpath(capsys, "machines", "diff", "mine", "1", "2")
    assert "firmware.kind: marlin -> reprapfirmware" in out


PRINTER_CFG = (
    "[printer]\nkinematics: cartesian\nmax_velocity: 300\nmax_accel: 3000\n"
    + "".join(f"[stepper_{axis}]\nposition_max: 200\n" for axis in "xyz")
    + "[include macros.cfg]\n[input_shaper]\nshaper_freq_x: 40\n"
)


def test_a_printer_cfg_brings_a_measured_machine_up_to_date(capsys, tmp_path) -> None:
    """Limits, travel and macros of its files; what was measured and named stays."""
    config, macros = tmp_path / "printer.cfg", tmp_path / "macros.cfg"
    config.write_text(PRINTER_CFG)
    macros.write_text("[gcode_macro M204]\ngcode:\n  SET_VELOCITY_LIMIT ACCEL={params.S}\n")
    stillpath(capsys, "machines", "from-config", config, "--name", "mine")
    measured = read_machine(stillpath(capsys, "machines", "mine")[1])
    measured = measured.model_copy(
        update={
            "axes": load_machine("ender3").axes,
            "mesh_slope": 0.01,
            "firmware": measured.firmware.model_copy(update={"stopping_macros": ("WIPE",)}),
        }
    )
    document = tmp_path / "mine.json"
    document.write_text(measured.model_dump_json())
    stillpath(capsys, "machines", "put", document)

    config.write_text(PRINTER_CFG.replace("3000", "4000") + "[danger_options]\n")
    _, out, _ = stillpath(capsys, "machines", "check", "mine", "--printer-cfg", config)
    assert f"machines set-firmware mine {config}" in out
    code, out, err = stillpath(capsys, "machines", "set-firmware", "mine", config)
    assert (code, err) == (0, "")
    assert out.startswith("mine: revision 3")
    now = read_machine(stillpath(capsys, "machines", "mine")[1])
    assert (now.axes, now.mesh_slope) == (measured.axes, 0.01)
    assert now.firmware.planner.max_accel_mm_s2 == 4000.0
    assert now.firmware.stopping_macros == ("WIPE", "SET_PRESSURE_ADVANCE")
    assert now.command.accel_mm_s2 == pytest.approx(4 / 3 * measured.command.accel_mm_s2)
    _, out, _ = stillpath(capsys, "machines", "check", "mine", "--printer-cfg", config)
    assert "printer.cfg" not in out

    config.write_text(PRINTER_CFG.replace("cartesian", "corexy"))
    code, _, err = stillpath(capsys, "machines", "set-firmware", "mine", config)
    assert code == 2
    assert "was measured as cartesian" in err
    macros.unlink()
    config.write_text(PRINTER_CFG)
    _, out, _ = stillpath(capsys, "machines", "set-firmware", "mine", config)
    assert "[include macros.cfg]" in out
    assert not read_machine(stillpath(capsys, "machines", "mine")[1]).firmware.macros_known


def test_a_machine_keeps_its_plants_where_klipper_replaces_marlin(capsys, tmp_path) -> None:
    marlin, config = EXAMPLES / "marlin.json", tmp_path / "printer.cfg"
    config.write_text(PRINTER_CFG.replace("[include macros.cfg]\n", ""))
    stillpath(capsys, "machines", "set-firmware", "ender3", marlin, "--as", "mine")
    code, _, _ = stillpath(capsys, "machines", "set-firmware", "mine", config)
    now = read_machine(stillpath(capsys, "machines", "mine")[1])
    assert (code, now.firmware.kind) == (0, "klipper")
    assert now.axes == load_machine("ender3").axes
    assert differences(now, read_printer_config(config)) == []


def test_what_the_motors_bear_is_derived_anew_where_it_was_derived(capsys, tmp_path) -> None:
    """A bed that bears less than the head, as config.g says (M201 X4000 Y1500)."""
    section = json.loads((EXAMPLES / "reprapfirmware.json").read_text())
    section |= {"print_accel_mm_s2": 10_000.0, "travel_accel_mm_s2": 10_000.0}
    section["x"]["max_accel_mm_s2"], section["y"]["max_accel_mm_s2"] = 4000.0, 1500.0
    reprap, config = tmp_path / "reprap.json", tmp_path / "printer.cfg"
    reprap.write_text(json.dumps(section))
    config.write_text(
        "[printer]\nkinematics: cartesian\nmax_velocity: 300\nmax_accel: 3000\n"
        + "".join(f"[stepper_{axis}]\nposition_max: 200\n" for axis in "xyz")
    )
    stillpath(capsys, "machines", "from-config", config, "--name", "mine")
    stillpath(capsys, "machines", "set-firmware", "mine", reprap)
    command = read_machine(stillpath(capsys, "machines", "mine")[1]).command
    # At least 1.5 times each, and up to 6000 three times: the ring holds few moves.
    assert (command.of("x").accel_mm_s2, command.of("y").accel_mm_s2) == (6000.0, 4500.0)
    # The built-in machine says 20 000 mm/s2, and that stays; `check` tells the least of both axes.
    stillpath(capsys, "machines", "set-firmware", "ender3", reprap, "--as", "stated")
    stated = read_machine(stillpath(capsys, "machines", "stated")[1]).command
    assert stated == load_machine("ender3").command
    told = " ".join(stillpath(capsys, "machines", "check", "stated")[1:])
    assert "otherwise put 4500 there" in told


@pytest.mark.parametrize("room", [None, 1.5])
def test_duets_with_low_accelerations_are_compensated(room, capsys, tmp_path) -> None:
    """M204 P500 T1000: streams of 1.5 times either fall behind, and the report says why."""
    section = json.loads((EXAMPLES / "reprapfirmware.json").read_text())
    section |= {"print_accel_mm_s2": 500.0, "travel_accel_mm_s2": 1000.0}
    reprap, config = tmp_path / "reprap.json", tmp_path / "printer.cfg"
    reprap.write_text(json.dumps(section))
    config.write_text(
        "[printer]\nkinematics: cartesian\nmax_velocity: 300\nmax_accel: 500\n"
        + "".join(f"[stepper_{axis}]\nposition_max: 200\n" for axis in "xyz")
    )
    stillpath(capsys, "machines", "from-config", config, "--name", "mine", "--fx", 45, "--fy", 29)
    stillpath(capsys, "machines", "set-firmware", "mine", reprap)
    machine = read_machine(stillpath(capsys, "machines", "mine")[1])
    assert machine.command.accel_mm_s2 == 3000.0
    if room is not None:
        command = machine.command.model_copy(update={"accel_mm_s2": room * 500.0})
        machine = machine.model_copy(update={"command": command})
    folder = tmp_path / "printed"
    folder.mkdir()
    result, _ = compensated(TRAVELS, folder, tmp_path / "cache", machine)
    reasons = [one.reason for one in result.put_back]
    assert bool(reasons) == (room is not None)
    assert all("command.accel_mm_s2 (750) is low: raise it" in reason for reason in reasons)


def test_a_firmware_that_executes_no_stream_is_told_at_once(capsys, tmp_path) -> None:
    file = tmp_path / "firmware.json"
    file.write_text('{"kind": "marlin", "variant": "bambu"}')
    code, out, _ = stillpath(capsys, "machines", "set-firmware", "ender3", file, "--as", "mine")
    assert code == 0
    assert "mine can be simulated, not compensated: Bambu" in out
    code, out, _ = stillpath(capsys, "machines", "check", "mine")
    assert code == 2
    assert "not compensated" in out


@pytest.mark.parametrize(
    ("section", "message"),
    [
        ("{", "at line 1 column 1); a firmware section as JSON is needed, an answer to M503"),
        ('{"kind": "klipper", "kind": "marlin"}', "'kind' is there twice; keep one of them"),
        ("[]", "says its kind"),
        ('{"planner": {}}', "says its kind"),
        ('{"kind": "grbl"}', "firmware: kind must be klipper, marlin or reprapfirmware"),
        ('{"kind": "marlin", "steps_per_mm": {"x": 0}}', "firmware.steps_per_mm.x: "),
        ('{"kind": "klipper", "planner": {"max_accel_mm_s2": -1}}', "firmware.planner.max_accel"),
        ('{"kind": "klipper", "shaper": {"type_x": "foo"}}', "firmware.shaper.type_x: 'foo' is no"),
        ('{"kind": "klipper", "shaper": {"type_y": "mzv\\nG28 ; "}}', "firmware.shaper.type_y: "),
        (
            '{"kind": "klipper", "shaper": {"type_y": "ei(.05)", "damping_y": 0.5}}',
            "firmware.shaper: damping_y is 0.5, and Klipper takes up to 0.4 for ei",
        ),
        (
            '{"kind": "marlin", "linear_advance_k_s": 45}',
            "firmware.linear_advance_k_s: must be at most 10",
        ),
        ('{"kind": "reprapfirmware", "shaper": {"type": "zv"}}', "firmware.shaper.type: "),
        ('{"kind": "reprapfirmware", "shaper": {"type": "custom"}}', "firmware.shaper.type: "),
    ],
)
def test_a_wrong_section_is_named(capsys, tmp_path, section: str, message: str) -> None:
    file = tmp_path / "firmware.json"
    file.write_text(section)
    code, _, err = stillpath(capsys, "machines", "set-firmware", "ender3", file, "--as", "mine")
    assert code == 2
    assert message in err


def test_a_section_without_kind_is_klippers() -> None:
    machine = load_machine("ender3")
    document = machine.model_dump(mode="json")
    del document["firmware"]["kind"]
    assert Machine.model_validate(document) == machine


def test_a_printer_cfg_says_nothing_of_marlin() -> None:
    section = json.loads((EXAMPLES / "marlin.json").read_text())
    document = load_machine("ender3").model_dump(mode="json")
    machine = Machine.model_validate({**document, "firmware": section})
    with pytest.raises(ModelError, match=r"runs marlin; a printer.cfg is Klipper's"):
        differences(machine, PrinterConfig("printer.cfg"))
