"""The resonance test that made a file: what it says, what the user says, what is assumed."""

from __future__ import annotations

from dataclasses import replace
from datetime import date

import numpy as np
import pytest
from pydantic import ValidationError

from stillpath.models.errors import ModelError
from stillpath.models.identification.excitation import (
    drive_spectrum,
    drive_spectrum_regenerated,
)
from stillpath.models.identification.readers import (
    ReadSettings,
    assumed_test,
    date_in_name,
    direction_of,
)
from stillpath.models.identification.spectrum_model import moved_most
from stillpath.models.identification.synthetic import Sensor
from stillpath.models.identification.types import Excitation, Spectrum
from tests.models.identification.recordings import LEGACY, SWEEPING, quick_log


def spectrum(
    source: str, axis: str | None = "x", accel_per_hz_mm_s: float | None = None
) -> Spectrum:
    return Spectrum(np.arange(3.0), {"x": np.ones(3)}, axis, source, accel_per_hz_mm_s)


OLD = Excitation((1.0, 0.0), 5.0, 10000 / 75, 75.0, 1.0, 0.0, 1.2)
NEW = Excitation((1.0, 0.0), 5.0, 135.0, 60.0, 1.0, 400.0, 1.2)


@pytest.mark.parametrize(
    ("source", "firmware", "expected", "words"),
    [
        ("resonances_x_20211217_070942.csv", None, OLD, "before 2024-12 by the date in the file"),
        ("resonances_x_20250102_070942.csv", None, NEW, "since 2024-12 by the date in the file"),
        ("resonances_x_a.csv", date(2024, 11, 30), OLD, "before 2024-12 by firmware_date"),
        ("resonances_x_20211217_070942.csv", date(2025, 1, 1), NEW, "2025-01-01"),
        ("resonances_x_a.csv", None, NEW, "no date is known"),
    ],
)
def test_defaults_by_date(
    source: str, firmware: date | None, expected: Excitation, words: str
) -> None:
    settings = ReadSettings(firmware_date=firmware)
    found, (note,) = assumed_test(spectrum(source), settings)
    assert found == expected
    assert words in note
    assert f"accel_per_hz {expected.accel_per_hz_mm_s:g}" in note


@pytest.mark.parametrize(
    ("test", "name", "settings", "words"),
    [
        (LEGACY, "20250601_101010", {}, "no slow sweep, whatever the date in the file's name"),
        (LEGACY, "mine", {}, "before 2024-12, because the log shows no slow sweep"),
        (LEGACY, "20250601_101010", {"accel_per_hz_mm_s": 75.0}, "before 2024-12, because"),
        (LEGACY, "20230601_101010", {}, "before 2024-12 by the date"),
        (
            SWEEPING,
            "mine",
            {"firmware_date": "2023-01-01"},
            "because the log shows a slow sweep",
        ),
        (SWEEPING, "20250601_101010", {}, "since 2024-12 by the date"),
    ],
)
def test_raw_logs_tell_which_test_they_are_of(
    test: Excitation, name: str, settings: dict[str, object], words: str
) -> None:
    """Printers of 2025 with a Klipper of 2022 are common; friction was blamed for it, and lost."""
    log = quick_log("x", test=test, sensor=Sensor(rate_hz=500.0, noise_mm_s2=80.0, gain=0.88))
    log = replace(log, source=f"raw_data_x_{name}.csv")
    given = ReadSettings.model_validate(settings)
    found, (note,) = assumed_test(log, given)
    assert found == (OLD if test is LEGACY else NEW)
    assert words in note


def test_a_log_without_slow_sweep_of_130_s_ends_at_135_hz() -> None:
    """As Kalico's test: to 133.33 Hz it would be too long, and its clock not be used."""
    test = replace(LEGACY, f_end_hz=135.0, out_and_back=False)
    log = quick_log("x", test=test, lead_s=0.0, tail_s=0.0)
    log = replace(log, source="raw_data_x_20260601_101010.csv")
    found, (note,) = assumed_test(log)
    assert found == replace(OLD, f_end_hz=135.0)
    assert "the log is 130 s long, as Kalico's test is to 135 Hz" in note
    # The length of a test that was stated otherwise tells nothing.
    assert assumed_test(log, ReadSettings(hz_per_s=2.0)).excitation == replace(OLD, hz_per_s=2.0)
    shorter = assumed_test(log, ReadSettings(f_end_hz=120.0)).excitation
    assert shorter == replace(OLD, f_end_hz=120.0)


def test_a_log_that_hardly_moves_tells_nothing() -> None:
    log = quick_log("x", test=LEGACY, sensor=Sensor(rate_hz=500.0, gain=0.02))
    log = replace(log, source="raw_data_x_20250601_101010.csv")
    assert assumed_test(log).excitation == NEW


def simulated_table(
    test: Excitation, source: str, *, accel_per_hz_mm_s: float | None = None, sets: bool = False
) -> Spectrum:
    """What Klipper writes of a test that the sensor follows exactly."""
    f_hz = np.arange(130) * 1.5625
    density = drive_spectrum_regenerated(test, f_hz) + 5.0
    psd = {"head": density, "bed": np.full(130, 5.0)} if sets else {"x": density}
    return Spectrum(f_hz, psd, "x", source, accel_per_hz_mm_s)


@pytest.mark.parametrize("sets", [False, True])
@pytest.mark.parametrize(
    ("test", "name", "words"),
    [
        (OLD, "20260601_101010", "the table shows no slow sweep, whatever the date"),
        (OLD, "mine", "before 2024-12, because the table shows no slow sweep"),
        (OLD, "20230601_101010", "before 2024-12 by the date"),
        (NEW, "20230601_101010", "because the table shows a slow sweep"),
        (NEW, "20260601_101010", "since 2024-12 by the date"),
        (NEW, "mine", "since 2024-12, because no date is known"),
    ],
)
def test_tables_tell_which_test_they_are_of(
    test: Excitation, name: str, words: str, sets: bool
) -> None:
    """Printers of 2026 with a Klipper of 2022, and Kalico, do not sweep slowly."""
    table = simulated_table(test, f"resonances_x_{name}.csv", sets=sets)
    found, (note,) = assumed_test(table)
    assert found == test
    assert words in note


def test_tables_cut_at_5_hz_are_of_a_klipper_that_does_not_sweep() -> None:
    table = simulated_table(NEW, "calibration_data_x_20260601.csv")
    cut = replace(table, f_hz=table.f_hz[4:], psd={"x": table.psd["x"][4:]})
    assert assumed_test(cut).excitation == OLD


def test_kalico_does_not_sweep_slowly() -> None:
    test = replace(OLD, accel_per_hz_mm_s=60.0, f_end_hz=135.0)
    table = simulated_table(test, "resonances_x_20260601.csv", accel_per_hz_mm_s=60.0)
    told = assumed_test(table).excitation
    assert (told.accel_per_hz_mm_s, told.sweeping_accel_mm_s2) == (60.0, 0.0)


def test_strong_shaking_is_no_slow_sweep() -> None:
    test = replace(OLD, accel_per_hz_mm_s=300.0)
    table = simulated_table(test, "resonances_x_20230601.csv")
    assert assumed_test(table).excitation.sweeping_accel_mm_s2 == 0.0


@pytest.mark.parametrize(
    ("max_freq", "last_hz", "expected"),
    [(100, 150.0, 100.0), (100, 149.2, 100.0), (300, 449.6, 300.0), (135, 201.6, 135.0),
     (135, 199.5, 135.0), (112, 167.2, 111.467)],
)  # fmt: skip
def test_range_by_where_the_table_ends(max_freq: float, last_hz: float, expected: float) -> None:
    f_hz = np.arange(0.0, last_hz + 1.0, 1.0) + (last_hz % 1.0)
    table = Spectrum(f_hz, {"x": np.ones(len(f_hz))}, "x", "resonances_x_20260101.csv")
    assert table.f_hz[-1] == pytest.approx(last_hz, abs=1.0)
    assert assumed_test(table).excitation.f_end_hz == pytest.approx(expected, abs=0.7)
    told = any("so max_freq is" in note for note in assumed_test(table).notes)
    assert told == (max_freq != 135)
    old = ReadSettings(firmware_date=date(2023, 1, 1))
    assert assumed_test(table, old).excitation.f_end_hz == pytest.approx(10000 / 75)
    assert assumed_test(table, ReadSettings(f_end_hz=90)).excitation.f_end_hz == 90.0


def test_a_table_wider_than_its_test_keeps_the_default() -> None:
    """The density says where the test ended: to 397 Hz, 265 were believed."""
    f_hz = np.arange(0.0, 398.0, 1.0)
    density = drive_spectrum(NEW, f_hz) + 1.0
    for max_freq, table in (
        (135.0, Spectrum(f_hz, {"x": density}, "x", "resonances_x_20260101.csv")),
        (265.0, Spectrum(f_hz, {"x": np.square(f_hz)}, "x", "resonances_x_20260101.csv")),
    ):
        settings = ReadSettings(sweeping_accel_mm_s2=400.0)
        assert assumed_test(table, settings).excitation.f_end_hz == max_freq
        notes = assumed_test(table, settings).notes
        assert any("so max_freq is" in note for note in notes) == (max_freq == 265.0)
        assert any("max_freq 135" in note for note in notes) == (max_freq == 135.0)


@pytest.mark.parametrize("max_freq", [80.0, 90.0, 100.0, 120.0])
def test_a_test_that_ended_early_in_a_table_up_to_200_hz(max_freq: float) -> None:
    """Vendors set max_freq to 90 or 100, with Klipper's tables of 2022: the end was a resonance."""
    test = replace(OLD, f_end_hz=max_freq)
    table = simulated_table(test, "resonances_x_20260101.csv")
    mode_hz, zeta = 65.0, 0.06
    ratio = table.f_hz / mode_hz
    gain = np.abs((1 + 2j * zeta * ratio) / (1 - ratio**2 + 2j * zeta * ratio)) ** 2
    rings = replace(table, psd={"x": table.psd["x"] * gain})
    for one in (table, rings):
        assert assumed_test(one).excitation == test
        assert any("max_freq is taken to be" in note for note in assumed_test(one).notes)
    stated = ReadSettings(f_end_hz=130.0)
    assert assumed_test(rings, stated).excitation.f_end_hz == 130.0
    assert not any("is taken" in note for note in assumed_test(rings, stated).notes)


@pytest.mark.parametrize("mode_hz", [38.0, 52.0, 71.0, 96.0])
@pytest.mark.parametrize("zero", [1.1, 1.25, None])
def test_a_resonance_is_not_the_end_of_a_test(mode_hz: float, zero: float | None) -> None:
    table = simulated_table(OLD, "resonances_x_20230101.csv")
    ratio = table.f_hz / mode_hz
    gain = 1 / (1 - ratio**2 + 0.04j * ratio)
    if zero is not None:
        gain *= 1 - (ratio / zero) ** 2 + 0.04j * ratio / zero
    rings = replace(table, psd={"x": table.psd["x"] * np.abs(gain) ** 2 + 1.0})
    assert assumed_test(rings).excitation == OLD


def test_settings_before_file_before_defaults() -> None:
    """Kalico writes accel_per_hz of printer.cfg, also of a test with another."""
    settings = ReadSettings(accel_per_hz_mm_s=90, f_end_hz=200, firmware_date=date(2023, 1, 1))
    told = assumed_test(spectrum("a.csv", "1,-1", 100.0), settings).excitation
    assert told.accel_per_hz_mm_s == 90.0
    assert told.f_end_hz == 200.0
    assert told.sweeping_accel_mm_s2 == 0.0
    np.testing.assert_allclose(told.direction, (np.sqrt(0.5), -np.sqrt(0.5)))
    notes = assumed_test(spectrum("a.csv", "x", 100.0), settings).notes
    assert notes[0] == "accel_per_hz 90 was stated, 100 in the file does not count"
    unstated = settings.model_copy(update={"accel_per_hz_mm_s": None})
    assert (
        assumed_test(spectrum("a.csv", "x", 100.0), unstated).excitation.accel_per_hz_mm_s == 100.0
    )
    (note,) = assumed_test(spectrum("a.csv", "x", 100.0), unstated).notes
    assert "accel_per_hz" not in note
    assert "f_end_hz" not in note


def test_nothing_assumed_when_everything_is_said() -> None:
    settings = ReadSettings(
        axis="y", accel_per_hz_mm_s=75, f_start_hz=5, f_end_hz=100, hz_per_s=1,
        sweeping_accel_mm_s2=0,
    )  # fmt: skip
    assert assumed_test(spectrum("a.csv", None), settings).notes == ()
    assert assumed_test(spectrum("a.csv", None), settings).excitation.direction == (0.0, 1.0)


def test_settings_that_contradict_themselves_or_the_file_are_refused() -> None:
    with pytest.raises(ModelError, match=r"a\.csv: neither the file nor its name says which axis"):
        assumed_test(spectrum("a.csv", None))
    with pytest.raises(ModelError, match=r"'z' is not a direction of the plane; .* tests along Z"):
        assumed_test(spectrum("a.csv", "z"))
    with pytest.raises(ModelError, match="from 5 to 4 Hz"):
        assumed_test(spectrum("a.csv"), ReadSettings(f_end_hz=4))
    for wrong in (
        {"axis": "w"},
        {"f_start_hz": 9, "f_end_hz": 8},
        {"repair_rounding": True, "dc_gain": 1.2},
        {"accel_per_hz": 75},
        {"time_column": -1},
    ):
        with pytest.raises(ValidationError):
            ReadSettings.model_validate(wrong)


@pytest.mark.parametrize("text", ["", "xy", "0,0", "1,2,3,4", "nan,1"])
def test_no_direction(text: str) -> None:
    with pytest.raises(ModelError, match="not a direction"):
        direction_of(text)


def test_date_in_name() -> None:
    assert date_in_name("0_2024-03-09_10.11.12.csv") == date(2024, 3, 9)
    assert date_in_name("raw_20249999_20240102.csv") == date(2024, 1, 2)
    assert date_in_name("raw_data_x_1.csv") is None


@pytest.mark.parametrize(
    ("test", "settings"),
    [
        (replace(OLD, f_start_hz=20.0, f_end_hz=120.0, accel_per_hz_mm_s=100.0), {}),
        (replace(NEW, f_start_hz=20.0, f_end_hz=120.0, accel_per_hz_mm_s=100.0), {}),
        (replace(NEW, f_start_hz=20.0), {}),
        (replace(OLD, f_start_hz=20.0, f_end_hz=80.0, accel_per_hz_mm_s=300.0), {}),
        (replace(OLD, f_start_hz=30.0, f_end_hz=90.0), {}),
        (replace(OLD, f_start_hz=10.0, f_end_hz=100.0, accel_per_hz_mm_s=150.0), {}),
        (replace(OLD, f_start_hz=20.0), {"f_start_hz": 18.0}),
    ],
)
def test_a_table_tells_that_its_test_began_late(
    test: Excitation, settings: dict[str, float]
) -> None:
    """Creality's K2 and FLSUN's S1 have min_freq 20, Anycubic's Kobra 3 has 10: what was not
    shaken was taken to stand still, and a machine had modes at 22, 26 and 36 Hz."""
    table = simulated_table(test, "resonances_x_a.csv")
    ratio = table.f_hz / 45.0
    gain = np.abs(1 / (1 - ratio**2 + 0.12j * ratio)) ** 2
    noise = np.full(len(gain), 20.0)
    rings = replace(table, psd={"x": table.psd["x"] * gain + noise, "z": noise})
    given = ReadSettings.model_validate(settings)
    for one in (table, rings):
        told = assumed_test(one, given).excitation
        assert told.f_start_hz == settings.get("f_start_hz", test.f_start_hz)
        assert told.f_end_hz == pytest.approx(test.f_end_hz, abs=1.7)
        warned = any("min_freq is taken to be" in note for note in assumed_test(one, given).notes)
        assert warned != bool(settings)
    assert moved_most(rings)[0] == "x"
    assert moved_most(rings)[1] > 0.99


@pytest.mark.parametrize("test", [OLD, NEW, replace(NEW, accel_per_hz_mm_s=40.0)])
@pytest.mark.parametrize("mode_hz", [16.0, 21.0, 26.0, 40.0, 70.0])
@pytest.mark.parametrize("zero", [0.85, 0.95, None])
def test_a_resonance_is_not_the_beginning_of_a_test(
    test: Excitation, mode_hz: float, zero: float | None
) -> None:
    table = simulated_table(test, "resonances_x_a.csv")
    ratio = table.f_hz / mode_hz
    gain = 1 / (1 - ratio**2 + 0.06j * ratio)
    if zero is not None:
        gain *= 1 - (ratio / zero) ** 2 + 0.06j * ratio / zero
    rings = replace(table, psd={"x": table.psd["x"] * np.abs(gain) ** 2 + 1.0})
    assert assumed_test(rings).excitation.f_start_hz == 5.0
