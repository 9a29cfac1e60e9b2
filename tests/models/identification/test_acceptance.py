"""The acceptance tests of identification, through what a user calls: files in, a machine out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stillpath.applications.identification.figures import AxisFigures
from stillpath.applications.identification.run import Identified, InputFile, identify_files
from stillpath.models.errors import ModelError
from stillpath.models.identification.readers import ReadSettings
from stillpath.models.identification.synthetic import (
    ADXL345,
    LIS2DW,
    Sensor,
    simulate_log,
    simulate_spectrum,
    write_raw_data,
)
from stillpath.models.machine import Machine
from stillpath.models.plants import (
    Mode,
    ModesSpec,
    PlantSpec,
    RelativeModesSpec,
    TfSpec,
    discretise,
    frequency_response,
)
from stillpath.models.store import load_machine
from tests.models.identification.klipper_files import write_calibration_data
from tests.models.identification.recordings import (
    BROKEN,
    LEGACY,
    QUICK_SETTINGS,
    SWEEPING,
    TAZ,
    broken,
    spectrum_file,
)

TURNED = ((2 / 3, -1 / 3, 2 / 3), (2 / 3, 2 / 3, -1 / 3), (-1 / 3, 2 / 3, 2 / 3))
TESTS = {"sweeping": (SWEEPING, "20260101_120000"), "legacy": (LEGACY, "20230101_120000")}
# The third mode lies beyond the sweep: only its flank is seen.
TRUTH = ModesSpec(
    modes=(
        Mode(f_hz=47, zeta=0.035, gain=0.7),
        Mode(f_hz=95, zeta=0.06, gain=0.2),
        Mode(f_hz=170, zeta=0.05, gain=0.1),
    )
)
IN_BAND = ((47.0, 0.035), (95.0, 0.06))


# Main modes by an independent fit of the same files (reference notes, section 5).
PEAKS = {
    "resonances_x_20220703_144605.csv": (126.0, 3.8),
    "resonances_y_20220703_143119.csv": (83.0, 3.1),
    "resonances_x_20220522_092825.csv": (95.0, 14.9),
}


@pytest.fixture(scope="module")
def base() -> Machine:
    return load_machine("generic-bedslinger")


def only_axis(found: Identified) -> AxisFigures:
    (axis,) = found.report.axes
    return axis


def nearest(axis: AxisFigures, f_hz: float) -> tuple[float, float]:
    mode = min(axis.modes, key=lambda m: abs(m.f_hz - f_hz))
    return mode.f_hz, mode.zeta


def check_in_band(axis: AxisFigures, f_rel: float, zeta_rel: float) -> None:
    for f_hz, zeta in IN_BAND:
        found = nearest(axis, f_hz)
        assert found[0] == pytest.approx(f_hz, rel=f_rel)
        assert found[1] == pytest.approx(zeta, rel=zeta_rel)


def nrmse(plant: PlantSpec, truth: PlantSpec, band_hz: tuple[float, float]) -> float:
    """Up to a delay: a log does not say when its test began."""
    f = np.linspace(*band_hz, 1000)
    g, g0 = frequency_response(plant, f), frequency_response(truth, f)
    delays_s = np.arange(-1e-3, 1e-3, 1e-6)[:, None]
    off = np.linalg.norm(g * np.exp(-2j * np.pi * f * delays_s) - g0, axis=1)
    return float(off.min() / np.linalg.norm(g0))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("test", "sensor", "start_s"), [("sweeping", LIS2DW, 0.5), ("legacy", ADXL345, -0.5)]
)
def test_1_simulated_raw_log(
    test: str, sensor: Sensor, start_s: float, base: Machine, tmp_path: Path
) -> None:
    excitation, name = TESTS[test]
    log = simulate_log(
        {"x": TRUTH},
        excitation,
        sensor=replace(sensor, rotation=TURNED, jitter_s=2e-6),
        lead_s=start_s,
        rng=np.random.default_rng(7),
    )
    path = write_raw_data(log, tmp_path, name)
    found = identify_files([InputFile(path.name, path.read_bytes())], base)
    axis = only_axis(found)
    check_in_band(axis, f_rel=2.5e-3, zeta_rel=0.02)
    assert axis.residual is not None
    assert axis.residual < 0.005
    assert axis.band_hz is not None
    assert nrmse(found.machine.axes["x"].nominal, TRUTH, axis.band_hz) < 0.005
    # What is given with 95 % is not far from the truth.
    for mode in axis.modes:
        truth = min(IN_BAND, key=lambda t: abs(t[0] - mode.f_hz))
        if mode.f_hz < axis.band_hz[1]:
            assert mode.f_sd_hz is not None
            assert abs(mode.f_hz - truth[0]) < 5 * mode.f_sd_hz


@pytest.mark.slow
@pytest.mark.parametrize(
    ("test", "modes"), [("legacy", ((38.0, 0.015), (61.0, 0.020))), ("sweeping", IN_BAND)]
)
def test_2_simulated_spectrum(
    test: str, modes: tuple[tuple[float, float], ...], base: Machine
) -> None:
    excitation, name = TESTS[test]
    shares = (0.7, 0.3) if modes is not IN_BAND else (0.7, 0.2)
    listed = [Mode(f_hz=f, zeta=z, gain=g) for (f, z), g in zip(modes, shares, strict=True)]
    plant = TRUTH if modes is IN_BAND else ModesSpec(modes=tuple(listed))
    axis = only_axis(identify_files([spectrum_file(plant, excitation, name=name)], base))
    assert axis.kind == "spectrum"
    for f_hz, zeta in modes:
        found = nearest(axis, f_hz)
        assert found[0] == pytest.approx(f_hz, rel=0.005)
        assert found[1] == pytest.approx(zeta, rel=0.15)
    assert axis.gain == pytest.approx(1.0, abs=0.03)
    assert axis.trust_below_hz is not None


@pytest.mark.shared
@pytest.mark.slow
def test_3_every_measured_table(shared_dir: Path, base: Machine) -> None:
    files = sorted(shared_dir.glob("measurements/*/resonances_*.csv"))
    assert len(files) >= 45
    met, residuals = [], []
    for path in files:
        found = identify_files([InputFile(path.name, path.read_bytes())], base)
        axis = only_axis(found)
        assert axis.residual is not None
        # The worst is an Ender 3's beyond 110 Hz, where |G| is -30 to -40 dB.
        assert axis.residual <= 3.0, path.name
        residuals.append(axis.residual)
        assert len(axis.modes) <= 4
        plants = found.machine.axes[axis.axis]
        for plant in (plants.nominal, *(m.plant for m in plants.weighted_members())):
            assert isinstance(plant, RelativeModesSpec)
            assert plant.roots().poles.real.max() < 0
            assert abs(frequency_response(plant, [0.0])[0] - 1) < 1e-9
        (recommended,) = [s for s in axis.shapers if s.recommended]
        if path.name in PEAKS:
            f_hz, peak = PEAKS[path.name]
            f = np.linspace(*plants.band_hz, 2000)
            size = np.abs(frequency_response(plants.nominal, f))
            # Of pairs, and at the edge of the band: not the same structure.
            assert f[np.argmax(size)] == pytest.approx(f_hz, rel=0.04)
            assert size.max() == pytest.approx(peak, rel=0.4)
        if recommended.name == "mzv":
            met.append(min(abs(m.f_hz / recommended.f_hz - 1) for m in axis.modes) < 0.1)
    assert len(met) >= 20
    # Some shapers are recommended between two modes.
    assert np.mean(met) >= 0.9
    # Where |G| is below a tenth the floor of a table is not explained (docs/identification.md).
    assert np.quantile(residuals, 0.75) < 1.1


@pytest.mark.slow
def test_4_both_tables_of_one_printer(base: Machine, tmp_path: Path) -> None:
    """Of two runs, as TEST_RESONANCES and SHAPER_CALIBRATE make them."""
    excitation, name = TESTS["sweeping"]
    resonances = spectrum_file(TRUTH, excitation, name=name, seed=1)
    spectrum = simulate_spectrum({"x": TRUTH}, excitation, rng=np.random.default_rng(2))
    path = write_calibration_data(spectrum, tmp_path, name, shapers={"mzv(46.8)": spectrum.f_hz})
    calibration = InputFile(path.name, path.read_bytes())
    one, other = (only_axis(identify_files([file], base)) for file in (resonances, calibration))
    assert len(one.modes) == len(other.modes)
    for f_hz, _ in IN_BAND:
        a, b = nearest(one, f_hz), nearest(other, f_hz)
        assert a[0] == pytest.approx(b[0], rel=0.01)
        assert a[1] == pytest.approx(b[1], rel=0.10)


def test_5_printed_taz_polynomial(base: Machine) -> None:
    file = InputFile("taz_x.json", TAZ.encode())
    with pytest.raises(ModelError, match=r"taz_x.json: model has an integrator .*rounded\?"):
        identify_files([file], base)
    found = identify_files([file], base, ReadSettings(repair_rounding=True))
    plant = found.machine.axes["x"].nominal
    assert isinstance(plant, TfSpec)
    assert abs(frequency_response(plant, [0.0])[0] - 1) < 1e-9
    discrete = discretise(plant, 1e-3)
    assert np.abs(discrete.poles()).max() < 1
    outside = discrete.zeros()[np.abs(discrete.zeros()) > 1]
    assert len(outside) == 2
    assert outside[0] == pytest.approx(np.conj(outside[1]))
    assert any("-4.54 to -4.53995" in note for note in only_axis(found).notes)


@pytest.mark.parametrize("what", BROKEN)
def test_6_broken_input(what: str, base: Machine) -> None:
    files = broken(what)
    with pytest.raises(ModelError) as caught:
        identify_files(files, base, ReadSettings.model_validate(QUICK_SETTINGS))
    message = str(caught.value)
    for word in [files[0].name, *BROKEN[what]]:
        assert word in message
    # Each has its own: the words of no other fit.
    fitting = [name for name, words in BROKEN.items() if all(word in message for word in words)]
    assert fitting == [what]
