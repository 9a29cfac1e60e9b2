"""Approximate inverses as compensators: that they track, keep limits and rests, or say why not."""

from __future__ import annotations

import numpy as np
import pytest

from stillpath.compensation.base import DesignError
from stillpath.compensation.inversion import invert
from stillpath.compensation.inverting import InversionCompensator, zero_phase_fir
from stillpath.compensation.registry import compensator
from stillpath.compensation.rests import stand_still
from stillpath.models.machine import Machine
from stillpath.models.plants import ZpkSpec, plant_set
from stillpath.models.store import load_machine

F_HZ = np.linspace(0.5, 450, 200)
NO_RESTS = np.zeros((0, 2), np.int64)


def strokes() -> np.ndarray:
    """Back and forth on both axes: 20 mm, 100 mm/s, 3000 mm/s2, at rest at both ends."""
    accel = np.concatenate([np.full(33, 3000.0), np.zeros(167), np.full(33, -3000.0)])
    profile = np.concatenate([np.zeros(200), accel, np.zeros(120), -accel, np.zeros(500)])
    x = np.cumsum(np.cumsum(profile)) * 1e-6
    return np.stack([x, np.roll(x, 40)])


def answer(machine: Machine, u: np.ndarray) -> np.ndarray:
    rows = []
    for axis, row in zip(("x", "y"), u, strict=True):
        plant = plant_set(machine.axes[axis], 1e-3).nominal
        pulse = plant.impulse_response(u.shape[1])
        rows.append(row[0] + np.convolve(pulse, row - row[0])[: u.shape[1]])
    return np.array(rows)


@pytest.mark.parametrize("name", ["zpetc", "ts", "shaper:mzv"])
def test_a_piece_without_samples_has_a_command_without(name: str) -> None:
    made = compensator(name, load_machine("ender3"), 1e-3)
    command = made.compensate(np.zeros((2, 0)), np.zeros(0, np.bool_), NO_RESTS)
    assert command.shape == (2, 0)


def test_fir_of_paper_002() -> None:
    np.testing.assert_allclose(
        zero_phase_fir(500, 1e-4, 5)[5:],
        [0.2116, 0.1514, 0.1062, 0.0716, 0.0441, 0.0210],
        atol=5e-5,
    )
    once, twice = zero_phase_fir(100, 1e-3, 8), zero_phase_fir(100, 1e-3, 8, passes=2)
    np.testing.assert_allclose(twice, np.convolve(once, once))
    with pytest.raises(DesignError, match="cutoff"):
        zero_phase_fir(600, 1e-3)


def test_filter_is_its_frequency_response() -> None:
    plant = plant_set(load_machine("voron-v0").axes["y"], 1e-3).nominal
    design = invert("zpetc", plant)
    impulse = np.zeros(4096)
    impulse[2048] = 1.0
    out = design.apply(impulse)
    spectrum = np.fft.fft(np.roll(out, -2048))[1:2000]
    f_hz = np.arange(1, 2000) / 4.096
    np.testing.assert_allclose(spectrum, design.response(f_hz, 1e-3), atol=1e-6)


@pytest.mark.parametrize(
    ("kind", "name", "limit_um"),
    [
        ("zpetc", "ender3", 8.0),
        ("zpetc", "voron-v0", 40.0),  # zeros right of the imaginary axis, on Y
        ("zpetc", "voron-v24-250", 2.0),
        ("zpetc", "generic-corexy", 2.0),
        ("zpetc", "taz6-x", 100.0),
        ("ebzpetc", "ender3", 12.0),
        ("ts", "ender3", 12.0),
        ("ts", "voron-v24-250", 8.0),
        ("zmetc", "ender3", 70.0),
        ("npz-ignore", "ender3", 60.0),
    ],
)
def test_it_tracks(kind: str, name: str, limit_um: float) -> None:
    machine, y_d = load_machine(name), strokes()
    made = compensator(kind, machine, 1e-3)
    assert isinstance(made, InversionCompensator)
    u = made.compensate(y_d, np.ones(y_d.shape[1], bool), NO_RESTS)
    after = np.abs(answer(machine, u) - y_d).max() * 1e3
    before = np.abs(answer(machine, y_d) - y_d).max() * 1e3
    assert after < min(limit_um, before)
    assert kind in ("zmetc", "npz-ignore") or after < before / (2.5 if name == "voron-v0" else 4)
    assert np.abs(np.diff(u, 2)).max() <= 20_000e-6
    np.testing.assert_array_equal(u[:, [0, -1]], y_d[:, [0, -1]])


def test_rests_are_kept() -> None:
    machine, y_d = load_machine("ender3"), strokes()
    rests = np.array([[480, 540]])
    u = compensator("zpetc", machine, 1e-3).compensate(y_d, np.ones(y_d.shape[1], bool), rests)
    assert np.all(np.diff(u[:, 479:540]) == 0)


def test_a_machine_too_slow_for_the_inverse_is_refused() -> None:
    machine = load_machine("ender3")
    slow = machine.model_copy(
        update={"command": machine.command.model_copy(update={"accel_mm_s2": 100.0})}
    )
    y_d = strokes()
    with pytest.raises(DesignError, match="zpetc, axis x: even with a low-pass"):
        compensator("zpetc", slow, 1e-3).compensate(y_d, np.ones(y_d.shape[1], bool), NO_RESTS)


@pytest.mark.parametrize(
    ("kind", "reason"),
    [
        ("ebzpetc", r"axis x: ebzpetc: the gain error of zpetc reaches .* does not converge"),
        ("ts", None),
        ("zmetc", None),
        ("npz-ignore", None),
    ],
)
def test_a_pair_of_zeros_outside_on_the_right(kind: str, reason: str | None) -> None:
    """The Taz's X axis: what each method makes of it."""
    machine, y_d = load_machine("taz6-x"), strokes()
    if reason is not None:
        with pytest.raises(DesignError, match=reason):
            compensator(kind, machine, 1e-3)
        return
    u = compensator(kind, machine, 1e-3).compensate(y_d, np.ones(y_d.shape[1], bool), NO_RESTS)
    after, before = (np.abs(answer(machine, c) - y_d).max() for c in (u, y_d))
    assert after < before


def test_terms_of_ts_follow_the_slowest_zero() -> None:
    made = compensator("ts", load_machine("taz6-x"), 1e-3)
    assert isinstance(made, InversionCompensator)
    size = np.abs(made.filters[0].uncancelled).min()
    order = made.filters[0].order
    assert size**-order <= 1e-3 < size ** (1 - order)
    # The same zeros, but hardly outside.
    machine = load_machine("generic-corexy")
    angle = 0.2 * np.pi
    zero = 1.005 * np.exp(1j * angle)
    spec = ZpkSpec(
        zeros=((zero.real, zero.imag), (zero.real, -zero.imag)),
        poles=((0.5, 0.2), (0.5, -0.2), (0.3, 0)),
        dt_s=1e-3,
    )
    x = machine.axes["x"].model_copy(update={"nominal": spec, "members": ()})
    near = machine.model_copy(update={"axes": {**machine.axes, "x": x}})
    with pytest.raises(DesignError, match=r"axis x: ts: zero .* needs 1386 terms .* limit 400"):
        compensator("ts", near, 1e-3)


def test_rests_stand_where_the_plan_rests_and_not_where_its_motions_go_on() -> None:
    y_d = np.zeros((2, 200))
    y_d[:, 99:] = 1.0
    # The motion goes on before the last sample of a rest, and soon after the first of a short one.
    y_d[:, 149:] = 1.0002 + 0.01 * np.arange(51)
    y_d[:, 160:] = y_d[:, 160, None]
    y_d[:, 161:] += 0.0016
    out = stand_still(y_d, y_d, np.array([[100, 150], [161, 162], [163, 164]]), 20)
    np.testing.assert_array_equal(out[:, 99:150], 1.0)
    assert np.all(out[:, 160:162] == y_d[:, [160]])
    # Rests that touch: what lies between them is done from one sample to the next.
    assert np.all(out[:, 162:164] == y_d[:, [162]])


def test_stand_still_joins_smoothly() -> None:
    t = np.arange(600)
    y_d = np.stack([np.clip(t - 100, 0, 200) * 0.1 + np.clip(t - 400, 0, 100) * 0.1] * 2)
    u = y_d + 0.05 * np.sin(t / 9.0)
    out = stand_still(u, y_d, np.array([[301, 400]]), 30)
    assert np.all(out[:, 300:400] == y_d[:, [350]])
    untouched = slice(31, 269)
    np.testing.assert_array_equal(out[:, untouched], u[:, untouched])
    jump = np.abs(np.diff(out - y_d)).max()
    assert jump < 0.01
    # Adjacent rests and rests at the ends.
    edge = stand_still(u, y_d, np.array([[0, 50], [50, 101], [590, 600]]), 30)
    assert np.all(edge[:, :101] == y_d[:, [100]])
    assert np.all(edge[:, 589:] == y_d[:, [599]])
