"""Coupon and tower: what is written is a print that any machine can run, and shows what it says."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from stillpath.applications.machines.envelope import with_firmware
from stillpath.applications.proof.coupon import coupon_program
from stillpath.applications.proof.drive import ringing_mode
from stillpath.applications.proof.program import PrintSettings
from stillpath.applications.proof.recorders import RingSettings
from stillpath.applications.proof.ring_test import RingTest
from stillpath.applications.proof.tower import tower_program, write_tower
from stillpath.cli.main import run
from stillpath.cli.proof import PrintOptions
from stillpath.gcode.firmware.klipper.planner import Planner
from stillpath.gcode.firmware.planning import join_phases
from stillpath.gcode.firmware.registry import adapter
from stillpath.gcode.types import Moves, joined
from stillpath.models.errors import ModelError
from stillpath.models.firmware.klipper import FirmwareShaper
from stillpath.models.machine import AxisTravel, Machine
from stillpath.models.plants import Mode, ModesSpec, discretise
from stillpath.models.store import builtin_machines, load_machine
from stillpath.pipeline.compensate import compensate_file
from stillpath.pipeline.options import Options
from stillpath.simulation.response import response
from tests.gcode.cutting import blocks_of

SETTINGS = PrintSettings()
EXAMPLES = Path(__file__).parents[2] / "examples" / "firmware"
COUPONS = ("voron-v24-250", "generic-bedslinger", "annex-k3", "taz6-x")
"""Machines whose coupons `test_proof_readback` reads back as well; of the others, towers."""


def text_of(what: str, machine: Machine, settings: PrintSettings = SETTINGS) -> str:
    if what == "coupon":
        return coupon_program(machine, settings)[0].text()
    axis = "x" if what == "tower x" else "y"
    return tower_program(machine, axis, settings, 4)[0].text()


def moves_of(data: bytes, machine: Machine) -> tuple[Moves, list[str], object]:
    """Interpreted and planned: a move outside the travel, or one refused, raises."""
    blocks = blocks_of(data, machine)
    planner = Planner(machine.firmware)
    phases = join_phases([*(planner.push(block) for block in blocks), planner.flush()])
    assert len(phases)
    moves = joined([block.moves for block in blocks])
    last = blocks[-1].limits[int(blocks[-1].events.limits_id[-1])]
    return moves, [str(planner.time_s)], last


@pytest.mark.parametrize("what", ["coupon", "tower x", "tower y"])
@pytest.mark.parametrize("name", builtin_machines())
def test_planned_prints_are_sound(what, name):
    machine = load_machine(name)
    moves, (time_s,), last = moves_of(text_of(what, machine).encode(), machine)
    travel = moves.end_mm - moves.start_mm
    xy = np.hypot(travel[:, 0], travel[:, 1])
    e = travel[:, 3]
    prints = (xy > 0) & (e > 0)
    extruder = machine.firmware.extruder
    area = math.pi * (0.5 * extruder.filament_diameter_mm) ** 2
    section = e[prints] * area / xy[prints]
    height, width = 0.2, 0.45
    wanted = height * (width - (1 - math.pi / 4) * height)
    z = np.unique(np.round(moves.end_mm[prints, 2], 3))
    walls = moves.end_mm[prints, 2] > 0.3
    assert section[walls] == pytest.approx(np.full(walls.sum(), wanted), rel=0.02)
    assert np.diff(z[z > 0.3]) == pytest.approx(np.full(len(z[z > 0.3]) - 1, height), abs=1e-3)
    # Filament moves by a retraction and back, in turn, and never feeds while it is back.
    alone = e[(xy == 0) & (e != 0)]
    back = machine.firmware.retraction.retract_length_mm
    assert alone[0] == pytest.approx(4.0)
    assert alone[1::2] == pytest.approx(np.full(len(alone[1::2]), -back))
    assert alone[2::2] == pytest.approx(np.full(len(alone[2::2]), back))
    assert np.all(e[(xy > 0) & ~prints] == 0)
    retracted = np.cumsum(np.where(xy == 0, e, 0.0)) < 4.0 - 1e-6
    assert not np.any(retracted & prints)
    assert last.accel_mm_s2 == machine.firmware.planner.max_accel_mm_s2
    limits = machine.firmware.planner
    assert moves.speed_mm_s.max() <= max(limits.max_velocity_mm_s, 200)
    if what == "coupon":
        assert 5 * 60 <= float(time_s) <= 10 * 60


@pytest.mark.parametrize("what", ["coupon", "tower x", "tower y", "ring test"])
@pytest.mark.parametrize("kind", ["marlin", "reprapfirmware"])
def test_each_axis_keeps_its_own_limits(kind, what):
    """On a bed slinger whose bed may less than its head."""
    machine = with_limits_of_each_axis(kind)
    if what == "ring test":
        text = RingTest(machine, RingSettings()).text()
    else:
        text = text_of(what, machine)
    blocks = blocks_of(text.encode(), machine)
    own = adapter(machine).initial_limits()
    limits = [one for block in blocks for one in block.limits]
    assert {one.accel_x_mm_s2 for one in limits} == {own.accel_x_mm_s2}
    assert {one.accel_y_mm_s2 for one in limits} == {own.accel_y_mm_s2}
    assert blocks[-1].limits[int(blocks[-1].events.limits_id[-1])] == own


def with_limits_of_each_axis(kind: str) -> Machine:
    section = json.loads((EXAMPLES / f"{kind}.json").read_text())
    for axis, accel_mm_s2 in (("x", 3000.0), ("y", 1000.0)):
        if kind == "marlin":
            section["planner"]["max_accel_mm_s2"][axis] = accel_mm_s2
        else:
            section[axis]["max_accel_mm_s2"] = accel_mm_s2
    return with_firmware(load_machine("generic-bedslinger"), section)


def test_drives_are_what_the_axes_shown_can_do():
    machine = with_limits_of_each_axis("reprapfirmware")
    assert coupon_program(machine, SETTINGS)[1].accel_mm_s2 <= 1000.0
    top = {axis: tower_program(machine, axis, SETTINGS, 4)[1][-1].accel_mm_s2 for axis in "xy"}
    assert top["y"] <= 1000.0 < top["x"] <= 3000.0
    assert RingTest(machine, RingSettings()).accel_mm_s2 == {"x": 3000.0, "y": 1000.0}


@pytest.mark.parametrize("name", builtin_machines())
def test_walls_ring_as_they_can_be_seen(name):
    machine = load_machine(name)
    _, chosen = coupon_program(machine, SETTINGS)
    limits = machine.firmware.planner
    assert chosen.accel_mm_s2 <= limits.max_accel_mm_s2
    assert chosen.speed_mm_s * 0.0814 <= SETTINGS.max_flow_mm3_s
    drives = tower_program(machine, "x", SETTINGS, 5)[1]
    accels = [d.accel_mm_s2 for d in drives]
    speeds = [d.speed_mm_s for d in drives]
    assert accels == sorted(set(accels))
    assert speeds == sorted(speeds)
    assert accels[-1] <= limits.max_accel_mm_s2


def test_ripples_are_two_to_six_mm_where_the_hotend_allows_it():
    machine = load_machine("generic-bedslinger")
    _, chosen = coupon_program(machine, SETTINGS)
    for axis in ("x", "y"):
        assert 2 <= chosen.speed_mm_s / ringing_mode(machine.axes[axis].nominal).f_hz <= 6


def test_ringing_of_a_mode_against_simulation():
    spec = ModesSpec(modes=(Mode(f_hz=40, zeta=0.05),))
    speed, accel = 80.0, 3000.0
    t = np.arange(4000) * 1e-4
    brake = speed / accel
    u = np.where(t < brake, speed * t - 0.5 * accel * t**2, 0.5 * speed**2 / accel)
    # Before it the axis has moved for long.
    run_up = np.linspace(-speed, 0, 10001)[:-1]
    whole = np.concatenate([run_up, u])[None]
    y = response([discretise(spec, 1e-4)], whole)[0]
    after = y[len(run_up) + round(brake * 1e4) :] - u[-1]
    mode = ringing_mode(spec)
    assert mode.f_hz == pytest.approx(40)
    assert mode.zeta == pytest.approx(0.05)
    expected = mode.ringing_um(speed, accel)
    assert 1e3 * np.abs(after).max() == pytest.approx(expected, rel=0.15)
    # Braking for one whole period leaves what damping took of the first step.
    assert mode.ringing_um(accel / 40, accel) < 0.3 * mode.um_per_mm_s2 * accel


def test_too_small_a_bed_is_refused_with_the_reason():
    machine = load_machine("ender3")
    small = machine.model_copy(
        update={"travel": {**machine.travel, "x": AxisTravel(min_mm=0, max_mm=80)}}
    )
    with pytest.raises(ModelError, match=r"coupon is 74 x 50 mm.*travel of x \(0 to 80 mm\)"):
        coupon_program(small, SETTINGS)
    with pytest.raises(ModelError, match="around x = 20 mm"):
        coupon_program(machine, PrintSettings(centre_mm=(20.0, 100.0)))
    with pytest.raises(ModelError, match="around x = nan mm"):
        coupon_program(machine, PrintSettings(centre_mm=(math.nan, 100.0)))
    with pytest.raises(ModelError, match="nozzle temperature 20 is outside 150 to 350"):
        coupon_program(machine, PrintSettings(nozzle_temp_c=20))
    with pytest.raises(ModelError, match="13 bands"):
        tower_program(machine, "x", SETTINGS, 13)


def with_extruder(nozzle_mm: float) -> Machine:
    document = load_machine("ender3").model_dump(mode="json")
    document["firmware"]["extruder"]["nozzle_diameter_mm"] = nozzle_mm
    return Machine.model_validate(document)


@pytest.mark.parametrize("nozzle_mm", [0.25, 0.8])
def test_nothing_is_printed_faster_than_the_hotend_melts(nozzle_mm):
    machine = with_extruder(nozzle_mm)
    program, _ = coupon_program(machine, PrintSettings(max_flow_mm3_s=9.0))
    moves, *_ = moves_of(program.text().encode(), machine)
    travel = moves.end_mm - moves.start_mm
    way = np.hypot(travel[:, 0], travel[:, 1])
    prints = (way > 0.1) & (travel[:, 3] > 0)
    mm3_per_mm = 0.25 * math.pi * 1.75**2 * travel[prints, 3] / way[prints]
    assert np.max(mm3_per_mm * moves.speed_mm_s[prints]) <= 9.0 * 1.01
    with pytest.raises(ModelError, match="take a finer nozzle"):
        coupon_program(with_extruder(1.2), PrintSettings(max_flow_mm3_s=4.0))


def test_a_tower_above_the_travel_is_refused():
    machine = load_machine("ender3")
    low = machine.model_copy(
        update={"travel": {**machine.travel, "z": AxisTravel(min_mm=0, max_mm=40)}}
    )
    with pytest.raises(ModelError, match=r"z = 40.2\d mm and the travel of z ends at 40 mm"):
        tower_program(low, "x", SETTINGS, 12)
    tower_program(low, "x", SETTINGS, 6)


def test_own_lines_at_start_and_end_and_the_shaper_put_back():
    machine = load_machine("ender3")
    shaper = FirmwareShaper(type_x="mzv", freq_x_hz=45, type_y="ei", freq_y_hz=32)
    machine = machine.model_copy(
        update={"firmware": machine.firmware.model_copy(update={"shaper": shaper})}
    )
    settings = PrintSettings(start_gcode="START_PRINT BED=60\n", end_gcode="END_PRINT\n")
    lines = text_of("coupon", machine, settings).splitlines()
    assert lines[0] == "START_PRINT BED=60"
    assert lines[-1] == "END_PRINT"
    assert not any(line.startswith(("G28", "M109")) for line in lines)
    back = next(line for line in lines if "SHAPER_FREQ_X=45" in line)
    assert lines.index(back) > len(lines) - 5
    default = text_of("coupon", load_machine("ender3")).splitlines()
    assert default[:5] == ["M140 S60", "M104 S210", "G28", "M190 S60", "M109 S210"]
    assert "M104 S0" in default[-6:]
    assert "M140 S0" in default[-6:]


def test_own_lines_may_begin_with_a_byte_order_mark(tmp_path):
    (tmp_path / "start.gcode").write_text("\ufeffSTART_PRINT\n", encoding="utf-8")
    assert PrintOptions(start_gcode=tmp_path / "start.gcode").chosen().start_gcode == (
        "START_PRINT\n"
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", COUPONS)
def test_the_compensated_half_of_the_coupon_is_three_times_nearer(name, coupon_of):
    machine = load_machine(name)
    planned = moves_of(text_of("coupon", machine).encode(), machine)[0]
    file, made = coupon_of(name)
    data = file.read_bytes()
    assert data.startswith(b"; Coupon for ")
    written, _, last = moves_of(data, machine)
    assert written.end_mm[-1] == pytest.approx(planned.end_mm[-1], abs=1e-3)
    assert last.accel_mm_s2 == machine.firmware.planner.max_accel_mm_s2
    assert last.square_corner_velocity_mm_s == pytest.approx(
        machine.firmware.planner.square_corner_velocity_mm_s
    )
    before, after = made.ringing["as planned"], made.ringing["compensated"]
    assert made.result.put_back == []
    assert after.rms_um <= before.rms_um / 3
    # Half of it is as planned on purpose, and it sets the shaper itself.
    for words in ("is not compensated", "would serve this file better", "The file sets"):
        assert not any(words in warning for warning in made.warnings), made.warnings
    with pytest.raises(ValueError, match="already processed"):
        compensate_file(file, file.with_name("again.gcode"), machine, Options())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "axis"),
    [(name, "xy"[k % 2]) for k, name in enumerate(builtin_machines()) if name not in COUPONS],
)
def test_every_band_of_the_tower_is_three_times_nearer(name, axis, tmp_path, cache):
    machine = load_machine(name)
    made = write_tower(machine, axis, tmp_path / "t.gcode", count=3, cache_dir=cache)
    moves_of((tmp_path / "t.gcode").read_bytes(), machine)
    assert len(made.bands) == 3
    assert made.written.result.put_back == []
    for band in made.bands:
        assert band.after.rms_um <= band.before.rms_um / 3
    rms = [band.before.rms_um for band in made.bands]
    assert rms == sorted(rms)
    assert f"{made.bands[-1].accel_mm_s2:g}" in made.written.legend[-2]


@pytest.mark.slow
def test_the_command_line(tmp_path, capsys):
    out = tmp_path / "coupon.gcode"
    assert run(["coupon", "-m", "generic-corexy", "-o", str(out), "--at", "100,90"]) == 0
    assert "compensated:" in capsys.readouterr().out
    assert out.stat().st_size > 100_000
    assert run(["tower", "-m", "ender3", "--axis", "z", "-o", str(out)]) == 2
    for place in ("7", "nan,nan", "inf,7"):
        assert run(["coupon", "-m", "ender3", "-o", str(out), "--at", place]) == 2
    assert run(["verify", str(out), str(tmp_path / "none.csv"), "-m", "ender3"]) == 2
