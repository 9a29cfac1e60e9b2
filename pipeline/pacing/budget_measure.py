"""Measure a print that was made faster, beside the print as sliced.

The written file has its own timing. Errors of the sliced file, also with the best shaper, are
measured at that file's own speeds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode.pacing import AS_SLICED
from stillpath.models.machine import Machine
from stillpath.models.schedule import OperatingPoint
from stillpath.pipeline.measuring.layers import LayerTile
from stillpath.pipeline.measuring.measure import UNCHANGED_CHANNELS, Measurement
from stillpath.pipeline.measuring.points import MotionSamples
from stillpath.pipeline.measuring.reference_shaper import BestShaper
from stillpath.pipeline.measuring.set_errors import ErrorSum, SetErrors
from stillpath.pipeline.measuring.tracing import Trace
from stillpath.pipeline.result import Channel, GroupFigures

__all__ = ["BudgetMeasurement"]

_STRIDE = 24
"""The set has many plants: their errors are measured at every 24th sample."""


class BudgetMeasurement(Measurement):
    """Measure both motions; parameters are those of `Measurement`.

    Channels, layers and features are those of the written file, with `before` and `shaper` at the
    speeds of the sliced file. What is drawn along the print (track, spectra, tiles of layers)
    shows all channels at the new speeds.
    """

    note = (
        "Curves along the print, spectra and layers show the uncompensated motion, and that with "
        "the best shaper, at the new speeds; all other figures of the two are at the file's own."
    )

    def __init__(
        self,
        machine: Machine,
        dt_s: float,
        shaper: BestShaper,
        *,
        take_layer: Callable[[LayerTile], None] | None = None,
        trace: Callable[[Trace], None] | None = None,
        size: int | None = None,
    ) -> None:
        super().__init__(machine, dt_s, shaper, take_layer=take_layer, trace=trace, size=size)
        self._sliced = Measurement(machine, dt_s, shaper, UNCHANGED_CHANNELS, size=size)
        self._set = SetErrors(machine, dt_s, stride=_STRIDE)

    def operate_at(self, point: OperatingPoint) -> None:
        """Set the operating point of the motion that follows."""
        super().operate_at(point)
        self._sliced.operate_at(point)
        self._set.operate_at(point)

    def add(self, samples: MotionSamples) -> None:
        """Add motion that stays as sliced."""
        self.add_pair(samples, samples, np.full(len(samples.moves), AS_SLICED, np.int32))

    def add_pair(
        self, written: MotionSamples, sliced: MotionSamples, classes: NDArray[np.int32]
    ) -> None:
        """Add the motion of a piece as it is written, and as it was sliced.

        Parameters
        ----------
        classes : ndarray of int32, shape (len(written.moves),)
            Class that the errors of each of `written.moves` count for.
        """
        super().add(written)
        self._sliced.add(sliced)
        if len(written):
            of_sample = classes[written.row]
            self._set.add(written.path_mm, written.executed_mm, written.extruding, of_sample)

    def jump(self) -> None:
        """Forget the position: the machine stands still when motion resumes."""
        super().jump()
        self._sliced.jump()
        self._set.jump()

    def finish(self) -> None:
        """Finish: the motion has ended."""
        super().finish()
        self._sliced.finish()
        self._set.finish()

    def sums(self) -> dict[int, ErrorSum]:
        """Return the errors of the written file by class of moves, so far."""
        return self._set.sums()

    def channels(self, after: str = "compensated") -> list[Channel]:
        """Return the figures of every channel; `after` is the label of the executed motion."""
        sliced = {channel.name: channel for channel in self._sliced.channels()}
        return [sliced.get(channel.name, channel) for channel in super().channels(after)]

    def layers(self) -> list[GroupFigures]:
        """Return the figures by layer."""
        return _joined(super().layers(), self._sliced.layers())

    def features(self, names: Sequence[str]) -> list[GroupFigures]:
        """Return the figures by feature."""
        return _joined(super().features(names), self._sliced.features(names))


def _joined(written: list[GroupFigures], sliced: list[GroupFigures]) -> list[GroupFigures]:
    """Override figures at the new speeds by those of the sliced file."""
    before = {group.name: group for group in sliced}
    joined = []
    for group in written:
        other = before.get(group.name)
        if other is None:
            joined.append(group)
            continue
        joined.append(
            group.model_copy(
                update={
                    "contour_rms_um": group.contour_rms_um | other.contour_rms_um,
                    "contour_max_um": group.contour_max_um | other.contour_max_um,
                }
            )
        )
    return joined
