"""Ripple as it is written down, and as it is learnt from passes."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from stillpath.models.errors import ModelError
from stillpath.models.identification.ripple import (
    PassLog,
    WaveBasis,
    learn_ripple,
    update_ripple,
)
from stillpath.models.identification.ripple_observability import folded_distances
from stillpath.models.plants import ContinuousPlant, DiscretePlant, Mode, ModesSpec, continuous
from stillpath.models.response_kernels import dense_response
from stillpath.models.ripple import (
    AxisRipple,
    RippleHarmonic,
    RippleSide,
    RippleSource,
    RippleTable,
)

DT = 1e-3
FINER = 8


def plant(f_hz: float = 45.0) -> ContinuousPlant:
    return continuous(ModesSpec(modes=(Mode(f_hz=f_hz, zeta=0.05),)))


def ripple(side: RippleSide = "input", **more: float) -> AxisRipple:
    waves = ((1, 20.0, 10.0), (2, 8.0, 40.0), (3, 4.0, -70.0))
    harmonics = tuple(RippleHarmonic(number=h, amplitude_um=a, phase_deg=p) for h, a, p in waves)
    source = RippleSource(name="belt", pitch_mm=2.0, enters=side, harmonics=harmonics)
    return AxisRipple(sources=(source,), **more)


def table(side: RippleSide = "input") -> RippleTable:
    return ripple(side).table(side)


def run(discrete: DiscretePlant, u: np.ndarray) -> np.ndarray:
    y = np.empty(len(u))
    a, b, c, d = discrete.a, discrete.b, discrete.c, discrete.d
    dense_response(a, b, c, d, float(u[0]), np.zeros(len(b)), np.ascontiguousarray(u), y)
    return y


def drive(kind: str, seconds: float = 6.0, speed: float = 80.0) -> np.ndarray:
    t = np.arange(0, seconds, DT)
    v = {
        "constant": np.full(len(t), speed),
        "ramp": np.interp(t, [0.2, seconds - 0.2], [30.0, 110.0]),
        "stop and go": 60 * np.sin(2 * np.pi * t / 1.5) ** 2,
    }[kind]
    v = v * np.clip(np.minimum(t / 0.1, (seconds - t) / 0.1), 0, 1)
    return np.cumsum(v) * DT


def driven(
    command: np.ndarray, waves: RippleTable, side: RippleSide, f_hz: float = 45.0
) -> tuple[np.ndarray, np.ndarray]:
    """Position of the axis, finely sampled, for a command that is linear between samples."""
    fine_t = np.arange((len(command) - 1) * FINER + 1) * DT / FINER
    fine = np.interp(fine_t, np.arange(len(command)) * DT, command)
    entering = fine + waves.deviation_mm(fine) if side == "input" else fine
    y = run(plant(f_hz).discretise(DT / FINER), entering)
    return fine_t, y if side == "input" else y + waves.deviation_mm(fine)


def learnt_error(learnt: RippleTable, true: RippleTable) -> float:
    difference = learnt.coefficient_mm - true.coefficient_mm
    return float(np.linalg.norm(difference) / np.linalg.norm(true.coefficient_mm))


class TestDocument:
    def test_the_deviation_is_the_sum_of_the_harmonics(self) -> None:
        s = np.array([0.0, 0.5, 1.3])
        expected = sum(
            1e-3 * a * np.sin(np.pi * h * s + math.radians(p))
            for h, a, p in ((1, 20, 10), (2, 8, 40), (3, 4, -70))
        )
        assert table().deviation_mm(s) == pytest.approx(expected)

    def test_slope_is_the_derivative(self) -> None:
        s = np.linspace(0, 2, 50)
        step = 1e-6
        difference = table().deviation_mm(s + step) - table().deviation_mm(s - step)
        assert table().slope(s) == pytest.approx(difference / (2 * step), abs=1e-8)

    def test_phase_errors_of_the_reference(self) -> None:
        """Cut for 5, 15, 30, 60 degrees of the pitch: 89, 67, 35, -17 %."""
        cuts = [1 - table().residual_share(2.0 * d / 360) for d in (5, 15, 30, 60)]
        assert cuts == pytest.approx([0.89, 0.67, 0.35, -0.17], abs=0.005)

    @given(st.floats(-5, 5))
    def test_residual_share_is_that_of_the_waves(self, offset: float) -> None:
        s = np.linspace(0, 2, 400, endpoint=False)
        waves = table()
        left = waves.deviation_mm(s + offset) - waves.deviation_mm(s)
        share = np.sqrt(np.mean(left**2) / np.mean(waves.deviation_mm(s) ** 2))
        assert waves.residual_share(offset) == pytest.approx(share, abs=1e-9)

    def test_wrong_units_are_noticed(self) -> None:
        wave = RippleHarmonic(number=1, amplitude_um=200.0, phase_deg=0.0)
        source = RippleSource(name="belt", pitch_mm=0.2, harmonics=(wave,))
        with pytest.raises(ValidationError, match="micrometres"):
            AxisRipple(sources=(source,))

    def test_what_no_belt_has(self) -> None:
        for amplitude_um in (5001.0, 1e300):
            wave = RippleHarmonic(number=1, amplitude_um=amplitude_um, phase_deg=0.0)
            source = RippleSource(name="belt", pitch_mm=2.0, enters="output", harmonics=(wave,))
            with pytest.raises(ValidationError, match="at most 5000 is a ripple"):
                AxisRipple(sources=(source,))

    def test_a_harmonic_twice(self) -> None:
        wave = RippleHarmonic(number=1, amplitude_um=2.0, phase_deg=0.0)
        with pytest.raises(ValidationError, match="twice"):
            RippleSource(name="belt", pitch_mm=2.0, harmonics=(wave, wave))


class TestLearning:
    basis = (WaveBasis("belt", 2.0),)

    @pytest.mark.parametrize("kind", ["constant", "ramp", "stop and go"])
    @pytest.mark.parametrize("side", ["input", "output"])
    def test_ripple_is_learnt_from_positions_with_honest_deviations(
        self, kind: str, side: RippleSide
    ) -> None:
        command = drive(kind)
        t, y = driven(command, table(side), side)
        noise = np.random.default_rng(1).normal(scale=0.01, size=len(t))
        log = PassLog(command, t[::FINER], (y + noise)[::FINER] + 0.3, homed=True)
        made = learn_ripple([log], (WaveBasis("belt", 2.0, enters=side),), plant().discretise(DT))
        # Waves above the resonance reach the sensor weakly.
        assert learnt_error(made.ripple.table(side), table(side)) < 0.08
        assert 0.4 < made.explained < 0.9
        assert all(one.observable and one.noise_gain < 1.3 for one in made.observability)
        # The standard deviations are honest: within four of them.
        for got, true in zip(
            made.ripple.sources[0].harmonics, ripple().sources[0].harmonics, strict=True
        ):
            assert got.sd_um is not None
            assert abs(got.amplitude_um - true.amplitude_um) < 4 * got.sd_um + 0.15

    @pytest.mark.parametrize("speed", [80.0, -80.0])
    def test_accelerometer(self, speed: float) -> None:
        command = drive("constant", speed=speed)
        t, y = driven(command, table(), "input")
        accel = np.gradient(np.gradient(y, t), t)
        at = np.arange(0, t[-1], 1 / 3200)
        noise = np.random.default_rng(2).normal(scale=300.0, size=len(at))
        log = PassLog(
            command, at, np.interp(at, t, accel) + noise + 9810, kind="acceleration", homed=True
        )
        made = learn_ripple([log], self.basis, plant().discretise(DT))
        assert learnt_error(made.ripple.table("input"), table()) < 0.03

    @pytest.mark.parametrize(("offset_hz", "bound"), [(9.5, 0.07), (0.25, 0.08)])
    def test_slow_sensor(self, offset_hz: float, bound: float) -> None:
        """100 Hz sensor, 5 s, 5 um noise: the reference has 2.8 and 3.9 % (finding vi)."""
        # The second harmonic folds onto the first near 3 f = 100 Hz; f = v / 2 mm.
        speed = 2.0 * (100 + offset_hz) / 3
        command = drive("constant", seconds=5.0, speed=speed)
        t, y = driven(command, table("output"), "output")
        at = np.arange(0, t[-1], 0.01)
        noise = np.random.default_rng(3).normal(scale=0.005, size=len(at))
        log = PassLog(command, at, np.interp(at, t, y) + noise, homed=True)
        basis = (WaveBasis("belt", 2.0, enters="output"),)
        made = learn_ripple([log], basis, plant().discretise(DT))
        assert learnt_error(made.ripple.table("output"), table("output")) < bound
        distance = made.observability[0].distance_hz
        assert distance == pytest.approx(min(offset_hz, 9.5), rel=0.5)

    def test_the_singular_set_is_refused_and_another_speed_heals_it(self) -> None:
        basis = (WaveBasis("belt", 2.0, enters="output"),)
        logs = []
        for speed in (2.0 * 100 / 3, 47.0):
            command = drive("constant", seconds=5.0, speed=speed)
            t, y = driven(command, table("output"), "output")
            at = np.arange(0.5, t[-1] - 0.2, 0.01)
            logs.append(PassLog(command, at, np.interp(at, t, y), homed=True))
        with pytest.raises(ModelError, match="another speed"):
            learn_ripple(logs[:1], basis, plant().discretise(DT))
        made = learn_ripple(logs, basis, plant().discretise(DT))
        assert learnt_error(made.ripple.table("output"), table("output")) < 0.02

    def test_refuses_without_an_absolute_phase(self) -> None:
        command = drive("constant")
        log = PassLog(command, np.arange(100) * DT, np.zeros(100), source="pass.csv")
        with pytest.raises(ModelError, match=r"pass\.csv.*homed"):
            learn_ripple([log], self.basis, plant().discretise(DT))

    def test_refuses_an_accelerometer_without_steady_speed(self) -> None:
        command = drive("stop and go")
        log = PassLog(command, np.arange(500) * DT, np.ones(500), "acceleration", homed=True)
        with pytest.raises(ModelError, match="constant speed"):
            learn_ripple([log], self.basis, plant().discretise(DT))

    @pytest.mark.parametrize("kind", ["position", "acceleration"])
    def test_refuses_waves_faster_than_the_samples_show(self, kind: str) -> None:
        command = drive("constant", speed=150.0)
        t = np.arange(len(command)) * DT
        log = PassLog(command, t, np.zeros(len(t)), kind, homed=True, source="fast.csv")
        with pytest.raises(ModelError, match=r"fast.csv: at 150 mm/s harmonic 3.*at most 133 mm/s"):
            learn_ripple([log], self.basis, plant().discretise(DT))

    def test_what_no_axis_has_is_refused(self) -> None:
        """Metres taken for millimetres: a ripple steeper than the axis moves."""
        command = drive("constant", speed=40.0)
        measured = command + 2.0 * np.sin(np.pi * command)
        log = PassLog(command, np.arange(len(command)) * DT, measured, homed=True)
        with pytest.raises(ModelError, match=r"cannot be the ripple.*slope"):
            learn_ripple([log], self.basis, plant().discretise(DT))

    def test_refuses_too_little(self) -> None:
        command = drive("constant")
        log = PassLog(command, np.arange(10) * DT, np.ones(10), homed=True)
        with pytest.raises(ModelError, match="drive longer"):
            learn_ripple([log], self.basis, plant().discretise(DT))


class TestUpdate:
    @settings(max_examples=30)
    @given(st.floats(0.05, 1.0), st.integers(1, 30))
    def test_converges_to_what_is_learnt(self, gain: float, rounds: int) -> None:
        wave = RippleHarmonic(number=1, amplitude_um=5.0, phase_deg=200.0)
        known = AxisRipple(sources=(RippleSource(name="belt", pitch_mm=2.0, harmonics=(wave,)),))
        start = learnt_error_of(known)
        for _ in range(rounds):
            known = update_ripple(known, ripple(), gain=gain)
        assert learnt_error_of(known) == pytest.approx(start * (1 - gain) ** rounds, abs=1e-9)

    @pytest.mark.parametrize("remaining", [False, True])
    def test_what_was_not_looked_for_stays(self, remaining: bool) -> None:
        """Another part, or another harmonic of this one."""
        wave = RippleHarmonic(number=7, amplitude_um=5.0, phase_deg=20.0, sd_um=0.5)
        other = RippleSource(name="pulley", pitch_mm=40.0, harmonics=(wave,))
        more = RippleSource(name="belt", pitch_mm=2.0, harmonics=(wave,))
        known = AxisRipple(sources=(more, other))
        made = update_ripple(known, ripple(), gain=0.5, remaining=remaining)
        belt, pulley = made.sources
        for kept in (pulley.harmonics[0], belt.harmonics[0]):
            assert kept.model_dump() == pytest.approx(wave.model_dump())

    def test_another_pitch_is_refused(self) -> None:
        other = ripple().model_copy(
            update={"sources": (ripple().sources[0].model_copy(update={"pitch_mm": 3.0}),)}
        )
        with pytest.raises(ModelError, match="learn afresh"):
            update_ripple(ripple(), other)

    def test_parts_of_one_name_are_told_by_their_pitch(self) -> None:
        wave = RippleHarmonic(number=1, amplitude_um=5.0, phase_deg=20.0)
        parts = [RippleSource(name="belt", pitch_mm=p, harmonics=(wave,)) for p in (2.0, 40.0)]
        known = AxisRipple(sources=tuple(parts))
        made = update_ripple(known, known)
        assert [source.pitch_mm for source in made.sources] == [2.0, 40.0]

    def test_too_many_harmonics_are_refused(self) -> None:
        few, many = (
            AxisRipple(
                sources=(
                    RippleSource(
                        name="belt",
                        pitch_mm=40.0,
                        harmonics=tuple(
                            RippleHarmonic(number=n, amplitude_um=0.1, phase_deg=0.0)
                            for n in numbers
                        ),
                    ),
                )
            )
            for numbers in (range(1, 31), range(31, 91))
        )
        with pytest.raises(ModelError, match=r"at most 64 .* learn fewer harmonics"):
            update_ripple(few, many)

    @pytest.mark.parametrize("gain", [0.0, 1.5])
    def test_gains_outside_0_to_1_are_refused(self, gain: float) -> None:
        with pytest.raises(ModelError, match="gain"):
            update_ripple(ripple(), ripple(), gain=gain)


def learnt_error_of(known: AxisRipple) -> float:
    s = np.linspace(0, 2, 200, endpoint=False)
    gap = known.table("input").deviation_mm(s) - table().deviation_mm(s)
    return float(np.sqrt(np.mean(gap**2)))


@pytest.mark.parametrize(
    ("f_hz", "sensor", "expected"),
    [
        # Paper 001: (0.6, 2k) and (0.3, 1.7k) Hz are singular for a sensor of 2 kHz.
        ((0.6e3, 2e3), 2e3, 0.0),
        ((0.3e3, 1.7e3), 2e3, 0.0),
        ((40.0, 80.0, 120.0), 1000.0, 40.0),
        ((33.0, 66.0), 100.0, 1.0),
    ],
)
def test_folded_distances(f_hz: tuple[float, ...], sensor: float, expected: float) -> None:
    assert folded_distances(np.array(f_hz), sensor).min() == pytest.approx(expected, abs=1e-9)
