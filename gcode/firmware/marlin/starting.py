"""Choose the acceleration of each line of a stream so that motors can start from rest.

The first step from rest lasts as long as the lowest step rate implies, and the second has the rate
that the acceleration has reached by then, up to the line's own (docs/marlin.md). A line no faster
than a motor's permitted speed step may therefore start under any acceleration; a faster one gets
the lowest acceleration that the motion around it allows.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from stillpath.gcode.firmware.encoding import Interleaved, lateness_s
from stillpath.gcode.firmware.marlin.limits import MarlinLimits
from stillpath.gcode.types import Phases
from stillpath.models.machine import CommandLimits

__all__ = ["StreamLevels", "gentle_accel_mm_s2"]

_WITHIN_S = 1e-3
"""Time in which a motor can follow its speed step."""
_RUNGS = (1.0, 1.1, 1.25, 1.5, 2.0, 3.0)
"""Levels tried, as multiples of the gentle acceleration; the last level is the stream's own."""
_ROOM, _RAMP_ROOM = 1.1, 1.8
"""Margins on the acceleration that a line needs: for the turn at its begin, and along its way.
A ramp that fills its line loses way, which the next line makes up for by a ramp of up to twice as
much: with less, some lines are late, and their remedy raises the acceleration of more."""
_TRIES = 8
"""Number of plans tried; in the last two, late lines get the full acceleration."""
_BEHIND_MM, _TRAVEL_BEHIND_MM = 0.02, 0.06
"""Lag, with and without filament, from which acceleration counts as too low."""
_CAUSES = 2
"""Number of lines, a late one the last of them, that may have made it late."""
_UNFED = 17
"""Lines around one, of which one has filament if it prints and E is on whole steps."""


def gentle_accel_mm_s2(axis_limits: CommandLimits, least_hz: float) -> float:
    """Return the largest acceleration with which a motor can follow a start from rest.

    Parameters
    ----------
    axis_limits : CommandLimits
        Of one axis.
    least_hz : float
        The least step rate.
    """
    return min(axis_limits.speed_step_mm_s / (1.0 / least_hz + _WITHIN_S), axis_limits.accel_mm_s2)


class StreamLevels:
    """Levels of acceleration of a stream's lines, the gentle one first and the stream's own last.

    Parameters
    ----------
    least_hz : float
        The least step rate, which a start from rest begins with.
    ahead : int
        Number of lines in the firmware's queue when one begins, including that one.
    steps_placed : bool
        Not every line that prints has a step of E.

    Attributes
    ----------
    limits : list of MarlinLimits
    level : ndarray of int64, shape (n,)
        Of every line, an index of `limits`.
    """

    def __init__(
        self,
        moves: Interleaved,
        stream: MarlinLimits,
        command: CommandLimits,
        *,
        least_hz: float,
        ahead: int,
        corexy: bool,
        steps_placed: bool = False,
    ) -> None:
        axis_limits = [command.of(axis) for axis in ("x", "y")]
        gentle = np.array([gentle_accel_mm_s2(one, least_hz) for one in axis_limits])
        top = np.array([stream.accel_x_mm_s2, stream.accel_y_mm_s2])
        rungs = [gentle * rung for rung in _RUNGS if np.all(gentle * rung < top)]
        self.limits = [
            *(replace(stream, accel_x_mm_s2=x, accel_y_mm_s2=y) for x, y in np.round(rungs)),
            stream,
        ]
        self._ours, self._ahead, self._moves = moves.row < 0, ahead, moves
        self._tries = 0
        way = np.where(self._ours[:, None], np.diff(moves.places_mm(), axis=0)[:, :2], 0.0)
        span_s = np.where(self._ours, np.maximum(moves.planned_s, 1e-6), 1.0)
        motors = way @ np.array([[1.0, 1.0], [1.0, -1.0]]) if corexy else way
        steps = np.array([one.speed_step_mm_s for one in axis_limits])
        self._speed_mm_s = np.hypot(*way.T) / span_s
        feeds = np.diff(moves.places_mm()[:, 3]) > 0.0
        self._feeds = maximum_filter1d(feeds, _UNFED) if steps_placed else feeds
        self._fast = np.any(np.abs(motors) / span_s[:, None] > steps, axis=1)
        deviation_mm = stream.junction_deviation_mm
        needed = _needed(way, motors, span_s, self._ours, gentle, deviation_mm)
        np.maximum(needed, _ROOM * self._to_stop(motors / gentle, span_s), out=needed)
        levels = np.array([*(rung[0] for rung in rungs), np.inf]) / gentle[0]
        self._least = np.where(self._ours, np.searchsorted(levels, needed), 0)
        self.level = self._spread()

    def raise_late(self, phases: Phases) -> NDArray[np.bool_]:
        """Raise the acceleration where the plan is late; return the changed lines.

        Parameters
        ----------
        phases : Phases
            The firmware's plan under these levels.
        """
        ours, top = self._ours, len(self.limits) - 1
        behind = self._behind(phases)
        around = np.zeros(len(ours), np.bool_)
        for k in np.flatnonzero((behind > 1.0) & (np.diff(behind, prepend=0.0) > 0.2)).tolist():
            around[max(k + 1 - _CAUSES, 0) : k + 1] = True
        self._tries += 1
        around &= ours & (self._least < top) & (self._tries <= _TRIES)
        self._least[around] = top if self._tries > _TRIES - 2 else self._least[around] + 1
        self.level = self._spread()
        return around

    def keep_up(self, phases: Phases) -> bool:
        """Return whether a plan is late by at most twice the limit."""
        return bool(np.all(self._behind(phases) < 2.0))

    def _behind(self, phases: Phases) -> NDArray[np.float64]:
        """Return the lag of each line's end relative to the limit, shape (n,)."""
        most_mm = np.where(self._feeds, _BEHIND_MM, _TRAVEL_BEHIND_MM)
        late_s = lateness_s(self._moves, phases, after_first=True)
        return np.asarray(late_s * self._speed_mm_s / most_mm)

    def _to_stop(
        self, motors: NDArray[np.float64], span_s: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the acceleration that allows a stop within the lines in the firmware's queue."""
        size = np.abs(motors).max(axis=1)
        n, known = len(size), self._ahead - 1
        passed = np.append(0.0, np.cumsum(size))
        stop = np.minimum(np.arange(n) + known, n)
        rests = np.append(np.flatnonzero(~self._ours), n)
        nearer = rests[np.searchsorted(rests, np.arange(n))] <= stop
        room = np.maximum(passed[stop] - passed[:-1], 1e-9)
        asked = np.where(nearer, 0.0, 0.5 * (size / span_s) ** 2 / room)
        needed = asked.copy()
        for k in range(1, min(known, n)):
            np.maximum(needed[k:], asked[:-k], out=needed[k:])
        return needed

    def _spread(self) -> NDArray[np.int64]:
        """Return the levels of all lines: as needed, slow lines no lower than the one before."""
        level = self._least.copy()
        now = 0
        for i in np.flatnonzero(self._ours).tolist():
            now = int(level[i]) if self._fast[i] else max(now, int(level[i]))
            level[i] = now
        return level


def _needed(
    way: NDArray[np.float64],
    motors: NDArray[np.float64],
    span_s: NDArray[np.float64],
    ours: NDArray[np.bool_],
    gentle: NDArray[np.float64],
    deviation_mm: float,
) -> NDArray[np.float64]:
    """Return the acceleration that each line should have, relative to the gentle one.

    A line speeds up within itself, and brakes within itself for the next; what turns at its begin
    is borne like the curve that short moves are part of, or by junction deviation.
    """
    speed = np.hypot(*way.T) / span_s
    heading = motors / np.maximum(speed * span_s, 1e-9)[:, None]
    before, after = np.append(0.0, speed[:-1]), np.append(speed[1:], 0.0)
    # From a stand and to one the mean speed is half of what is reached.
    twice = (
        np.append(1.0, np.where(ours[:-1], 1.0, 2.0)),
        np.append(np.where(ours[1:], 1.0, 2.0), 2.0),
    )
    twice[0][0] = 2.0
    ramp = np.maximum((speed - before) * twice[0], (speed - after) * twice[1]).clip(0.0)
    along = ramp * np.abs(heading / gentle).max(axis=1) / span_s
    turn = np.diff(heading, axis=0, prepend=heading[:1]) * np.minimum(speed, before)[:, None]
    size = np.abs(turn / gentle).max(axis=1)
    corner = (turn**2 / gentle).max(axis=1) / (8.0 * deviation_mm)
    turning = np.maximum(size / span_s, corner)
    needed: NDArray[np.float64] = np.maximum(_RAMP_ROOM * along, _ROOM * turning)
    return needed
