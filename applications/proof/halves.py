"""Build prints of two halves, the left as planned and the right compensated.

Both halves are mirror images, drawn outwards from the gap between them, so that equal walls follow
equal corners. The right one is compensated by the pipeline itself, like any file.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from stillpath.applications.proof.program import (
    LETTER_HEIGHT_MM,
    Place,
    PrintSettings,
    Program,
    place,
)
from stillpath.gcode.firmware.file_shapers import FILE_SETS_SHAPER
from stillpath.gcode.firmware.registry import adapter
from stillpath.models.machine import Machine
from stillpath.models.plants import continuous
from stillpath.pipeline.compensate import compensate_file
from stillpath.pipeline.files import replacing
from stillpath.pipeline.options import Options
from stillpath.pipeline.progress import ProgressCallback
from stillpath.pipeline.result import Result
from stillpath.pipeline.summary import SHAPER_IS_BETTER
from stillpath.pipeline.totals import NOT_COMPENSATED

__all__ = ["AS_PLANNED", "COMPENSATED", "Halves", "ProofPrint", "Ringing", "write_proof"]

Point = tuple[float, float]

AS_PLANNED, COMPENSATED = "as planned", "compensated"

_LONGEST_STAND_S = 0.5
_BY_DESIGN = (FILE_SETS_SHAPER, NOT_COMPENSATED, SHAPER_IS_BETTER)
"""Warnings about an ordinary file; half of this one is uncompensated on purpose."""
_GAP_MM, _RIM_MM, _PURGE_MM = 10.0, 4.0, 5.0


class Halves:
    """Places two mirrored halves on the bed and writes what both share.

    Parameters
    ----------
    width_mm, depth_mm : float
        Of a half.
    what : str
        The print's name, for messages.

    Attributes
    ----------
    program : Program
    """

    def __init__(
        self,
        machine: Machine,
        settings: PrintSettings,
        width_mm: float,
        depth_mm: float,
        what: str,
    ) -> None:
        self.program = Program(machine, settings)
        self._width_mm = width_mm
        plants = [continuous(machine.axes[a].nominal) for a in ("x", "y")]
        settling_s = max(plant.settling_time_s(0.05) for plant in plants)
        self._settling_s = min(settling_s, _LONGEST_STAND_S)
        front = LETTER_HEIGHT_MM + 2 * _RIM_MM
        area = place(
            machine,
            settings,
            2 * (width_mm + _RIM_MM) + _GAP_MM,
            depth_mm + front + _RIM_MM + _PURGE_MM,
            what,
        )
        self._base = Place((area.low_mm[0], area.low_mm[1] + _PURGE_MM), area.high_mm)
        self._purge_from = area.low_mm
        self._middle_mm = 0.5 * (area.low_mm[0] + area.high_mm[0])
        self._front_mm = self._base.low_mm[1] + front

    def begin(self) -> float:
        """Write all lines before the first wall; return the height of the base."""
        low, high = self._base.low_mm, self._base.high_mm
        self.program.begin(self._purge_from, high[0] - low[0])
        return self.program.base(low, high)

    def words(self, accel_mm_s2: float) -> None:
        """Write OFF before the left half and ON before the right one, then set an acceleration."""
        self.program.region("words")
        self.program.limit_accel(self.program.gentle_mm_s2)
        y = self._front_mm - _RIM_MM - 0.5 * LETTER_HEIGHT_MM
        for word, side in (("OFF", -1), ("ON", 1)):
            x = self._middle_mm + side * (0.5 * _GAP_MM + 0.5 * self._width_mm)
            self.program.word(word, (x, y))
        self.program.limit_accel(accel_mm_s2)

    def both(self, paths: Sequence[Sequence[Point]], speed_mm_s: float, band: str = "") -> None:
        """Write the paths of one layer in both halves.

        Parameters
        ----------
        paths : sequence of sequence of (x, y)
            As on the right half, x from its inner wall outwards, y from its front.
        band : str
            Comes before the names of the two regions.
        """
        program = self.program
        program.region(band + AS_PLANNED)
        for path in paths:
            program.trace([self._at(point, -1) for point in path], speed_mm_s)
        # The left half's vibration must decay before the right half begins.
        program.stand(self._settling_s)
        program.region(band + COMPENSATED)
        with program.compensated():
            for path in paths:
                program.trace([self._at(point, 1) for point in path], speed_mm_s)

    def _at(self, point: Point, side: int) -> Point:
        x = self._middle_mm + side * (0.5 * _GAP_MM + point[0])
        return x, self._front_mm + point[1]


@dataclass(frozen=True, slots=True)
class Ringing:
    """Predicted distance of the nozzle from the walls of a region, in um."""

    rms_um: float
    largest_um: float


@dataclass(frozen=True, slots=True)
class ProofPrint:
    """A print that was written.

    Attributes
    ----------
    result : Result
        The pipeline's, measured on the written file.
    ringing : dict of str to Ringing
        By region.
    legend : list of str
        First comments of the file.
    """

    result: Result
    ringing: dict[str, Ringing]
    legend: list[str]
    warnings: list[str]


class HasText(Protocol):
    """Anything that can be written as lines."""

    def text(self) -> str:
        """Return all lines."""


def write_proof(
    program: HasText,
    machine: Machine,
    target: Path,
    legend: Callable[[dict[str, Ringing], Result], list[str]],
    *,
    cache_dir: Path | None = None,
    progress: ProgressCallback | None = None,
) -> ProofPrint:
    """Compensate a program's right half and write it with its legend, whole or not at all.

    Parameters
    ----------
    legend : callable
        Makes lines for users from the predictions.
    cache_dir, progress
        As of `pipeline.compensate.compensate_file`.

    Raises
    ------
    GcodeError, DesignError, ModelError
        As of `pipeline.compensate.compensate_file`.
    """
    with tempfile.TemporaryDirectory(prefix="stillpath-proof-") as folder:
        planned, written = Path(folder, "planned.gcode"), Path(folder, "written.gcode")
        planned.write_text(program.text(), encoding="utf-8", newline="\n")
        result = compensate_file(
            planned, written, machine, Options(), cache_dir=cache_dir, progress=progress
        )
        result = result.model_copy(update={"source_name": target.name})
        ringing = _ringing(result)
        lines = legend(ringing, result)
        head = "".join(f"; {line}\n" if line else ";\n" for line in lines)
        with replacing(target) as temporary:
            temporary.write_bytes(head.encode() + written.read_bytes())
    return ProofPrint(result, ringing, lines, _warnings(machine, result))


def _ringing(result: Result) -> dict[str, Ringing]:
    """Return the ringing of the written file by region."""
    return {
        group.name: Ringing(group.contour_rms_um["after"], group.contour_max_um["after"])
        for group in result.features
        if "after" in group.contour_rms_um
    }


def _warnings(machine: Machine, result: Result) -> list[str]:
    out = [w for w in result.warnings if not any(words in w for words in _BY_DESIGN)]
    stream_commands = adapter(machine).stream_commands()
    if stream_commands.shaper_off and stream_commands.shaper_on is None:
        out.append(
            "the firmware's input shaper is switched off for both halves, and the machine does not "
            "say what it was (firmware.shaper): restart the firmware after the print"
        )
    if result.put_back:
        seconds = sum(piece.extruding_seconds for piece in result.put_back)
        out.append(
            f"{len(result.put_back)} of {result.pieces} compensated pieces left as planned "
            f"({seconds:.0f} s): {result.put_back[0].reason}"
        )
    return out
