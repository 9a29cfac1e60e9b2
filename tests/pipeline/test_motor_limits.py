"""Limits by axis, where one bears more, and by motor, where both move either axis."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError

from stillpath.compensation.defaults import DT_S
from stillpath.gcode.firmware.registry import adapter
from stillpath.models.machine import Machine
from stillpath.models.store import load_machine
from stillpath.pipeline.compensated_piece import CompensatedPiece, Unfit
from tests.gcode.cutting import HEAD, compensated, ender3_with

ZIGZAG = "".join(
    f"G1 X{60 + 8 * (k % 2)} Y{50 + 3 * (k // 2 % 2)} E.4 F9000\n" for k in range(1, 24)
) + "".join(f"G1 X{60 + 3 * (k // 2 % 2)} Y{50 + 8 * (k % 2)} E.4 F9000\n" for k in range(1, 24))
CORNERS = (
    "G1 X90 Y60 E1 F9000\nG1 X20 Y20 E2\nG1 X21 Y60 E1\nG1 X90 Y21 E2\n"
    "G1 X20 Y90 F12000\nG1 X90 Y20 E3 F6000\nG1 X20 Y20 E1\n"
)


def with_command(machine: Machine, **command: Any) -> Machine:
    document = machine.model_dump(mode="json")
    return Machine.model_validate({**document, "command": command})


def heavy_bed(kind: str) -> Machine:
    """X bears four times what Y does."""
    bears_more = {"x": {"accel_mm_s2": 16_000, "speed_step_mm_s": 45}}
    return with_command(ender3_with(kind), accel_mm_s2=4000, speed_step_mm_s=30, axes=bears_more)


def slow_corexy() -> Machine:
    machine = load_machine("voron-v24-250")
    planner = machine.firmware.planner.model_copy(update={"max_accel_mm_s2": 3000.0})  # type: ignore[union-attr]
    firmware = machine.firmware.model_copy(update={"planner": planner})
    return machine.model_copy(update={"firmware": firmware})


def peaks(made: CompensatedPiece) -> NDArray[np.float64]:
    return np.abs(np.diff(made.command_mm[:2], 2)).max(axis=1) / DT_S**2


@pytest.mark.parametrize("kind", ["marlin", "reprapfirmware"])
def test_each_axis_keeps_what_it_bears(kind: str) -> None:
    machine = heavy_bed(kind)
    _, made = compensated(HEAD + ZIGZAG, machine)
    asked = peaks(made)
    assert asked[1] <= 4000 * (1 + 1e-9) < asked[0] <= 16_000 * (1 + 1e-9)


@pytest.mark.parametrize("kind", ["marlin", "reprapfirmware"])
def test_so_does_the_firmware_in_a_stream(kind: str) -> None:
    """Wherever it breaks off: what it brakes and starts with along each axis."""
    machine = heavy_bed(kind)
    firmware = adapter(machine)
    limits = firmware.stream_limits(firmware.initial_limits())
    assert (limits.accel_x_mm_s2, limits.accel_y_mm_s2) == (16_000, 4000)  # type: ignore[attr-defined]
    assert limits.jerk_x_mm_s == pytest.approx(1.5 * limits.jerk_y_mm_s, rel=1e-3)  # type: ignore[attr-defined]


def test_ramps_of_a_stream_keep_it_too() -> None:
    _, made = compensated(HEAD + ZIGZAG, heavy_bed("reprapfirmware"))
    phases = made.encoded.phases
    ramps = phases.accel_mm_s2[:, None] * np.abs(phases.direction[:, :2])
    # In ticks of the step clock.
    assert np.all(ramps.max(axis=0) <= np.array([16_000, 4000]) * (1 + 1e-3))
    assert ramps[:, 0].max() > 4000


def test_both_axes_alike_is_the_same_as_no_axes() -> None:
    plain = with_command(ender3_with("marlin"), accel_mm_s2=8000)
    alike = {axis: {"accel_mm_s2": 8000, "speed_step_mm_s": 45} for axis in "xy"}
    stated = with_command(ender3_with("marlin"), accel_mm_s2=8000, axes=alike)
    (_, one), (_, other) = (compensated(HEAD + ZIGZAG, m) for m in (plain, stated))
    np.testing.assert_array_equal(one.encoded.position, other.encoded.position)
    np.testing.assert_array_equal(one.encoded.feedrate_mm_min, other.encoded.feedrate_mm_min)


def test_no_motor_of_a_corexy_is_asked_for_more_than_it_bears() -> None:
    machine, accel = slow_corexy(), 4000.0
    loose = with_command(machine, accel_mm_s2=accel)
    held = with_command(machine, accel_mm_s2=accel, motors={"accel_mm_s2": 1.42 * accel})

    def asked(which: Machine) -> float:
        x, y = compensated(HEAD + CORNERS, which)[1].command_mm[:2]
        return max(np.abs(np.diff(row, 2)).max() / DT_S**2 for row in (x + y, x - y))

    assert asked(loose) > 1.43 * accel
    assert asked(held) <= 1.42 * accel * (1 + 1e-9)


def test_one_corner_of_a_corexy_costs_only_its_surroundings() -> None:
    """Where X and Y together ask too much of a motor; the rest stays as it would be without."""
    machine, accel = slow_corexy(), 4000.0
    loose = with_command(machine, accel_mm_s2=accel)
    held = with_command(machine, accel_mm_s2=accel, motors={"accel_mm_s2": 1.42 * accel})
    straight = "".join(f"G1 X{20 + 70 * (k % 2)} Y20 E2 F6000\n" for k in range(1, 12))
    commands = [
        compensated(HEAD + CORNERS + straight + CORNERS, which)[1].command_mm[:2]
        for which in (loose, held)
    ]
    n = commands[0].shape[1]
    assert commands[1].shape[1] == n
    apart = np.abs(commands[1] - commands[0]).max(axis=0)
    assert apart.max() > 1e-3
    assert apart[int(0.35 * n) : int(0.65 * n)].max() < 1e-6


@pytest.mark.parametrize(("motor", "left"), [(8000.0, 5656.854), (30_000.0, 8000.0)])
def test_klippers_one_acceleration_is_right_for_a_motor_on_a_diagonal(
    motor: float, left: float
) -> None:
    machine = with_command(
        load_machine("voron-v24-250"), accel_mm_s2=8000, motors={"accel_mm_s2": motor}
    )
    firmware = adapter(machine)
    assert firmware.refusal is None
    limits = firmware.stream_limits(firmware.initial_limits())
    assert limits.accel_mm_s2 == pytest.approx(left)  # type: ignore[attr-defined]


def test_marlins_m201_is_of_motors() -> None:
    section = json.loads(json.dumps(ender3_with("marlin").firmware.model_dump(mode="json")))
    document = load_machine("voron-v24-250").model_dump(mode="json") | {"firmware": section}
    machine = with_command(
        Machine.model_validate(document), accel_mm_s2=6000, motors={"accel_mm_s2": 8400}
    )
    firmware = adapter(machine)
    limits = firmware.stream_limits(firmware.initial_limits())
    assert (limits.accel_x_mm_s2, limits.accel_y_mm_s2) == (8400, 8400)  # type: ignore[attr-defined]
    assert limits.print_accel_mm_s2 == 6000  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("name", "kind", "command", "words"),
    [
        ("ender3", "marlin", {"axes": {"y": {"accel_mm_s2": 900}}}, "lower accel_mm_s2 to 900"),
        ("ender3", "klipper", {"axes": {"x": {"accel_mm_s2": 3e4}}}, "Klipper has one accel"),
        ("ender3", "klipper", {"motors": {"accel_mm_s2": 3e4}}, "each axis has a motor"),
        ("voron-v0", "klipper", {"axes": {"x": {"accel_mm_s2": 3e4}}}, "command.motors"),
        ("voron-v0", "klipper", {"motors": {"velocity_mm_s": 100}}, "lower velocity_mm_s"),
    ],
)
def test_what_cannot_be_kept_is_refused(
    name: str, kind: str, command: dict[str, Any], words: str
) -> None:
    machine = ender3_with(kind) if name == "ender3" else load_machine(name)
    with pytest.raises(ValidationError, match=words):
        with_command(machine, **command)


def test_machines_that_state_nothing_of_it_keep_their_revision() -> None:
    """As 0.1.0 computed it."""
    assert load_machine("ender3").revision == "26f24281edd0"
    assert load_machine("voron-v0").revision == "843c3eba6432"


@pytest.mark.parametrize(
    ("borne_mm_s2", "asked_mm_s2", "words"),
    [(4500, 7000, "planned by the firmware's rules"), (750, 3000, "even the gentlest design")],
)
def test_a_slicer_that_accelerates_more_than_the_motors_bear_is_told_so(
    borne_mm_s2: float, asked_mm_s2: float, words: str
) -> None:
    """Klipper obeys M204 above max_accel, from which the motors' limits are derived."""
    machine = with_command(load_machine("ender3"), accel_mm_s2=borne_mm_s2)
    remedy = f"as sliced, X accelerates by {asked_mm_s2} .*: slice with less of it, or raise"
    with pytest.raises(Unfit, match=f"{words}.*{remedy}"):
        compensated(f"{HEAD}M204 S{asked_mm_s2}\n{ZIGZAG}", machine)
