"""Interface of a firmware to the pipeline: its planner, encoder and commands for a stream.

The pipeline gets the `FirmwareAdapter` of a machine from `gcode.firmware.registry.adapter` and
knows no firmware by name; all differences between firmwares are behind these protocols.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode.types import Limits, Moves, Phases, ProgramBlock

if TYPE_CHECKING:
    from stillpath.gcode.dialect import Dialect
    from stillpath.gcode.firmware.encoding import Encoded
    from stillpath.gcode.pieces import Piece
    from stillpath.gcode.segments import Segments
    from stillpath.gcode.timeline import Group, Timeline
    from stillpath.models.machine import CommandLimits
    from stillpath.models.shaping import Shaping

__all__ = [
    "Adviser",
    "Encoder",
    "FirmwareAdapter",
    "Planner",
    "StreamCommands",
    "changed_limits",
    "corner_step_mm_s",
    "scaled",
    "square_corner_mm_s",
]

_CORNER_SHARE = 0.6
"""Share of the motors' permitted step of speed for a corner; the ramps around it need the rest."""


class Planner(Protocol):
    """Plans a stream of moves as the firmware does.

    There is one row of `Phases` per move, in order, and `move_index` names it; a move without any
    displacement may have none. A move that the firmware swallows has no duration.
    """

    @property
    def time_s(self) -> float:
        """When the last planned move or dwell ends."""

    def push(self, block: ProgramBlock) -> Phases:
        """Plan the moves of a block, with the stops that its events bring.

        Raises
        ------
        GcodeError
            For a move that the firmware refuses.
        """

    def push_moves(self, moves: Moves, limits: Sequence[Limits]) -> Phases:
        """Plan moves that follow the last ones without a stop; return those that are final."""

    def plan_whole(self, moves: Moves, limits: Sequence[Limits]) -> Phases:
        """Plan moves that follow the last ones, all at once, and come to rest."""

    def stop(self, dwell_s: float = 0.0) -> Phases:
        """Come to rest after the last move and stand for `dwell_s`."""

    def flush(self) -> Phases:
        """Come to rest; return the remaining phases."""


class Encoder(Protocol):
    """Turns the segments of a piece into moves that the firmware executes on time."""

    @property
    def grid_mm(self) -> float:
        """Grid of the X and Y that it writes; the segments are fitted on it."""

    @property
    def feed_step_mm_s(self) -> float:
        """Step of the extruder's speed, from a change of filament per mm, that costs no time."""

    def rest_durations(self, piece: Piece, groups: Sequence[Group]) -> NDArray[np.float64]:
        """Return a first estimate of how long each rest takes [s], shape (len(groups),)."""

    def encode(self, piece: Piece, timeline: Timeline, segments: Segments) -> Encoded:
        """Choose rounded positions and feedrates.

        Raises
        ------
        GcodeError
            If the firmware would refuse a move.
        """


class StreamCommands(Protocol):
    """The commands of a firmware that are needed to write a stream."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Lines of the header with advice for users."""

    @property
    def stand_still(self) -> bytes:
        """A line that waits for the end of motion and changes nothing."""

    @property
    def fence(self) -> bytes:
        """The line of `limits` that waits until the move before has been planned; empty: none."""

    @property
    def positioning_sets_extruder(self) -> bool:
        """G90 and G91 set the extruder's mode as well (Marlin)."""

    @property
    def one_command(self) -> bool:
        """A line has only one command (RepRapFirmware allows several)."""

    @property
    def first_wins(self) -> bool:
        """Of repeated words the first counts, and numbers may have exponents (RepRapFirmware)."""

    @property
    def ignores_subcodes(self) -> bool:
        """G1.5 is a G1 (Marlin)."""

    @property
    def marks(self) -> bool:
        """`in_stream` does no more than mark limits, for macros that find the shaper off."""

    @property
    def factors_need_axes(self) -> bool:
        """M220 and M221 do not apply to moves of the extruder alone (RepRapFirmware)."""

    @property
    def folds_case(self) -> bool:
        """Lower case is read as upper case."""

    @property
    def coarse_extruder(self) -> bool:
        """Relative E is summed in 32-bit floats, so small moves far from 0 lose digits (Marlin)."""

    @property
    def relative_moves_count(self) -> bool:
        """Absolute E goes on from where relative moves have ended (not in RepRapFirmware)."""

    @property
    def replays(self) -> bool:
        """After a pause, moves that waited are read again, and E as it was last said to be.

        So M82 and M83 must not stand among moves without a stop (RepRapFirmware).
        """

    @property
    def shaper_off(self) -> bytes:
        """Lines that switch the firmware's own input shaper off; empty: it has none."""

    @property
    def shaper_on(self) -> bytes | None:
        """Lines that restore the machine's stated shaper; None: it states none."""

    @property
    def shaper_absent(self) -> bool:
        """It was seen that the firmware has none; `shaper_off` may be there all the same."""

    @property
    def file_shaper_off(self) -> bytes:
        """Lines that switch off a shaper set by the file, whatever the machine states."""

    def shaped_axes(self, line: bytes) -> str:
        """Return the axes, of X and Y, whose frequency a line that sets the shaper states."""

    def advance(self, limits: Limits) -> bytes:
        """Lines that set pressure advance of the tool in use, if `shaper_off` turns it off."""

    def advance_aside(self, limits: Limits) -> bytes:
        """Return lines that set pressure advance while the shaper is off; empty: not needed."""

    @property
    def advance_assumed(self) -> bool:
        """Whether `advance` sets 0 only because the machine states no pressure advance."""

    @property
    def advance_off(self) -> bytes:
        """Return lines that switch it off again, if the limits of a stream do not."""

    def conflict(self, line: bytes) -> str | None:
        """Return why a line must not stand in a file with a stream; None: it may."""

    def limits(self, limits: Limits) -> bytes:
        """Lines that set the planner's limits."""

    def acceleration(self, accel_mm_s2: float) -> bytes:
        """Lines that limit the acceleration of X and Y and leave all other limits alone."""

    def axis_accelerations(self, limits: Limits) -> bytes:
        """Lines that limit X and Y each; empty where `acceleration` is the only limit."""

    def acceleration_back(self, limits: Limits) -> bytes:
        """Lines that put back what those of `acceleration` have changed."""

    def in_stream(self, limits: Limits) -> Limits:
        """Return the file's own limits, marked as being in the middle of a stream.

        PAUSE macros may read the mark; a firmware without macros returns them as they are.
        """

    def unmarks(self, line: bytes) -> bool:
        """Return whether a line of the file that sets limits removes that mark."""


class Adviser(Protocol):
    """Commands for the firmware's own shaper and the acceleration of printing moves.

    Lines come without their ends, so that a comment can follow.
    """

    @property
    def shapers(self) -> tuple[str, ...]:
        """Shaper types that a file may set, by our names (`models.shaper_pulses`)."""

    @property
    def shaper_word(self) -> str:
        """The command that sets it."""

    @property
    def same_for_both(self) -> bool:
        """X and Y share one type and one frequency (RepRapFirmware)."""

    @property
    def travel_apart(self) -> bool:
        """Travel has an acceleration of its own, which `accel_lines` leaves alone."""

    @property
    def skips_lines(self) -> bool:
        """For an excluded object it skips all lines, not only moves (Bambu)."""

    @property
    def highest_mm_s2(self) -> float:
        """Acceleration of X and Y that the machine is set up for."""

    @property
    def stated(self) -> Shaping | None:
        """The shaper that the machine states; None: it does not say."""

    def accel_mm_s2(self, limits: Limits) -> float:
        """Return the acceleration of moves that print."""

    def with_accel(self, limits: Limits, accel_mm_s2: float) -> Limits:
        """Return limits with another acceleration of moves that print."""

    def accel_lines(self, accel_mm_s2: float) -> tuple[bytes, ...]:
        """Return the lines that set it."""

    def sets_accel(self, text: str) -> bool:
        """Return whether a line of a file sets it."""

    def stores(self, text: str) -> bool:
        """Return whether a line of a file stores the current settings permanently."""

    def shaper_lines(self, shaping: Shaping) -> tuple[bytes, ...]:
        """Return the lines that set the shapers of X and Y."""

    def read_shaper(self, text: str, now: Shaping) -> Shaping:
        """Return the shaper in force after a line of a file."""


class FirmwareAdapter(Protocol):
    """Everything that the pipeline needs of one machine's firmware."""

    @property
    def refusal(self) -> str | None:
        """Why no stream can be made for this machine, and what to do instead; None: it can."""

    @property
    def step_mm(self) -> tuple[float, float, float, float]:
        """Largest distance x y z e between a commanded position and where the machine stops.

        0 for a firmware that keeps positions exactly, one step otherwise.
        """

    def stands(self, places_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where the motors stand when they are sent to places, shapes (n, 3), x y z."""

    @property
    def shortest_move_mm(self) -> float:
        """Length in XY below which a move is merged with its neighbours; 0: never."""

    @property
    def extruder_alone_stops(self) -> bool:
        """X, Y and Z always come to rest before a move of the extruder alone, and after it."""

    @property
    def restart_s(self) -> float:
        """How long the firmware waits after a stop before it moves again.

        A plan from rest to rest leaves it out.
        """

    def initial_limits(self) -> Limits:
        """Limits before the first line of a file."""

    def stream_limits(self, own: Limits) -> Limits:
        """Return the limits of a stream where the file has set `own`.

        What a file sets and a stream must keep (pressure advance, say) is copied. A piece ends
        where these limits change.
        """

    def paced(self, own: Limits, accel: float, speed: float, most: CommandLimits) -> Limits:
        """Return limits under which X and Y are quicker (or slower) than under `own`.

        Parameters
        ----------
        own : Limits
            What the file has set.
        accel : float
            Ratio of the accelerations. Corners are passed at its square root times the speed: they
            stay as round as they are.
        speed : float
            Ratio of the speed limits.
        most : CommandLimits
            Upper bound of the limits; higher ones set by the file stay.

        Notes
        -----
        Limits of Z and of the extruder stay.
        """

    def planner(self, *, rests_apart: bool = False) -> Planner:
        """Return a planner at rest.

        A firmware may merge moves that are too short into the next one. With `rests_apart` it does
        not if that is of Z or the extruder alone, so that rests stay as in the file.
        """

    def encoder(self) -> Encoder:
        """Return an encoder of the stream."""

    def stream_commands(self) -> StreamCommands:
        """Return the stream commands of the firmware."""

    def adviser(self, dialect: Dialect) -> Adviser:
        """Return its commands for shaper and acceleration, for files of a dialect."""

    def too_steep(self, travel_mm: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Mark moves that climb so steeply that a stream could not keep their times.

        Parameters
        ----------
        travel_mm : ndarray, shape (n, 4)
            x y z e; moves that do not climb in the file may still climb along a bed mesh.
        """


def changed_limits(commands: StreamCommands, before: Limits | None, after: Limits) -> bytes:
    """Return the lines that set limits, less those that say what is in force already."""
    known = [] if before is None else commands.limits(before).splitlines(keepends=True)
    lines = commands.limits(after).splitlines(keepends=True)
    return b"".join(line for line in lines if line == commands.fence or line not in known)


def corner_step_mm_s(command: CommandLimits) -> float:
    """Return the largest step of velocity that the firmware may make at a corner of a stream.

    A stream runs under the motors' own acceleration and such corners, so that it may be interrupted
    at any line: braking and starting again, the firmware keeps its limits.
    """
    return _CORNER_SHARE * command.speed_step_mm_s


def square_corner_mm_s(command: CommandLimits) -> float:
    """Return the same as a square corner velocity, on which junction deviation is based.

    Around a small angle t velocity steps most: the speed there is s sqrt(8 (sqrt(2) - 1)) / t
    (klippy/toolhead.py `calc_junction`, 2026-08), s being the speed through a square corner.
    """
    return corner_step_mm_s(command) / math.sqrt(8.0 * (math.sqrt(2.0) - 1.0))


def scaled(value: float, ratio: float, most: float) -> float:
    """Return `ratio` times a limit, raised to at most `most`; higher limits stay."""
    return min(ratio * value, max(value, most))
