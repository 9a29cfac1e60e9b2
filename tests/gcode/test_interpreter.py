from __future__ import annotations

import weakref

import numpy as np
import pytest

from stillpath.gcode.errors import GcodeError
from stillpath.gcode.firmware.registry import adapter
from stillpath.gcode.interpreter import Interpreter
from stillpath.gcode.types import EventKind, ProgramBlock
from stillpath.models.firmware.klipper import Extruder, PlannerLimits
from stillpath.models.machine import Machine
from tests.gcode.cutting import blocks_of


def run(text: str, machine: Machine) -> ProgramBlock:
    """The one block of a small program."""
    (block,) = blocks_of(text.encode(), machine)
    return block


def ends(block: ProgramBlock) -> list[list[float]]:
    return block.moves.end_mm.round(9).tolist()


def kinds(block: ProgramBlock) -> list[EventKind]:
    return [EventKind(kind) for kind in block.events.kind]


def test_words_in_every_spelling(golden_machine: Machine) -> None:
    block = run(
        "G28\nM83\ng1x10y5f3000\nG1X20.Y.5E.02\nG1 X+21 Y-0.0\n  \tG1\tX27\tY8\tE.1   \r\n"
        "G1 X92 X93 ; X5\nN4G1X83Y80\nN1 G1 X81 Y80 E.1*83\nG1 X1.5E1\n"
        "G1 X94.123456789012345678\nG0 X1e-2\n",
        golden_machine,
    )
    assert ends(block) == [
        [10, 5, 0, 0],
        [20, 0.5, 0, 0.02],
        [21, 0, 0, 0.02],
        [27, 8, 0, 0.12],
        [93, 8, 0, 0.12],
        [83, 80, 0, 0.12],
        [81, 80, 0, 0.22],
        [1.5, 80, 0, 1.22],
        [94.123456789, 80, 0, 1.22],
        [1, 80, 0, -0.78],
    ]
    assert block.moves.line.tolist() == list(range(3, 13))
    assert block.moves.speed_mm_s.tolist() == [50.0] * 10


def test_modes_and_origins(golden_machine: Machine) -> None:
    block = run(
        "G28\nG1 X10 E5\nG92 X0 E0\nG1 X10 E1\nG91\nG1 X1 E1\nG90\nG1 X0 E3\nM83\nG1 E1\nM82\n"
        "G92\nG1 X1 E1\n",
        golden_machine,
    )
    x_and_e = [[row[0], row[3]] for row in ends(block)]
    assert x_and_e == [[10, 5], [20, 6], [21, 7], [10, 8], [10, 9], [11, 10]]
    modal = [block.modal[k] for k in block.moves.modal_id]
    assert [m.absolute_xyz for m in modal] == [True, True, False, True, True, True]
    assert [m.absolute_e for m in modal] == [True, True, True, True, False, True]


def test_m220_and_m221_scale_speed_and_filament(golden_machine: Machine) -> None:
    block = run(
        "G28\nG1 X10 E10 F6000\nM221 S50\nG1 X20 E12\nM220 S50\nG1 X30\nG1 X40 F3000\nM220\n"
        "G1 X50\nM221\nG1 X60 E13\n",
        golden_machine,
    )
    assert block.moves.end_mm[:, 3].tolist() == [10, 11, 11, 11, 11, 12]
    assert block.moves.speed_mm_s == pytest.approx([100, 100, 50, 25, 50, 50])
    assert block.modal[block.moves.modal_id[3]].speed_factor == pytest.approx(0.5)


def test_klipper_limits_follow_the_file(golden_machine: Machine) -> None:
    block = run(
        "M204 S1000\nM204 P800 T1500 R9\nM204 P700\n"
        "set_velocity_limit velocity=250 ACCEL=4000 ACCEL_TO_DECEL=2000 ; x\n"
        'SET_VELOCITY_LIMIT SQUARE_CORNER_VELOCITY="8" MINIMUM_CRUISE_RATIO=0\n',
        golden_machine,
    )
    assert kinds(block) == [EventKind.LIMITS] * 5
    after = [block.limits[k] for k in block.events.limits_id]
    assert [limit.accel_mm_s2 for limit in after] == [1000, 800, 800, 4000, 4000]
    assert after[-1].velocity_mm_s == 250
    assert after[-1].square_corner_velocity_mm_s == 8
    assert after[-1].minimum_cruise_ratio == 0


def test_limits_of_klipper_before_the_cruise_ratio(golden_machine: Machine) -> None:
    """Its max_accel_to_decel does not follow ACCEL, and what we write back is for both ages."""
    firmware = golden_machine.firmware
    assert firmware.kind == "klipper"
    planner = firmware.planner.model_copy(update={"max_accel_to_decel_mm_s2": 2500.0})
    firmware = firmware.model_copy(update={"planner": planner})
    machine = golden_machine.model_copy(update={"firmware": firmware})
    block = run(
        "M204 S1000\nSET_VELOCITY_LIMIT ACCEL=4000 ACCEL_TO_DECEL=2000\n"
        "SET_VELOCITY_LIMIT ACCEL=3000 MINIMUM_CRUISE_RATIO=0\n",
        machine,
    )
    after = [block.limits[k] for k in block.events.limits_id]
    assert [limit.accel_to_decel_mm_s2 for limit in after] == [2500, 2000, 2000]
    ratio = planner.minimum_cruise_ratio
    assert [limit.minimum_cruise_ratio for limit in after] == [ratio] * 3
    back = adapter(machine).stream_commands().limits(after[-1]).decode()
    assert " ACCEL=3000 ACCEL_TO_DECEL=2000 " in back
    assert back.endswith(f"MINIMUM_CRUISE_RATIO={ratio:g}\n")


def test_limits_that_a_firmware_caps(golden_machine: Machine) -> None:
    """Speed and acceleration stop at the configuration's, as on the Centauri Carbon."""
    capped = golden_machine.firmware.model_copy(update={"limits_capped": True})
    machine = golden_machine.model_copy(update={"firmware": capped})
    most = capped.planner  # type: ignore[union-attr]
    line = "SET_VELOCITY_LIMIT VELOCITY=90000 ACCEL=90000 SQUARE_CORNER_VELOCITY=90\n"
    block = run(f"M204 S90000\n{line}M204 S70\n{line}", machine)
    after = [block.limits[k] for k in block.events.limits_id]
    assert [one.accel_mm_s2 for one in after] == [most.max_accel_mm_s2] * 2 + [
        70,
        most.max_accel_mm_s2,
    ]
    assert after[-1].velocity_mm_s == most.max_velocity_mm_s
    assert after[-1].square_corner_velocity_mm_s == 90


def test_limits_of_remembered_lines(golden_machine: Machine) -> None:
    """A line that comes again sets what it set the first time, whatever was in force before it."""
    accels = [800, 4000, 800, 800, 1500, 4000, 800, 1500, 800]
    velocities = [100, 100, 200, 100, 200, 200, 100, 100, 200]

    def limits_of(numbered: bool) -> list[tuple[list[object], list[object]]]:
        lines = ["G28", "G1 X1 Y1 Z1 F600"]
        for k, (accel, velocity) in enumerate(zip(accels, velocities, strict=True)):
            note = f" ; {k}" if numbered else ""  # such a line has never been seen before
            lines += [f"M204 S{accel}{note}", f"SET_VELOCITY_LIMIT VELOCITY={velocity}{note}"]
            lines += [";TYPE:Perimeter", f"G1 X{k + 2}"] * (k % 3 > 0)
        blocks = blocks_of("\n".join(lines).encode(), golden_machine)
        return [
            ([b.limits[n] for n in b.moves.limits_id], [b.limits[n] for n in b.events.limits_id])
            for b in blocks
        ]

    assert limits_of(numbered=False) == limits_of(numbered=True)


def test_quarter_arc_and_circle(golden_machine: Machine) -> None:
    block = run("G28\nG1 X10\nM83\nG3 X0 Y10 Z1 I-10 J0 E2\n", golden_machine)
    arc = block.moves.end_mm[1:]
    n = int(np.hypot(5 * np.pi, 1.0) / 0.1)
    assert len(arc) == n
    assert np.hypot(arc[:, 0], arc[:, 1]) == pytest.approx(np.full(n, 10.0))
    assert arc[-1].tolist()[:3] == [0, 10, 1]
    assert arc[-1, 3] == pytest.approx(2)
    assert np.diff(arc[:, 2]) == pytest.approx(np.full(n - 1, 1 / n))
    assert set(block.moves.line[1:].tolist()) == {4}
    circle = run("G28\nG1 X10\nG2 I-10 J0\n", golden_machine).moves.end_mm[1:]
    assert len(circle) == 628
    assert circle[0, 1] < 0  # clockwise
    assert circle[-1].tolist() == [10, 0, 0, 0]
    upright = run("G28\nG18\nG2 X20 I10 K0\n", golden_machine).moves.end_mm
    assert np.all(upright[:, 1] == 0)
    assert np.abs(upright[:, 2]).max() == pytest.approx(10, abs=0.01)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("G20", "inches"),
        ("G1 X1..2", "not a number"),
        ("G1 X1 E1:2", "not a number"),
        ("G1 X", "not a number"),
        ("G1 X5 F0", "feedrate"),
        ("G1 X1001", "X 1001.000 mm lies outside.*1000.000"),
        ("G1 X" + "9" * 400, "out of range"),
        ("G2 X5 Y5 R5", "R"),
        ("G2 X5 Y5", "centre"),
        ("G91\nG2 X5 I5", "G90"),
        ("G2 X5 I100000000", "pieces"),
        ("M220 S0", "above 0"),
        ("G4 P-5", "value -5 is .*P of G4"),
        ("RESTORE_GCODE_STATE NAME=none", "SAVE_GCODE_STATE"),
        (
            "\n".join(f"SAVE_GCODE_STATE NAME={max(0, k)}" for k in range(-9, 1001)),
            "more than 1000 names; use a name again",
        ),
        ("SET_VELOCITY_LIMIT ACCEL=0", "above 0"),
        ("SET_VELOCITY_LIMIT ACCEL=nan", "out of range"),
        ('SET_VELOCITY_LIMIT ACCEL="5', "quote"),
        ("SET_VELOCITY_LIMIT ACCEL", "KEY=VALUE"),
    ],
)
def test_lines_that_klipper_would_not_execute_are_refused(
    line: str, words: str, golden_machine: Machine
) -> None:
    with pytest.raises(GcodeError, match=words) as caught:
        run(f"G28\n{line}\n", golden_machine)
    assert caught.value.line == 2 + line.count("\n")
    assert caught.value.text


@pytest.mark.parametrize("macro", ["MY_MACRO", "T1"])
def test_a_state_that_a_macro_may_have_saved(macro: str, wary_machine: Machine) -> None:
    """It may have another origin; what is known is so again after homing."""
    moves = "G1 X5 Y5 Z5 F600\nG1 X6\n"
    text = f"G28\n{macro}\n{moves}RESTORE_GCODE_STATE NAME=s MOVE=1\n{moves}G28\n{moves}"
    interpreter = Interpreter(wary_machine)
    (block,) = interpreter.push(text.encode())
    assert block.moves.known.tolist() == [0, 7, 0, 0, 0, 7]
    assert kinds(block) == [EventKind.UNKNOWN] * 4
    (warning,) = interpreter.warnings
    assert warning.startswith("line 5: RESTORE_GCODE_STATE NAME=s: a macro may have saved it")


def test_bounds_only_where_known(wary_machine: Machine) -> None:
    run("G91\nG1 X5000\n", wary_machine)
    with pytest.raises(GcodeError, match="X 5000"):
        run("G1 X5000\n", wary_machine)
    (block,) = blocks_of(b"G1 X5000\n", wary_machine, strict_bounds=False)
    assert len(block.moves) == 1


def test_axes_are_known_until_a_macro_may_have_moved_them(wary_machine: Machine) -> None:
    block = run(
        "G28\nG1 X5\nG1 X6 Y5\nG1 X7 Y6\nSTART_PRINT A=1\nG91\nG1 X1\nG90\nG1 X1\nG1 X2\n"
        "G28 X\nG1 X0 Y0\n",
        wary_machine,
    )
    assert block.moves.known.tolist() == [0, 1, 3, 0, 0, 1, 0]
    assert kinds(block)[:2] == [EventKind.UNKNOWN, EventKind.UNKNOWN]
    # A probe is taken to the middle of the bed; macros of X and Y lift Z.
    facts = {"firmware": wary_machine.firmware.model_copy(update={"home_mm": (0.0, 0.0, 0.0)})}
    homed = wary_machine.model_copy(update=facts)
    block = run("G28\nG1 X5\nG28 Z\nG1 X6\nG1 X7 Y7\nG28 X\nG1 X1\nG1 Y1\nG1 Z1\n", homed)
    assert block.moves.known.tolist() == [7, 4, 5, 1, 1, 3]
    # A named axis whose place we do not know may move, though we guess it stands there.
    assert kinds(run("G28\nG1 X0\nG1 X0\n", wary_machine))[1:] == [
        EventKind.UNKNOWN,
        EventKind.MODE,
    ]


def test_lines_are_harmless_stops_or_unknown(wary_machine: Machine) -> None:
    expected = {
        "; comment": EventKind.HARMLESS,
        "": EventKind.HARMLESS,
        "M106 S255": EventKind.HARMLESS,
        "M104 S200": EventKind.HARMLESS,
        "SET_PRESSURE_ADVANCE ADVANCE=0.05": EventKind.STOP,
        "SET_PRESSURE_ADVANCE ADVANCE=0.06": EventKind.HARMLESS,
        "M117 G1 X500 Y500 ; not a move": EventKind.HARMLESS,
        "M117 100% done (really)": EventKind.HARMLESS,
        'RESPOND MSG="G1 X1; quoted"': EventKind.HARMLESS,
        'M862.3 P "MK3S"': EventKind.HARMLESS,
        "(full line comment G1 X5)": EventKind.HARMLESS,
        "/G1 X1 Y1": EventKind.HARMLESS,
        "G1(inline comment X99)X26": EventKind.HARMLESS,
        "M205 X8": EventKind.HARMLESS,
        "G1 F1800": EventKind.MODE,
        "G21": EventKind.HARMLESS,
        "M400": EventKind.STOP,
        "M119": EventKind.STOP,
        "QUERY_ENDSTOPS": EventKind.STOP,
        "SET_SERVO SERVO=brush ANGLE=30": EventKind.STOP,
        "M109 S200": EventKind.STOP,
        "TEMPERATURE_WAIT SENSOR=extruder MINIMUM=5": EventKind.STOP,
        "G4 P200": EventKind.STOP,
        "T0": EventKind.UNKNOWN,
        "M600": EventKind.UNKNOWN,
        "G29": EventKind.UNKNOWN,
        "PAUSE": EventKind.UNKNOWN,
        "MY_MACRO X=5": EventKind.UNKNOWN,
        "M84": EventKind.UNKNOWN,
        "SET_INPUT_SHAPER SHAPER_FREQ_X=0": EventKind.SHAPER,
        "EXCLUDE_OBJECT_START NAME=a": EventKind.OBJECT,
        "EXCLUDE_OBJECT_DEFINE NAME=a": EventKind.HARMLESS,
        "M486 S-1": EventKind.OBJECT,
        "; Processed by stillpath 1.0": EventKind.STAMP,
        "; stillpath: report": EventKind.STAMP,
    }
    block = run("\n".join(expected) + "\n", wary_machine)
    assert dict(zip(expected, kinds(block), strict=True)) == expected
    # The dwell, and how far pressure advance looks ahead: after none, and twice for the shaper.
    assert block.events.dwell_s.sum() == pytest.approx(0.2 + 0.021 + 0.04)


@pytest.mark.parametrize("smooth_s", [0.02, 0.04])
def test_klipper_stands_for_the_stated_smooth_time(golden_machine: Machine, smooth_s: float):
    """Creality's have 0.02, and a file that adapts pressure advance stops thousands of times."""
    extruder = Extruder(pressure_advance_smooth_time_s=smooth_s)
    facts = {"extruder": extruder, "stopping_macros": ("SET_PRESSURE_ADVANCE",)}
    firmware = golden_machine.firmware.model_copy(update=facts)
    machine = golden_machine.model_copy(update={"firmware": firmware, "pressure_advance_s": 0.05})
    for line, dwell_s in (("ADVANCE=.06", smooth_s), ("SMOOTH_TIME=.1", 0.5 * smooth_s + 0.05)):
        block = run(f"G1 X5 F600\nSET_PRESSURE_ADVANCE {line}\nG1 X9\n", machine)
        assert block.events.dwell_s.sum() == pytest.approx(dwell_s)


@pytest.mark.parametrize(
    ("between", "dwell_s"), [("", 0.04), ("G4 P100\n", 0.14), ("G1 E-1\nG1 E1\n", 0.08)]
)
def test_klipper_flushes_once_at_a_rest(golden_machine: Machine, between: str, dwell_s: float):
    machine = golden_machine.model_copy(update={"pressure_advance_s": 0.05})
    lines = ("SET_INPUT_SHAPER SHAPER_FREQ_X=40\n", "SET_INPUT_SHAPER SHAPER_FREQ_Y=40\n")
    block = run(f"M83\nG1 X5 F600\n{between.join(lines)}G1 X9\n", machine)
    assert block.events.dwell_s.sum() == pytest.approx(dwell_s)


@pytest.mark.parametrize("to_decel_mm_s2", [None, 1000.0])
def test_a_newer_klipper_looks_ahead_as_before_the_first(
    golden_machine: Machine, to_decel_mm_s2: float | None
):
    """Its motion queuing knows how far it has to flush from the last move alone."""
    planner = golden_machine.firmware.planner.model_copy(
        update={"max_accel_to_decel_mm_s2": to_decel_mm_s2}
    )
    firmware = golden_machine.firmware.model_copy(update={"planner": planner})
    update = {"firmware": firmware, "pressure_advance_s": 0.0}
    machine = golden_machine.model_copy(update=update)
    stands = {}
    for kinds in (("60",), ("20",), ("60", "20")):
        lines = "".join(f"SET_INPUT_SHAPER SHAPER_TYPE=zv SHAPER_FREQ_X={f}\n" for f in kinds)
        stands[kinds] = float(run(f"G1 X5 F600\n{lines}G1 X9\n", machine).events.dwell_s.sum())
    before_s = 1e-3 if to_decel_mm_s2 is None else stands["60",] - 1e-3
    assert stands["60", "20"] == pytest.approx(before_s + stands["20",] - 1e-3)


def test_a_shaper_with_much_damping_makes_klipper_stand_longer(golden_machine: Machine) -> None:
    """ZV: the second pulse comes half a damped period later, and the middle lies nearer to it."""
    machine = golden_machine.model_copy(update={"pressure_advance_s": 0.0})
    stands = {}
    for damping in (0.05, 0.1, 0.3):
        line = f"SET_INPUT_SHAPER SHAPER_TYPE=zv SHAPER_FREQ_X=40 DAMPING_RATIO_X={damping}\n"
        stands[damping] = float(run(line, machine).events.dwell_s[0])
        bent = np.sqrt(1.0 - damping**2)
        ahead_s = 0.5 / 40.0 / bent / (1.0 + np.exp(-np.pi * damping / bent))
        assert stands[damping] == pytest.approx(1e-3 + ahead_s, abs=1e-9)
    assert stands[0.3] - stands[0.05] > 1.5e-3


@pytest.mark.parametrize(
    ("line", "dwell_s"),
    [
        ("ADVANCE=0", 0.021),
        ("ADVANCE=.07", None),
        ("ADVANCE=.05 SMOOTH_TIME=.04 EXTRUDER=extruder", None),
        ("SMOOTH_TIME=.1", 0.07),
        ("SMOOTH_TIME=0", 0.021),
        ("ADVANCE=.05 EXTRUDER=extruder1", None),
        ("SMOOTH_TIME=.1 EXTRUDER=extruder1", 0.07),
        # Nothing changes for the extruder in use, which looks ahead as before.
        ("ADVANCE=0 EXTRUDER=extruder1", 0.04),
        ("ADVANCE=0 EXTRUDER=my_stepper", 0.04),
    ],
)
def test_klipper_stands_where_pressure_advance_averages_over_another_time(
    line: str, dwell_s: float | None, golden_machine: Machine
) -> None:
    machine = golden_machine.model_copy(update={"pressure_advance_s": 0.05})
    block = run(f"SET_PRESSURE_ADVANCE {line}\n" * 2, machine)
    again = line.endswith("my_stepper")
    stop, harmless = EventKind.STOP, EventKind.HARMLESS
    assert kinds(block) == [harmless if dwell_s is None else stop, stop if again else harmless]
    assert block.events.dwell_s[0] == pytest.approx(dwell_s or 0.0)


@pytest.mark.parametrize(
    "told",
    [
        {"stopping_macros": ("set_pressure_advance",)},
        {"planner": PlannerLimits(max_accel_to_decel_mm_s2=1500.0)},
    ],
)
def test_older_klippers_stand_at_every_pressure_advance(
    told: dict[str, object], golden_machine: Machine
) -> None:
    firmware = golden_machine.firmware.model_copy(update=told)
    facts = {"firmware": firmware, "pressure_advance_s": 0.05}
    block = run("SET_PRESSURE_ADVANCE ADVANCE=.07\n", golden_machine.model_copy(update=facts))
    assert kinds(block) == [EventKind.STOP]
    assert block.events.dwell_s[0] == pytest.approx(0.04)


def test_a_pressure_advance_that_may_stop_a_stream_is_told(golden_machine: Machine) -> None:
    """Adaptive pressure advance changes it between the lines of a print."""
    told = {"stopping_macros": ("SET_PRESSURE_ADVANCE",)}
    older = golden_machine.firmware.model_copy(update=told)
    text = "SET_PRESSURE_ADVANCE ADVANCE=.0{}\n"
    print_ = f"{text.format(5)}G28\nG1 X5 Y5 F600\n{text.format(4)}"

    def told_of(written: str, **facts: object) -> bool:
        update = {"pressure_advance_s": 0.05, **facts}
        reader = Interpreter(golden_machine.model_copy(update=update))
        reader.push(written.encode())
        return any("stopping_macros" in warning for warning in reader.warnings)

    assert told_of(print_)
    assert not told_of(print_, firmware=older)
    # Where the printer stands anyway, or the slicer sets it once.
    assert not told_of(print_.replace("G1 X5 Y5 F600", "T1"))
    assert not told_of(print_.replace(text.format(5), ""))


def test_macros_that_the_machine_declares(wary_machine: Machine) -> None:
    firmware = wary_machine.firmware.model_copy(
        update={
            "harmless_macros": ("_on_layer",),
            "stopping_macros": ("CLEAN", "M600"),
            "macros": ("M900", "M300", "M106"),  # not Klipper's own commands
        }
    )
    machine = wary_machine.model_copy(update={"firmware": firmware})
    block = run("_ON_LAYER LAYER=1\nCLEAN\nm600\nOTHER\nM900 K5\nM300\nM205 X8\nM106\n", machine)
    harmless, stop, unknown = EventKind.HARMLESS, EventKind.STOP, EventKind.UNKNOWN
    assert kinds(block) == [harmless, stop, stop, *3 * [unknown], harmless, harmless]


def test_a_printer_without_macros_still_has_klippers_own_commands(golden_machine: Machine) -> None:
    firmware = golden_machine.firmware.model_copy(update={"unknown_commands": "skip"})
    machine = golden_machine.model_copy(update={"firmware": firmware})
    block = run("START_PRINT\nPAUSE\nM25\nSET_TMC_CURRENT STEPPER=stepper_x CURRENT=1\n", machine)
    assert kinds(block) == [EventKind.HARMLESS, *[EventKind.UNKNOWN] * 3]


def test_firmware_retraction(golden_machine: Machine) -> None:
    block = run("G28\nG1 X5 E1 F6000\nG10\nG10\nG1 X6\nG11\nG1 X7 E2\n", golden_machine)
    assert block.moves.end_mm[:, 3] == pytest.approx([1, 0.2, 0.2, 1, 2])
    assert block.moves.speed_mm_s == pytest.approx([100, 35, 100, 35, 100])
    assert block.moves.known.tolist() == [7, 0, 7, 0, 7]


@pytest.mark.parametrize("macro", ["START", "PAUSE", "START\nPAUSE\nSTART"])
def test_behind_a_macro_filament_may_be_retracted(macro: str, golden_machine: Machine) -> None:
    """So a stream rests there: G11 would stop it in motion."""
    told = golden_machine.firmware.model_copy(update={"unknown_commands": "unknown"})
    machine = golden_machine.model_copy(update={"firmware": told})
    block = run(f"G11\nG28\nG11\n{macro}\nG1 X5 F6000\nG11\nG1 X6\nG11\nG1 X7\n", machine)
    assert block.moves.end_mm[:, 0].tolist() == [5.0, 5.0, 6.0, 7.0]
    assert block.moves.end_mm[1, 3] - block.moves.end_mm[0, 3] == pytest.approx(0.8)
    assert kinds(block)[:: len(block.events) - 1] == [EventKind.MODE] * 2


def test_states_and_offsets(golden_machine: Machine) -> None:
    block = run(
        "G28\nG1 X5 Y5 E1 F6000\nSAVE_GCODE_STATE NAME=a\nG91\nG1 X5 E2 F60\n"
        "RESTORE_GCODE_STATE NAME=a MOVE=1 MOVE_SPEED=7\nG1 X6 E2\n"
        "SET_GCODE_OFFSET Z_ADJUST=0.05 MOVE=1\nSET_GCODE_OFFSET X=1\nG1 X6\n",
        golden_machine,
    )
    assert ends(block)[1:] == [
        [10, 5, 0, 3],
        [5, 5, 0, 3],
        [6, 5, 0, 4],
        [6, 5, 0.05, 4],
        [7, 5, 0.05, 4],
    ]
    assert block.moves.speed_mm_s.tolist() == pytest.approx([100, 1, 7, 100, 100, 100])


def test_moves_carry_layer_feature_and_object_of_the_marks(golden_machine: Machine) -> None:
    text = (
        "G28\n;LAYER_CHANGE\n;Z:.3\n;TYPE:Perimeter\n; printing object A id:0 copy 0\nG1 X1\n"
        "; stop printing object A id:0 copy 0\n;TYPE:Infill\nG1 X2\n;LAYER_CHANGE\n;Z:.5\n"
        ";TYPE:Perimeter\nG1 X3\n;LAYER_CHANGE\nG1 X4\nEXCLUDE_OBJECT_START NAME='b c'\nG1 X5\n"
    )
    interpreter = Interpreter(golden_machine)
    (block,) = interpreter.push(text.encode())
    assert block.moves.layer.tolist() == [0, 0, 1, 2, 2]
    assert [interpreter.feature_names[k] for k in block.moves.feature] == [
        "Perimeter",
        "Infill",
        *["Perimeter"] * 3,
    ]
    assert block.moves.object_id.tolist() == [0, -1, -1, -1, 1]
    assert kinds(block).count(EventKind.OBJECT) == 1
    assert interpreter.state.objects.names == ["A id:0 copy 0", "B C"]
    assert interpreter.state.tables.layer_z[:2].tolist() == [0.3, 0.5]


@pytest.mark.parametrize(
    ("layer", "feature"),
    [
        ("N7 ; CHANGE_LAYER", "N8 ; FEATURE: Outer wall"),
        ("; BEGIN_LAYER_OBJECT z=0.3", "; 'Perimeter Path', 1.2 [feed mm/s]"),
        (";; --- layer 0 (0.3) ---", "; feature wall"),
    ],
)
def test_marks_of_slicers(layer: str, feature: str, golden_machine: Machine) -> None:
    block = run(f"G28\n{layer}\n{feature}\nG1 X1\n", golden_machine)
    assert (block.moves.layer.tolist(), block.moves.feature.tolist()) == ([0], [0])


def test_bom_and_line_ends(golden_machine: Machine) -> None:
    data = b"\xef\xbb\xbfG91\r\nG1 X1\nG1 X1\r\nG1 X1"
    (first,), (last,) = (lambda i: (i.push(data), i.flush()))(Interpreter(golden_machine))
    assert first.text + last.text == data
    assert last.moves.end_mm[0, 0] == 3
    assert (last.moves.byte_start[0], last.moves.byte_end[0]) == (len(data) - 5, len(data))


def test_a_snapshot_is_gone_with_its_last_user(golden_machine: Machine) -> None:
    """Each has buffers; a file is read with one a line in tests, one a piece otherwise."""
    reader = Interpreter(golden_machine)
    reader.push(b"G28\nG1 X1 F600\n")
    other = reader.snapshot()
    other.push(b"G1 X2\n")
    with pytest.raises(GcodeError):
        other.push(b"G1 X1 F0\n")
    gone = weakref.ref(other)
    del other
    assert gone() is None


@pytest.mark.parametrize("encoding", ["utf-16-le", "utf-16-be"])
def test_utf_16_is_named(encoding: str, golden_machine: Machine) -> None:
    with pytest.raises(GcodeError, match="UTF-16"):
        Interpreter(golden_machine).push("\ufeffG28\nG1 X5\n".encode(encoding))


def test_origin_set_from_a_guess_stays_a_guess(wary_machine: Machine) -> None:
    block = run("START_PRINT\nG92 X0\nG1 X5\nG1 X6\nG28\nG1 X5\nG1 X7 F600\n", wary_machine)
    assert block.moves.known.tolist() == [0, 0, 0, 1]


def test_g92_and_offsets_move_the_origin(golden_machine: Machine) -> None:
    block = run(
        "G28\nG1 X10\nG92 X0\nG1 X1\nSET_GCODE_OFFSET Z=0.2\nG1 X2 Z1\nG28\nG1 X2\n",
        golden_machine,
    )
    origins = [block.modal[k].origin_mm for k in block.moves.modal_id]
    assert origins == [(0, 0, 0), (10, 0, 0), (10, 0, 0.2), (0, 0, 0.2)]
    assert ends(block)[2:] == [[12, 0, 1.2, 0], [2, 0, 0, 0]]


@pytest.mark.parametrize(
    ("end", "told"),
    [("G1 X115 Y1", True), ("G1 X1\nM84", False), ("G1 X1\n; end", False), ("G1 X1\n", False)],
)
def test_a_file_that_may_have_been_cut_off_is_told(
    golden_machine: Machine, end: str, told: bool
) -> None:
    reader = Interpreter(golden_machine)
    for chunk in ("G28\nG1 X5 F600\n", end[:4], end[4:]):
        reader.push(chunk.encode())
    reader.flush()
    said = [warning for warning in reader.warnings if "may have been cut off" in warning]
    assert len(said) == told
    assert not told or said[0].startswith("line 3: the file ends with a move")
