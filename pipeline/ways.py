"""Describe the two ways to print compensated: from the written file, or live in Klipper."""

from __future__ import annotations

from stillpath.pipeline.result import Channel, PrintWay, Result

__all__ = ["file_way", "live_way"]

_RAISED = (
    "Pause, cancel, mesh, pressure advance, M220 and object exclusion do not run as usual, but "
    "under raised limits"
)


def file_way(result: Result) -> PrintWay:
    """Return how the written file prints on a Klipper machine.

    Parameters
    ----------
    result : Result
        Result of a compensated file.
    """
    channel = next(channel for channel in result.channels if channel.name == "after")
    return PrintWay(
        name="file",
        **_figures(channel),
        time_s=result.time_s,
        file_bytes=result.written_bytes,
        needs=[
            "the written file",
            "the macros for PAUSE, RESUME and CANCEL_PRINT, installed once (docs/klipper.md)",
        ],
        lacks=[
            _RAISED,
            "It does not fit another machine, nor this one once it has changed",
        ],
    )


def live_way(channel: Channel, time_s: float, size: int) -> PrintWay:
    """Return how the file as sliced prints with the extra inside Klipper.

    Parameters
    ----------
    time_s : float
        Print time as sliced.
    size : int
        Size of the sliced file [bytes].
    """
    return PrintWay(
        name="live",
        **_figures(channel),
        time_s=time_s,
        file_bytes=size,
        needs=[
            "the extra of Stillpath in Klipper, installed once (docs/klipper-live.md)",
            "the filter of the machine beside printer.cfg (stillpath klipper export)",
            "Klipper's own input shaper switched off",
            "the file as sliced",
        ],
        lacks=[
            "It does not compensate friction, ripple, or what mass and position change",
            "It does not keep a speed budget",
            "It does not check a file before it prints: one filter per axis serves all files",
            "It has not been tried on a printer yet",
        ],
    )


def _figures(channel: Channel) -> dict[str, float | tuple[float, float] | None]:
    """Return the figures of a channel: while extruding, or of all motion if nothing is."""
    extrudes = channel.extruding.contour_max_um > 0.0
    errors = channel.extruding if extrudes else channel.all_motion
    # If only a part is compensated, the range is of that part.
    whole = extrudes and channel.selected_rms_um is None
    return {
        "contour_rms_um": errors.contour_rms_um,
        "contour_range_um": channel.contour_range_um if whole else None,
        "contour_max_um": errors.contour_max_um,
    }
