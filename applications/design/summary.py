"""Summary of a design at the top of page and terminal, in figures and in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from stillpath.applications.design.figures import (
    Curve,
    DesignReport,
    ModeFigures,
    RungFigures,
    ZeroFigures,
)

__all__ = ["Summary", "modes_text", "zero_text"]


@dataclass(frozen=True, slots=True)
class Summary:
    """Key figures derived from a report."""

    report: DesignReport

    @property
    def uncompensated(self) -> Curve:
        """The path itself as the command."""
        return self.report.robustness.curves[0]

    @property
    def own(self) -> Curve | None:
        """The command of the requested design; None if it was refused."""
        wanted = f"fbf-{self.report.robust}"
        compensated = [c for c in self.report.robustness.curves if c.name.startswith("fbf-")]
        if len(self.report.plant.members) < 2 and wanted not in {c.name for c in compensated}:
            wanted = "fbf-off"
        return next((c for c in compensated if c.name == wanted), None)

    @property
    def rung(self) -> RungFigures | None:
        """The step of the ladder used for the reference motion."""
        return None if self.report.chosen is None else self.report.ladder[self.report.chosen]

    @property
    def best_shaper(self) -> Curve | None:
        """The shaper with the smallest error on the nominal plant."""
        return min(self._shapers, key=lambda c: c.nominal_um, default=None)

    @property
    def best_shaper_of_set(self) -> Curve | None:
        """The shaper with the smallest worst error over the members."""
        return min(self._shapers, key=lambda c: c.members_worst_um, default=None)

    @property
    def reaches(self) -> list[float]:
        """Half and all of the range of frequency errors, in percent."""
        largest = max(map(abs, self.report.robustness.errors_percent), default=0.0)
        return [largest / 2, largest] if largest else []

    def worst(self, curve: Curve) -> list[float]:
        """Return the worst error of a curve within each of `reaches`."""
        pairs = list(zip(self.report.robustness.errors_percent, curve.contour_um, strict=True))
        return [max(um for e, um in pairs if abs(e) <= reach) for reach in self.reaches]

    @property
    def _shapers(self) -> list[Curve]:
        return [
            c
            for c in self.report.robustness.curves
            if c.name != "none" and not c.name.startswith("fbf-")
        ]


def modes_text(modes: Sequence[ModeFigures]) -> str:
    """Return modes as "45.0 Hz (0.050), ..."."""
    return ", ".join(f"{m.f_hz:.1f} Hz ({m.zeta:.3f})" for m in modes) or "none"


def zero_text(zero: ZeroFigures) -> str:
    """Return a zero as "z = -3.67 (500 Hz)" or "z = 0.98 ± 0.33i, |z| 1.03 (51.2 Hz)"."""
    if zero.imag == 0:
        return f"z = {zero.real:.3g} ({zero.f_hz:.0f} Hz)"
    return f"z = {zero.real:.3f} ± {zero.imag:.3f}i, |z| = {zero.radius:.3f} ({zero.f_hz:.1f} Hz)"
