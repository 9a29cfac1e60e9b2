"""The figures of a scan: what `scan_file` returns and the page shows."""

from __future__ import annotations

from typing import Any

from stillpath.models.document import Document

__all__ = ["ScanReport", "TrackFigures", "VariantFigures"]


class TrackFigures(Document):
    """One track: where it lies in the file and on the work, and its errors by variant, in um."""

    line: int
    last_line: int
    length_mm: float
    x_mm: tuple[float, ...]
    y_mm: tuple[float, ...]
    rms_um: dict[str, float]
    largest_um: dict[str, float]
    across_um: dict[str, float]


class VariantFigures(Document):
    """One way to drive the scanner, over all samples of all tracks.

    `across_um`: rms of the error across the tracks.
    """

    name: str
    label: str
    rms_um: float
    largest_um: float
    across_um: float


class ScanReport(Document):
    """What a scan leaves; the variants from as sent to the best there is."""

    version: str
    source: str
    machine: str
    title: str
    unit: str
    um_per_unit: float
    rate_hz: float
    prefilter: str
    preview_samples: int
    peak_gain: float | None
    """Largest gain of the prefilter over frequency; None if it is no filter (fbf)."""
    coefficients: tuple[dict[str, Any], ...]
    """Of zpetc at the loop's rate: taps with their preview, sections, and low-pass, in series."""
    controller: str | None
    disturbance: str | None
    enters: str | None
    duration_s: float
    drawn_s: float
    drawn_mm: float
    variants: tuple[VariantFigures, ...]
    tracks: tuple[TrackFigures, ...]
    notes: tuple[str, ...]
