"""Paper 002 and the reference's section 3: margins, limits, prefilter, four stages."""

from __future__ import annotations

import math

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stillpath.compensation.base import DesignError
from stillpath.compensation.feedback.controller import Refusal
from stillpath.compensation.feedback.disturbance_observer import (
    binomial_q,
    continuous_q,
    delay_limit_hz,
    design_disturbance_observer,
    observer_sensitivity,
)
from stillpath.compensation.feedback.pd import inertia_pd, loop_margins, margins
from stillpath.compensation.feedback.zero_phase import design_prefilter, reference_plant
from stillpath.models.diagrams import Diagram, polynomial_response
from stillpath.models.loops import Loop, load_loop
from stillpath.simulation.closed_loop import Imperfections, simulate
from tests.compensation.feedback.stability import assert_fades, made_or_refused

LOOPS = load_loop("direct-drive-table").loops()
TABLE = LOOPS[0]
DT = TABLE.dt_s
F_HZ = np.linspace(1.0, 4999.0, 20_001)


def there_and_back(quantum_mm: float = 0.5e-3) -> np.ndarray:
    """2 mm in 16 ms with a triangular speed, and back."""
    t, took = np.arange(1200) * DT, 0.016
    accel = 8.0 / took**2

    def out(t: np.ndarray) -> np.ndarray:
        x = np.clip(t, 0, took)
        return np.where(x < took / 2, 0.5 * accel * x**2, 2.0 - 0.5 * accel * (took - x) ** 2)

    return np.round((out(t - 0.01) - out(t - 0.06)) / quantum_mm) * quantum_mm


class TestPd:
    def test_pd_gains_are_those_of_the_paper(self) -> None:
        kp, kv = inertia_pd(1.0, DT, 100.0, 0.85)
        assert (kp, kv) == (pytest.approx(0.001872, abs=1e-6), pytest.approx(0.05065, abs=1e-5))

    def test_poles_of_a_pure_inertia(self) -> None:
        kp, kv = inertia_pd(0.5, DT, 100.0, 0.85)
        # z^-1 / (1 - z^-1)^2 with kp + kv (1 - z^-1).
        roots = np.roots(np.array([1.0, -2.0, 1.0]) + np.array([0.0, kp + kv, -kv]))
        s = np.log(roots) / DT
        assert np.abs(s) / (2 * math.pi) == pytest.approx([100.0, 100.0])
        assert -s.real / np.abs(s) == pytest.approx([0.85, 0.85])

    def test_margins_of_the_paper(self) -> None:
        got = loop_margins(TABLE)
        assert got.phase_deg == pytest.approx(40.0, abs=0.1)
        assert got.gain_db == pytest.approx(9.33, abs=0.03)

    def test_margins_against_python_control(self) -> None:
        f_hz = np.linspace(0.01, 4999.0, 100_001)
        top, bottom = np.array([0.0, 0.1, 0.05]), np.array([1.0, -1.7, 0.72])
        ours = margins(f_hz, polynomial_response(top, bottom, np.exp(2j * np.pi * f_hz * DT)))
        gain, phase, *_ = control.margin(control.tf(top, bottom, DT))
        assert ours.gain_db == pytest.approx(20 * math.log10(gain), abs=1e-3)
        assert ours.phase_deg == pytest.approx(phase, abs=1e-2)

    def test_refuses_poles_beyond_nyquist(self) -> None:
        with pytest.raises(DesignError, match="5000 Hz"):
            inertia_pd(1.0, DT, 6000.0, 0.7)


class TestObserver:
    def test_q_is_the_bilinear_transform(self) -> None:
        warped = np.tan(np.pi * F_HZ * DT) / (np.pi * DT)
        z = np.exp(2j * np.pi * F_HZ * DT)
        ours = polynomial_response(*binomial_q(150.0, DT), z)
        assert ours == pytest.approx(continuous_q(150.0, warped), abs=1e-12)

    def test_what_the_delay_costs(self) -> None:
        with_delay = np.abs(observer_sensitivity(150.0, DT, 4, F_HZ))
        without = np.abs(1 - continuous_q(150.0, F_HZ))
        more_db = 20 * math.log10(with_delay.max() / without.max())
        assert more_db == pytest.approx(1.70, abs=0.01)
        assert F_HZ[np.argmax(with_delay)] == pytest.approx(221, abs=1)

    def test_limit_of_an_observer_that_knows_no_delay(self) -> None:
        error = np.abs(np.exp(-2j * np.pi * F_HZ * 400e-6) - 1)
        for cutoff, db in ((50.0, -16.5), (150.0, -7.1), (450.0, 1.8)):
            worst = np.max(np.abs(continuous_q(cutoff, F_HZ)) * error)
            assert 20 * math.log10(worst) == pytest.approx(db, abs=0.05)
        assert delay_limit_hz(400e-6) == pytest.approx(354, abs=1)

    def test_blocks_are_what_was_predicted(self) -> None:
        made = design_disturbance_observer(LOOPS, 150.0)
        whole = Diagram((*TABLE.blocks(), *made.blocks))
        f_hz = made.prediction.f_hz[::50]
        got = whole.response(f_hz, DT, "d_out", "y")
        assert got == pytest.approx(made.prediction.s[::50], abs=1e-8)
        assert max(made.spectral_radii) < 1

    def test_a_constant_force_is_rejected(self) -> None:
        made = design_disturbance_observer(LOOPS, 150.0)
        force = np.ones(4000)
        for loop in LOOPS:
            y = simulate(loop, made.blocks, {"d_in": force})["y"]
            assert abs(y[-1]) < 1e-3 * abs(simulate(loop, (), {"d_in": force})["y"][-1])

    def test_a_ringing_inverse_is_refused(self) -> None:
        bad = Loop((0.0, 0.02, 0.02, 0.03), (1.0, -1.2, 0.5), DT)
        with pytest.raises(Refusal, match="zero at") as refused:
            design_disturbance_observer((bad,), 100.0)
        assert refused.value.reason == "inverse"

    def test_beyond_its_limit_it_is_refused(self) -> None:
        late = (TABLE, TABLE.varied(1.0, 4.0))
        with pytest.raises(Refusal) as refused:
            design_disturbance_observer(late, 800.0)
        assert refused.value.reason == "unstable"

    @settings(max_examples=25)
    @given(cutoff=st.floats(5, 1500), gain=st.floats(0.6, 1.5), delay=st.floats(0.0, 4.0))
    def test_stable_on_every_member_or_refused(
        self, cutoff: float, gain: float, delay: float
    ) -> None:
        try:
            loops = (TABLE, TABLE.varied(gain, delay))
        except ValueError:
            return  # no stable baseline
        made = made_or_refused(lambda: design_disturbance_observer(loops, cutoff), "unstable")
        if made is not None:
            kick = np.zeros(30_000)
            kick[:10] = 1.0
            assert_fades(made, loops, {"d_in": kick}, ("y", "c", "est", "own"))


class TestPrefilter:
    def test_peak_and_preview_of_the_paper(self) -> None:
        made = design_prefilter(TABLE)
        assert made.peak.db == pytest.approx(52.2, abs=0.1)
        assert made.peak.f_hz == pytest.approx(3077, abs=3)
        assert made.preview == 5
        assert design_prefilter(TABLE, cutoff_hz=500.0).preview == 10

    def test_zero_phase_overall(self) -> None:
        total = design_prefilter(TABLE).response(F_HZ) * TABLE.tracking(F_HZ)
        assert total == pytest.approx(np.cos(np.pi * F_HZ * DT) ** 2, abs=1e-8)

    def test_reference_plant(self) -> None:
        ours = reference_plant(TABLE).frequency_response(F_HZ[::100])
        assert ours == pytest.approx(TABLE.tracking(F_HZ[::100]), abs=1e-9)

    def test_coefficients_are_the_filter(self) -> None:
        made = design_prefilter(TABLE, cutoff_hz=500.0)
        assert [part.kind for part in made.coefficients] == ["fir", "sos", "fir"]


def test_observer_and_prefilters_each_reduce_the_error() -> None:
    """PD, with observer, with ZPETC, with FIR: 600 um without feedforward, chatter gone with it."""
    y_d = there_and_back()
    observer = design_disturbance_observer(LOOPS, 150.0).blocks
    real = Imperfections(input_limit=10.0, friction=0.12, friction_speed=1e-5)
    peak, step = {}, {}
    for name, blocks, r in (
        ("pd", (), y_d),
        ("observer", observer, y_d),
        ("zpetc", observer, design_prefilter(TABLE).apply(y_d)),
        ("fir", observer, design_prefilter(TABLE, cutoff_hz=500.0).apply(y_d)),
    ):
        got = simulate(TABLE, blocks, {"r": r}, ("y", "u"), imperfections=real)
        peak[name] = 1e3 * np.abs(y_d - got["y"]).max()
        step[name] = np.sqrt(np.mean(np.diff(got["u"]) ** 2))
    assert peak["pd"] == pytest.approx(580, rel=0.02)
    assert peak["observer"] == pytest.approx(576, rel=0.02)
    assert peak["zpetc"] < 5
    assert peak["fir"] < 5
    assert step["fir"] < step["zpetc"] / 4
