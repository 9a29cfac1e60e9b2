"""Answers to motion that comes in parts, against whole commands one after another."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from stillpath.compensation.shapers import shape, shaper_pulses
from stillpath.models.machine import Machine
from stillpath.models.store import load_machine
from stillpath.pipeline.measuring.points import MotionSamples
from stillpath.pipeline.measuring.reference_shaper import BestShaper
from stillpath.pipeline.measuring.responses import Responses, ResponseSamples
from stillpath.simulation.machine_response import MachineStream
from tests.gcode.cutting import blocks_of

DT_S = 1e-3
SHAPER = BestShaper("mzv", 45.3, 38.1, 0.1, contour_rms_um=0.0, tracking_rms_um=0.0)
NAMES = ("before", "after", "shaper")


@pytest.fixture(scope="module")
def ender() -> Machine:
    return load_machine("ender3")


def walk(seed: int, count: int) -> np.ndarray:
    speed = np.random.default_rng(seed).normal(size=(2, count))
    speed[:, :200] = 0.0  # a shaper looks ahead, and a machine stands where its command begins
    return 100.0 + np.cumsum(np.cumsum(speed, axis=1) * 1e-4, axis=1)


def pushed(
    answers: Responses, path: np.ndarray, executed: np.ndarray
) -> Iterator[ResponseSamples | None]:
    moves = blocks_of(b"G28\nG1 X1\n", load_machine("ender3"))[0].moves
    count = path.shape[1]
    for part in np.split(np.arange(count), [7, 300, 5000, 9100, 9101]):
        zeros = np.zeros(len(part))
        extruding, row = zeros > 0.0, zeros.astype(np.int64)
        yield answers.push(
            MotionSamples(path[:, part], executed[:, part], zeros, extruding, row, moves)
        )
    yield answers.flush()


@pytest.mark.parametrize(
    ("compensated", "friction_mm"), [(True, None), (False, None), (True, 0.01)]
)
def test_parts_join_to_the_response_of_the_whole_motion(
    ender: Machine, compensated: bool, friction_mm: float | None
) -> None:
    update = {"friction_mm": friction_mm}
    axes = {a: plants.model_copy(update=update) for a, plants in ender.axes.items()}
    ender = ender.model_copy(update={"axes": axes})
    names = NAMES if compensated else ("before", "shaper")
    answers = Responses(ender, DT_S, SHAPER, names)
    pulses = [shaper_pulses("mzv", f_hz, 0.1) for f_hz in (SHAPER.fx_hz, SHAPER.fy_hz)]
    for seed in (1, 2):  # the machine comes to stand in between
        path, executed = walk(seed, 12_000), walk(seed + 10, 12_000)
        found = [part for part in pushed(answers, path, executed) if part is not None]
        assert len(found) > 1
        response = np.concatenate([part.response_mm for part in found], axis=2)
        np.testing.assert_array_equal(np.concatenate([p.path_mm for p in found], axis=1), path)
        np.testing.assert_array_equal(
            np.concatenate([p.executed_mm for p in found], axis=1), executed
        )
        shaped = np.stack([shape(p, DT_S, q) for p, q in zip(path, pulses, strict=True)])
        commands = {"before": path if compensated else executed, "after": executed}
        for name, one in zip(names, response, strict=True):
            whole = MachineStream(ender, DT_S).push(commands.get(name, shaped), path)
            np.testing.assert_allclose(one, whole, rtol=0.0, atol=1e-9)
