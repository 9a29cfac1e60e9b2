"""Estimated frequency responses against the truth, scipy, python-control and a real recording."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import control
import numpy as np
import pytest
from numpy.typing import NDArray

from stillpath.models.errors import ModelError
from stillpath.models.identification.alignment import align
from stillpath.models.identification.estimation import (
    check_plateau,
    estimate_aligned,
    estimate_driven,
    estimate_response,
    plateau_gain,
)
from stillpath.models.identification.local_model import Transformed, local_response
from stillpath.models.identification.readers import ReadSettings, assumed_test, read_measurements
from stillpath.models.identification.synthetic import ADXL345, Sensor, simulate_log, write_raw_data
from stillpath.models.identification.types import (
    AccelerationLog,
    DrivenLog,
    Excitation,
    FrequencyResponse,
)
from stillpath.models.plants import (
    Mode,
    ModesSpec,
    PairsSpec,
    PolePair,
    ZeroPair,
    frequency_response,
)

NEW = Excitation((1.0, 0.0))
LEGACY = Excitation((1.0, 0.0), 5.0, 10_000 / 75, 75.0, 1.0, 0.0, out_and_back=True)
SHORT = Excitation((1.0, 0.0), 5.0, 25.0, 60.0, 1.0)
TURNED = ((2 / 3, -1 / 3, 2 / 3), (2 / 3, 2 / 3, -1 / 3), (-1 / 3, 2 / 3, 2 / 3))
MODES = ModesSpec(
    modes=(
        Mode(f_hz=47, zeta=0.035, gain=0.7),
        Mode(f_hz=95, zeta=0.06, gain=0.2),
        Mode(f_hz=170, zeta=0.05, gain=0.1),
    )
)
SHARP = PairsSpec(
    poles=(PolePair(f_hz=38, zeta=0.015), PolePair(f_hz=61, zeta=0.02)),
    zeros=(ZeroPair(f_hz=50, zeta=0.02),),
)
LIS2DW_LIKE = Sensor(rate_hz=1600.0)


def measured(
    plant: ModesSpec | PairsSpec, excitation: Excitation, seed: int = 21, **options: object
) -> AccelerationLog:
    rng = np.random.default_rng(seed)
    return simulate_log({"x": plant, "y": plant}, excitation, rng=rng, **options)  # type: ignore[arg-type]


def errors(
    found: FrequencyResponse, plant: ModesSpec | PairsSpec, delay_s: float
) -> NDArray[np.float64]:
    """Relative error, the delay of the alignment put back."""
    truth = frequency_response(plant, found.f_hz)
    aligned = found.response * np.exp(-2j * np.pi * found.f_hz * delay_s)
    return np.asarray(np.abs(aligned / truth - 1), np.float64)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sensor", "median", "p95", "tests"),
    [
        (Sensor(rotation=TURNED), 0.0015, 0.0035, [(NEW, MODES), (LEGACY, SHARP)]),
        (Sensor(rate_hz=3187.3, jitter_s=2e-6), 0.0015, 0.0035, [(NEW, SHARP), (LEGACY, MODES)]),
        (LIS2DW_LIKE, 0.004, 0.011, [(NEW, MODES), (LEGACY, SHARP)]),
    ],
)
def test_the_response_is_within_its_tolerances(
    sensor: Sensor,
    median: float,
    p95: float,
    tests: list[tuple[Excitation, ModesSpec | PairsSpec]],
) -> None:
    for excitation, plant in tests:
        log = measured(plant, excitation, sensor=sensor, start_s=99.7, lead_s=0.4)
        aligned = align(log, excitation)
        found = estimate_aligned(log, aligned)
        assert found.f_hz[0] == 6.0
        assert found.f_hz[-1] == pytest.approx(excitation.f_end_hz - 1, abs=0.25)
        assert found.coherence.min() > 0.95
        error = errors(found, plant, aligned.start_s - 99.7)
        assert np.median(error) < median
        assert np.quantile(error, 0.95) < p95
        assert error.max() < 0.02


def test_the_standard_deviation_is_that_of_the_errors() -> None:
    ratios = []
    for seed in range(3):
        sensor = Sensor(rate_hz=1600.0, noise_mm_s2=200.0, lsb_mm_s2=0.0)
        log = measured(MODES, NEW, seed, sensor=sensor)
        aligned = align(log, NEW)
        found = estimate_aligned(log, aligned)
        error = errors(found, MODES, aligned.start_s - 100.0)
        ratios.append(error * np.abs(frequency_response(MODES, found.f_hz)) / found.sd)
    # Complex Gaussian errors: mean square 1, median sqrt(log 2).
    assert np.sqrt(np.mean(np.square(ratios))) == pytest.approx(1.0, abs=0.1)
    assert np.median(ratios) == pytest.approx(np.sqrt(np.log(2)), abs=0.06)


def test_a_resonance_keeps_its_height() -> None:
    quiet = Sensor(noise_mm_s2=1.0, lsb_mm_s2=0.0)
    found = estimate_response(measured(SHARP, NEW, sensor=quiet), NEW)
    truth = np.abs(frequency_response(SHARP, found.f_hz))
    peak = int(np.argmax(truth))
    assert np.abs(found.response[peak]) == pytest.approx(truth[peak], rel=3e-3)


def test_the_response_carries_what_is_known_of_the_log() -> None:
    stages: list[tuple[str, float]] = []
    log = replace(measured(MODES, SHORT), notes=("of a file",), source="raw_data_x.csv")
    found = estimate_response(
        log, SHORT, label="75 mm/s", progress=lambda *stage: stages.append(stage)
    )
    assert (found.axis, found.label, found.source) == ("x", "75 mm/s", "raw_data_x.csv")
    assert found.notes == ("of a file",)
    assert stages[0] == ("align", 0.0)
    assert stages[-1] == ("estimate", 1.0)
    assert plateau_gain(found) == pytest.approx(1.0, abs=0.02)


def test_a_written_log_gives_the_response_it_was_made_with(tmp_path: Path) -> None:
    across = replace(SHORT, direction=(0.0, 1.0))
    path = write_raw_data(measured(MODES, across), tmp_path)
    (log,) = read_measurements(path)
    assert isinstance(log, AccelerationLog)
    excitation = assumed_test(log, ReadSettings(f_end_hz=25.0)).excitation
    assert excitation == across
    found = estimate_response(log, excitation)
    truth = frequency_response(MODES, found.f_hz)
    np.testing.assert_allclose(np.abs(found.response / truth), 1.0, atol=0.01)


@pytest.mark.parametrize(("f_hz", "zeta"), [(22.0, 0.05), (27.0, 0.29), (150.0, 0.02)])
def test_the_plateau_is_1_below_low_and_high_resonances(f_hz: float, zeta: float) -> None:
    plant = ModesSpec(modes=(Mode(f_hz=f_hz, zeta=zeta),))
    for gain in (1.0, 0.93):
        log = measured(plant, SHORT, sensor=Sensor(gain=gain))
        assert plateau_gain(estimate_response(log, SHORT)) == pytest.approx(gain, abs=0.05)


@pytest.mark.parametrize("true_level", [40.0, 75.0])
def test_a_wrong_level_names_the_level_of_the_log(true_level: float) -> None:
    log = measured(MODES, replace(SHORT, accel_per_hz_mm_s=true_level))
    with pytest.raises(ModelError, match="accel_per_hz = 60; it must be 1") as caught:
        estimate_response(log, SHORT)
    told = str(caught.value).split("looks like accel_per_hz = ")[1]
    assert float(told.split(":")[0]) == pytest.approx(true_level, rel=0.03)
    # Friction makes an axis move less, never more.
    assert ("rubs much" in told) == (true_level < 60.0)


def test_a_sensor_that_is_only_shaken_along_has_its_own_message() -> None:
    log = measured(MODES, SHORT, sensor=Sensor(gain=0.08))
    with pytest.raises(ModelError, match="is not mounted on what moves"):
        estimate_response(log, SHORT)


def test_a_sweep_that_drifts_away_has_its_own_message() -> None:
    like = r"drifts away from .* like hz_per_sec = (1|0\.999\d|1\.000\d):"
    with pytest.raises(ModelError, match=like):
        estimate_response(measured(MODES, NEW), replace(NEW, hz_per_s=0.998))


def test_a_test_that_kalico_slowed_down_is_told_how_to_be_repeated() -> None:
    """ACCEL_PER_HZ=100 where printer.cfg says 75: Kalico takes 133.6 s for 130.0 s."""
    slowed, stated = replace(NEW, hz_per_s=0.998), replace(NEW, hz_per_s=1.0)
    with pytest.raises(ModelError, match=r"Kalico slows .* set accel_per_hz there"):
        estimate_response(measured(MODES, slowed), stated)
    with pytest.raises(ModelError, match="drifts away") as faster:
        estimate_response(measured(MODES, stated), slowed)
    assert "Kalico" not in str(faster.value)


def test_a_soft_axis_with_a_noisy_sensor_is_used_where_it_follows() -> None:
    soft = PairsSpec(poles=(PolePair(f_hz=26.5, zeta=0.2),))
    log = measured(soft, NEW, sensor=Sensor(rate_hz=800.0, noise_mm_s2=300.0))
    found = estimate_response(log, NEW)
    assert np.mean(found.coherence > 0.95) < 0.45
    used = found.coherence > 0.99
    truth = np.abs(frequency_response(soft, found.f_hz[used]))
    np.testing.assert_allclose(np.abs(found.response[used]), truth, rtol=0.1)


def test_a_sensor_that_is_too_slow_for_the_test_is_named() -> None:
    log = replace(measured(MODES, NEW, sensor=Sensor(rate_hz=200.0)), source="raw_data_x.csv")
    with pytest.raises(ModelError, match=r"raw_data_x\.csv: 200 samples per s .* max_freq = 98 to"):
        estimate_response(log, NEW)
    short = replace(NEW, f_end_hz=98.0)
    assert estimate_response(log, short).f_hz[-1] == pytest.approx(97.0)


def test_a_level_that_cannot_be_checked_is_noted() -> None:
    high = replace(SHORT, f_start_hz=20.0, f_end_hz=60.0)
    found = estimate_response(measured(MODES, high), high)
    assert plateau_gain(found) is None
    assert any("level not checked" in note for note in found.notes)
    check_plateau(found, high)


def driven_log(
    samples: int, seed: int, *, noise: float = 0.05, rate_hz: float = 1000.0
) -> tuple[DrivenLog, control.TransferFunction]:
    """Coloured noise through a plant that python-control simulates; the start is cut off."""
    rng = np.random.default_rng(seed)
    w, zeta = 2 * np.pi * 47, 0.05
    plant = control.sample_system(control.tf([w * w], [1, 2 * zeta * w, w * w]), 1 / rate_hz)
    command = rng.normal(size=samples + 1000)
    measured = control.forced_response(plant, inputs=command).outputs[1000:]
    measured = measured + noise * rng.normal(size=samples)
    time_s = 3.0 + np.arange(samples) / rate_hz
    return DrivenLog(time_s, command[1000:], measured, "x", f"log{seed}.csv"), plant


@pytest.mark.parametrize("logs", [1, 3])
def test_recorded_drives_give_the_response_of_python_control(logs: int) -> None:
    recorded = [driven_log(30_000, seed) for seed in range(logs)]
    plant = recorded[0][1]
    found = estimate_driven([log for log, _ in recorded], label="noise")
    truth = plant(np.exp(2j * np.pi * found.f_hz / 1000))
    strong = np.abs(truth) > 0.3
    error = np.abs(found.response - truth)
    assert np.median(error[strong] / np.abs(truth[strong])) < 0.015
    assert np.sqrt(np.mean((error / found.sd)[strong] ** 2)) == pytest.approx(1.0, abs=0.25)
    assert np.mean(found.coherence[strong] > 0.95) > 0.95
    assert (found.axis, found.label) == ("x", "noise")
    assert found.source.startswith("log0.csv")


@pytest.mark.parametrize(("fade_s", "rest_s"), [(0.0, 0.0), (0.5, 0.0), (0.5, 0.5), (0.0, 0.2)])
def test_a_sweep_without_long_rests_is_coherent_only_where_it_drives(
    fade_s: float, rest_s: float
) -> None:
    """Transients explained all bins outside the sweep, and the first noise became a mode."""
    rate_hz, last_hz, lasts_s = 1000.0, 110.0, 60.0
    rest = np.zeros(round(rest_s * rate_hz))
    t = np.arange(round(lasts_s * rate_hz)) / rate_hz
    phase = 2 * np.pi * (5.0 * t + 0.5 * (last_hz - 5.0) / lasts_s * t**2)
    fade = np.clip(np.minimum(t, lasts_s - t) / max(fade_s, 1e-9), 0.0, 1.0)
    command = np.concatenate([rest, fade * np.sin(phase), rest])
    _, plant = driven_log(1, 0)
    answer = control.forced_response(plant, inputs=command).outputs
    noise = np.random.default_rng(9).normal(size=len(answer))
    answer = answer + 0.01 * np.std(answer) * noise
    log = DrivenLog(np.arange(len(answer)) / rate_hz, command, answer, "x")
    found = estimate_driven(log)
    used = found.coherence >= 0.95
    assert np.all(found.sd[used] <= 0.15 * np.abs(found.response[used]))
    assert np.mean(used[(found.f_hz > 6.0) & (found.f_hz < 90.0)]) > 0.97


def test_a_sampling_interval_that_changes_is_no_other_frequency() -> None:
    """The mean rate stretched both parts of the record, and a wrong response was coherent."""
    log, plant = driven_log(40_000, 5, noise=0.0)
    smooth = np.convolve(log.command, np.hanning(12) / 6.0, mode="same")
    answer = control.forced_response(plant, inputs=smooth).outputs
    kept = np.arange(40_000)
    kept = kept[(kept < 20_000) | (kept % 2 == 0)]
    found = estimate_driven(DrivenLog(log.time_s[kept], smooth[kept], answer[kept], "x"))
    at = (found.f_hz > 5.0) & (found.f_hz < 100.0)
    truth = plant(np.exp(2j * np.pi * found.f_hz[at] / 1000))
    assert np.quantile(np.abs(found.response[at] / truth - 1.0), 0.95) < 0.02


@pytest.mark.parametrize("at_rest", [True, False])
def test_gravity_in_a_recorded_drive_changes_nothing(at_rest: bool) -> None:
    log, plant = driven_log(20_000, 3)
    if at_rest:
        command = np.where(np.arange(20_000) % 19_000 < 1000, 0.0, log.command)
        log = replace(
            log, command=command, measured=control.forced_response(plant, inputs=command).outputs
        )
    plain = estimate_driven(log)
    heavy = estimate_driven(replace(log, measured=log.measured + 9806.65))
    strong = plain.f_hz < 80.0
    np.testing.assert_allclose(heavy.response[strong], plain.response[strong], rtol=1e-3)


def test_local_model_is_exact_for_one_pole_and_transients() -> None:
    # A response with one pole near, and a start that is not at rest.
    f = np.arange(0, 1001) * 0.1
    rng = np.random.default_rng(6)
    u = rng.normal(size=len(f)) + 1j * rng.normal(size=len(f))
    truth = (1 + 0.2j * f) / (f - (40.0 + 0.3j))
    y = truth * u + (2.0 - 1.0j) / (f - (40.0 + 0.3j))
    at = np.arange(30.0, 50.0, 0.5)
    found = local_response([Transformed(0.1, u, y)], at, 1.0, transient=True)
    index = np.round(at / 0.1).astype(int)
    np.testing.assert_allclose(found.response, truth[index], rtol=1e-4)
    assert found.coherence.min() > 0.9999


def test_wrong_drives_have_their_own_messages() -> None:
    log, _ = driven_log(8000, 7)
    rng = np.random.default_rng(8)
    with pytest.raises(ModelError, match="follows the command at no frequency"):
        estimate_driven(replace(log, measured=rng.normal(size=8000)))
    with pytest.raises(ModelError, match=r"logs of different axes \(x, y\)"):
        estimate_driven([log, replace(log, axis="y")])
    with pytest.raises(ModelError, match="at least one"):
        estimate_driven([])
    few = DrivenLog(log.time_s[:12], log.command[:12], log.measured[:12], "x", "few.csv")
    with pytest.raises(ModelError, match=r"too (short|few)"):
        estimate_driven(few)


def test_a_log_that_ends_at_the_start_of_the_band_is_refused() -> None:
    tiny = replace(SHORT, f_end_hz=7.5)
    log = measured(MODES, SHORT, sensor=ADXL345)
    with pytest.raises(ModelError, match=r"reaches 7\.5 Hz of the sweep only"):
        estimate_response(log, tiny)


def test_two_modes_within_one_band_stay_two() -> None:
    """Modes 5 % apart, closer than the band of the local fit is wide."""
    plant = ModesSpec(
        modes=(Mode(f_hz=34.6, zeta=0.011, gain=0.6), Mode(f_hz=36.4, zeta=0.008, gain=0.4))
    )
    test = Excitation((1.0, 0.0), 5.0, 65.0, 60.0, 1.0, 0.0)
    rng = np.random.default_rng(0)
    sensor = Sensor(rate_hz=800.0, noise_mm_s2=60.0)
    log = simulate_log({"x": plant}, test, sensor=sensor, rng=rng)
    found = estimate_response(log, test)
    truth = np.abs(frequency_response(plant, found.f_hz))
    near = truth > 0.3
    np.testing.assert_allclose(np.abs(found.response[near]), truth[near], rtol=0.02)
