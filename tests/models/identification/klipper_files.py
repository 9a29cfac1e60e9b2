"""Files of spectra as Klipper writes them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillpath.models.identification.synthetic import file_axis, write_table
from stillpath.models.identification.types import Spectrum

Array = NDArray[np.float64]


def write_resonances(spectrum: Spectrum, folder: Path, name: str = "20260101_120000") -> Path:
    """Write `resonances_<axis>_<name>.csv` as Klipper does; return its path."""
    path = folder / f"resonances_{file_axis(spectrum.axis)}_{name}.csv"
    columns = ("x", "y", "z", "xyz")
    rows = np.column_stack([spectrum.f_hz, *(spectrum.psd[c] for c in columns)])
    header = ",".join(["freq", *(f"psd_{c}" for c in columns)])
    write_table(path, header, "%.1f,%.3e,%.3e,%.3e,%.3e", rows)
    return path


def write_calibration_data(
    spectrum: Spectrum,
    folder: Path,
    name: str = "20260101_120000",
    *,
    shapers: Mapping[str, Array] | None = None,
) -> Path:
    """Write `calibration_data_<axis>_<name>.csv` as klippy/extras/shaper_calibrate.py does."""
    path = folder / f"calibration_data_{file_axis(spectrum.axis)}_{name}.csv"
    f = spectrum.f_hz
    scale = np.where(f < 10.0, np.exp(1.0 - (10.0 / (f + 0.1)) ** 2), 1.0) / (f + 0.1)
    columns, curves = ("x", "y", "z", "xyz"), shapers or {}
    header = [*(f"psd_{c}" for c in columns), *(["shapers:", *curves] if curves else [])]
    layout = "%.1f" + ",%.3e" * len(columns) + ("," if curves else "") + ",%.3f" * len(curves)
    rows = np.column_stack([f, *(spectrum.psd[c] * scale for c in columns), *curves.values()])
    write_table(path, ",".join(["freq", *header]), layout, rows)
    return path
