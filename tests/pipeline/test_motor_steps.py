"""Motors that stand on whole steps: errors are those from what the file asks for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stillpath.gcode.pieces import Piece
from stillpath.models.machine import Machine
from stillpath.models.schedule import EMPTY
from stillpath.models.store import load_machine
from stillpath.pipeline.compensated_piece import Unfit
from stillpath.pipeline.measuring.points import MotionSamples
from stillpath.pipeline.result import Result
from stillpath.pipeline.simulate import simulate_file
from stillpath.pipeline.verifying import Verifier
from tests.compensating import compensated
from tests.gcode.cutting import HEAD, ender3_with, pieces_of

LINES = "G28\nG90\nM83\nG1 X60 Y60.005 Z5 F1200\n" + "".join(
    f"G1 X{60 + 10 * i} Y60.005 E1 F300\n" for i in range(1, 6)
)
"""Along Y 60.005, slowly: the nearest step is 60.000 at 80 steps/mm."""


def machine_with(kind: str) -> Machine:
    machine = ender3_with(kind)
    if kind == "reprapfirmware":
        y = machine.firmware.y.model_copy(update={"steps_per_mm": 80.0})  # type: ignore[union-attr]
        firmware = machine.firmware.model_copy(update={"y": y})
        return machine.model_copy(update={"firmware": firmware})
    return machine


def rms_um(result: Result) -> dict[str, float]:
    return {c.name: c.extruding.contour_rms_um for c in result.channels}


@pytest.mark.parametrize("kind", ["marlin", "reprapfirmware"])
def test_rounding_to_steps_is_an_error(kind: str, tmp_path: Path, cache: Path) -> None:
    machine = machine_with(kind)
    source = tmp_path / "lines.gcode"
    source.write_text(LINES)
    seen = rms_um(simulate_file(source, machine, cache_dir=cache))
    for method in ("none", "fbf"):
        found = rms_um(compensated(LINES, tmp_path, cache, machine, method=method)[0])
        assert found["before"] == pytest.approx(5.0, abs=0.3)
        assert found["before"] == pytest.approx(seen["before"], abs=0.05)
        assert found["shaper"] == pytest.approx(seen["shaper"], abs=0.05)
        assert found["after"] <= found["before"] + 0.1


def test_a_wipe_on_the_spot_may_wait(tmp_path: Path, cache: Path) -> None:
    """What is too short for Marlin waits for the next move: the piece is good without it."""
    wipe = "G1 Z5.2 F600\nG1 E1 F2100\nG1 F8640\n" + "".join(
        f"G1 X110 Y60.{y} E-.01\n" for y in ("080", "043", "005")
    )
    text = f"{LINES}{wipe}G4 P500\nG1 E-.8 F2100\nG1 X60 Y60 F6000\n"
    result, written = compensated(text, tmp_path, cache, machine_with("marlin"))
    assert result.put_back == []
    assert b"Y60.043" not in written


@pytest.mark.parametrize("junction", ["classic_jerk", "deviation"])
@pytest.mark.parametrize("y_steps", [(0, 0), (0, 1), (0, 1, 0, -1)])
def test_moves_of_single_steps_lose_no_time(
    junction: str, y_steps: tuple[int, ...], tmp_path: Path, cache: Path
) -> None:
    """To and fro, in stairs, in a meander: slower than the firmware steps, it ran ahead."""
    document = machine_with("marlin").model_dump(mode="json")
    document["firmware"] |= {"min_steps_per_segment": 1, "junction": junction}
    x_mm, y_mm, lines = 80.0, 60.0, ["G28", "G90", "M83", "G1 X60 Y60 Z5 F6000", "G1 X80 E1 F3000"]
    for k in range(300):
        across = y_steps[k % len(y_steps)]
        back = not any(y_steps) and k % 2
        x_mm += 0.0 if across else -0.0125 if back else 0.0125
        y_mm += 0.0125 * across
        lines.append(f"G1 X{x_mm:.4f} Y{y_mm:.4f} E.001 F600")
    text = "\n".join([*lines, "G1 X110 E1 F3000", "G1 Y90 E1", ""])
    result, _ = compensated(text, tmp_path, cache, Machine.model_validate(document))
    assert not [one.reason for one in result.put_back if "from its command" in one.reason]


def test_sudden_corners_are_rounded(tmp_path: Path, cache: Path) -> None:
    """Marlin passes these corners without slowing down: no command follows all of them at once."""
    document = machine_with("marlin").model_dump(mode="json")
    document["firmware"]["min_steps_per_segment"] = 1
    document["firmware"]["planner"]["max_accel_mm_s2"] |= {"x": 20000.0, "y": 20000.0}
    for axis, f_hz, zeta in (("x", 83.01, 0.021), ("y", 91.26, 0.102)):
        pole = {"f_hz": f_hz, "zeta": zeta}
        plant = {"kind": "pairs", "poles": [pole], "zeros": []}
        document["axes"][axis] = {"nominal": plant, "band_hz": (8.0, 130.0)}
    lines = ["G28", "G90", "M83", "M204 P12000 T12000"]
    for layer in range(3):
        lines += [f"G1 Z{0.2 * (layer + 1):.1f} F600", "G1 E-.8 F2400", "G1 X79.293 Y60 F9000"]
        lines += ["G1 E.8 F2400"]
        for radius in (19.293, 18.843, 18.393):
            places = 60.0 + 60.0j + radius * np.exp(0.25j * np.pi * np.arange(9))
            sides = [f"G1 X{p.real:.3f} Y{p.imag:.3f}" for p in places.tolist()]
            lines += [f"{sides[0]} F6000", *(f"{side} E.5" for side in sides[1:])]
    text = "\n".join(lines) + "\n"
    result, _ = compensated(text, tmp_path, cache, Machine.model_validate(document))
    assert result.put_back == []
    found = rms_um(result)
    assert found["after"] < 0.5 * found["shaper"] < 0.5 * found["before"]


def test_marlin_follows_travel_as_fast_as_commands_may_be(tmp_path: Path, cache: Path) -> None:
    """Along an axis at the command's highest speed, and along a diagonal faster than that."""
    document = machine_with("marlin").model_dump(mode="json")
    planner = document["firmware"]["planner"]
    planner["max_accel_mm_s2"] |= {"x": 8000.0, "y": 8000.0}
    planner["max_feedrate_mm_s"] |= {"x": 300.0, "y": 300.0}
    document["command"]["velocity_mm_s"] = 300.0
    fast = "G1 X160 F24000\nG1 Y61 E1\nG1 X20 Y60 F24000\nG1 X160 Y180 F24000\nG1 X20 Y60 F24000\n"
    head = "G28\nG90\nM83\nM204 P8000 T8000\nG1 X20 Y60 Z5 F6000\n"
    text = head + 4 * (fast + "G1 X40 Y70 E1 F6000\nG1 X20 Y60 E1\n")
    result, _ = compensated(text, tmp_path, cache, Machine.model_validate(document))
    assert result.put_back == []


def samples(executed_um: float, sliced_um: float | None) -> MotionSamples:
    """Motion along X for 2 s, off by so much in Y."""
    piece: Piece = pieces_of(HEAD + "G1 X70 E1 F300\n", load_machine("ender3"))[-1]
    x = np.linspace(60.0, 70.0, 2001)

    def line(off_um: float) -> np.ndarray:
        return np.stack([x, np.full_like(x, 50.0 + 1e-3 * off_um)])

    return MotionSamples(
        path_mm=line(0.0),
        executed_mm=line(executed_um),
        z_mm=np.full_like(x, 5.0),
        extruding=np.ones(len(x), np.bool_),
        row=np.zeros(len(x), np.int64),
        moves=piece.moves,
        sliced_mm=None if sliced_um is None else line(sliced_um),
    )


def test_what_would_print_worse_stays_as_it_came() -> None:
    verifier = Verifier(load_machine("ender3"), 2.0)
    with pytest.raises(Unfit, match=r"6.0 µm rms, against 3.0 µm as sliced"):
        verifier.check_gain(samples(6.0, 3.0), EMPTY)
    verifier.check_gain(samples(3.0, 6.0), EMPTY)
    # A little more is no reason, nor is what nobody sees, nor where nothing is rounded.
    verifier.check_gain(samples(3.2, 3.0), EMPTY)
    verifier.check_gain(samples(0.9, 0.1), EMPTY)
    verifier.check_gain(samples(6.0, None), EMPTY)


def test_what_vibrates_on_from_before_counts_for_both() -> None:
    """As it came it is a little better where the machine stood before, and not where it shakes."""
    verifier = Verifier(load_machine("ender3"), 2.0)
    motion = samples(4.0, 2.0)
    x = np.append(np.linspace(40.0, 60.0, 100), np.full(10, 60.0))
    verifier.observe(np.stack([x, np.linspace(30.0, 50.0, 110)]))
    verifier.check_gain(motion, EMPTY)
    verifier.lose_position()
    with pytest.raises(Unfit, match="as sliced"):
        verifier.check_gain(motion, EMPTY)
