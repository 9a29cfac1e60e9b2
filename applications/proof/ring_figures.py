"""Figures of a ring test's logs."""

from __future__ import annotations

from typing import Literal

from stillpath.models.confirmation import Confirmation
from stillpath.models.document import Document

__all__ = ["AxisRing", "Half", "RingReport", "Verdict"]

Verdict = Literal["confirmed", "not confirmed", "says nothing"]


class Half(Document):
    """Vibration after the stops of one half of an axis: rms over stops, in the band of the modes.

    `scatter_um` is the standard error, from repeats of the same stops; the noise floor is taken off
    all figures.
    """

    stops: int
    measured_mm_s2: float
    measured_um: float
    scatter_um: float
    predicted_mm_s2: tuple[float, float]
    predicted_um: tuple[float, float]


class AxisRing(Document):
    """One axis. Figures are None where its logs say nothing at all.

    `misses` is how much of the motion the plant of the set that does best misses, 0 to 1, gain and
    lag of the sensor fitted; `gain` the sensor's, 3 to 20 Hz; `lag_ms` by how much the first log
    comes later than the plants say, on the clock that both of its axes share.
    """

    axis: Literal["x", "y"]
    verdict: Verdict
    text: str
    band_hz: tuple[float, float]
    logs: tuple[str, ...] = ()
    seen: int = 0
    within: int = 0
    gain: float | None = None
    misses: float | None = None
    lag_ms: tuple[float, float] | None = None
    floor_um: float | None = None
    as_planned: Half | None = None
    compensated: Half | None = None
    confirmation: Confirmation | None = None


class RingReport(Document):
    """What `stillpath verify` found of a ring test."""

    version: str
    machine: str
    machine_title: str
    machine_revision: str
    printed: str
    logs: list[str]
    axes: list[AxisRing]
    notes: list[str]
