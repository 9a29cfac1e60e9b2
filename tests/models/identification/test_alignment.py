"""Finding Klipper's test in a log: start, direction, and what is wrong with a log."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import butter, correlate, sosfiltfilt

from stillpath.models.errors import ModelError
from stillpath.models.identification.alignment import align, check_pair
from stillpath.models.identification.chirp_search import resample
from stillpath.models.identification.excitation import regenerate
from stillpath.models.identification.synthetic import ADXL345, LIS2DW, Sensor, simulate_log
from stillpath.models.identification.types import AccelerationLog, Excitation
from stillpath.models.plants import Mode, ModesSpec

NEW = Excitation((1.0, 0.0))
NEW_Y = Excitation((0.0, 1.0))
LEGACY = Excitation((1.0, 0.0), 5.0, 10_000 / 75, 75.0, 1.0, 0.0, out_and_back=True)
SHORT = Excitation((1.0, 0.0), 5.0, 25.0, 60.0, 1.0)
PLANT = ModesSpec(modes=(Mode(f_hz=47, zeta=0.035, gain=0.8), Mode(f_hz=95, zeta=0.06, gain=0.2)))
PLANTS = {"x": PLANT, "y": PLANT}
SWAPPED = ((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0))
TURNED = ((2 / 3, -1 / 3, 2 / 3), (2 / 3, 2 / 3, -1 / 3), (-1 / 3, 2 / 3, 2 / 3))
TURNED_SENSOR = Sensor(rate_hz=3187.3, rotation=TURNED, delay_s=0.6e-3, jitter_s=2e-6)
# Group delay of PLANT towards 0 Hz, sum of gain 2 zeta/w.
SLOW_S = 0.8 * 0.035 / (np.pi * 47) + 0.2 * 0.06 / (np.pi * 95)


def log_of(excitation: Excitation = SHORT, **options: object) -> AccelerationLog:
    rng = np.random.default_rng(11)
    return simulate_log(PLANTS, excitation, rng=rng, **options)  # type: ignore[arg-type]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("excitation", "sensor", "offset_s"),
    [
        (NEW, ADXL345, -0.5),
        (NEW, TURNED_SENSOR, 0.37),
        (LEGACY, LIS2DW, 0.37),
        (LEGACY, TURNED_SENSOR, -0.5),
        (NEW_Y, ADXL345, 0.37),
        (NEW_Y, LIS2DW, -0.5),
    ],
)
def test_start_and_direction_are_found(
    excitation: Excitation, sensor: Sensor, offset_s: float
) -> None:
    start_s = 100.0 + offset_s
    aligned = align(log_of(excitation, sensor=sensor, start_s=start_s, lead_s=0.8), excitation)
    # The start cannot be told from the delays of sensor and plant.
    assert aligned.start_s == pytest.approx(start_s + sensor.delay_s + SLOW_S, abs=1e-4)
    along = np.array([*excitation.direction, 0.0])
    np.testing.assert_allclose(aligned.direction, np.array(sensor.rotation) @ along, atol=0.005)
    assert aligned.correlation > 0.99
    assert aligned.f_reached_hz == excitation.f_end_hz
    assert len(aligned.command_mm_s2) == len(aligned.measured_mm_s2)
    assert aligned.notes == ()


def test_a_log_that_begins_with_the_test_has_the_rest_before_it() -> None:
    """As Klipper writes it: the machine stood still, and nobody recorded that."""
    rested, cut = (align(log_of(lead_s=lead_s), SHORT) for lead_s in (0.8, 0.0))
    assert abs(len(cut.command_mm_s2) - len(rested.command_mm_s2)) <= 2
    still = int(0.45 * cut.rate_hz)
    assert not cut.measured_mm_s2[:still].any()
    assert not cut.command_mm_s2[:still].any()
    begun = int(0.55 * cut.rate_hz)
    assert np.abs(cut.command_mm_s2[still:begun]).max() > 100.0


@pytest.mark.parametrize("old", [False, True])
@pytest.mark.parametrize("frame_hz", [7.0, 10.0, 13.0])
def test_a_log_without_the_slow_wave_shows_of_which_kind_its_test_is(
    frame_hz: float, old: bool
) -> None:
    """Klipper's before 2024-12, or that of Kalico and of sweeping_period 0."""
    test = replace(SHORT, sweeping_accel_mm_s2=0.0, f_end_hz=40.0)
    shaken = ModesSpec(
        modes=(Mode(f_hz=frame_hz, zeta=0.05, gain=0.06), Mode(f_hz=30.0, zeta=0.1, gain=0.94))
    )
    rng = np.random.default_rng(3)
    log = simulate_log({"x": shaken}, replace(test, out_and_back=old), rng=rng)
    for asked in (False, True):
        aligned = align(log, replace(test, out_and_back=asked))
        assert aligned.excitation == replace(test, out_and_back=old)
        assert aligned.start_s == pytest.approx(100.0, abs=5e-3)


@pytest.mark.parametrize("old", [False, True])
def test_a_log_as_klipper_wrote_it_shows_its_kind_by_its_length(old: bool) -> None:
    """Where a test begins near the resonance, its phases fit either kind."""
    test = replace(SHORT, f_start_hz=10.0, sweeping_accel_mm_s2=0.0, f_end_hz=40.0)
    soft = ModesSpec(
        modes=(Mode(f_hz=9.0, zeta=0.05, gain=0.1), Mode(f_hz=26.0, zeta=0.12, gain=0.9))
    )
    options = {"lead_s": 0.0, "tail_s": 0.0, "rng": np.random.default_rng(3)}
    log = simulate_log({"x": soft}, replace(test, out_and_back=old), **options)  # type: ignore[arg-type]
    assert align(log, test).excitation.out_and_back is old


@settings(max_examples=12)
@given(st.floats(0.0, 1e5), st.floats(-0.4, 8.0), st.floats(0.0, 6.0), st.integers(0, 2**32 - 1))
def test_any_start_is_found(start_s: float, lead_s: float, tail_s: float, seed: int) -> None:
    log = simulate_log(
        PLANTS,
        SHORT,
        sensor=LIS2DW,
        start_s=start_s,
        lead_s=lead_s,
        tail_s=tail_s,
        rng=np.random.default_rng(seed),
    )
    assert align(log, SHORT).start_s == pytest.approx(start_s + SLOW_S, abs=2e-4)


def test_start_is_where_scipys_correlation_has_its_peak() -> None:
    log = log_of(lead_s=3.0, start_s=40.0)
    aligned = align(log, SHORT)
    h = 1 / 3200
    command = regenerate(SHORT).cell_averages(np.arange(0.0, 20.0, h), h)
    band = butter(4, [6.0, 16.0], "bandpass", fs=3200, output="sos")
    moved = log.accel_mm_s2[:, 0] - log.accel_mm_s2[:, 0].mean()
    cross = correlate(sosfiltfilt(band, moved), sosfiltfilt(band, command), mode="full")
    lag = int(np.argmax(cross)) - (len(command) - 1)
    assert aligned.start_s == pytest.approx(log.time_s[0] + lag * h, abs=0.5e-3)


def test_the_whole_log_is_searched() -> None:
    aligned = align(log_of(lead_s=31.0, tail_s=17.0, start_s=500.0), SHORT)
    assert aligned.start_s == pytest.approx(500.0, abs=1e-3)


def test_resampling_keeps_a_slow_wave_and_takes_gravity_off() -> None:
    rng = np.random.default_rng(12)
    time_s = 10.0 + np.cumsum(rng.uniform(0.9, 1.1, 4000)) / 1344.3
    wave = 1000 * np.sin(2 * np.pi * 60 * time_s)
    accel = np.column_stack([wave, np.full(4000, np.nan), wave * 0 + 9806.65])
    grid_s, found = resample(AccelerationLog(time_s, accel, "x", "a.csv"))
    np.testing.assert_allclose(np.diff(grid_s), 1 / round(1 / np.median(np.diff(time_s))))
    expected = 1000 * np.sin(2 * np.pi * 60 * grid_s)
    expected -= np.median(expected)
    np.testing.assert_allclose(found[10:-10, 0], expected[10:-10], atol=3.0)
    np.testing.assert_allclose(found[:, 1:], 0.0, atol=1e-9)


def test_a_little_may_be_missing_at_both_ends() -> None:
    assert align(log_of(lead_s=-0.3), SHORT).start_s == pytest.approx(100.0, abs=1e-3)
    aligned = align(log_of(tail_s=-0.5), SHORT)
    assert aligned.f_reached_hz == pytest.approx(24.5, abs=0.05)
    assert aligned.notes == ("the log ends at 24.5 Hz of the sweep",)


def test_part_of_a_longer_sweep_can_be_used() -> None:
    aligned = align(log_of(SHORT), replace(SHORT, f_end_hz=20.0))
    assert aligned.f_reached_hz == 20.0


def test_the_other_axis_measured_in_place_of_this_one_is_found_by_the_mounting() -> None:
    log = replace(log_of(replace(SHORT, direction=(0.0, 1.0))), axis=None)
    with pytest.raises(ModelError, match=r"moved along \(-?0.00, 1.00, .* not along \(1.00, 0.00"):
        align(log, SHORT, sensor_direction=(1.0, 0.0, 0.0))


def test_one_axis_measured_twice_is_found_by_the_pair() -> None:
    across = replace(SHORT, direction=(0.0, 1.0))
    x, y = align(log_of(SHORT), SHORT), align(log_of(across), across)
    check_pair(x.direction, y.direction)
    swapped = align(log_of(across, sensor=Sensor(rotation=SWAPPED)), across)
    with pytest.raises(ModelError, match="same axis was measured twice"):
        check_pair(x.direction, swapped.direction)


@pytest.mark.parametrize("test", [SHORT, replace(SHORT, sweeping_accel_mm_s2=0.0)])
@pytest.mark.parametrize("first_hz", [1.0, 3.5])
def test_a_test_that_began_lower_is_found(test: Excitation, first_hz: float) -> None:
    """Its pulses come at other times within their periods: friction was blamed for that."""
    log = log_of(replace(test, f_start_hz=first_hz), lead_s=0.0)
    with pytest.raises(
        ModelError, match=rf"began .* before it reached 5 Hz.* min_freq = {first_hz:g}"
    ):
        align(log, test)
    assert align(log, replace(test, f_start_hz=first_hz)).correlation > 0.95
    # A rest before the test is none.
    assert align(log_of(test, lead_s=4.0), test).correlation > 0.95


@pytest.mark.parametrize("accel_per_hz", [30.0, 50.0, 75.0, 150.0])
@pytest.mark.parametrize("gain", [0.88, 1.0])
def test_the_slow_sweep_tells_how_strong_the_pulses_were(accel_per_hz: float, gain: float) -> None:
    """Whatever the sensor's gain. Taken for 60, pulses of 50 made slow modes and delays of 1 ms."""
    log = log_of(replace(SHORT, accel_per_hz_mm_s=accel_per_hz), sensor=replace(LIS2DW, gain=gain))
    shown = align(log, SHORT, is_strength_known=False)
    assert shown.excitation == replace(SHORT, accel_per_hz_mm_s=accel_per_hz)
    (note,) = shown.notes
    assert note.startswith(f"accel_per_hz {accel_per_hz:g} instead, as the log shows beside its")
    stated = align(log, SHORT)
    assert (stated.excitation, stated.notes) == (SHORT, ())


def test_pulses_as_strong_as_assumed_stay_so() -> None:
    log = log_of(SHORT, sensor=LIS2DW)
    shown, stated = align(log, SHORT, is_strength_known=False), align(log, SHORT)
    assert (shown.excitation, shown.notes) == (SHORT, ())
    np.testing.assert_array_equal(shown.command_mm_s2, stated.command_mm_s2)


def test_what_hides_the_slow_sweep_does_not_tell_another_strength() -> None:
    """Noise as strong as the friction of a heavy axis whose frame shakes: it told 65."""
    log = log_of(SHORT, sensor=replace(ADXL345, noise_mm_s2=4000.0))
    shown = align(log, SHORT, is_strength_known=False)
    assert shown.excitation == SHORT


def test_wrong_logs_have_their_own_messages() -> None:
    good = log_of()
    rng = np.random.default_rng(13)
    shape = good.accel_mm_s2.shape
    dead = good.accel_mm_s2.copy()
    dead[:, 0] = 12.0
    twice = AccelerationLog(
        np.concatenate([good.time_s, good.time_s + good.time_s[-1] - good.time_s[0] + 1 / 3200]),
        np.concatenate([good.accel_mm_s2, log_of(start_s=7.0).accel_mm_s2]),
        "x",
        "twice.csv",
    )
    cases = {
        "nothing that changes": replace(good, accel_mm_s2=np.full(shape, np.nan)),
        "no axis of the sensor was recorded, or it is dead": replace(
            good, accel_mm_s2=np.ones(shape)
        ),
        "accel_x is constant": replace(good, accel_mm_s2=dead),
        "does not move with the tested axis": replace(
            good, accel_mm_s2=rng.normal(0.0, 30.0, shape)
        ),
        "the test is not in the log": replace(good, accel_mm_s2=rng.normal(0.0, 3000.0, shape)),
        "the file is a test of axis y": replace(good, axis="y"),
        "more than one test": twice,
        "begins 3.0 s after the start of the test, at 8.0 Hz": log_of(lead_s=-3.0),
        "at 19.0 Hz of 25 Hz.*give max_freq = 18 |at 19.0 Hz of 25 Hz.*give max_freq = 19 ": log_of(
            tail_s=-6.0
        ),
        "too short to find": log_of(tail_s=-12.0),
    }
    for message, log in cases.items():
        with pytest.raises(ModelError, match=message):
            align(log, SHORT)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"hz_per_s": 2.0}, "the test is not in the log.*at 2 Hz/s.*check min_freq"),
        ({"hz_per_s": 0.9}, "the test is not in the log"),
        ({"f_start_hz": 3.5}, "correct min_freq"),
        ({"f_end_hz": 40.0}, "record the whole test, or give max_freq = 25"),
    ],
)
def test_wrong_settings_are_found(wrong: dict[str, float], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        align(log_of(), replace(SHORT, **wrong))  # type: ignore[arg-type]
