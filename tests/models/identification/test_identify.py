"""From measurements to plants and schedules: which file counts for what, and what is refused."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from contextlib import nullcontext
from dataclasses import replace
from datetime import date

import numpy as np
import pytest
from scipy.signal import hilbert

from stillpath.applications.identification.run import InputFile, identify_files
from stillpath.models.errors import ModelError
from stillpath.models.identification.conditioned import SpectrumRun, of_one_test
from stillpath.models.identification.conditions import Condition
from stillpath.models.identification.identify import Measured, identify
from stillpath.models.identification.messages import (
    mounting_notes,
    phase_fault,
    phase_warning,
    spectrum_level_warning,
)
from stillpath.models.identification.modal_fit import fit_modes
from stillpath.models.identification.prompt import prompt
from stillpath.models.identification.readers import ReadSettings, read_content
from stillpath.models.identification.readers.checks import RangeEnded
from stillpath.models.identification.synthetic import Sensor, simulate_spectrum
from stillpath.models.identification.trust import check_informative
from stillpath.models.identification.types import (
    AccelerationLog,
    AxisIdentification,
    Excitation,
    Fit,
    FrequencyResponse,
    Measurement,
    ModeEstimate,
    PlantModel,
    Spectrum,
)
from stillpath.models.notes import WarningNote
from stillpath.models.plants import (
    PairsSpec,
    PlantSetSpec,
    PolePair,
    RelativeMode,
    RelativeModesSpec,
    ZeroPair,
    frequency_response,
)
from stillpath.models.schedule import AxisSchedule, MassSchedule
from stillpath.models.store import load_machine
from tests.models.identification.recordings import (
    LEGACY,
    QUICK,
    QUICK_SENSOR,
    QUICK_SETTINGS,
    SWEEPING,
    along,
    late_by_less,
    one_mode,
    quick_log,
    quick_raw,
    raw_file,
    spectrum_file,
)

SETTINGS = ReadSettings.model_validate(QUICK_SETTINGS)
F_HZ = np.linspace(6.0, 150.0, 300)


def read(*files: InputFile, settings: ReadSettings = SETTINGS) -> list[Measured]:
    return [
        Measured(measurement, file.condition)
        for file in files
        for measurement in read_content(file.content, file.name, settings=settings)
    ]


def one(*files: InputFile, settings: ReadSettings = SETTINGS) -> AxisIdentification:
    (found,) = identify(read(*files, settings=settings), settings).values()
    return found


def response(plant: PairsSpec, *, axis: str = "x", source: str = "frf.csv") -> FrequencyResponse:
    rng = np.random.default_rng(0)
    g = frequency_response(plant, F_HZ)
    noise = 1e-3 * (rng.normal(size=len(g)) + 1j * rng.normal(size=len(g)))
    sd = np.full(len(g), np.nan)
    return FrequencyResponse(F_HZ, g + noise, sd, np.ones(len(g)), axis, "", source)


def at(measurement: Measurement, condition: str = "") -> Measured:
    return Measured(measurement, Condition.parse(condition))


def main_mode(found: AxisIdentification) -> float:
    assert found.fit is not None
    return max(found.fit.modes, key=lambda m: m.peak).f_hz


def two_modes(bed_hz: float, frame_hz: float = 60.0) -> PairsSpec:
    return PairsSpec(
        poles=(PolePair(f_hz=bed_hz, zeta=0.06), PolePair(f_hz=frame_hz, zeta=0.08)),
    )


def mass_of(found: AxisIdentification) -> MassSchedule:
    assert found.schedule is not None
    assert found.schedule.mass is not None
    return found.schedule.mass


# Which file counts for what


def test_files_go_to_their_axes() -> None:
    x, y = quick_raw("x"), quick_raw("y", name="20251224_120000")
    sources = [file.source for file in (x, y)]
    found = identify(read(x, y), SETTINGS, sources=sources)
    assert list(found) == ["x", "y"]
    for axis, file, f_hz, day in (
        ("x", x, 42.0, date(2026, 1, 1)),
        ("y", y, 35.0, date(2025, 12, 24)),
    ):
        about = found[axis].plants.provenance  # type: ignore[index]
        assert about is not None
        assert (about.kind, about.sources, about.measured_on) == ("raw log", (file.source,), day)
        assert main_mode(found[axis]) == pytest.approx(f_hz, rel=1e-3)  # type: ignore[index]
    assert all(1 < len(one.plants.weighted_members()) <= 16 for one in found.values())


def test_the_best_kind_is_used_and_the_others_are_named() -> None:
    raw = quick_raw("x", one_mode(42.0, 0.06))
    psd = spectrum_file(one_mode(50.0, 0.06), QUICK, sensor=Sensor(rate_hz=1600.0))
    found = one(psd, raw)
    assert main_mode(found) == pytest.approx(42.0, rel=1e-3)
    assert found.plants.provenance is not None
    assert found.plants.provenance.kind == "raw log"
    told = [n for n in found.notes if n.startswith(psd.name)]
    assert told == [f"{psd.name}: not used, because a raw log of axis x says more"]
    assert not found.plants.friction_assumed


@pytest.mark.parametrize(
    ("guides", "least_mm_s2"), [(None, 75.0), ("rails", 75.0), ("wheels", 150.0)]
)
def test_tables_do_not_show_friction_so_a_little_is_assumed(
    guides: str | None, least_mm_s2: float
) -> None:
    table = spectrum_file(one_mode(50.0, 0.06), QUICK, sensor=Sensor(rate_hz=1600.0))
    found = one(table, settings=SETTINGS.model_copy(update={"guides": guides}))
    assert found.plants.friction_assumed
    held_mm = least_mm_s2 / (2.0 * np.pi * 50.0) ** 2
    assert found.plants.friction_mm == pytest.approx(held_mm, rel=0.1)
    assumed = f"{1e-3 * least_mm_s2:g} N per kg"
    assert any(assumed in n and f"{1e3 * held_mm:.1f} µm" in n for n in found.notes)


@pytest.mark.parametrize(
    ("base", "assumed"), [("generic-bedslinger", "0.15 N per kg"), ("generic-corexy", "0.075 N")]
)
def test_beds_that_move_mostly_run_on_wheels(base: str, assumed: str) -> None:
    table = spectrum_file(one_mode(50.0, 0.06), QUICK, sensor=Sensor(rate_hz=1600.0))
    (axis,) = identify_files([table], load_machine(base), SETTINGS).report.axes
    assert any(assumed in note for note in axis.notes)


def test_a_model_goes_before_measurements() -> None:
    spec = one_mode(61.0, 0.05)
    found = identify([at(response(one_mode(40.0, 0.05))), at(PlantModel(spec, "x", "m.json"))])
    assert found["x"].plants.nominal == spec
    assert found["x"].fit is None
    with pytest.raises(ModelError, match=r"axis x: 2 models \(a.json, b.json\); give one"):
        identify([at(PlantModel(spec, "x", name)) for name in ("a.json", "b.json")])


def test_what_is_said_of_several_files_is_said_once() -> None:
    files = [quick_raw("x", name=f"20260101_12000{i}", seed=i) for i in range(2)]
    (assumed,) = [note for note in one(*files).notes if "assumed" in note]
    assert assumed.startswith(
        "raw_data_x_20260101_120000.csv, raw_data_x_20260101_120001.csv: assumed accel_per_hz 60"
    )


@pytest.mark.parametrize(
    ("axis", "words"),
    [
        (None, "f.csv: neither the file nor its name says which axis"),
        ("1.000,1.000", "f.csv: measured along 1.000,1.000, which moves both axes"),
        ("z", "f.csv: axis 'z' is not a direction of the plane"),
    ],
)
def test_an_axis_that_cannot_be(axis: str | None, words: str) -> None:
    measured = replace(response(one_mode(40.0, 0.05), source="f.csv"), axis=axis)
    with pytest.raises(ModelError, match=words):
        identify([at(measured)])
    if axis is None:
        assert list(identify([at(measured)], ReadSettings(axis="y"))) == ["y"]


def test_nothing_to_identify() -> None:
    with pytest.raises(ModelError, match="nothing to identify"):
        identify([])


# Level and mounting


def test_a_level_that_only_the_fit_shows() -> None:
    """So weak that nothing is coherent from 8 to 15 Hz: not taken for a measurement."""
    weak = Sensor(rate_hz=500.0, noise_mm_s2=20.0, gain=0.02)
    with pytest.raises(ModelError, match=r"raw_data_x.*0\.02 times as much .*measure at the part"):
        one(quick_raw("x", sensor=weak))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("accel_per_hz_mm_s", "settings", "warned"),
    [
        (60.0, {}, True),
        (75.0, {}, False),
        (60.0, {"accel_per_hz_mm_s": 60.0}, False),
    ],
)
def test_a_log_without_slow_sweep_may_be_of_klippers_weaker_test(
    accel_per_hz_mm_s: float, settings: dict[str, float], *, warned: bool
) -> None:
    """`sweeping_period: 0` of Klipper since 2024-12; Kalico's test lasts as long."""
    test = replace(
        SWEEPING,
        accel_per_hz_mm_s=accel_per_hz_mm_s,
        sweeping_accel_mm_s2=0.0,
        sweeping_period_s=0.0,
    )
    file = quick_raw("x", test=test, lead_s=0.0, tail_s=0.0)
    found = one(file, settings=ReadSettings.model_validate(settings))
    texts = [text for text in found.warnings if "sweeping_period 0: state yours" in text]
    assert len(texts) == warned
    assert main_mode(found) == pytest.approx(42.0, rel=0.005)


def test_axes_of_the_sensor_that_seem_exchanged() -> None:
    swapped = Sensor(rate_hz=500.0, rotation=((0, 1, 0), (1, 0, 0), (0, 0, -1)))
    files = [quick_raw(axis, sensor=swapped) for axis in "xy"]
    for axis, found in identify(read(*files), SETTINGS).items():
        other = {"x": "y", "y": "x"}[axis]
        assert found.warnings == ()
        text = f"the sensor's {other} moved in the test of axis {axis}"
        assert sum(text in note for note in found.notes) == 1
    said = SETTINGS.model_copy(update={"sensor_axis": "y"})
    assert not any("sensor's" in note for note in one(files[0], settings=said).notes)
    with pytest.raises(ModelError, match="another axis was measured"):
        one(files[0], settings=SETTINGS.model_copy(update={"sensor_axis": "x"}))


@pytest.mark.parametrize("gain", [1.0, 3.7, -1000.0])
def test_a_response_that_may_not_be_1_at_low_frequency(gain: float) -> None:
    plant = one_mode(40.0, 0.05)
    scaled = response(plant)
    scaled = replace(scaled, response=gain * scaled.response)
    found = identify([at(scaled)])["x"]
    told = [f"is {abs(gain):.3g} times the command" in w for w in found.warnings]
    assert any(told) if gain != 1.0 else not told
    np.testing.assert_allclose(
        np.abs(frequency_response(found.plants.nominal, F_HZ)),
        np.abs(frequency_response(plant, F_HZ)),
        rtol=1e-2,
        atol=1e-2,  # a real zero stands for time that nobody has
    )


@pytest.mark.parametrize("unit", [1e-3, 60.0])
def test_frequencies_that_are_not_in_hz(unit: float) -> None:
    plain = response(one_mode(40.0, 0.05))
    with pytest.raises(ModelError, match=r"frequencies must be in Hz \(not kHz"):
        identify([at(replace(plain, f_hz=unit * plain.f_hz))])


@pytest.mark.slow
@pytest.mark.parametrize("power", [-2, 1])
def test_command_and_measurement_of_different_kinds(power: int) -> None:
    plain = response(one_mode(60.0, 0.05))
    derived = replace(plain, response=plain.response * (2j * np.pi * F_HZ) ** power)
    try:
        said = identify([at(derived)])["x"].warnings
    except ModelError as error:  # what rings most is no mode of the band then
        said = (str(error),)
    assert any(f"goes like f^{power} " in w and f"(2 pi j f)^{-power}" in w for w in said)


@pytest.mark.slow
def test_command_and_measurement_exchanged() -> None:
    plant = PairsSpec(poles=(PolePair(f_hz=40.0, zeta=0.3), PolePair(f_hz=90.0, zeta=0.3)))
    forward = response(plant)
    swapped = replace(forward, response=1.0 / forward.response)
    with pytest.raises(ModelError, match="ahead of the command"):
        identify([at(swapped)])
    assert not any("ahead" in w for w in identify([at(forward)])["x"].warnings)


def test_a_dc_gain_that_was_scaled_is_a_warning() -> None:
    def model(gain: float) -> InputFile:
        return InputFile("m_x.json", f'{{"num": [{gain}], "den": [1e-5, 1e-4, 1.0]}}'.encode())

    (warning,) = one(model(1.1)).warnings
    assert warning.startswith("m_x.json: DC gain 1.1 scaled to 1; more than 2% off")
    near = one(model(1.01))
    assert near.warnings == ()
    assert near.notes == ("m_x.json: DC gain 1.01 scaled to 1",)


@pytest.mark.parametrize("name", ["x.csv", "1-X100-200-0-none.csv"])
def test_a_log_of_m956(name: str) -> None:
    """RepRapFirmware has no test: frequencies or an axis do not help. (A name of Duet's plugin.)"""
    ringing = 0.3 * np.exp(-np.arange(3000) / 300) * np.sin(np.arange(3000) * 0.2)
    rows = "".join(f"{i},{v:.3f}\n" for i, v in enumerate(ringing))
    file = InputFile(name, f"Sample,X\n{rows}Rate 1600, overflows 0\n".encode())
    with pytest.raises(
        ModelError, match=rf"^{name}: RepRapFirmware has no resonance test.*ring-test"
    ):
        one(file)


@pytest.mark.slow
@pytest.mark.parametrize("column", ["x", "y"])
def test_a_sensor_whose_range_ended(column: str) -> None:
    turned = QUICK_SENSOR if column == "x" else replace(QUICK_SENSOR, rotation=TURNED_ROUND_Z)
    log = quick_log("x", sensor=turned)
    largest = float(np.abs(log.accel_mm_s2[:, "xyz".index(column)]).max())

    def clipped(share: float) -> InputFile:
        accel = np.clip(log.accel_mm_s2, -share * largest, share * largest)
        return raw_file(replace(log, accel_mm_s2=accel))

    found = one(clipped(0.9))
    assert sum(f"the sensor's {column} stops at" in w for w in found.warnings) == 1
    # With more of it, damping came out up to three times too large, and friction was blamed.
    with pytest.raises(ModelError, match=rf"csv: the sensor's {column} stops at .* range ended"):
        one(clipped(0.7))


def test_a_sensor_whose_range_ended_in_a_recorded_drive() -> None:
    t = np.arange(8000) / 1000.0
    command = np.sin(2 * np.pi * (5.0 + 3.0 * t) * t)
    for most, words in ((0.7, "measurement stops at 0.7,"), (2.0, None)):
        columns = np.stack([t, command, np.clip(0.9 * command, -most, most)], axis=1)
        rows = "".join(f"{at_s:.3f},{u:.4f},{y:.4f}\n" for at_s, u, y in columns)
        file = InputFile("drive_x.csv", f"time_s,cmd_acc,meas_acc\n{rows}".encode())
        if words is None:
            (driven,) = read(file)
            assert driven.measurement.notes == ()
        else:
            with pytest.raises(ModelError, match=words):
                read(file)


@pytest.mark.parametrize("notes", [(), (RangeEnded("the sensor's x stops at 9"),)])
def test_friction_is_not_blamed_for_a_sensor_whose_range_ended(notes: tuple[str, ...]) -> None:
    assert ("friction" in phase_warning("x", "nothing fits", notes)) is not bool(notes)


@pytest.mark.slow
@pytest.mark.parametrize(("share", "warned"), [(0.6, True), (0.2, False)])
def test_motion_across_the_tested_axis(share: float, warned: bool) -> None:
    log, other = quick_log("x"), quick_log("x", one_mode(25.0, 0.06))
    accel = log.accel_mm_s2.copy()
    accel[:, 1] += share * (other.accel_mm_s2[:, 0] - accel[:, 0])
    found = one(raw_file(replace(log, accel_mm_s2=accel)))
    assert any("across axis x the sensor moved" in w for w in found.warnings) == warned


@pytest.mark.slow
def test_one_axis_measured_twice() -> None:
    files = [quick_raw("x"), quick_raw("y", sensor=Sensor(rate_hz=500.0, rotation=TURNED_ROUND_Z))]
    with pytest.raises(ModelError, match=r"raw_data_x_.*, raw_data_y_.*: .*measured twice"):
        identify(read(*files), SETTINGS)
    turned = SETTINGS.model_copy(update={"sensor_turned": True})
    assert list(identify(read(*files), turned)) == ["x", "y"]


@pytest.mark.parametrize(
    ("direction", "warned"),
    [((0.72, -0.69, 0.02), True), ((0.1, 0.68, 0.73), True), ((0.87, 0.5, 0.0), False)],
)
def test_a_belt_tested_as_an_axis(direction: tuple[float, ...], warned: bool) -> None:
    """A test of a belt, called X, was said to have coupled axes."""
    felt = replace(response(one_mode(40.0, 0.05)), sensor_direction=direction)
    found = [note for note in mounting_notes("x", [felt]) if "test of a belt" in note]
    assert len(found) == warned
    assert all("the sensor moved as much along its" in note for note in found)
    assert all(isinstance(note, WarningNote) for note in found)


TURNED_ROUND_Z = ((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0))


def test_delays_of_responses_are_compared() -> None:
    late = response(one_mode(40.0, 0.05), axis="y")
    shifted = replace(late, response=late.response * np.exp(-2j * np.pi * F_HZ * 1e-3))
    found = identify([at(response(one_mode(40.0, 0.05))), at(shifted)])
    assert all(
        any("delays of the axes differ by 1.0" in w for w in a.warnings) for a in found.values()
    )


@pytest.mark.slow
def test_a_poor_fit_is_told() -> None:
    two = PairsSpec(poles=two_modes(33.0, 55.0).poles)
    (warning, *_) = identify([at(response(two))], max_order=1)["x"].warnings
    assert warning.startswith("the model misses")
    assert re.search("Leave out files.*measure again.*max_order", warning)
    assert identify([at(response(two))])["x"].warnings == ()


# A weight on the bed


def loaded(kg: float, f_hz: float = 35.0, zeta: float = 0.08, m0_kg: float = 0.8) -> PairsSpec:
    """Stiffness and viscous damping stay."""
    factor = 1.0 / math.sqrt(1.0 + kg / m0_kg)
    return one_mode(f_hz * factor, zeta * factor)


def test_raw_logs_of_a_klipper_before_2024_12() -> None:
    """Its pulses lead out and back, a quarter of a period away from those of newer versions."""
    old = replace(QUICK, out_and_back=True)
    found = one(quick_raw("x", one_mode(42.0, 0.06), test=old))
    assert main_mode(found) == pytest.approx(42.0, rel=0.01)
    assert found.plants.provenance is not None
    assert found.plants.provenance.kind == "raw log"
    assert not [w for w in found.warnings if "phase" in w]


def test_lost_messages_of_a_sensor_do_not_matter() -> None:
    rows = quick_raw("x").content.splitlines(keepends=True)
    lost = {at + k for at in range(1000, 15000, 1300) for k in range(4)}
    content = b"".join(row for i, row in enumerate(rows) if i not in lost)
    (log,) = read_content(content, "raw_data_x_20260101_120000.csv", settings=SETTINGS)
    (found,) = identify([Measured(log)], SETTINGS).values()
    assert main_mode(found) == pytest.approx(42.0, rel=2e-3)
    assert any("44 samples (0.28%) are missing in 11 gaps" in note for note in found.notes)


def test_moving_mass_from_two_raw_logs() -> None:
    found = one(quick_raw("y", loaded(0.0)), quick_raw("y", loaded(0.5), condition="+500g"))
    mass = mass_of(found)
    assert mass.moving_mass_kg == pytest.approx(0.8, rel=0.01)
    assert mass.modes == (0,)
    assert main_mode(found) == pytest.approx(35.0, rel=1e-3)  # the empty bed's
    (note,) = [n for n in found.notes if "lowered" in n]
    assert note.startswith("0.5 kg on the bed lowered 35.00 Hz to 27.4")
    # The schedule's own plant with the weight is the one that was measured with it.
    heavy = mass.loaded(found.plants.nominal, 0.5)
    f = np.linspace(6.0, 60.0, 100)
    truth = np.abs(frequency_response(loaded(0.5), f))
    assert np.max(np.abs(np.abs(frequency_response(heavy, f)) - truth)) < 0.03 * np.max(truth)


def test_a_second_weight_checks_the_first() -> None:
    runs = [quick_raw("y", loaded(kg), condition=f"+{kg}kg") for kg in (0.2, 0.5)]
    found = one(quick_raw("y", loaded(0.0)), *runs)
    assert mass_of(found).moving_mass_kg == pytest.approx(0.8, rel=0.01)
    assert "0.2 kg on the bed: 31.30 Hz, by that mass 31.30 Hz" in found.notes


def test_repeats_with_a_weight_are_one_run() -> None:
    runs = [
        quick_raw("y", loaded(0.5), seed=1, condition="+0.5kg"),
        quick_raw("y", loaded(0.5), seed=2, condition="+500g"),
    ]
    found = one(quick_raw("y", loaded(0.0)), *runs)
    assert len([n for n in found.notes if "on the bed" in n]) == 1
    assert len(found.measured) == 3


def test_the_mode_of_the_bed_is_found_among_others() -> None:
    """Also when the weight brings it below the frame's, which stays."""
    bed_below = identify([at(response(two_modes(35.0))), at(response(two_modes(28.0)), "+0.45kg")])
    assert mass_of(bed_below["x"]).modes == (0,)
    assert mass_of(bed_below["x"]).moving_mass_kg == pytest.approx(0.8, rel=0.01)
    bed_above = identify(
        [at(response(two_modes(60.0, 38.0))), at(response(two_modes(50.0, 38.0)), "+0.352kg")]
    )
    assert mass_of(bed_above["x"]).modes == (1,)
    assert mass_of(bed_above["x"]).moving_mass_kg == pytest.approx(0.8, rel=0.01)


@pytest.mark.parametrize(
    ("runs", "words"),
    [
        ([("+0.5kg", 27.5)], "axis x: every run has a weight on the bed"),
        ([("", 27.5), ("+0.5kg", 35.0)], "axis x: with 0.5 kg .* were the runs swapped"),
        ([("", 42.0), ("+0.5kg", 41.9)], "axis x: .* is lost in the scatter .* heavier weight"),
    ],
)
def test_weights_that_tell_nothing(runs: list[tuple[str, float]], words: str) -> None:
    with pytest.raises(ModelError, match=words):
        identify([at(response(one_mode(f, 0.06)), condition) for condition, f in runs])


# Places


def placed(places: Iterable[tuple[str, float]]) -> list[InputFile]:
    return [quick_raw("x", one_mode(f, 0.06), condition=where) for where, f in places]


def test_heights_make_a_grid() -> None:
    found = one(*placed([("z=200", 40.0), ("z=0", 44.0), ("z=100", 42.0)]))
    assert found.schedule is not None
    grid = found.schedule.grid
    assert grid is not None
    assert [node.z_mm for node in grid.nodes] == [0.0, 100.0, 200.0]
    (told,) = [note for note in found.notes if "follows the place" in note]
    assert told.endswith("at z=0 44.00 Hz; z=100 42.00 Hz; z=200 40.00 Hz")
    for node, f_hz in zip(grid.nodes, (44.0, 42.0, 40.0), strict=True):
        assert isinstance(node.plant, PairsSpec)
        assert node.plant.poles[0].f_hz == pytest.approx(f_hz, rel=1e-3)
    assert main_mode(found) == pytest.approx(42.0, rel=1e-3)  # the middle one's
    assert len(found.measured) == 3


def test_repeats_at_places_are_one_node_each() -> None:
    files = placed([("x=50", 40.0), ("x=250", 44.0)])
    again = quick_raw("x", one_mode(40.0, 0.06), seed=5, condition="x=50.0")
    found = one(*files, again)
    assert found.schedule is not None
    assert found.schedule.grid is not None
    assert len(found.schedule.grid.nodes) == 2


def test_members_follow_the_grid() -> None:
    """Runs of several strengths would be listed one by one, which a grid cannot move."""
    found = one(
        quick_raw("x", one_mode(41.0, 0.06), condition="weak"),
        quick_raw("x", one_mode(44.0, 0.06), condition="strong"),
        *placed([("z=0", 44.0), ("z=200", 40.0)]),
    )
    assert isinstance(found.schedule, AxisSchedule)
    assert len(found.plants.weighted_members()) == 9
    assert any("spread about the plant of each place" in note for note in found.notes)


@pytest.mark.parametrize(
    ("places", "words"),
    [
        (["z=20"], r"axis x: measured at one place only \(z=20\): measure at another"),
        (["x=0,y=0", "x=0,y=100", "x=100,y=0"], "axis x: .* no node at x 100, y 100 mm"),
        (["z=0", "x=100"], "axis x: .* lacks"),
    ],
)
def test_places_that_make_no_grid(places: list[str], words: str) -> None:
    with pytest.raises(ModelError, match=words):
        identify([at(response(one_mode(40.0, 0.06)), place) for place in places])


# Labels


def test_labels_are_members_and_repeats_are_one() -> None:
    three = [quick_raw("x", one_mode(40.0, 0.06), seed=k) for k in range(3)]
    far = [quick_raw("x", one_mode(44.0, 0.06), seed=k, condition="far") for k in (3, 4)]
    found = one(*three, *far)
    assert len(found.measured) == 5
    assert len(found.member_fits) == 2
    assert len(found.plants.weighted_members()) == 3


def test_labels_too_far_apart_for_a_mean_are_named() -> None:
    near, far = (at(response(one_mode(f, 0.05)), f"{f:g}") for f in (52.0, 58.0))
    said = "what rings most is at 52.0 Hz in 52 and at 58.0 Hz in 58"
    assert any(said in warning for warning in identify([near, far])["x"].warnings)


def test_a_mode_that_might_be_anywhere_is_refused_with_what_else_was_found() -> None:
    unsure = ModeEstimate(f_hz=54.0, zeta=0.05, f_sd_hz=8.0, zeta_sd=0.01, peak=10.0)
    fit = Fit(one_mode(54.0, 0.05), 0.1, 1.0, 0.0, (5.0, 130.0), (unsure,))
    with pytest.raises(ModelError, match=r"give or take 16\.0 Hz; .* And: two labels\. Measure"):
        check_informative(fit, (), ["a.csv"], ["two labels"])


@pytest.mark.parametrize(("zeta", "peak", "refused"), [(0.003, 52.0, False), (0.05, 17.0, True)])
def test_a_mode_beyond_the_band_is_not_the_main_one_for_want_of_damping(
    zeta: float, peak: float, *, refused: bool
) -> None:
    """Of a stiff CoreXY: 95 Hz rings, and how much 177 Hz is damped nobody has measured."""
    main = ModeEstimate(f_hz=95.0, zeta=0.042, f_sd_hz=0.1, zeta_sd=0.01, peak=16.0)
    beyond = ModeEstimate(f_hz=177.0, zeta=zeta, f_sd_hz=6.0, zeta_sd=0.01, peak=peak)
    fit = Fit(one_mode(95.0, 0.042), 0.02, 1.0, 0.0, (6.0, 134.0), (main, beyond))
    words = (
        r"177\.0 Hz, outside the measured 6\.0 to 134\.0 Hz, .* Measure up to 250 Hz \(Klipper: max"
    )
    told = pytest.raises(ModelError, match=words)
    with told if refused else nullcontext():
        check_informative(fit, (), ["a.csv"])


@pytest.mark.parametrize(("to_hz", "refused"), [(50.0, False), (95.0, True)])
def test_an_axis_that_sticks_where_it_has_its_resonance_is_refused(
    to_hz: float, *, refused: bool
) -> None:
    """What friction leaves below was taken for the axis: 16 to 100 Hz were not measured."""
    seen = response(one_mode(14.0, 0.3))
    sticks = (F_HZ > 16.0) & (to_hz > F_HZ)
    seen = replace(seen, coherence=np.where(sticks, 0.1, 0.999))
    fit = Fit(one_mode(14.0, 0.3), 0.02, 1.0, 0.0, (6.0, 134.0), ())
    words = r"raw\.csv: .* does not follow the command between 15\.6 and 95\.1 Hz .* accel_per_hz"
    with pytest.raises(ModelError, match=words) if refused else nullcontext():
        check_informative(fit, [seen], ["raw.csv"])


def test_repeats_alone_make_a_set_of_what_explains_them() -> None:
    found = one(*(quick_raw("x", seed=k) for k in range(3)))
    assert found.member_fits == ()
    plants = found.plants.weighted_members()
    assert 4 < len(plants) <= 16
    assert sum(p.weight for p in plants) == pytest.approx(1.0)
    truth = frequency_response(one_mode(42.0, 0.06), F_HZ)
    for one_of_all in plants:
        answer = frequency_response(one_of_all.plant, F_HZ)
        # Damping differs from run to run.
        assert np.max(np.abs(np.abs(answer) - np.abs(truth))) < 0.4 * np.max(np.abs(truth))


def test_strengths_of_the_test_are_operating_points() -> None:
    weak = replace(QUICK, accel_per_hz_mm_s=40.0)
    measured = [*read(quick_raw("x", one_mode(44.0, 0.06), test=weak))]
    settings = SETTINGS.model_copy(update={"accel_per_hz_mm_s": 40.0})
    assert [r.label for r in identify(measured, settings)["x"].measured if r.label] == ["40 mm/s"]


# Spectra


@pytest.mark.parametrize("gain", [0.6, 1.4])
def test_a_level_that_is_too_low_may_be_friction(gain: float) -> None:
    (warning,) = spectrum_level_warning(gain, LEGACY, "table.csv")
    assert f"implies accel_per_hz = {75 * gain:.0f}" in warning
    assert ("rubs much" in warning) == (gain < 1.0)


@pytest.mark.parametrize(("stated", "gain"), [(75.0, 0.0092), (0.69, 1.0)])
def test_gains_are_no_densities(stated: float, gain: float) -> None:
    """What M959 K of Prusa's firmware prints; with the accel_per_hz it was said to have, a wrong
    machine was made."""
    test = replace(LEGACY, accel_per_hz_mm_s=stated)
    with pytest.raises(ModelError, match=r"no test is below 3: .* Prusa's M958 and M959"):
        spectrum_level_warning(gain, test, "table.csv")


TABLES = SETTINGS.model_copy(update={"f_end_hz": 80.0})


def quick_table(axis: str, sensor: Sensor = QUICK_SENSOR) -> Measured:
    truth = {"x": one_mode(42.0, 0.06), "y": one_mode(35.0, 0.08)}
    rng = np.random.default_rng(0)
    found = simulate_spectrum(
        truth, along(axis, replace(QUICK, f_end_hz=80.0)), sensor=sensor, rng=rng
    )
    return Measured(replace(found, axis=axis, source=f"resonances_{axis}_1.csv"))


@pytest.mark.parametrize("gain", [0.0, 0.1, 7.0])
def test_a_table_of_something_else_is_refused(gain: float) -> None:
    """Noise alone, or the head of a bed slinger in the test of its bed, made a model."""
    with pytest.raises(ModelError, match=r"_x_1\.csv: .* times as much as a test with accel_per"):
        identify([quick_table("x", replace(QUICK_SENSOR, gain=gain))], TABLES, max_order=1)


def test_one_axis_in_the_tables_of_both_is_refused() -> None:
    """The table of X, given for Y too, made two axes alike."""
    round_z = replace(QUICK_SENSOR, rotation=TURNED_ROUND_Z)
    tables = [quick_table("x"), quick_table("y", round_z)]
    with pytest.raises(ModelError, match=r"_x_1\.csv, resonances_y_1\.csv: .* measured twice"):
        identify(tables, TABLES, max_order=1)
    turned = TABLES.model_copy(update={"sensor_turned": True})
    found = identify(tables, turned, max_order=1)
    assert not any("mounted so" in note for note in found["x"].notes)
    assert any("sensor's x moved in the test of axis y" in note for note in found["y"].notes)


def test_a_table_of_the_other_axis_among_repeats_is_refused() -> None:
    """A table of Y that was called X was averaged into X."""
    misnamed = quick_table("y")
    renamed = replace(misnamed.measurement, axis="x", source="resonances_x_2.csv")
    tables = [quick_table("x"), Measured(renamed), misnamed]
    with pytest.raises(ModelError, match=r"axis X: .*its x in resonances_x_1\.csv; its y in "):
        identify(tables, TABLES, max_order=1)


def test_tables_of_x_and_y_that_may_be_exchanged_are_warned_of() -> None:
    """It stood in a note between others, and the axes were stored exchanged."""
    exchanged = [
        Measured(replace(quick_table(was).measurement, axis=now, source=f"{now}.csv"))
        for was, now in ("xy", "yx")
    ]
    found = identify(exchanged, TABLES, max_order=1)
    for axis, other in ("xy", "yx"):
        text = f"{axis}.csv: the sensor's {other} moved in the test of axis {axis}"
        (warning,) = (w for w in found[axis].warnings if text in w)
        # It copies Y to X, never X to Y.
        assert ("Creality's K1" in warning) == (axis == "x")


def test_a_sensor_that_is_turned_for_both_axes_is_no_fault() -> None:
    for rotation in (TURNED_ROUND_Z, TURNED_BY_45):
        sensor = replace(QUICK_SENSOR, rotation=rotation)
        tables = [quick_table("x", sensor), quick_table("y", sensor)]
        assert list(identify(tables, TABLES, max_order=1)) == ["x", "y"]


TURNED_BY_45 = ((0.5**0.5, 0.5**0.5, 0.0), (-(0.5**0.5), 0.5**0.5, 0.0), (0.0, 0.0, 1.0))


def test_spectra_of_different_tests_have_no_mean() -> None:
    files = [
        spectrum_file(one_mode(50.0, 0.06), LEGACY, name="20230101_120000"),
        spectrum_file(one_mode(50.0, 0.06), name="20260101_120000"),
    ]
    with pytest.raises(ModelError, match=r"csv, .*csv: the spectra come from different tests"):
        one(*files, settings=ReadSettings())
    empty = spectrum_file(one_mode(55.0, 0.06), name="20260101_110000")
    loaded = [replace(file, condition=Condition.parse("+0.5kg")) for file in files]
    with pytest.raises(ModelError, match=r"csv, .*csv: the spectra come from different tests"):
        one(empty, *loaded, settings=ReadSettings())


def test_spectra_of_different_labels_have_no_mean() -> None:
    files = [spectrum_file(one_mode(50.0, 0.06), condition=label) for label in ("slow", "fast")]
    with pytest.raises(ModelError, match=r"different labels \(slow, fast\)"):
        one(*files)


def test_logs_that_become_spectra_keep_the_most_of_one_test() -> None:
    """Where no model explains the phase of raw logs of several tests."""

    def tested(name: str, test: Excitation, condition: str = "") -> SpectrumRun:
        (file,) = read(spectrum_file(one_mode(50.0, 0.06), QUICK, name=name))
        assert isinstance(file.measurement, Spectrum)
        return SpectrumRun(file.measurement, test, Condition.parse(condition))

    old, new, again, loaded = (
        tested("20240101_120000", LEGACY),
        tested("20260101_120000", SWEEPING),
        tested("20260101_130000", SWEEPING),
        tested("20240101_140000", LEGACY, "+0.5kg"),
    )
    kept, notes = of_one_test([old, new, again, loaded], "x")
    assert kept == [new, again, loaded]
    assert [old.spectrum.source in note for note in notes] == [True]


# Progress


@pytest.mark.slow
def test_progress_rises_from_nothing_to_all() -> None:
    seen: list[tuple[str, float]] = []
    files = [quick_raw("x"), quick_raw("x", seed=2, condition="far"), quick_raw("y")]
    spare = spectrum_file(one_mode(50.0, 0.06), QUICK, sensor=Sensor(rate_hz=1600.0))
    identify(read(*files, spare), SETTINGS, progress=lambda what, part: seen.append((what, part)))
    parts = [part for _, part in seen]
    assert parts == sorted(parts)
    assert parts[0] < 0.1
    assert seen[-1] == ("done", 1.0)
    assert all(0.0 <= part <= 1.0 for part in parts)
    assert any(what == "axis y: raw_data_y_20260101_120000.csv, estimate" for what, _ in seen)


def test_whoever_listens_can_stop_it() -> None:
    def stop(what: str, _: float) -> None:
        if "fitting" in what:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        identify(read(quick_raw("x")), SETTINGS, progress=stop)


@pytest.mark.slow
def test_same_files_same_plants() -> None:
    files = [quick_raw("x")]
    first, again = (identify(read(*files), SETTINGS) for _ in range(2))
    assert [a.plants for a in first.values()] == [a.plants for a in again.values()]


@pytest.mark.slow
def test_what_no_model_explains_is_refused() -> None:
    f = np.arange(5.0, 130.0, 0.5)
    rng = np.random.default_rng(5)
    noise = rng.normal(size=len(f)) + 1j * rng.normal(size=len(f))
    response = FrequencyResponse(
        f, noise, np.full(len(f), np.nan), np.full(len(f), np.nan), axis="x", source="noise.csv"
    )
    with pytest.raises(ModelError, match=r"noise.csv: no stable model .* explains this"):
        identify([Measured(response)])


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.75, 0.4])
def test_logs_whose_phase_no_model_explains_count_as_tables(share: float) -> None:
    """However little of it: motors with detents, of a heavy bed, left 80 %; here .4 leaves 59 %."""
    plant = one_mode(42.0, 0.06)
    test = replace(QUICK, f_end_hz=90.0)
    settings = ReadSettings.model_validate({**QUICK_SETTINGS, "f_end_hz": 90.0})
    log = late_by_less(quick_log(plant=plant, test=test), plant, share)
    turned = replace(log, accel_mm_s2=log.accel_mm_s2[:, [2, 1, 0]])
    found = one(raw_file(turned), settings=settings)
    about = found.plants.provenance
    assert about is not None
    assert about.magnitude_only
    assert any("only the size of the vibrations" in text for text in found.warnings)
    # What the log says of its test and its sensor is said, not what a spectrum of it would.
    assert any("the sensor's z moved in the test of axis x" in note for note in found.notes)
    assert found.plants.friction_assumed is any("mass is assumed" in note for note in found.notes)
    assert found.plants.friction_assumed is not any("dry friction holds" in n for n in found.notes)
    assert main_mode(found) == pytest.approx(42.0, rel=0.05)


def test_a_fit_misses_what_the_plant_without_its_delay_misses() -> None:
    plant, f_hz = one_mode(60.0, 0.04), np.arange(6.0, 100.0, 0.5)
    g = frequency_response(plant, f_hz)
    seen = np.abs(g) * np.exp(0.7j * np.angle(g))
    fit = fit_modes(FrequencyResponse(f_hz, seen, 0.004 * np.abs(g), np.ones(len(g))))
    used = fit.gain * np.abs(frequency_response(prompt(fit), f_hz))
    missed = np.linalg.norm(used - np.abs(g)) / np.linalg.norm(g)
    assert missed <= fit.residual


@pytest.mark.slow
def test_modes_whose_slow_motion_is_early_count_as_the_plant_they_are_used_as() -> None:
    """Modes as strongly damped as these explain a phase, and are another plant on time."""
    f_hz = np.arange(6.0, 132.0, 0.25)
    modes = ((22.5, 0.06, 0.02), (75.2, 0.03, 0.95), (102.2, 0.69, 0.9), (104.2, 1.0, -0.87))
    plant = RelativeModesSpec(
        modes=tuple(
            RelativeMode(f_hz=hz, zeta=zeta, share=share, grounded=1.0) for hz, zeta, share in modes
        )
    )
    g = frequency_response(plant, f_hz)
    fit = fit_modes(FrequencyResponse(f_hz, g, 0.002 * np.abs(g), np.ones(len(g))))
    used = fit.gain * np.abs(frequency_response(prompt(fit), f_hz))
    missed = np.linalg.norm(used - np.abs(g)) / np.linalg.norm(g)
    assert missed < 0.025


def staggering(log: AccelerationLog, from_hz: float) -> AccelerationLog:
    """Return the log of an axis that sometimes sticks above a frequency of the test (2 Hz/s)."""
    since_s = log.time_s - log.time_s[0]
    knots_s = np.arange(0.0, since_s[-1] + 0.1, 0.1)
    late = np.interp(since_s, knots_s, np.random.default_rng(1).standard_normal(len(knots_s)))
    late *= 5.0 + 2.0 * since_s > from_hz
    level = log.accel_mm_s2.mean(axis=0)
    moved = np.asarray(hilbert(log.accel_mm_s2 - level, axis=0)) * np.exp(1j * late)[:, None]
    return replace(log, accel_mm_s2=np.real(moved) + level)


@pytest.mark.slow
def test_logs_that_hardly_follow_at_the_resonance_count_as_tables() -> None:
    """Guides that rub much; such logs were refused, with the advice to measure what they are."""
    test = replace(QUICK, f_end_hz=90.0)
    settings = ReadSettings.model_validate({**QUICK_SETTINGS, "f_end_hz": 90.0})
    found = one(raw_file(staggering(quick_log(test=test), 38.0)), settings=settings)
    about = found.plants.provenance
    assert about is not None
    assert about.magnitude_only
    assert found.fit is not None
    assert max(found.fit.modes, key=lambda m: m.peak).f_hz == pytest.approx(42.0, rel=0.1)
    assert any("only the size of the vibrations" in text for text in found.warnings)


@pytest.mark.parametrize(("rings_hz", "told"), [(42.0, True), (35.0, False)])
def test_the_phase_of_logs_that_follow_up_to_below_the_resonance_is_not_used(
    rings_hz: float, *, told: bool
) -> None:
    rings = ModeEstimate(f_hz=rings_hz, zeta=0.06, f_sd_hz=0.1, zeta_sd=0.01, peak=8.0)
    plant = one_mode(rings_hz, 0.06)
    fit = Fit(plant, 0.02, 1.0, 0.0, (6.0, 37.0), (rings,))
    plants = PlantSetSpec(nominal=plant)
    found = AxisIdentification(axis="x", plants=plants, fit=fit, measured=(response(plant),))
    fault = phase_fault(found)
    assert (fault is not None) == told
    assert not told or "follows its command up to 37.0 Hz only" in str(fault)


def test_logs_that_hardly_follow_are_refused_and_friction_is_named() -> None:
    with pytest.raises(ModelError, match=r"are needed\): .* the axis rubs so much"):
        one(raw_file(staggering(quick_log(), 10.0)))


@pytest.mark.slow
def test_a_table_that_rocks_under_a_frame_that_shakes() -> None:
    """Only one of the two is found as the frame; the other one is no more the nozzle's."""
    poles, zeros = [PolePair(f_hz=42.0, zeta=0.06)], []
    for f_hz, mass_ratio in ((9.0, 0.05), (21.0, 0.08)):
        poles.append(PolePair(f_hz=f_hz, zeta=0.08))
        zeros.append(ZeroPair(f_hz=f_hz * (1 + 0.5 * mass_ratio), zeta=0.08 * (1 + mass_ratio)))
    felt = PairsSpec(poles=tuple(poles), zeros=tuple(zeros))
    test = replace(QUICK, f_end_hz=90.0)
    settings = ReadSettings.model_validate({**QUICK_SETTINGS, "f_end_hz": 90.0})
    found = one(raw_file(quick_log(plant=felt, test=test)), settings=settings)
    assert any("the frame shakes on its feet" in note for note in found.notes)
    assert any("or what it stands on" in warning for warning in found.warnings)
    f_hz = np.arange(7.0, 35.0)
    over_bed = np.abs(frequency_response(one_mode(42.0, 0.06), f_hz))
    np.testing.assert_allclose(
        np.abs(frequency_response(found.plants.nominal, f_hz)), over_bed, rtol=0.05
    )
