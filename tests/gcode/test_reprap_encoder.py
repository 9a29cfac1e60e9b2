"""RepRapFirmware's encoder, read back with its planner, and its words with its interpreter."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stillpath.gcode.firmware._encoding_kernels import MoveLimits
from stillpath.gcode.firmware.encoding import as_moves
from stillpath.gcode.firmware.planning import join_phases
from stillpath.gcode.firmware.registry import adapter
from stillpath.gcode.firmware.reprapfirmware._encoder_kernels import assign_speeds, keep_apart
from stillpath.gcode.firmware.reprapfirmware.encoder import stream_limits
from stillpath.gcode.firmware.reprapfirmware.limits import RepRapLimits
from stillpath.gcode.firmware.reprapfirmware.planner import RepRapPlanner, on_steps
from stillpath.gcode.firmware.reprapfirmware.stream_commands import RepRapStreamCommands
from stillpath.gcode.interpreter import Interpreter
from stillpath.gcode.sampler import sample_phases
from stillpath.gcode.types import EventKind
from stillpath.models.firmware import RepRapFirmware
from stillpath.models.firmware.reprapfirmware import Drive, RepRapExtruder, RepRapShaper
from stillpath.models.machine import CommandLimits, Machine
from stillpath.models.store import load_machine
from stillpath.pipeline.compensated_piece import Unfit, deviation
from stillpath.pipeline.measuring.reference_shaper import BestShaper
from stillpath.pipeline.options import Options
from stillpath.pipeline.piece_compensator import PieceCompensator
from tests.gcode.cutting import HEAD, compensated, pieces_of
from tests.gcode.test_encoder import BODIES

ADVANCE_S = 0.04
ADVANCED = "G1 X90 E2 F6000\nG1 X90 Y60 E1\nG1 X20 E3.5 F3000\nG1 Y20 E2\n"


def firmware(steps_per_mm: float = 80.0, **changes: object) -> RepRapFirmware:
    def drive(**given: float) -> Drive:
        return Drive(
            **{
                "steps_per_mm": steps_per_mm,
                "max_speed_mm_s": 500.0,
                "max_accel_mm_s2": 5000.0,
                "jerk_mm_s": 8.0,
                **given,
            }
        )

    return RepRapFirmware(
        x=drive(),
        y=drive(),
        z=drive(steps_per_mm=800.0, max_speed_mm_s=20.0, max_accel_mm_s2=200.0, jerk_mm_s=1.0),
        extruder=RepRapExtruder(max_accel_mm_s2=5000.0),
        home_mm=(0.0, 0.0, 0.0),
    ).model_copy(update=changes)


def machine_of(
    own: RepRapFirmware,
    *,
    advance_s: float = 0.0,
    kinematics: Literal["cartesian", "corexy"] = "cartesian",
) -> Machine:
    changes = {"firmware": own, "pressure_advance_s": advance_s, "kinematics": kinematics}
    return load_machine("ender3").model_copy(update=changes)


@pytest.mark.parametrize("name", sorted(BODIES))
@pytest.mark.parametrize(
    ("steps_per_mm", "kinematics"), [(80.0, "cartesian"), (160.0, "cartesian"), (160.0, "corexy")]
)
def test_executed_is_the_command(
    name: str, steps_per_mm: float, kinematics: Literal["cartesian", "corexy"]
) -> None:
    _, made = compensated(
        HEAD + BODIES[name], machine_of(firmware(steps_per_mm), kinematics=kinematics)
    )
    gap = deviation(made, made.encoded.phases)
    step = 1.0 / steps_per_mm
    tolerance = 1e-3 * Options().tolerance_um
    # A low peak of speed that is cut off shifts what follows in time, by less than a step or so.
    assert np.mean(gap[made.extruding] <= tolerance + 2.0 * step) > 0.98
    # A command may set out a little quicker than the firmware, which keeps what the motors bear.
    assert np.max(gap[made.extruding]) <= 25e-3 + tolerance + step
    np.testing.assert_allclose(
        made.encoded.position[-1] * 1e-6, made.command_mm[:, -1], atol=2e-6 + step
    )


@pytest.mark.parametrize("kinematics", ["cartesian", "corexy"])
def test_segments_end_on_whole_steps(kinematics: Literal["cartesian", "corexy"]) -> None:
    machine = machine_of(firmware(), kinematics=kinematics)
    _, made = compensated(HEAD + BODIES["corners"], machine)
    places = made.encoded.position[:-1, :3] * 1e-6
    assert isinstance(machine.firmware, RepRapFirmware)
    stands = on_steps(places, machine.firmware, kinematics)
    assert np.max(np.abs(stands - places)[:, :2]) < 1e-6
    # Nowhere so near to half a step that the firmware's single precision could round otherwise.
    motors = places[:, 0] + places[:, 1] if kinematics == "corexy" else places[:, 0]
    assert np.max(np.abs(80.0 * motors - np.rint(80.0 * motors))) < 0.01


@pytest.mark.parametrize(
    ("kinematics", "accel_mm_s2", "borne_mm_s2"),
    [
        ("cartesian", 500.0, 1500.0),
        ("corexy", 500.0, 1500.0),
        ("corexy", 300.0, 900.0),
        ("cartesian", 5000.0, 5000.0),
    ],
)
def test_fast_lines_under_low_accelerations_are_on_time(
    kinematics: Literal["cartesian", "corexy"], accel_mm_s2: float, borne_mm_s2: float
) -> None:
    """M201 500, as the configurator writes, or motors that bear no more than the file asks.

    Behind short moves the firmware stays slow: the motion was up to 180 mm off, and reverted.
    """
    drive = firmware().x.model_copy(update={"max_accel_mm_s2": accel_mm_s2})
    machine = machine_of(firmware(x=drive, y=drive), kinematics=kinematics)
    command = CommandLimits(accel_mm_s2=borne_mm_s2)
    machine = machine.model_copy(update={"command": command})
    lines = "G1 X200 Y190 E6 F18000\nG1 X20 Y150 E6\nG1 X190 Y20 E6\nG1 X60 Y200 E6\n"
    _, made = compensated(HEAD + lines, machine)
    assert np.max(deviation(made, made.encoded.phases)) < 0.06
    (limits,) = made.encoded.limits
    assert isinstance(limits, RepRapLimits)
    motors = 2**0.5 if kinematics == "corexy" else 1.0
    assert limits.accel_x_mm_s2 <= motors * borne_mm_s2 * (1 + 1e-9)
    assert min(limits.accel_x_mm_s2, limits.travel_accel_mm_s2) <= borne_mm_s2


def zigzag(lines: int) -> str:
    """Infill: lines of 80 mm, .4 mm apart."""
    ends = [f"G1 X{60 if i % 2 else 140} Y{50 + 0.4 * i:.1f} E2.6 F24000\n" for i in range(lines)]
    return "M204 P6000\n" + "".join(ends)


def vase(turns: int) -> str:
    """A circle of 20 mm that climbs .2 mm a turn, Z with three decimals as slicers write it."""
    angle = np.arange(1, 120 * turns + 1) * 2.0 * np.pi / 120.0
    x, y, z = 80.0 - 20.0 * np.cos(angle), 50.0 + 20.0 * np.sin(angle), 5.0 + 0.1 * angle / np.pi
    places = zip(x, y, z, strict=True)
    return "".join(f"G1 X{a:.3f} Y{b:.3f} Z{c:.3f} E.035 F12000\n" for a, b, c in places)


@pytest.mark.parametrize("body", [zigzag(300), vase(5)], ids=["infill", "vase"])
def test_long_stretches_stay_in_time(body: str) -> None:
    """Thousands of segments, foreseen to the clock: their roundings do not add up."""
    machine = machine_of(firmware(160.0))
    _, made = compensated(HEAD + body, machine)
    encoded = made.encoded
    assert len(encoded.position) > 1000
    gap = deviation(made, encoded.phases)
    tolerance = 1e-3 * Options().tolerance_um
    # Where vertices lie on steps, and when steps come, are off by up to a step each. A vertex that
    # is left out costs some more along the path, for some milliseconds.
    step = np.hypot(1.0, 1.0) / 160.0
    assert np.quantile(gap[made.extruding], 0.998) <= tolerance + 2.8 * step
    assert np.max(gap[made.extruding]) <= tolerance + 4.0 * step


@pytest.mark.parametrize("slower", [5, 15, 25])
def test_slow_lines_of_nearly_the_same_speed_stay_in_time(slower: int) -> None:
    """The firmware cuts off peaks of speed that do not stand out by a tenth of it."""
    lines = [(50.0 + 0.9 * i, 50.0 + 0.02 * i * i, 300 - slower * (i % 2)) for i in range(1, 60)]
    body = "".join(f"G1 X{x:.2f} Y{y:.2f} E.03 F{f}\n" for x, y, f in lines)
    _, made = compensated(HEAD + "M204 P6000\n" + body, machine_of(firmware(160.0)))
    gap = deviation(made, made.encoded.phases)
    assert np.max(gap[made.extruding]) <= 0.02


def test_filament_holds_the_advance_that_the_firmware_has_switched_off() -> None:
    machine = machine_of(firmware(), advance_s=ADVANCE_S)
    _, made = compensated(HEAD + ADVANCED, machine)
    _, plain = compensated(HEAD + ADVANCED, machine_of(firmware()))
    phases = made.encoded.phases
    t = made.timeline.dt_s * np.arange(made.command_mm.shape[1])
    executed, _ = sample_phases(phases, t)
    planned = made.command_mm[3]
    speed = np.gradient(planned, made.timeline.dt_s)
    wanted = planned + ADVANCE_S * speed
    # The advance reaches K v = .04 * 100 * .067 = .26 mm and is kept to some hundredths of that.
    assert np.max(wanted - planned) > 0.1
    assert np.sqrt(np.mean((executed[3] - wanted) ** 2)) < 5e-3
    # It is given back: the file's own amount of filament is fed in all.
    assert made.encoded.position[-1, 3] == plain.encoded.position[-1, 3]
    # The plan itself minds the advance: 5 mm/s of the extruder at most / .04 s.
    piece = pieces_of(HEAD + ADVANCED, machine)[1]
    feeding = np.abs(piece.phases.direction[:, 3]) * piece.phases.accel_mm_s2
    assert np.max(feeding) <= 5.0 / ADVANCE_S * 1.01


def test_rests_run_under_the_files_own_limits() -> None:
    """A retraction of .8 mm at 35 mm/s and 5000 mm/s2 takes .8 / 35 + 35 / 5000 s from rest."""
    machine = machine_of(firmware())
    piece = pieces_of(HEAD + BODIES["retraction"], machine)[1]
    _, made = compensated(HEAD + BODIES["retraction"], machine)
    rows = np.flatnonzero(made.encoded.row >= 0)
    phases = made.encoded.phases
    lasts = (phases.lasts_s)[rows]
    # After a rest the motion goes on with at most the stream's jerk of the extruder, 10 mm/s, so
    # that up to 10 / 5000 s of its braking fall away.
    longest = 0.8 / 35.0 + 35.0 / 5000.0
    assert longest - 10.0 / 5000.0 <= lasts[0] <= longest + 1e-5
    jerk = stream_limits(firmware(), CommandLimits()).jerk_e_mm_s
    # The stretch begins with some filament, too, so that the step is a little less.
    assert np.max(phases.end_mm_s[rows]) <= 1.01 * jerk
    assert made.encoded.row[rows].tolist() == [
        k for k, way in enumerate(piece.phases.direction) if not np.any(way[:3])
    ]


def test_a_queue_that_cannot_be_kept_filled_is_refused() -> None:
    machine = machine_of(firmware(ring_length=6, prepare_least_s=0.2))
    piece = pieces_of(HEAD + BODIES["corners"], machine)[1]
    work = PieceCompensator(machine, Options(), BestShaper("mzv", 40.0, 40.0, 0.1, 0.0, 0.0))
    with pytest.raises(Unfit, match=r"M595 P|speed would step"):
        work.compensate(piece)


@pytest.mark.parametrize("least_s", [0.025, 0.0])
def test_a_dense_stream_is_thinned_out_for_a_short_queue(least_s: float) -> None:
    # 7 moves must last 27 ms: none of them may be the 1 ms that a corner would like.
    machine = machine_of(firmware(ring_length=16, prepare_least_s=least_s))
    _, short = compensated(HEAD + BODIES["corners"], machine)
    phases = short.encoded.phases
    total = np.cumsum(np.append(0.0, phases.lasts_s))
    assert np.min(total[7:] - total[:-7]) >= 27e-3
    _, long = compensated(HEAD + BODIES["corners"], machine_of(firmware(ring_length=100)))
    assert len(long.encoded.row) > len(short.encoded.row)
    assert np.max(np.diff(phases.t_s) - np.diff(total)[:-1]) < 1e-9


@pytest.mark.parametrize(("climb", "steep"), [(0.0, False), (0.09, False), (0.11, True)])
def test_moves_that_climb_too_much_stay_as_they_are(climb: float, steep: bool) -> None:
    machine = machine_of(firmware())
    way = np.array([[8.0, 6.0, climb, 0.1]])
    assert adapter(machine).too_steep(way).tolist() == [steep]
    # For a bed mesh Z's limits are raised beside that.
    tilted = machine.model_copy(update={"mesh_slope": 0.05})
    assert adapter(tilted).too_steep(way).tolist() == [steep]


def test_words_set_the_limits_that_they_name() -> None:
    own = replace(
        RepRapLimits.of(firmware(), 0.0), jerk_x_mm_s=4.0, jerk_policy=1.0, min_speed_mm_s=0.3
    )
    stream_commands = RepRapStreamCommands(firmware(), ADVANCE_S)
    # The least that the firmware takes.
    least = replace(own, accel_e_mm_s2=0.1, speed_z_mm_s=0.3)
    for limits in (own, least, stream_limits(firmware(), CommandLimits())):
        reader = Interpreter(machine_of(firmware(), advance_s=0.03))
        blocks = [*reader.push(stream_commands.limits(limits) + b"G1 X1 F600\n"), *reader.flush()]
        read = blocks[0].limits[blocks[0].moves.limits_id[0]]
        expected = replace(limits, pressure_advance_s=0.03).as_row()
        assert read.as_row() == pytest.approx(expected, abs=1e-6)
        assert read.accel_e_mm_s2 == pytest.approx(limits.accel_e_mm_s2)


def test_words_around_the_firmwares_own_shaper() -> None:
    shaper = RepRapShaper(type="zvd", freq_hz=40.5, damping=0.12)
    stream_commands = RepRapStreamCommands(firmware(shaper=shaper), ADVANCE_S)
    assert stream_commands.shaper_off == b'M593 P"none"\nM572 S0\n'
    assert stream_commands.shaper_on == b'M593 P"zvd" F40.5 S0.12\nM572 S0.04\n'
    assert RepRapStreamCommands(firmware(), 0.0).shaper_on == b'M593 P"none"\nM572 S0\n'
    assert stream_commands.acceleration(1500.0) == b"G1\nM204 P1500 T1500\n"


def test_limits_wait_until_the_move_before_them_is_planned() -> None:
    """After a G1 without words, which is no move and stops none."""
    stream_commands, machine = RepRapStreamCommands(firmware(), 0.0), machine_of(firmware())
    raised = stream_commands.limits(stream_limits(firmware(), CommandLimits()))
    assert raised.startswith(b"G1\nM201 X")
    blocks = Interpreter(machine).push(b"G1 X1 F600\n" + raised + b"G1 X2\n")
    assert [len(block.moves) for block in blocks] == [2]
    assert max(blocks[0].events.kind) < EventKind.STOP
    assert blocks[0].moves.speed_mm_s.tolist() == [10.0, 10.0]


@given(
    st.lists(
        st.tuples(st.floats(0.02, 4.0), st.floats(1.5e-3, 0.03), st.sampled_from([0.0, 0.3, -1.0])),
        min_size=1,
        max_size=60,
    )
)
@settings(max_examples=60)
def test_predicted_times_are_the_planners(steps: list[tuple[float, float, float]]) -> None:
    """What the encoder predicts is the firmware's own plan; to a clock where a time is half of one.

    How such a time is rounded hangs on its last digit.
    """
    assert _missed_s(steps) < 1.01 / firmware().step_clock_hz


def test_predicted_times_are_exact_where_no_rounding_is_in_doubt() -> None:
    rng = np.random.default_rng(5)
    for _ in range(20):
        columns = (rng.uniform(0.02, 4.0, 40), rng.uniform(1.5e-3, 0.03, 40))
        turns = rng.choice([0.0, 0.3, -1.0], 40)
        assert _missed_s(list(zip(*columns, turns, strict=True))) < 1e-9


def _missed_s(steps: list[tuple[float, float, float]]) -> float:
    own = firmware(ring_length=1000)
    # Wide limits: braking over several moves is no stream's, and not foreseen.
    limits = stream_limits(own, CommandLimits(accel_mm_s2=60_000.0, speed_step_mm_s=212.0))
    length, planned, turn = (np.array(column) for column in zip(*steps, strict=True))
    # Slow enough to stop in the last move, and not so slow that the least speed matters.
    planned = np.clip(planned, length / 150.0, length / 2.0)
    angle = np.cumsum(turn)
    way = length[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    places = np.zeros((len(length) + 1, 4))
    places[1:, :2] = np.cumsum(way, axis=0)
    unit = way / length[:, None]
    bend = np.abs(np.diff(unit, axis=0)).max(axis=1, initial=0.0)
    junction = np.append(0.0, limits.jerk_x_mm_s / np.maximum(bend, 1e-12))
    share = np.abs(unit)
    accel = np.minimum(
        limits.travel_accel_mm_s2, limits.accel_x_mm_s2 / np.maximum(share.max(axis=1), 1e-9)
    )
    n = len(length)
    feedrate, predicted = np.zeros(n), np.zeros(n)
    assign_speeds(
        np.ones(n, np.bool_),
        MoveLimits(length, accel, np.full(n, 500.0), junction),
        np.cumsum(planned),
        planned,
        np.zeros(n),
        0.0,
        own.step_clock_hz,
        feedrate,
        predicted,
    )
    planner = RepRapPlanner(own, "cartesian")
    moves = as_moves(places[:-1], places[1:], feedrate / 60.0, np.zeros(n, np.int32))
    phases = join_phases([planner.push_moves(moves, [limits]), planner.flush()])
    lasts = phases.lasts_s
    # The stream is not braked for its end: the last moves are left out.
    settled = np.flatnonzero(np.cumsum(length[::-1])[::-1] > 2.0)
    return float(np.max(np.abs(lasts - predicted)[settled], initial=0.0))


@pytest.mark.parametrize("excess_mm_s", np.linspace(-1.0, 1.0, 41).round(3).tolist())
def test_a_long_segment_a_little_faster_than_its_neighbours_is_in_time(excess_mm_s: float) -> None:
    """10 clocks of 60 000 mm/s2 are .8 mm/s; .45 s of .4 mm/s too slow would be 180 um late."""
    speed = np.array([36.0, 41.0, 39.2, 39.2 + excess_mm_s, 39.2, 34.0, 34.0, 34.0])
    planned = np.array([5e-3, 5e-3, 8e-3, 0.45, 4e-3, 4e-3, 4e-3, 4e-3])
    # A slanting move of a CoreXY machine accelerates less than one along X or Y.
    accel = np.array([56e3, 56e3, 56e3, 60e3, 56e3, 56e3, 56e3, 56e3])
    n = len(speed)
    feedrate, predicted, length = np.zeros(n), np.zeros(n), speed * planned
    assign_speeds(
        np.ones(n, np.bool_),
        MoveLimits(length, accel, np.full(n, 500.0), np.full(n, 500.0)),
        np.cumsum(planned),
        planned,
        np.zeros(n),
        0.0,
        750e3,
        feedrate,
        predicted,
    )
    late = np.cumsum(predicted)[:-1] - np.cumsum(planned)[:-1]
    assert np.max(np.abs(late)) * 40.0 < 10e-3


@given(st.lists(st.floats(1e-3, 5e-3), min_size=2, max_size=40), st.floats(1e-3, 4e-3))
@settings(max_examples=40)
def test_crowded_ends_are_kept_apart(lasts: list[float], least_s: float) -> None:
    end_s = np.cumsum(lasts)
    n = len(end_s)
    final = np.zeros(n, np.bool_)
    final[[n // 2, n - 1]] = True
    begin_s = np.where(np.arange(n) <= n // 2, 0.0, end_s[n // 2])
    keep = np.zeros(n, np.bool_)
    keep_apart(end_s, np.ones(n, np.bool_), final, begin_s, np.full(n, least_s), keep)
    assert np.all(keep[final])
    kept = np.concatenate([[0.0], end_s[keep]])
    short = np.diff(kept) < least_s - 1e-8
    assert not np.any(short & ~final[keep])
    # Nothing is dropped that is far enough from the one before.
    last = 0.0
    for k in range(n):
        if k and final[k - 1]:
            last = begin_s[k]
        assert keep[k] == (final[k] or end_s[k] - last >= least_s - 1e-9)
        last = end_s[k] if keep[k] else last
