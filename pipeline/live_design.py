"""Choose a machine's filter for live printing, and predict its errors over the plant set.

Filters of several bandwidths, each mixed with the best shaper in several shares, are tried on the
reference motion. Of those no worse than the shaper for any member, the best for the likely members
is chosen. The shaper itself is always among the candidates.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from stillpath.compensation.base import DesignError
from stillpath.compensation.defaults import DT_S
from stillpath.compensation.live_filter import LiveFilter, design_taps, exact_moments, shaper_taps
from stillpath.models.arrays import Array
from stillpath.models.machine import Machine, MotorLimits
from stillpath.models.plants import plant_set
from stillpath.models.reference_motion import reference_motion_of
from stillpath.pipeline.caution import (
    Mixtures,
    Shares,
    best_shares,
    most_share,
)
from stillpath.pipeline.error_range import ErrorRange, error_ranges
from stillpath.pipeline.files import kept
from stillpath.pipeline.measuring.reference_shaper import BestShaper, cached_shaper

__all__ = ["LiveDesign", "cached_live_design", "design_live", "live_filter"]

_VERSION = 8
"""Part of the cache's name; rises when the design changes."""
_CORNERS_HZ = (70.0, 90.0, 115.0, 150.0, 200.0, 270.0)
_REACHES = (80, 160)
"""Samples on either side; the longer one serves axes with a mode below about 25 Hz."""
_NOTHING = 1e-12
_AS_GOOD, _AS_SHARP = 1.05, 1.02
"""Ratios to the least error. The shortest filter within the first is chosen, and of that length the
one of least bandwidth within the second, which needs less acceleration."""


@dataclass(frozen=True, slots=True)
class LiveDesign:
    """The filter chosen for a machine.

    Attributes
    ----------
    taps : ndarray, shape (2, n)
    shares : (float, float)
        Share of the filter in the taps of X and Y; the rest is the shaper.
    worst, mean : float
        Largest and geometric mean over the members of the contour error against the shaper's.
    ranges : dict of str to ErrorRange
        On the reference motion, by channel: before, live, shaper.
    peak_accel_mm_s2 : float
        Of an axis of the command on the reference motion.
    """

    taps: Array
    shares: Shares
    corner_hz: float
    shaper: BestShaper
    worst: float
    mean: float
    ranges: dict[str, ErrorRange]
    peak_accel_mm_s2: float

    def accel_gain(self, axis: int) -> float:
        """Return the largest ratio of the command's acceleration to the plan's: sum |taps|."""
        return float(np.abs(self.taps[axis]).sum())


def live_filter(machine: Machine, taps: Array) -> LiveFilter:
    """Return the filter with these taps, shape (2, n), within the machine's command limits."""
    bounds = [(machine.travel[a].min_mm, machine.travel[a].max_mm) for a in ("x", "y")]
    command, motors = machine.command, machine.command.motors or MotorLimits()
    return LiveFilter(
        taps,
        DT_S,
        command.velocity_mm_s,
        command.accel_mm_s2,
        np.array(bounds),
        motors.velocity_mm_s or math.inf,
        motors.accel_mm_s2 or math.inf,
    )


def design_live(machine: Machine, shaper: BestShaper) -> LiveDesign:
    """Design and choose the filter of a machine.

    Parameters
    ----------
    shaper : BestShaper
        Tuned for the nominal plants on the same motion.

    Raises
    ------
    DesignError
        For a machine that cannot print live (`Machine.live_refusal`).
    """
    _check_live(machine)
    return _Trial(machine, shaper).chosen()


def cached_live_design(machine: Machine, directory: Path) -> LiveDesign:
    """Return the filter of a machine, designed once per machine revision (this takes seconds).

    It is cached as a JSON file in `directory`; an unreadable file is made again.

    Raises
    ------
    DesignError
        As `design_live` does.
    """
    path = directory / f"live-{machine.revision}-v{_VERSION}.json"
    _check_live(machine)
    return kept(path, _read, lambda: design_live(machine, cached_shaper(machine, directory, DT_S)))


def _check_live(machine: Machine) -> None:
    if machine.live_refusal is not None:
        raise DesignError(machine.live_refusal)


def _read(found: dict[str, Any]) -> LiveDesign:
    taps = np.array(found["taps"], dtype=float)
    if taps.shape not in {(2, 2 * reach + 1) for reach in _REACHES} or not np.isfinite(taps).all():
        raise ValueError("no taps of a filter")
    ranges = {name: ErrorRange(**known) for name, known in found["ranges"].items()}
    given = {"taps": taps, "shares": tuple(found["shares"]), "ranges": ranges}
    return LiveDesign(**{**found, **given, "shaper": BestShaper(**found["shaper"])})


@dataclass(frozen=True, slots=True)
class _Candidate:
    """A filter, and the geometric mean over the members of its error relative to the shaper's."""

    ratio: float
    corner_hz: float
    taps: Array
    shares: Shares


class _Trial:
    """Responses of every member to filters on the reference motion."""

    def __init__(self, machine: Machine, shaper: BestShaper) -> None:
        self._machine, self._shaper = machine, shaper
        path, extruding = reference_motion_of(machine, DT_S)
        centre = [sum((machine.travel[a].min_mm, machine.travel[a].max_mm)) / 2 for a in ("x", "y")]
        self._path = path + np.array(centre)[:, None]
        self._smooth_taps = np.stack([shaper_taps(p, DT_S, _REACHES[-1]) for p in shaper.pulses])
        self._smooth = self._command(self._smooth_taps)
        self._mixtures = Mixtures(machine, self._path, extruding, self._smooth, DT_S)

    def chosen(self) -> LiveDesign:
        """Return the best candidate (see the module's description)."""
        candidates = list(self._candidates())
        least = min(one.ratio for one in candidates)
        length = min(one.taps.shape[1] for one in candidates if one.ratio <= _AS_GOOD * least)
        short = [one for one in candidates if one.taps.shape[1] == length]
        least = min(one.ratio for one in short)
        accurate = [one for one in short if one.ratio <= _AS_SHARP * least]
        best = min(accurate, key=lambda one: (one.corner_hz, one.ratio))
        command = self._command(best.taps)
        mixtures = self._mixtures
        ratio = mixtures.errors_mm(mixtures.responses(command)) / mixtures.shaped_mm
        channels = {"before": [self._path], "live": [command], "shaper": [self._smooth]}
        return LiveDesign(
            best.taps,
            best.shares,
            best.corner_hz,
            self._shaper,
            float(ratio.max()),
            mixtures.mean(ratio),
            error_ranges(self._machine, channels, lambda one: mixtures.rms_mm(one[0]), DT_S),
            _peak(command),
        )

    def _candidates(self) -> Iterator[_Candidate]:
        """Yield the shaper, then filters within the limits that are no worse for any member."""
        sets = [plant_set(self._machine.axes[a].without_delay(), DT_S) for a in ("x", "y")]
        most_shares = [most_share(self._machine.axes[a]) for a in ("x", "y")]
        yield _Candidate(1.0, 0.0, _shortened(self._smooth_taps), (0.0, 0.0))
        for reach, corner_hz in itertools.product(_REACHES, _CORNERS_HZ):
            exact = np.stack([design_taps(s.members, s.weights, corner_hz, reach) for s in sets])
            command = self._command(exact)
            if _peak(command) > self._machine.command.accel_mm_s2:
                continue
            cost = cache(partial(self._ratio, self._mixtures.responses(command)))
            shares = best_shares(cost, most_shares)
            if shares != (0.0, 0.0) and np.isfinite(cost(shares)):
                yield _Candidate(cost(shares), corner_hz, self._mixed(exact, shares), shares)

    def _mixed(self, exact: Array, shares: Shares) -> Array:
        a = np.array(shares)[:, None]
        padding = (self._smooth_taps.shape[1] - exact.shape[1]) // 2
        exact = np.pad(exact, ((0, 0), (padding, padding)))
        return _shortened(a * exact + (1.0 - a) * self._smooth_taps)

    def _ratio(self, exact_mm: list[Array], shares: Shares) -> float:
        """Return the mean error relative to the shaper; infinite if any member is worse."""
        ratio = self._mixtures.errors_mm(exact_mm, shares) / self._mixtures.shaped_mm
        return self._mixtures.mean(ratio) if ratio.max() <= 1.0 else np.inf

    def _command(self, taps: Array) -> Array:
        live = live_filter(self._machine, taps)
        return live.command(np.pad(self._path, ((0, 0), (live.margin, live.margin)), mode="edge"))


def _shortened(taps: Array) -> Array:
    """Return the taps at the shortest length that loses nothing."""
    for reach in _REACHES:
        more = taps.shape[1] // 2 - reach
        lost = np.delete(taps, np.s_[more : taps.shape[1] - more], axis=1)
        if not np.any(np.abs(lost) > _NOTHING):
            kept = taps[:, more : taps.shape[1] - more]
            return np.stack([exact_moments(row) for row in kept])
    raise ValueError(f"{taps.shape[1]} taps are more than any filter has")


def _peak(command: Array) -> float:
    return float(np.abs(np.diff(command, 2)).max()) / DT_S**2
