"""Residual error of the reference motion when one axis differs from the measured one.

Every command is designed once. This axis' plant is then replaced, by itself with all frequencies
scaled together and by the members of its set, while the other axis stays nominal.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from stillpath.applications.design.figures import Curve
from stillpath.compensation.fbf import PreviewFbf
from stillpath.compensation.shapers import shape_xy
from stillpath.models.arrays import Array
from stillpath.models.errors import ModelError
from stillpath.models.machine import Machine
from stillpath.models.plants import DiscretePlant, PlantSpec, WeightedMember, discretise, plant_set
from stillpath.models.reference_motion import reference_motion_of
from stillpath.pipeline.measuring.reference_shaper import BestShaper
from stillpath.simulation.measures import Tally, contour_error
from stillpath.simulation.response import response

__all__ = ["STAND_S", "OffDesignTrial"]

STAND_S = 0.12
"""Standstill before and after the motion: centred shapers begin early and end late."""
_STRIDE = 2
_NO_RESTS = np.zeros((0, 2), np.int64)


class OffDesignTrial:
    """One motion on a machine, one of whose axes may differ from the design.

    Parameters
    ----------
    axis : str
        The axis in doubt, x or y.
    motion : (path, extruding), optional
        Shapes (2, n) in mm and (n,), at rest at both ends; default: the reference motion.
    errors_percent : sequence of float
        Errors of frequency, in percent of the nominal plant's.

    Attributes
    ----------
    y_d_mm, extruding : ndarray
        The motion between two standstills.
    errors_percent : tuple of float
        Empty if the plant's frequencies cannot be scaled; `notes` then says why.
    """

    def __init__(
        self,
        machine: Machine,
        axis: str,
        dt_s: float,
        motion: tuple[Array, NDArray[np.bool_]] | None = None,
        errors_percent: Sequence[float] = (),
    ) -> None:
        path, extruding = motion or reference_motion_of(machine, dt_s)
        pad = _STRIDE * round(STAND_S / dt_s / _STRIDE)
        self.y_d_mm = np.pad(path, ((0, 0), (pad, pad)), mode="edge")
        self.extruding = np.pad(extruding, pad)
        self.notes: list[str] = []
        self._machine, self._dt_s = machine, dt_s
        self._row = "xy".index(axis)
        spec = machine.axes["x" if axis == "x" else "y"]
        plants = plant_set(spec, dt_s)
        self._nominal, self._members, self._weights = plants.nominal, plants.members, plants.weights
        other = machine.axes["y" if axis == "x" else "x"]
        self._other = discretise(other.nominal, dt_s)
        self._scaled: list[DiscretePlant] = []
        self.errors_percent: tuple[float, ...] = ()
        try:
            self._scaled = [_shifted(spec.nominal, error, dt_s) for error in errors_percent]
            self.errors_percent = tuple(float(error) for error in errors_percent)
        except ModelError as error:
            self.notes.append(f"no curve over errors of frequency: {error}")

    def uncompensated(self) -> Curve:
        """Return the figures of the path itself as the command."""
        return self._curve("none", "as planned", "", self.y_d_mm)

    def shaped(self, shaper: BestShaper) -> Curve:
        """Return the figures of a firmware shaper with its tuned frequencies."""
        command = shape_xy(self.y_d_mm, self._dt_s, shaper.pulses)
        setting = f"{shaper.fx_hz:.1f} / {shaper.fy_hz:.1f} Hz"
        return self._curve(shaper.type, shaper.type, setting, command)

    def compensated(self, fbf: PreviewFbf, mode: str, rungs: Sequence[str]) -> Curve:
        """Return the figures of filtered basis functions.

        Parameters
        ----------
        mode : str
            Its setting of `robust`.
        rungs : sequence of str
            Name of each step of the ladder.

        Raises
        ------
        DesignError
            If the command cannot keep the machine's limits or a design is refused.
        """
        fbf.reset(self.y_d_mm[:, 0])
        command = fbf.compensate(self.y_d_mm, self.extruding, _NO_RESTS)
        setting = rungs[fbf.rungs[self._row]]
        return self._curve(f"fbf-{mode}", f"fbf {mode}", setting, command)

    def path_acceleration(self) -> tuple[float, float]:
        """Return peak and rms acceleration [mm/s^2] of this axis' planned motion."""
        return self._acceleration(self.y_d_mm)

    def contour_rms_um(self, command_mm: Array, plant: DiscretePlant) -> float:
        """Return the rms contour error while extruding with another plant for the axis.

        Parameters
        ----------
        command_mm : ndarray, shape (2, samples of `y_d_mm`)
        """
        other = response([self._other], command_mm[[1 - self._row]])[0]
        return self._rms(command_mm, plant, other)

    def _curve(self, name: str, label: str, setting: str, command: Array) -> Curve:
        other = response([self._other], command[[1 - self._row]])[0]
        members = [self._rms(command, plant, other) for plant in self._members]
        peak, rms = self._acceleration(command)
        return Curve(
            name=name,
            label=label,
            setting=setting,
            contour_um=tuple(self._rms(command, plant, other) for plant in self._scaled),
            nominal_um=self._rms(command, self._nominal, other),
            members_um=tuple(members),
            members_mean_um=float(self._weights @ members),
            members_best_um=min(members),
            members_worst_um=max(members),
            peak_accel_mm_s2=peak,
            rms_accel_mm_s2=rms,
        )

    def _rms(self, command: Array, plant: DiscretePlant, other: Array) -> float:
        y = np.empty_like(command)
        y[self._row] = response([plant], command[[self._row]])[0]
        y[1 - self._row] = other
        error = Tally()
        use = self.extruding if self.extruding.any() else np.ones(len(self.extruding), bool)
        error.add(contour_error(self.y_d_mm, y, self._dt_s, stride=_STRIDE), use[::_STRIDE])
        return 1e3 * error.rms

    def _acceleration(self, command: Array) -> tuple[float, float]:
        bend = np.diff(command[self._row], 2) / self._dt_s**2
        return float(np.max(np.abs(bend))), float(np.sqrt(np.mean(bend**2)))


def _shifted(nominal: PlantSpec, error_percent: float, dt_s: float) -> DiscretePlant:
    scaled = nominal.scaled(1.0 + error_percent / 100.0, 1.0)
    return discretise(WeightedMember.model_validate({"plant": scaled.model_dump()}).plant, dt_s)
