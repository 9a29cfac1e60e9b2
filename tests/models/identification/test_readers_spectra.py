"""Spectra of every generation of Klipper, and tables of frequency responses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import scipy.signal
from hypothesis import given
from hypothesis import strategies as st

from stillpath.models.errors import ModelError
from stillpath.models.identification.readers import (
    ReadSettings,
    assumed_test,
    read_content,
    read_measurements,
)
from stillpath.models.identification.synthetic import (
    simulate_spectrum,
)
from stillpath.models.identification.types import Excitation, FrequencyResponse, Spectrum
from stillpath.models.plants import PairsSpec, PolePair
from tests.models.identification.klipper_files import write_calibration_data, write_resonances

RATE_HZ = 3193.7


def some_spectrum() -> tuple[np.ndarray, np.ndarray]:
    """Klipper's way of making one, by scipy: frequencies, densities of x, y, z, xyz."""
    noise = np.random.default_rng(2).normal(0, 2000, (3, 40_000))
    f_hz, psd = scipy.signal.welch(
        noise, RATE_HZ, ("kaiser", 6.0), nperseg=2048, noverlap=1024, detrend="constant"
    )
    kept = f_hz < 200
    return f_hz[kept], np.vstack([psd, psd.sum(axis=0)])[:, kept]


F_HZ, PSD = some_spectrum()


def table(header: str, psd: np.ndarray, *more: str) -> str:
    rows = [
        ",".join([f"{f:.1f}", *(f"{p:.3e}" for p in column), *more])
        for f, column in zip(F_HZ, psd.T, strict=True)
    ]
    return header + "\n" + "\n".join(rows) + "\n"


def read(text: str, name: str = "resonances_x_20220101_120000.csv", **known: object) -> Spectrum:
    (one,) = read_content(text.encode(), name, settings=ReadSettings.model_validate(known))
    assert isinstance(one, Spectrum)
    return one


def test_resonances() -> None:
    spectrum = read(table("freq,psd_x,psd_y,psd_z,psd_xyz", PSD))
    assert list(spectrum.psd) == ["x", "y", "z", "xyz"]
    for name, expected in zip(spectrum.psd, PSD, strict=True):
        np.testing.assert_allclose(spectrum.psd[name], expected, rtol=6e-4)
    assert spectrum.axis == "x"
    assert spectrum.accel_per_hz_mm_s is None
    assert spectrum.notes == ()


def test_grid_is_restored_from_rounded_frequencies() -> None:
    spectrum = read(table("freq,psd_x,psd_y,psd_z,psd_xyz", PSD))
    assert np.abs(np.round(F_HZ, 1) - F_HZ).max() > 0.04
    np.testing.assert_allclose(spectrum.f_hz, F_HZ, atol=0.01)


def test_kalico_column_and_data_sets() -> None:
    kalico = read(table("freq,psd_x,psd_y,psd_z,psd_xyz,accel_per_hz", PSD, "100.0"))
    assert kalico.accel_per_hz_mm_s == 100.0
    assert list(kalico.psd) == ["x", "y", "z", "xyz"]
    sets = read(table('freq,"adxl345, hotend",bed', PSD[:2]))
    assert list(sets.psd) == ["adxl345, hotend", "bed"]
    np.testing.assert_allclose(sets.psd["bed"], PSD[1], rtol=6e-4)


def low(f_hz: np.ndarray) -> np.ndarray:
    return np.where(f_hz < 10, np.exp(1 - (10 / (f_hz + 0.1)) ** 2), 1.0)


@pytest.mark.parametrize(
    ("header", "more", "kept"),
    [
        ("psd_x,psd_y,psd_z,psd_xyz,shapers:,zv(59.6),mzv(55.0)", ("", "0.1", "0.2"), low),
        ("psd_x,psd_y,psd_z,psd_xyz,zv(59.6),2hump_ei(67.2)", ("0.1", "0.2"), low),
        ("psd_x,psd_y,psd_z,psd_xyz,mzv", ("0.1",), low),
        (
            "psd_x,psd_y,psd_z,psd_xyz,accel_per_hz,mzv(55.0/80.1),smooth_ei(50.0)",
            ("60.0", "0.1", "0.2"),
            lambda f: np.tanh(0.1 * f),
        ),
        ("psd_x,psd_y,psd_z,psd_xyz,zv(59.6)", ("0.1",), lambda f: 1.0 * (f >= 5)),
    ],
)
def test_normalisation_is_undone(header: str, more: tuple[str, ...], kept: object) -> None:
    assert callable(kept)
    written = PSD * kept(F_HZ) / (F_HZ + 0.1)
    spectrum = read(table("freq," + header, written, *more), "calibration_data_y_1.csv")
    assert spectrum.axis == "y"
    at = spectrum.f_hz > 5.2
    assert at.sum() > 110
    reference = np.interp(spectrum.f_hz, F_HZ, PSD[0])
    np.testing.assert_allclose(spectrum.psd["x"][at], reference[at], rtol=3e-3)
    assert all((psd >= 0).all() and psd[0] > 0 for psd in spectrum.psd.values())
    assert spectrum.notes == ("Klipper's normalisation by frequency is undone",)


GAINS = [f"{f:.2f},1.01200,0.00100,0.00200,1.01500" for f in range(5, 151)]


@pytest.mark.parametrize(
    "lines",
    [
        ["freq,psd_x,psd_y,psd_z,psd_xyz,mzv", *GAINS],
        ["echo:Running: M959 X K", "freq,psd_x,psd_y,psd_z,psd_xyz,mzv", *GAINS, "ok"],
        [
            "Send: M959 X",
            "Recv: Sample freq: 1271.62",
            "Recv: frequency[Hz] excitation[m/s^2] X[m/s^2] Y[m/s^2] Z[m/s^2] X_gain Y_gain Z_gain",
            "Recv: 6.00 2.50 2.55800 0.02148 0.07608 1.02301 0.00859 0.03043",
        ],
        [
            "excitation_frequency[Hz] excitation[m/s^2] X[m/s^2] X_gain Y_gain Z_gain",
            "6.00 2.50 2.55800 1.02301 0.00859 0.03043",
        ],
    ],
)
def test_gains_of_prusas_firmware_are_called_so(lines: list[str]) -> None:
    """A line had too few fields, and the advice was to complete it."""
    with pytest.raises(ModelError, match=r"^m959\.txt: Prusa's M958 and M959 .*M959 names"):
        read("\n".join([*lines, ""]), "m959.txt")


def test_data_sets_with_shapers() -> None:
    written = PSD[:2] * low(F_HZ) / (F_HZ + 0.1)
    spectrum = read(table("freq,a,b,shapers:,mzv(40.2)", written, "", "0.3"))
    assert list(spectrum.psd) == ["a", "b"]
    np.testing.assert_allclose(spectrum.psd["b"][-50:], PSD[1, -50:], rtol=3e-3)


def test_commas_in_names_of_shapers() -> None:
    """As of calibrate_shaper.py --shapers='ei,mzv(n=6,t=1.0)': a line had too few fields."""
    header = "freq,psd_x,psd_y,psd_z,psd_xyz,shapers:,ei(52.0),mzv(n=6,t=1.0)(48.2)"
    written = PSD * low(F_HZ) / (F_HZ + 0.1)
    spectrum = read(table(header, written, "", "0.1", "0.2"), "x.csv")
    assert list(spectrum.psd) == ["x", "y", "z", "xyz"]
    np.testing.assert_allclose(spectrum.psd["x"][-50:], PSD[0, -50:], rtol=3e-3)
    lines = table(header, written, "", "0.1", "0.2").split("\n")
    short = "\n".join([*lines[:2], lines[2].rpartition(",")[0], *lines[3:]])
    with pytest.raises(ModelError, match=r"line 3: 7 fields where 8 are expected"):
        read(short)


def interpolated(
    psd: np.ndarray, bins_hz: np.ndarray, end_hz: float = 202.5, more: str = ""
) -> str:
    """A table of two data sets as Klipper writes it since 2025-11: every 0.2 Hz."""
    grid_hz = np.arange(0.0, end_hz, 0.2)
    one, other = (np.interp(grid_hz, bins_hz, column) for column in psd[:2])
    rows = [f"{f:.1f},{a:.3e},{b:.3e}{more}\n" for f, a, b in zip(grid_hz, one, other, strict=True)]
    shapers = ",shapers:,mzv(40.2)" if more else ""
    return f"freq,/tmp/resonances_x_a.csv,/tmp/resonances_x_b.csv{shapers}\n" + "".join(rows)


@pytest.mark.parametrize("bin_hz", [1.0986, 1.3125, 1.5594, 1.9531])
def test_tables_every_fifth_of_a_hertz_are_taken_back_to_bins(bin_hz: float) -> None:
    """Whatever sensor it was, 1.5625 Hz were assumed: two modes became one."""
    bins_hz = bin_hz * np.arange(200)
    psd = np.random.default_rng(3).chisquare(60, (2, 200)) * 1e4
    spectrum = read(interpolated(psd, bins_hz))
    np.testing.assert_allclose(np.diff(spectrum.f_hz), bin_hz, rtol=1e-3)
    found = spectrum.psd["/tmp/resonances_x_b.csv"]
    expected = np.interp(spectrum.f_hz, bins_hz, psd[1])
    np.testing.assert_allclose(found, expected, rtol=0.06)
    low_psd = psd * low(bins_hz) / (bins_hz + 0.1)
    normalised = read(interpolated(low_psd, bins_hz, more=",,0.3"), "calibration_data_x_1.csv")
    used = normalised.f_hz > 6.0
    back = normalised.psd["/tmp/resonances_x_b.csv"]
    expected = np.interp(normalised.f_hz, bins_hz, psd[1])
    np.testing.assert_allclose(back[used], expected[used], rtol=0.06)


def test_other_fine_tables_stay_as_they_are() -> None:
    f_hz = np.arange(0.0, 180.0, 0.2)
    smooth = 1e4 * (2.0 + np.sin(f_hz / 3.0))
    rows = "".join(f"{f:.1f},{p:.3e}\n" for f, p in zip(f_hz, smooth, strict=True))
    assert len(read("freq,psd_x\n" + rows).f_hz) == len(f_hz)


def test_the_largest_range_of_klipper_is_read() -> None:
    """max_freq 300 makes 2250 lines."""
    psd = np.random.default_rng(3).chisquare(60, (2, 300)) * 1e4
    assert read(interpolated(psd, 1.5625 * np.arange(300), 450.0)).f_hz[-1] > 448.0


def test_spectrum_faults() -> None:
    header = "freq,psd_x,psd_y,psd_z,psd_xyz"
    dead = PSD.copy()
    dead[0] = 0
    with pytest.raises(ModelError, match="sensor's x is dead"):
        read(table(header, dead))
    assert read(table(header, dead), sensor_axis="z").notes == ("the sensor's x = 0 is constant",)
    with pytest.raises(ModelError, match="every column"):
        read(table(header, 0 * PSD))
    negative = PSD.copy()
    negative[2, 7] = -4
    with pytest.raises(ModelError, match="line 9: psd_z is negative"):
        read(table(header, negative))
    with pytest.raises(ModelError, match="after freq there must be"):
        read(table("freq,mzv(40)", PSD[:1]))
    with pytest.raises(ModelError, match="frequencies, at least"):
        read("\n".join(table(header, PSD).split("\n")[:9]) + "\n")
    with pytest.raises(ModelError, match="does not rise"):
        read(table(header, PSD).replace("\n6.2,", "\n2.2,"))
    with pytest.raises(ModelError, match=r"line 2: freq -0\.1 is negative"):
        read(table(header, PSD).replace("\n0.0,", "\n-0.1,"))
    text = table(header + ",accel_per_hz", PSD, "60.0")
    with pytest.raises(ModelError, match="the same in every line"):
        read(text[: text.rindex("60.0")] + "75.0\n")


def test_simulated_tables_come_back(tmp_path: Path) -> None:
    plant = PairsSpec(poles=(PolePair(f_hz=40, zeta=0.05),))
    test = Excitation((0.0, 1.0), f_start_hz=5, f_end_hz=30)
    rng = np.random.default_rng(4)
    made = simulate_spectrum({"y": plant}, test, rng=rng)
    curve = {"mzv(52.2)": np.zeros(len(made.f_hz))}
    for path, above_hz in (
        (write_resonances(made, tmp_path), -1.0),
        (write_calibration_data(made, tmp_path, "1"), 5.0),
        (write_calibration_data(made, tmp_path, "2", shapers=curve), 5.0),
    ):
        (read_back,) = read_measurements(path)
        assert isinstance(read_back, Spectrum)
        assert read_back.axis == "y"
        used = read_back.f_hz > above_hz
        start = len(made.f_hz) - len(read_back.f_hz)
        np.testing.assert_allclose(read_back.f_hz, made.f_hz[start:], atol=0.01)
        for name, psd in made.psd.items():
            np.testing.assert_allclose(read_back.psd[name][used], psd[start:][used], rtol=0.01)


@pytest.mark.shared
def test_every_measured_table_is_read(shared_dir: Path) -> None:
    files = sorted((shared_dir / "measurements").rglob("resonances_*.csv"))
    assert len(files) == 45
    for path in files:
        (spectrum,) = read_measurements(path)
        assert isinstance(spectrum, Spectrum)
        assert list(spectrum.psd) == ["x", "y", "z", "xyz"]
        assert spectrum.axis == path.name.split("_")[1]
        assert assumed_test(spectrum).excitation.f_end_hz == pytest.approx(10000 / 75)
        written = np.loadtxt(path, delimiter=",", skiprows=1)
        np.testing.assert_allclose(spectrum.f_hz, written[:, 0], atol=0.0501)
        np.testing.assert_array_equal(spectrum.psd["xyz"], written[:, 4])
        # The bins of 2048 samples at 3200 Hz, whatever the sensor's clock says.
        np.testing.assert_allclose(np.diff(spectrum.f_hz), 3200 / 2048, rtol=0.05)
        assert np.ptp(np.diff(spectrum.f_hz)) < 1e-9


POINTS = st.lists(
    st.tuples(st.floats(1e-3, 1e3), st.floats(-360_000, 360_000)), min_size=8, max_size=30
)


@given(POINTS, st.sampled_from(["abs", "dB", "unit", "re", "rad"]))
def test_response_is_read_as_written(points: list[tuple[float, float]], form: str) -> None:
    f_hz = 1.0 + np.arange(len(points))
    mag, phase_deg = np.array(points).T
    expected = mag * np.exp(1j * np.deg2rad(phase_deg))
    header, first, second = {
        "abs": ("mag,phase_deg", mag, phase_deg),
        "dB": ("mag_dB,phase_deg", 20 * np.log10(mag), phase_deg),
        "unit": ("mag,phase_deg", 20 * np.log10(mag), phase_deg),
        "re": ("real,imag", expected.real, expected.imag),
        "rad": ("magnitude,phase_rad", mag, np.deg2rad(phase_deg)),
    }[form]
    columns = zip(f_hz.tolist(), first.tolist(), second.tolist(), strict=True)
    text = f"freq_hz,{header}\n" + "".join(f"{f!r},{a!r},{b!r}\n" for f, a, b in columns)
    settings = ReadSettings(magnitude_unit="dB") if form == "unit" else None
    (one,) = read_content(text.encode(), "frf_y.csv", settings=settings)
    assert isinstance(one, FrequencyResponse)
    np.testing.assert_array_equal(one.f_hz, f_hz)
    np.testing.assert_allclose(one.response, expected, rtol=1e-10)
    assert np.isnan(one.coherence).all()
    assert np.isnan(one.sd).all()
    assert one.axis == "y"


def test_responses_by_amplitude() -> None:
    lines = ["freq_hz,mag,phase_deg,coherence,amplitude"]
    for amplitude in ("40", "75"):
        lines += [f"{f},{float(amplitude) / f},{-f},0.98,{amplitude}" for f in range(5, 25)]
    both = read_content("\n".join(lines).encode(), "frf_x.csv")
    assert [m.label for m in both if isinstance(m, FrequencyResponse)] == ["40", "75"]
    for one in both:
        assert isinstance(one, FrequencyResponse)
        np.testing.assert_allclose(np.abs(one.response), float(one.label) / np.arange(5, 25))
        np.testing.assert_allclose(one.coherence, 0.98)


def test_response_faults() -> None:
    def text(header: str, row: str) -> bytes:
        return (header + "\n" + "".join(f"{f},{row}\n" for f in range(5, 25))).encode()

    with pytest.raises(ModelError, match=r"line 2: mag is negative .*dB"):
        read_content(text("freq_hz,mag,phase_deg", "-3,1"), "f.csv")
    with pytest.raises(ModelError, match="column 'phase_deg' is missing"):
        read_content(text("freq_hz,mag,coherence", "3,1"), "f.csv")
    with pytest.raises(ModelError, match=r"coherence 1\.2 is not between"):
        read_content(text("freq_hz,mag,phase_deg,coherence", "3,1,1.2"), "f.csv")
    with pytest.raises(ModelError, match="sd -1 is not between 0"):
        read_content(text("freq_hz,mag,phase_deg,sd", "3,1,-1"), "f.csv")
    with pytest.raises(ModelError, match="column 'imag' is missing"):
        read_content(text("freq_hz,real", "3"), "f.csv")
    with pytest.raises(ModelError, match="dB is beyond"):
        read_content(text("freq_hz,mag_db,phase_deg", "900,1"), "f.csv")


def test_a_table_of_more_rows_than_a_test_has() -> None:
    rows = "".join(f"{0.01 * k:.2f},1.0,1.0,1.0,3.0\n" for k in range(2501))
    with pytest.raises(ModelError, match=r"2501 frequencies, at most 2500 are read"):
        read("freq,psd_x,psd_y,psd_z,psd_xyz\n" + rows)
