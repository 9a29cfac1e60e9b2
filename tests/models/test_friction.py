"""Dry friction that holds an axis back."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pydantic import ValidationError

from stillpath.models.friction import BEND_MM, CREEP_S, DryFriction, bend_of
from stillpath.models.plants import PlantSetSpec
from stillpath.models.store import load_machine

HELD_MM = (0.003, 0.012)
DT_S = 1e-3
T_S = np.arange(3000) * DT_S
WAYS = np.stack([2.0 * np.sin(9.0 * T_S), 5.0 + 0.05 * np.sin(40.0 * T_S) + 3.0 * T_S])


def against(ways: np.ndarray) -> np.ndarray:
    return ways + np.array(HELD_MM)[:, None] * np.stack([bend_of(row, DT_S) for row in ways])


def test_the_bend_follows_the_way_and_turns_over() -> None:
    way = np.concatenate([np.linspace(0, 1, 200), np.linspace(1, 0.9, 100)])
    bend = bend_of(way)
    assert bend[0] == 0.0
    assert bend[199] == pytest.approx(1.0, abs=1e-9)
    assert bend[-1] == pytest.approx(-1.0, abs=1e-3)
    # However it is sampled.
    assert bend_of(np.array([0.0, BEND_MM]))[-1] == pytest.approx(
        bend_of(np.linspace(0.0, BEND_MM, 50))[-1], abs=1e-12
    )


def test_the_kernel_does_what_plain_python_does() -> None:
    way = np.concatenate([WAYS[0, :400], np.full(200, WAYS[0, 399]), WAYS[1, :400]])
    bend, expected = 0.0, [0.0]
    for step in np.diff(way).tolist():
        bend *= math.exp(-DT_S / CREEP_S)
        bend = np.sign(step) + (bend - np.sign(step)) * math.exp(-abs(step) / BEND_MM)
        expected.append(bend)
    np.testing.assert_allclose(bend_of(way, DT_S), expected, atol=1e-12)


def test_slow_motion_bends_guides_half_where_they_creep_as_fast() -> None:
    assert bend_of(BEND_MM / CREEP_S * T_S, DT_S)[-1] == pytest.approx(0.5, abs=0.01)


def test_a_command_that_makes_up_for_it_arrives() -> None:
    received = DryFriction(HELD_MM, DT_S).received_mm(against(WAYS))
    np.testing.assert_allclose(received, WAYS, atol=2e-6)


def test_a_plain_command_is_held_back_by_as_much_as_it_says() -> None:
    received = DryFriction(HELD_MM, DT_S).received_mm(WAYS)
    late = WAYS - received
    np.testing.assert_allclose(np.abs(late).max(axis=1), HELD_MM, rtol=0.05)


def test_an_axis_that_stands_creeps_to_its_command() -> None:
    """Whether it stands after motion, or a command holds it ahead of where it was held back."""
    way = np.stack([np.minimum(30.0 * T_S, 30.0), np.zeros(len(T_S))])
    late = way - DryFriction(HELD_MM, DT_S).received_mm(way)
    stopped = round(1.0 / DT_S)
    assert late[0, stopped] == pytest.approx(HELD_MM[0], rel=0.01)
    soon = stopped + round(0.5 * CREEP_S / DT_S)
    assert 0.1 * HELD_MM[0] < late[0, soon] < HELD_MM[0]
    assert abs(late[0, stopped + round(10 * CREEP_S / DT_S)]) < 0.01 * HELD_MM[0]
    ahead = against(way) - way
    assert abs(ahead[0, stopped + round(10 * CREEP_S / DT_S)]) < 1e-3 * HELD_MM[0]


def test_blocks_and_other_axes_make_no_difference() -> None:
    whole = DryFriction(HELD_MM, DT_S).received_mm(WAYS)
    friction = DryFriction(HELD_MM, DT_S)
    parts = [friction.received_mm(WAYS[:, a : a + 700]) for a in range(0, 3000, 700)]
    np.testing.assert_array_equal(np.hstack(parts), whole)
    alone = [DryFriction(HELD_MM[k:][:1], DT_S).received_mm(WAYS[k:][:1]) for k in (0, 1)]
    np.testing.assert_array_equal(np.vstack(alone), whole)
    friction.stand()
    np.testing.assert_array_equal(friction.received_mm(WAYS), whole)


def test_without_friction_everything_arrives() -> None:
    assert DryFriction((0.0, 0.0), DT_S).received_mm(WAYS) is WAYS


def test_documents_without_friction_are_what_they_were() -> None:
    machine = load_machine("ender3")
    assert machine.friction_mm == (0.0, 0.0)
    axes = {k: v.model_copy(update={"friction_mm": 0.004}) for k, v in machine.axes.items()}
    rubbing = machine.model_copy(update={"axes": axes})
    assert rubbing.revision != machine.revision
    assert rubbing.without_friction().revision == machine.revision


def test_more_than_guides_may_rub_is_refused() -> None:
    plants = load_machine("ender3").axes["x"].model_dump()
    with pytest.raises(ValidationError):
        PlantSetSpec.model_validate({**plants, "friction_mm": 0.5})
