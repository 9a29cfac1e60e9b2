"""Files for machines identified from real tables, printed by plants fitted to the same tables.

`twins.py` has two plants for each of four printers, which somebody else made. This script makes
such plants, two for each axis, for every other pair of tables in the shared folder, by plain least
squares from random starts: twin a of four modes that may be heavily damped, twin b of five that
are not. `identify` makes the machine from the two tables; it shares nothing with these fits but the
spectrum of the drive.

Beside it: nothing; the shapers that Klipper's rules recommend from the same tables; and the shaper
tuned by brute force on the twin itself, which nobody has.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from statistics import geometric_mean

import numpy as np
from inputs import find_input, one_thread_each, plain_copy, shared_folder
from readback import Judge, Shaped, read_motion
from scipy.optimize import OptimizeResult, least_squares
from twins import Row, judged

from stillpath.applications.identification.run import InputFile, identify_files
from stillpath.models.arrays import Array
from stillpath.models.identification.excitation import Excitation, drive_spectrum
from stillpath.models.identification.readers import ReadSettings, read_content
from stillpath.models.identification.shaper_choice import choose_shaper_of
from stillpath.models.identification.types import Spectrum
from stillpath.models.plants import PlantSetSpec, RelativeModesSpec
from stillpath.models.shaper_pulses import shaper_pulses
from stillpath.models.store import load_machine
from stillpath.pipeline.files import default_cache_dir
from stillpath.pipeline.options import Options

_ENDER, _ANNEX, _VORON = "bassco_ender3", "nielsvz_annexK3", "richardjm_voron24_250"
PAIRS = {
    f"{folder} {x}": (base, f"{folder}/resonances_x_{x}.csv", f"{folder}/resonances_y_{y}.csv")
    for base, folder, x, y in (
        ("ender3", _ENDER, "20210701_223821", "20210130_221343"),
        ("annex-k3", _ANNEX, "20220521_204959", "20220521_205239"),
        ("annex-k3", _ANNEX, "20220607_201452", "20220607_201807"),
        ("annex-k3", _ANNEX, "20220611_180403", "20220611_181032"),
        ("voron-v24-250", _VORON, "20211217_070942", "20211217_071158"),
        ("voron-v24-250", _VORON, "20211217_075710", "20211217_075926"),
        ("voron-v24-250", _VORON, "20211217_081636", "20211217_081852"),
        ("voron-v24-250", _VORON, "20211217_082736", "20211217_082952"),
        ("voron-v24-250", _VORON, "20211217_084132", "20211217_084348"),
        ("voron-v24-250", _VORON, "20211217_085714", "20211217_085930"),
        ("voron-v24-250", _VORON, "20211217_090804", "20211217_091019"),
        ("voron-v24-250", _VORON, "20220213_155340", "20220213_155556"),
        ("voron-v24-250", _VORON, "20220213_160124", "20220213_160340"),
        ("voron-v24-250", _VORON, "20220501_133900", "20220501_134118"),
        ("voron-v24-250", _VORON, "20220501_134810", "20220501_135026"),
        ("voron-v24-250", _VORON, "20220501_135759", "20220501_140015"),
    )
}
"""Base machine and tables of X and Y; those of the built-in machines are in `twins.py`."""

_DRIVE = Excitation(
    direction=(1.0, 0.0), f_end_hz=133.3, accel_per_hz_mm_s=75.0, sweeping_accel_mm_s2=0.0
)
"""Klipper's test of 2021 and 2022, when the tables were taken."""

_BAND_HZ, _POINTS, _STARTS = (8.0, 130.0), 90, 30
_LEVEL_DB = 0.6
"""The sensor's gain may be off by so much."""


@dataclass(frozen=True, slots=True)
class Print:
    """A twin's print, and the contour rms with the recommended shapers."""

    row: Row
    recommended_um: float

    @property
    def to_recommended(self) -> float:
        """Ours over the recommended shapers'."""
        return self.row.ours_um / self.recommended_um

    def __str__(self) -> str:
        row = self.row
        return (
            f"{row.file[:25]:26}{row.twin:5}{row.none_um:7.2f}{self.recommended_um:8.2f}"
            f"{row.shaper_um:7.2f}{row.ours_um:7.2f}{self.to_recommended:9.2f}"
            f"{row.to_shaper:7.2f}{row.to_none:7.2f}"
        )


@dataclass(frozen=True, slots=True)
class Shape:
    """What the modes of a twin may be: as wide as those of `golden/twins.json`."""

    modes: int
    f_hz: tuple[float, float]
    zeta: tuple[float, float]
    share: tuple[float, float]

    def bounds(self) -> tuple[Array, Array]:
        """Bounds of log frequencies, log dampings, all shares but the last, and the level in dB."""
        n = self.modes
        low, high = (
            np.concatenate(
                [
                    np.full(n, np.log(self.f_hz[k])),
                    np.full(n, np.log(self.zeta[k])),
                    np.full(n - 1, self.share[k]),
                    [(-_LEVEL_DB, _LEVEL_DB)[k]],
                ]
            )
            for k in (0, 1)
        )
        return low, high


SHAPES = {
    "a": Shape(4, (13.0, 300.0), (0.02, 0.7), (-2.2, 2.0)),
    "b": Shape(5, (13.0, 250.0), (0.01, 0.35), (-1.0, 1.2)),
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("files", nargs="*", default=["ps_voron_klipper_ringing"])
    parser.add_argument("--pairs", nargs="+", default=list(PAIRS), help="parts of their names")
    parser.add_argument("--shared", type=Path, help="default: $STILLPATH_SHARED or ../shared")
    parser.add_argument("--cache", type=Path, default=default_cache_dir() / "benchmarks")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    given = parser.parse_args()
    shared = shared_folder(given.shared)
    if shared is None:
        sys.exit("the folder of shared data is not there; see --shared")
    one_thread_each()
    print(
        f"{'tables of X':38}{'file':26}{'twin':5}{'none':>7}{'recom.':>8}{'best':>7}{'ours':>7}"
        f"{'/recom.':>9}{'/best':>7}{'/none':>7}",
        flush=True,
    )
    found: list[Print] = []
    with tempfile.TemporaryDirectory(prefix="stillpath-twins-") as folder:
        files = [plain_copy(find_input(name, shared), Path(folder)) for name in given.files]
        with ProcessPoolExecutor(given.jobs, mp_context=get_context("spawn")) as pool:
            waiting = {
                name: pool.submit(of_pair, name, files, shared, given.cache)
                for name in PAIRS
                if any(part in name for part in given.pairs)
            }
            for name, done in waiting.items():
                for one in done.result():
                    found.append(one)
                    print(f"{name:38}{one}", flush=True)
    for what, ratios in (
        ("the recommended shaper", [one.to_recommended for one in found]),
        ("the best-tuned shaper", [one.row.to_shaper for one in found]),
        ("nothing", [one.row.to_none for one in found]),
    ):
        print(f"to {what}: geometric mean {geometric_mean(ratios):.3f}, worst {max(ratios):.3f}")
    return 0


def of_pair(name: str, files: Sequence[Path], shared: Path, cache: Path) -> list[tuple[Row, float]]:
    """Return what the twins of a pair of tables print, and with the recommended shapers, in um."""
    base, *tables = PAIRS[name]
    shipped = load_machine(base)
    paths = [shared / "measurements" / table for table in tables]
    inputs = [InputFile(path.name, path.read_bytes()) for path in paths]
    machine = identify_files(inputs, shipped, ReadSettings()).machine
    spectra = [table_of(path) for path in paths]
    shapers = [choose_shaper_of(spectrum)[0] for spectrum in spectra]
    pulses = [shaper_pulses(one.name, one.f_hz, 0.1) for one in shapers]
    truths = {
        twin: shipped.model_copy(
            update={
                "axes": {
                    axis: PlantSetSpec(nominal=fitted(spectrum, shape))
                    for axis, spectrum in zip(("x", "y"), spectra, strict=True)
                },
                "name": f"{name}-{twin}",
            }
        )
        for twin, shape in SHAPES.items()
    }
    found = []
    for file in files:
        own = read_motion(file, machine)
        rows = judged(file, machine, truths, Options(), cache)
        for row, truth in zip(rows, truths.values(), strict=True):
            judge = Judge(truth, members=False)
            for section in Shaped.through(own, pulses):
                judge.add(section)
            found.append(Print(row, 1e3 * judge.contour.rms))
    return found


def table_of(path: Path) -> Spectrum:
    """Read a table."""
    (table,) = read_content(path.read_bytes(), path.name)
    assert isinstance(table, Spectrum)
    return table


def fitted(table: Spectrum, shape: Shape) -> RelativeModesSpec:
    """Fit modes to the magnitude that a table tells, in decibels on a logarithmic axis.

    Raises
    ------
    RuntimeError
        If no start ends at a plant that gives way to a steady force (compliance above 0).
    """
    f_hz = np.geomspace(*_BAND_HZ, _POINTS)
    measured_db = magnitude_db(table, f_hz)
    low, high = shape.bounds()
    rng = np.random.default_rng(1)
    best: OptimizeResult | None = None
    for _ in range(_STARTS):
        start = rng.uniform(low, high)
        end = least_squares(
            lambda q: level_db(q, shape.modes, f_hz) - measured_db,
            start,
            bounds=(low, high),
            max_nfev=300,
        )
        if compliance_s2(end.x, shape.modes) > 0.0 and (best is None or end.cost < best.cost):
            best = end
    if best is None:
        raise RuntimeError(f"no plant with {shape.modes} modes explains the table")
    w, zeta, share = modes_of(best.x, shape.modes)
    modes = [
        {"f_hz": w[k] / (2 * np.pi), "zeta": zeta[k], "share": share[k]} for k in range(shape.modes)
    ]
    return RelativeModesSpec.model_validate({"modes": modes})


def magnitude_db(table: Spectrum, f_hz: Array) -> Array:
    """Return |G| of a table at some frequencies, averaged over five bins.

    The column is the one that follows the drive where nothing resonates yet.
    """
    near = slice(np.searchsorted(table.f_hz, 8.0), np.searchsorted(table.f_hz, 15.0))
    density = max((table.psd[axis] for axis in "xyz"), key=lambda psd: float(psd[near].sum()))
    low, high = np.searchsorted(table.f_hz, _BAND_HZ)
    at_hz, density = table.f_hz[low:high], density[low:high]
    gain_db = 10 * np.log10(density / drive_spectrum(_DRIVE, at_hz))
    smooth_db = np.convolve(np.pad(gain_db, 2, "edge"), np.full(5, 0.2), "valid")
    return np.interp(f_hz, at_hz, smooth_db)


def modes_of(q: Array, n: int) -> tuple[Array, Array, Array]:
    """Return angular frequencies in rad/s, dampings and shares, which add up to 1."""
    shares = q[2 * n : 3 * n - 1]
    return 2 * np.pi * np.exp(q[:n]), np.exp(q[n : 2 * n]), np.append(shares, 1.0 - shares.sum())


def level_db(q: Array, n: int, f_hz: Array) -> Array:
    """Return the magnitude of a plant at some frequencies, with its level, in dB."""
    w, zeta, share = modes_of(q, n)
    s = 2j * np.pi * f_hz[:, None]
    each = (2 * zeta * w * s + w**2) / (s * s + 2 * zeta * w * s + w**2)
    return np.asarray(20 * np.log10(np.abs(each @ share)) + q[-1], np.float64)


def compliance_s2(q: Array, n: int) -> float:
    """Return how far the plant gives way to a steady acceleration, per mm/s^2, in mm."""
    w, _, share = modes_of(q, n)
    return float(np.sum(share / w**2))


if __name__ == "__main__":
    sys.exit(main())
