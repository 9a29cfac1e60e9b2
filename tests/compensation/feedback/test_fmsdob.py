"""Forward-model observer: paper 000, interpolation, stability, refusals."""

from __future__ import annotations

import json
from dataclasses import replace

import control
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from stillpath.compensation.base import DesignError
from stillpath.compensation.feedback.bandpass import LatticeBandPass
from stillpath.compensation.feedback.controller import Controller, Prediction, Refusal
from stillpath.compensation.feedback.fmsdob import (
    Around,
    QFilter,
    Shape,
    Trim,
    add_on_blocks,
    design_q,
    fmsdob,
    forward_model,
    instant_check,
)
from stillpath.compensation.feedback.inverse_dob import inverse_dob
from stillpath.models.diagrams import Diagram, polynomial_response
from stillpath.models.loops import Loop, builtin_loops, load_loop
from stillpath.simulation.closed_loop import batch, simulate

PRINTED = Loop((0, 0, 0.0282, 0.1504, 0.1146), (1, -1.319, 0.929, -0.6073, -0.0035), 2.5e-5)
FAST = load_loop("galvo-40khz")
SLOW = load_loop("galvo-10khz")
AROUND: tuple[Around, ...] = ("servo", "plant")
SHAPES: tuple[Shape, ...] = ("pointwise", "hermite")


def add_on(loop: Loop, q: QFilter, f_hz: np.ndarray, around: Around) -> np.ndarray:
    forward = polynomial_response(*forward_model(loop, around), loop.z(f_hz))
    return np.asarray(1 - forward * q.response(2 * np.pi * f_hz * loop.dt_s))


def test_example_5() -> None:
    """Paper 000, example 5: the printed plant gives the printed taps."""
    q = design_q(PRINTED, [2000, 4000, 7000], bandwidth_hz=None, around="plant")
    assert q.taps == pytest.approx([22.6, -88.0, 149.7, -147.1, 82.9, -21.7], abs=0.1)


def test_figure_10() -> None:
    """min 1/|T| without the band pass: -2.9 dB at low frequency, -12.82 dB near 9 kHz."""
    loop = FAST.nominal()
    f = np.linspace(0.5, 20000, 40000)
    for shape, value_db, tolerance, at in (
        ("pointwise", -2.9, 0.15, 0.5),
        ("hermite", -12.82, 0.03, 9001),
    ):
        q = design_q(loop, [4000], shape=shape, bandwidth_hz=None, around="plant")
        worst = Prediction(f, loop.s0(f), add_on(loop, q, f, "plant")).min_inverse_t
        assert worst.db == pytest.approx(value_db, abs=tolerance)
        assert worst.f_hz == pytest.approx(at, abs=60)


@pytest.mark.parametrize("around", AROUND)
def test_narrow_bands_meet_the_instant_check(around: Around) -> None:
    """T runs on the circle through T0 and 1, whatever Q is."""
    loop = SLOW.nominal()
    for target in (700.0, 1500.0, 3200.0):
        f = target + np.linspace(-30, 30, 200001)
        q = design_q(loop, [target], bandwidth_hz=0.5, around=around)
        t = 1 - loop.s0(f) * add_on(loop, q, f, around)
        assert 1 / np.abs(t).max() == pytest.approx(instant_check(loop, [target])[0], rel=2e-3)


targets = st.lists(st.floats(0.03, 0.45), min_size=1, max_size=3, unique=True)


@given(targets, st.sampled_from(SHAPES), st.sampled_from(AROUND), st.sampled_from([None, 60.0]))
@settings(max_examples=60)
def test_q_interpolates(
    parts: list[float], shape: Shape, around: Around, bandwidth_hz: float | None
) -> None:
    """1 - PQ = 0 at every target, with its slope for Hermite filters without a band pass."""
    assume(len(parts) < 2 or np.diff(np.sort(parts)).min() > 0.04)
    loop = SLOW.nominal()
    f = np.array(parts) / loop.dt_s
    q = design_q(loop, f.tolist(), shape=shape, bandwidth_hz=bandwidth_hz, around=around)
    assert np.abs(add_on(loop, q, f, around)).max() < 1e-7
    if shape == "hermite" and bandwidth_hz is None:
        step = 1e-4
        slope = np.abs(add_on(loop, q, f + step, around)) / (2 * np.pi * step * loop.dt_s)
        assert slope.max() < 0.05


@given(targets, st.floats(20, 400), st.sampled_from(builtin_loops()))
@settings(max_examples=40)
def test_what_is_returned_is_stable_on_every_member(
    parts: list[float], bandwidth_hz: float, machine: str
) -> None:
    """Or refused; judged here by simulation, not by eigenvalues."""
    assume(len(parts) < 2 or np.diff(np.sort(parts)).min() > 0.04)
    spec = load_loop(machine)
    f = np.array(parts) / spec.loop.dt_s
    try:
        made = fmsdob(spec.loops(), f.tolist(), bandwidth_hz=bandwidth_hz)
    except DesignError:
        return
    assert len(made.spectral_radii) == len(spec.loops())
    ticks = int(8 / (1 - max(made.spectral_radii)))
    assume(ticks < 200_000)
    pulse = np.zeros(2 * ticks)
    pulse[0] = 1.0
    for signal in ("y", "c", "model", "band"):
        out = np.abs(
            batch(spec.loops(), made.blocks, {"d_out": pulse, "d_in": pulse}, signal=signal)
        )
        assert out[:, ticks:].max() <= 0.05 * out.max()


@pytest.mark.parametrize("around", AROUND)
def test_controller_keeps_its_prediction(around: Around) -> None:
    loop = SLOW.nominal()
    made = fmsdob(SLOW.loops(), [900.0, 2600.0], around=around)
    diagram = Diagram((*loop.blocks(), *made.blocks))
    f = made.prediction.f_hz
    s = diagram.response(f, loop.dt_s, "d_out", "y")
    assert s == pytest.approx(made.prediction.s, abs=1e-6)
    assert diagram.response(f, loop.dt_s, "r", "y") == pytest.approx(loop.tracking(f), abs=1e-6)
    uniform = np.linspace(0, 5000, 8001)[1:]
    t = diagram.response(uniform, loop.dt_s, "n", "y")
    assert made.noise_gain == pytest.approx(np.sqrt(np.mean(np.abs(t) ** 2)), rel=3e-3)


def test_rejection_in_time() -> None:
    t = np.arange(20000) * 1e-4
    d = 0.1 * np.sin(2 * np.pi * 1500 * t) + 0.1 * np.sin(2 * np.pi * 2600 * t)
    made = fmsdob(SLOW.loops(), [1500.0, 2600.0])
    for y in batch(SLOW.loops(), made.blocks, {"d_out": d}):
        assert np.abs(y[-1000:]).max() < 1e-9
    r = np.sin(2 * np.pi * 40 * t)
    both = simulate(SLOW.nominal(), made.blocks, {"d_out": d, "r": r})["y"]
    alone = simulate(SLOW.nominal(), (), {"r": r})["y"]
    assert both[-1000:] == pytest.approx(alone[-1000:], abs=1e-9)


def test_velocity_loop_keeps_its_tracking() -> None:
    """With C_e and C_y apart the model of the loop is not T0."""
    table = load_loop("direct-drive-table")
    made = fmsdob(table.loops(), [400.0], bandwidth_hz=20.0)
    loop = table.nominal()
    f = np.array([3.0, 50.0, 390.0, 1500.0])
    diagram = Diagram((*loop.blocks(), *made.blocks))
    assert diagram.response(f, loop.dt_s, "r", "y") == pytest.approx(loop.tracking(f), abs=1e-9)
    assert abs(diagram.response([400.0], loop.dt_s, "d_out", "y")[0]) < 1e-9


def test_detuning_limits_the_depth() -> None:
    q = design_q(SLOW.nominal(), [1500.0], trim=Trim(detuning=0.7))
    depth = np.abs(add_on(SLOW.nominal(), q, np.array([1500.0]), "servo"))[0]
    assert depth == pytest.approx(0.3, abs=1e-9)
    with pytest.raises(DesignError, match="detuning"):
        design_q(SLOW.nominal(), [1500.0], trim=Trim(detuning=1.5))


def test_q_has_the_zeros_that_were_fixed() -> None:
    zeros = [(1.0, 0.0), (1.0, 5000.0), (0.98, 300.0)]
    q = design_q(SLOW.nominal(), [1500.0], bandwidth_hz=None, trim=Trim(zeros=zeros))
    assert len(q.taps) == 2 + 1 + 1 + 2
    points = [1.0, -1.0, 0.98 * np.exp(2j * np.pi * 300 * 1e-4)]
    for z in points:
        assert abs(np.polyval(q.taps[::-1], 1 / z)) < 1e-9
    assert np.abs(add_on(SLOW.nominal(), q, np.array([1500.0]), "servo"))[0] < 1e-9
    with pytest.raises(DesignError, match="fixed zeros"):
        fmsdob(SLOW.loops(), [1500.0], trim=Trim(zeros=[(0.0, 100.0)]))


def test_width_after_a_band_pass() -> None:
    """Finding b: a Hermite Q after a band pass is as narrow as a pointwise one."""
    loop = FAST.nominal()
    f = 4000 + np.linspace(-400, 400, 80001)
    widths = {}
    for shape, through in (("pointwise", False), ("hermite", False), ("hermite", True)):
        q = design_q(loop, [4000], shape=shape, bandwidth_hz=400,
                     trim=Trim(through_band=through), around="plant")  # fmt: skip
        widths[shape, through] = 0.01 * (np.abs(add_on(loop, q, f, "plant")) < 0.1).sum()
    assert widths["pointwise", False] == pytest.approx(37, abs=1)
    assert widths["hermite", False] == pytest.approx(41, abs=1)
    assert widths["hermite", True] == pytest.approx(365, abs=2)


def test_log_sensitivity_integrates_to_its_unstable_zeros() -> None:
    """(18): ln|1 - PQ| integrates to pi times the logarithms of its unstable zeros."""
    loop = SLOW.nominal()
    made = fmsdob(SLOW.loops(), [1500.0], bandwidth_hz=300.0)
    assert made.spectral_radii[0] < 1
    q = design_q(loop, [1500.0], bandwidth_hz=None)
    num, den = forward_model(loop, "servo")
    product = np.convolve(num, q.taps)
    zeros = np.abs(np.roots(np.pad(np.asarray(den), (0, len(product) - len(den))) - product))
    near = np.geomspace(1e-13, 1e-2, 4000)
    target = 2 * np.pi * 1500 * loop.dt_s
    w = np.unique(np.concatenate([np.linspace(1e-9, np.pi, 200001), target + near, target - near]))
    w = w[np.abs(w - target) > 1e-14]
    values = np.log(
        np.maximum(np.abs(add_on(loop, q, w / (2 * np.pi * loop.dt_s), "servo")), 1e-300)
    )
    outside = zeros[zeros > 1 + 1e-9]
    assert np.trapezoid(values, w) == pytest.approx(np.pi * np.log(outside).sum(), abs=1e-3)


def test_the_band_pass_is_1_at_its_centres_with_the_stated_slopes() -> None:
    band = LatticeBandPass.at((2000, 4000, 7000), (40, 40, 40), 2.5e-5)
    w = np.array(band.centres)
    assert band.response(w) == pytest.approx(1.0, abs=1e-9)
    assert np.abs(band.response(np.array([1e-12, np.pi]))) == pytest.approx(0.0, abs=1e-9)
    single = LatticeBandPass((0.7,), (2e-3 * np.pi,))
    fine = 0.7 + np.linspace(-0.01, 0.01, 200001)
    inside = fine[np.abs(single.response(fine)) ** 2 >= 0.5]
    assert inside[-1] - inside[0] == pytest.approx(2e-3 * np.pi, abs=1e-6)
    for i in range(3):
        numeric = (band.response(w[i : i + 1] + 1e-7) - band.response(w[i : i + 1] - 1e-7)) / 2e-7
        assert band.slope(i) == pytest.approx(numeric[0], rel=1e-5)
    assert abs(LatticeBandPass.at((4000,), (400,), 2.5e-5).slope(0)) == pytest.approx(31.7, abs=0.2)
    close = LatticeBandPass((0.1 * np.pi, 0.2 * np.pi, 0.35 * np.pi), (0.1 * np.pi,) * 3)
    assert np.abs(close.response(np.linspace(0, np.pi, 20001))).max() == pytest.approx(
        1.12, abs=5e-3
    )
    blocks = Diagram(band.blocks("x", "y"))
    f = np.array([500.0, 1990.0, 6000.0])
    found = blocks.response(f, 2.5e-5, "x", "y")
    assert found == pytest.approx(band.response(2 * np.pi * f * 2.5e-5), abs=1e-12)
    with pytest.raises(DesignError, match="must lie in"):
        LatticeBandPass((4.0,), (0.1,))


def test_inverse_dob_matches_and_refuses() -> None:
    made = inverse_dob(SLOW.loops(), [1500.0])
    diagram = Diagram((*SLOW.nominal().blocks(), *made.blocks))
    f = made.prediction.f_hz
    found = diagram.response(f, 1e-4, "d_out", "y")
    assert found == pytest.approx(made.prediction.s, abs=1e-8)
    with pytest.raises(Refusal, match=r"zero at \|z\| = 4.41") as refused:
        inverse_dob(FAST.loops(), [1500.0])
    assert refused.value.reason == "inverse"


def test_uncertainty_beyond_the_small_gain_limit_is_refused() -> None:
    """Refused where |Delta| >= 1/|T|, with the frequency."""
    loops = SLOW.loops()
    limit = fmsdob(loops, [1500.0]).prediction.min_inverse_t
    fmsdob(loops, [1500.0], uncertainty=0.999 * limit.value)
    with pytest.raises(Refusal, match="allows 1/") as refused:
        fmsdob(loops, [1500.0], uncertainty=1.001 * limit.value)
    assert refused.value.reason == "small gain"
    assert refused.value.f_hz == pytest.approx(limit.f_hz)
    fmsdob(loops, [1500.0], uncertainty=lambda f: np.where(f > 4000, 0.9, 0.3))


def test_no_plant_is_known_to_the_last_digit() -> None:
    """A target beside Nyquist: |T| of 1e8, where rounding alone decides on stability."""
    with pytest.raises(Refusal, match="never known better") as refused:
        fmsdob([FAST.nominal()], [19999.9], bandwidth_hz=None)
    assert refused.value.reason == "small gain"
    with pytest.raises(Refusal, match="no finite"):
        fmsdob(SLOW.loops(), [1500.0], uncertainty=float("nan"))


def test_low_targets_lie_on_the_grid() -> None:
    made = fmsdob(SLOW.loops(), [0.4], bandwidth_hz=0.2)
    at = np.flatnonzero(made.prediction.f_hz == 0.4)
    assert np.abs(made.prediction.add_on[at]) == pytest.approx([0.0], abs=1e-6)


def test_members_are_checked() -> None:
    loop = SLOW.nominal()
    wild = (loop, loop.varied(gain=1.0, delay_samples=1))
    with pytest.raises(Refusal, match=r"delay 1.*not internally stable") as refused:
        fmsdob(wild, [2600.0], bandwidth_hz=50.0)
    assert refused.value.reason == "unstable"
    with pytest.raises(Refusal, match="use around='servo'"):
        fmsdob(FAST.loops(), [4000.0], around="plant")


@pytest.mark.parametrize(
    ("targets_hz", "message"),
    [([], "at least one"), ([100.0, 100.0], "twice"),
     ([1500.0, 1500.0 + 1e-8], "too close")],
)  # fmt: skip
def test_impossible_targets(targets_hz: list[float], message: str) -> None:
    with pytest.raises(DesignError, match=message):
        fmsdob(SLOW.loops(), targets_hz)


@pytest.mark.parametrize("target_hz", [float("nan"), 0.0, 5000.0])
def test_targets_outside_the_band(target_hz: float) -> None:
    for design in (fmsdob, inverse_dob):
        with pytest.raises(DesignError, match="half the sampling rate"):
            design(SLOW.loops(), [target_hz])


def test_blocked_target() -> None:
    num = np.convolve([0.0, 0.2], [1.0, -2 * np.cos(0.6), 1.0])
    loop = Loop(tuple(num.tolist()), (1.0, -0.3, 0.0, 0.0), 1e-3, (0.0,))
    with pytest.raises(DesignError, match="blocks the disturbance"):
        design_q(loop, [0.6 / (2 * np.pi * 1e-3)])


def test_json_and_header_hold_the_designed_taps() -> None:
    made = fmsdob(SLOW.loops(), [1500.0])
    document = json.loads(json.dumps(made.to_dict(curves=True)))
    assert document["method"] == "fmsdob"
    assert len(document["f_hz"]) == len(document["sensitivity_db"])
    assert document["min_inverse_t_db"] == pytest.approx(made.prediction.min_inverse_t.db)
    assert made.to_dict() == fmsdob(SLOW.loops(), [1500.0]).to_dict()
    assert made.multiplications == sum(b.multiplications for b in made.blocks)
    header = made.to_c_header()
    q = [float(v) for v in header.split("fmsdob_c_num[2] = {")[1].split("}")[0].split(",")]
    assert q == list(design_q(SLOW.nominal(), [1500.0]).taps)
    assert header.count("#ifndef") == header.count("#endif") == 1
    numpy_numbers = fmsdob([replace(SLOW.nominal(), dt_s=np.float64(1e-4))], [1500.0])
    assert "np." not in numpy_numbers.to_c_header()


def test_coefficients_are_the_blocks() -> None:
    """What is exported makes the same filter as what is simulated."""
    made: Controller = fmsdob(SLOW.loops(), [1500.0, 2600.0])
    parts = {c.name: c.values for c in made.coefficients}
    notch = control.tf([1], [1], 1e-4)
    for row in parts["notch"]["rows"]:
        notch *= control.tf(row[:3], row[3:], 1e-4)
    z = np.exp(2j * np.pi * np.array([100.0, 1480.0, 2700.0]) * 1e-4)
    q = (1 - notch(z)) * np.polyval(np.array(parts["q"]["taps"])[::-1], 1 / z)
    diagram = Diagram(design_q(SLOW.nominal(), [1500.0, 2600.0]).blocks("x", "c"))
    found = diagram.response([100.0, 1480.0, 2700.0], 1e-4, "x", "c")
    assert found == pytest.approx(q, abs=1e-9)
    blocks = add_on_blocks(SLOW.nominal(), design_q(SLOW.nominal(), [1500.0, 2600.0]), "servo")
    assert made.blocks == blocks
