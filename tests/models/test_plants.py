"""Plants against scipy, python-control and the golden recipe."""

from __future__ import annotations

import control
import numpy as np
import pytest
import scipy.signal
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from stillpath.models.errors import ModelError
from stillpath.models.notes import WarningNote
from stillpath.models.plants import (
    FirSpec,
    Mode,
    ModesSpec,
    PairsSpec,
    ParametricMembers,
    PlantSetSpec,
    PolePair,
    TfSpec,
    ZeroPair,
    ZpkSpec,
    continuous,
    discretise,
    frequency_response,
    plant_set,
)
from stillpath.models.repair import repair_rounded

F_HZ = np.linspace(0.5, 240.0, 97)

PAIRS = PairsSpec(
    poles=(PolePair(f_hz=34, zeta=0.28), PolePair(f_hz=44.7, zeta=0.046)),
    zeros=(ZeroPair(f_hz=41.2, zeta=-0.2),),
    real_zero_tau_s=0.0012,
)
TAZ_NUM = (0.0874, -0.3415, 0.5118, -0.3481, 0.09063)
TAZ_DEN = (1.0, -4.54, 8.283, -7.583, 3.479, -0.639)

modes = st.lists(
    st.tuples(st.floats(8, 180), st.floats(0.01, 0.9)),
    min_size=1,
    max_size=4,
    unique_by=lambda m: m[0],
)


def polynomial(f_hz: float, zeta: float) -> np.ndarray:
    w = 2 * np.pi * f_hz
    return np.array([1 / w**2, 2 * zeta / w, 1.0])


def transfer(spec: PairsSpec) -> control.TransferFunction:
    num, den = np.array([spec.real_zero_tau_s, 1.0]), np.ones(1)
    for z in spec.zeros:
        num = np.polymul(num, polynomial(z.f_hz, z.zeta))
    for p in spec.poles:
        den = np.polymul(den, polynomial(p.f_hz, p.zeta))
    return control.tf(num, den)


def test_pairs_answer_as_python_control_says() -> None:
    expected = transfer(PAIRS)(2j * np.pi * F_HZ)
    np.testing.assert_allclose(frequency_response(PAIRS, F_HZ), expected, rtol=1e-9)
    np.testing.assert_allclose(continuous(PAIRS).frequency_response(F_HZ), expected, rtol=1e-9)


@pytest.mark.parametrize("dt_s", [1e-3, 1e-4])
def test_first_order_hold_as_scipy(dt_s: float) -> None:
    plant = discretise(PAIRS, dt_s)
    system = transfer(PAIRS)
    a, b, c, d = scipy.signal.tf2ss(system.num[0][0], system.den[0][0])
    reference = scipy.signal.cont2discrete((a, b, c, d), dt_s, method="foh")[:4]
    impulse = scipy.signal.dimpulse((*reference, dt_s), n=200)[1][0][:, 0]
    np.testing.assert_allclose(plant.impulse_response(200), impulse, atol=1e-9)


def test_hold_is_exact_for_a_ramp_between_samples() -> None:
    rng = np.random.default_rng(4)
    u = rng.normal(size=60)
    system = control.ss(transfer(PAIRS))
    fine = np.arange(0, 59 * 50 + 1) / 50
    dense = control.forced_response(system, fine * 1e-3, np.interp(fine, np.arange(60), u - u[0]))
    plant = discretise(PAIRS, 1e-3)
    y = np.convolve(plant.impulse_response(60), u - u[0])[:60]
    np.testing.assert_allclose(y, np.asarray(dense.outputs)[::50], atol=1e-9)


@given(modes)
@settings(max_examples=40)
def test_sum_of_modes_is_the_sum(listed: list[tuple[float, float]]) -> None:
    spec = ModesSpec(modes=tuple(Mode(f_hz=f, zeta=z, gain=1 / len(listed)) for f, z in listed))
    s = 2j * np.pi * F_HZ
    expected = sum(1 / len(listed) / np.polyval(polynomial(f, z), s) for f, z in listed)
    np.testing.assert_allclose(continuous(spec).frequency_response(F_HZ), expected, rtol=1e-5)
    plant = discretise(spec, 1e-3)
    np.testing.assert_allclose(plant.frequency_response(0.0), 1.0, atol=1e-9)
    assert np.abs(plant.poles()).max() < 1


@given(st.floats(0.8, 1.2), st.floats(0.5, 1.5))
@settings(max_examples=25)
def test_scaling_roots_is_scaling_the_document(frequency: float, damping: float) -> None:
    plain = PairsSpec(poles=PAIRS.poles, zeros=PAIRS.zeros)
    roots = plain.roots()
    as_zpk = ZpkSpec(
        zeros=tuple((z.real, z.imag) for z in roots.zeros),
        poles=tuple((p.real, p.imag) for p in roots.poles),
    )
    np.testing.assert_allclose(
        frequency_response(as_zpk.scaled(frequency, damping), F_HZ),
        frequency_response(plain.scaled(frequency, damping), F_HZ),
        rtol=1e-9,
    )


def test_modes_zeros_and_settling_time() -> None:
    plant = discretise(PAIRS, 1e-3)
    np.testing.assert_allclose(plant.modes(), [[34, 0.28], [44.7, 0.046]], rtol=1e-9)
    # Slowest pole: zeta w = .046 * 2 pi 44.7, to one percent.
    assert plant.settling_time_s() == pytest.approx(np.log(100) / (0.046 * 2 * np.pi * 44.7))
    zeros = continuous(PAIRS).zeros()
    w = 2 * np.pi * 41.2
    pair = w * (0.2 + 1j * np.sqrt(1 - 0.04))
    assert np.abs(zeros - pair).min() < 1e-6
    assert np.abs(zeros + 1 / 0.0012).min() < 1e-6


def test_fir_is_its_taps() -> None:
    spec = FirSpec(taps=(0.2, 0.5, 0.3), dt_s=1e-3)
    plant = discretise(spec, 1e-3)
    np.testing.assert_allclose(plant.impulse_response(5), [0.2, 0.5, 0.3, 0, 0], atol=1e-15)
    with pytest.raises(ModelError, match="pure delay"):
        discretise(spec, 5e-4)
    assert discretise(FirSpec(taps=(1.0,), dt_s=1e-3), 1e-3).order == 0


def test_an_axis_without_dynamics_is_a_plant() -> None:
    still = FirSpec(taps=(1.0,), dt_s=1e-3)
    for plant in (still, discretise(still, 2e-3), continuous(still)):
        np.testing.assert_array_equal(frequency_response(plant, [10.0, 90.0]), 1.0)


def test_a_long_impulse_response_takes_little_memory() -> None:
    """By its polynomial, and by its states block by block, as scipy says."""
    taps = np.exp(-np.arange(512) / 60.0) * np.sin(np.arange(512) / 9.0) + 0.01
    taps /= taps.sum()
    spec = FirSpec(taps=tuple(taps.tolist()), dt_s=1e-3)
    f_hz = np.array([1.0, 20.0, 333.0])
    _, wanted = scipy.signal.freqz(taps, worN=2e-3 * np.pi * f_hz)
    np.testing.assert_allclose(frequency_response(spec, f_hz), wanted, rtol=1e-9)
    np.testing.assert_allclose(frequency_response(discretise(spec, 1e-3), f_hz), wanted, rtol=1e-9)


def test_discrete_plant_at_another_sampling_time() -> None:
    fine = discretise(PAIRS, 5e-4)
    again = ZpkSpec(
        zeros=tuple((z.real, z.imag) for z in fine.zeros()),
        poles=tuple((p.real, p.imag) for p in fine.poles()),
        dt_s=5e-4,
    )
    np.testing.assert_allclose(
        discretise(again, 1e-3).impulse_response(80),
        discretise(PAIRS, 1e-3).impulse_response(80),
        atol=1e-8,
    )
    assert "converted" in discretise(again, 1e-3).notes[-1]


def test_dc_gain_rule() -> None:
    assert TfSpec(num=(0.1,), den=(1, -0.9), dt_s=1e-3).notes == ()
    assert "scaled" in TfSpec(num=(0.101,), den=(1, -0.9), dt_s=1e-3).notes[0]
    (far_off,) = TfSpec(num=(0.11,), den=(1, -0.9), dt_s=1e-3).notes
    assert isinstance(far_off, WarningNote)
    assert not isinstance(TfSpec(num=(0.101,), den=(1, -0.9), dt_s=1e-3).notes[0], WarningNote)
    with pytest.raises(ValidationError, match=r"DC gain 1\.2"):
        TfSpec(num=(0.12,), den=(1, -0.9), dt_s=1e-3)
    spec = TfSpec(num=(0.11,), den=(1, -0.9), dt_s=1e-3)
    assert discretise(spec, 1e-3).frequency_response(0.0)[0] == pytest.approx(1.0, abs=1e-12)
    assert frequency_response(spec, [0.0])[0] == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: TfSpec(num=(0.1,), den=(1, -1.1), dt_s=1e-3), r"unstable plant: pole z = 1\.1"),
        (lambda: TfSpec(num=(1.0,), den=(1, -1.0)), r"unstable plant: pole s = 1"),
        (lambda: TfSpec(num=(1.0,), den=(1, 0.0)), "integrator"),
        (lambda: TfSpec(num=TAZ_NUM, den=TAZ_DEN, dt_s=1e-3), "integrator .*rounded"),
        (lambda: TfSpec(num=(1, 2, 1), den=(1, 1.0)), "improper"),
        (lambda: TfSpec(num=(float("nan"),), den=(1, 1.0)), "finite"),
        (lambda: ZpkSpec(poles=((-1.0, 1.0),)), "conjugate"),
        (lambda: ZpkSpec(poles=((0.0, 0.0),)), "integrator"),
        (lambda: PairsSpec(poles=(PolePair(f_hz=30, zeta=0.0),)), "greater than 0"),
        (
            lambda: discretise(PairsSpec(poles=(PolePair(f_hz=30, zeta=1e-20),)), 1e-3),
            "never dies away .* correct its damping",
        ),
        (lambda: FirSpec(taps=(float("inf"),), dt_s=1e-3), "finite"),
        (
            lambda: PlantSetSpec(
                nominal=FirSpec(taps=(1.0,), dt_s=1e-3),
                members=ParametricMembers(frequency_scale=(0.9, 1.1)),
            ),
            "no frequencies to scale",
        ),
    ],
)
def test_refusals_say_why(make: object, message: str) -> None:
    with pytest.raises((ValidationError, ModelError), match=message):
        make()  # type: ignore[operator]


def test_taz_repair_a() -> None:
    """Figures of the reference notes, section 6."""
    num, den, moved = repair_rounded(TAZ_NUM, TAZ_DEN, (4, 4, 4, 4, 5), (3,) * 6)
    np.testing.assert_allclose(np.abs(den - TAZ_DEN)[1:], 4.6e-5, rtol=0.02)
    assert np.abs(moved).max() == pytest.approx(0.09, abs=0.005)
    plant = discretise(TfSpec(num=tuple(num), den=tuple(den), dt_s=1e-3), 1e-3)
    assert np.abs(plant.poles()).max() == pytest.approx(0.9803, abs=1e-4)
    np.testing.assert_allclose(plant.modes(), [[21.0, 0.29], [35.5, 0.089]], rtol=0.01)
    np.testing.assert_allclose(
        np.abs(plant.frequency_response([5, 10, 20, 30, 60])),
        [1.014, 1.056, 0.81, 0.68, 0.10],
        atol=0.006,
    )
    outside = plant.zeros()[np.abs(plant.zeros()) > 1]
    np.testing.assert_allclose(np.abs(outside), 1.0345, atol=1e-3)
    with pytest.raises(ModelError, match="fit it again"):
        repair_rounded((0.5,), (1.0, -0.9), (6,), (6, 6))


def test_golden_members_are_ten_plants() -> None:
    rule = ParametricMembers(frequency_scale=(0.96, 0.98, 1, 1.02, 1.04), damping_scale=(0.8, 1.2))
    spec = PlantSetSpec(nominal=PAIRS, members=rule)
    plants = plant_set(spec, 1e-3)
    assert len(plants.members) == 10
    assert plants.weights.sum() == pytest.approx(1.0)
    expected = [(34 * f, 0.28 * z) for f in (0.96, 0.98, 1, 1.02, 1.04) for z in (0.8, 1.2)]
    np.testing.assert_allclose([p.modes()[0] for p in plants.members], expected, rtol=1e-9)
    member = spec.weighted_members()[0].plant
    assert isinstance(member, PairsSpec)
    assert member.zeros[0].f_hz == pytest.approx(41.2 * 0.96)
    assert member.zeros[0].zeta == pytest.approx(-0.2 * 0.8)
    assert plant_set(PlantSetSpec(nominal=PAIRS), 1e-3).weights.tolist() == [1.0]


def test_sampling_time_must_be_positive() -> None:
    with pytest.raises(ModelError, match="positive"):
        discretise(PAIRS, 0.0)
