"""The range of a print's errors, from excerpts of its motion."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lsim

from stillpath.gcode.interpreter import Interpreter
from stillpath.gcode.types import Moves
from stillpath.models.machine import Machine
from stillpath.models.plants import PlantSetSpec, RelativeMode, RelativeModesSpec, WeightedMember
from stillpath.models.reference_motion import reference_motion
from stillpath.models.store import load_machine
from stillpath.pipeline.measuring import excerpts
from stillpath.pipeline.measuring.excerpts import MotionExcerpts
from stillpath.pipeline.measuring.points import MotionSamples
from stillpath.pipeline.measuring.reference_shaper import BestShaper

DT_S = 1e-3
ZETA, WINDOW = 0.06, 80
FOUND_HZ, OTHERS_HZ = 48.0, (42.0, 55.0)
SHAPER = BestShaper("zv", FOUND_HZ, FOUND_HZ, 0.1, 0.0, 0.0)


def plant(f_hz: float) -> RelativeModesSpec:
    return RelativeModesSpec(modes=(RelativeMode(f_hz=f_hz, zeta=ZETA, share=1.0),))


def machine() -> Machine:
    members = tuple(WeightedMember(plant=plant(f_hz)) for f_hz in (FOUND_HZ, *OTHERS_HZ))
    axis = PlantSetSpec(nominal=plant(FOUND_HZ), members=members)
    return load_machine("generic-corexy").model_copy(update={"axes": {"x": axis, "y": axis}})


def moves() -> Moves:
    reader = Interpreter(machine())
    (block,) = [*reader.push(b"G28\nG1 X5 F600\n"), *reader.flush()]
    return block.moves


def motion(path: np.ndarray, command: np.ndarray, extruding: np.ndarray) -> MotionSamples:
    n = path.shape[1]
    return MotionSamples(path, command, np.zeros(n), extruding, np.zeros(n, np.int64), moves())


def answered(f_hz: float, command: np.ndarray) -> np.ndarray:
    """Response of the continuous plant, by scipy."""
    w = 2 * np.pi * f_hz
    t = DT_S * np.arange(command.shape[1])
    start = command[:, :1]
    system = ([2 * ZETA * w, w**2], [1.0, 2 * ZETA * w, w**2])
    return start + np.stack([lsim(system, row, t)[1] for row in command - start])


def contour_um(path: np.ndarray, moved: np.ndarray, extruding: np.ndarray) -> float:
    """Rms distance of positions to the segments of the path around their time."""
    found = []
    for k in np.flatnonzero(extruding)[::5]:
        near = path[:, max(0, k - WINDOW) : k + WINDOW + 1]
        a, d, p = near[:, :-1], np.diff(near), moved[:, k, None]
        along = np.sum((p - a) * d, axis=0) / np.maximum(np.sum(d * d, axis=0), 1e-30)
        rest = p - a - np.clip(along, 0.0, 1.0) * d
        found.append(np.min(np.hypot(*rest)))
    return 1e3 * float(np.sqrt(np.mean(np.square(found))))


def test_the_range_is_that_of_the_plants_on_the_print_itself() -> None:
    """As all members follow the whole print from its start."""
    path, extruding = reference_motion(DT_S)
    shown = MotionExcerpts(DT_S)
    command = path + 0.02 * np.sin(2 * np.pi * 7.0 * DT_S * np.arange(path.shape[1]))
    shown.add(motion(path, command, extruding))
    ranges = shown.ranges(machine(), SHAPER)
    for name, asked in (("before", path), ("after", command)):
        whole = {
            f_hz: contour_um(path, answered(f_hz, asked), extruding)
            for f_hz in (FOUND_HZ, *OTHERS_HZ)
        }
        found = ranges[name]
        assert found.reference_um == pytest.approx(whole[FOUND_HZ], rel=0.1)
        ratios = np.array(list(whole.values())) / whole[FOUND_HZ]
        assert found.low == pytest.approx(ratios.min(), rel=0.05)
        assert found.high == pytest.approx(ratios.max(), rel=0.05)
    assert ranges["shaper"].reference_um < 0.5 * ranges["before"].reference_um


def test_a_stretch_in_the_middle_of_a_line_shakes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """A diagonal at constant speed leaves no error, wherever it is cut, though the axes differ."""
    axes = {"x": PlantSetSpec(nominal=plant(42.0)), "y": PlantSetSpec(nominal=plant(55.0))}
    unlike = machine().model_copy(update={"axes": axes})
    n = 60_000
    path = np.stack([0.1 * np.arange(n), 0.1 * np.arange(n)])

    def error_um() -> float:
        shown = MotionExcerpts(DT_S)
        shown.add(motion(path, path, np.ones(n, bool)))
        return shown.ranges(unlike, SHAPER)["before"].reference_um

    assert error_um() < 0.01
    monkeypatch.setattr(excerpts, "_LEAD_S", 0.0)
    monkeypatch.setattr(excerpts, "_from_a_standstill", lambda motion_mm, dt_s: motion_mm.copy())
    assert error_um() > 1.0


def test_a_long_print_is_sampled_along_its_whole_length() -> None:
    shown = MotionExcerpts(DT_S)
    n = 1500
    for k in range(1000):
        path = np.stack([k + 1e-3 * np.arange(n), np.zeros(n)])
        shown.add(motion(path, path, np.ones(n, bool)))
    places = [float(one.path_mm[0, -1]) for one in shown._kept]
    assert len(places) <= excerpts._MOST
    assert places[0] < 50.0
    assert places[-1] > 950.0
    assert np.ptp(np.diff(places)) < 1e-6


def test_pieces_of_half_a_second_count_from_their_standstill() -> None:
    path, extruding = reference_motion(DT_S)
    first = int(np.flatnonzero(extruding)[0])
    shown = MotionExcerpts(DT_S)
    for _ in range(5):
        part = slice(first, first + 500)
        shown.add(motion(path[:, part], path[:, part], extruding[part]))
    found = shown.ranges(machine(), SHAPER)["before"]
    assert found.low < 1.0 < found.high


def test_travels_alone_say_nothing() -> None:
    path = np.stack([0.1 * np.arange(20_000), np.zeros(20_000)])
    shown = MotionExcerpts(DT_S)
    shown.add(motion(path, path, np.zeros(20_000, bool)))
    shown.add(motion(path[:, :300], path[:, :300], np.ones(300, bool)))
    assert shown.ranges(machine(), SHAPER) == {}
