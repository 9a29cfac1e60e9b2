"""Shake&Tune's recordings (.stdata): raw accelerations of one or more resonance tests."""

from __future__ import annotations

import re
from typing import Annotated

from pydantic import BaseModel, FailFast, ValidationError

from stillpath.models.errors import ModelError
from stillpath.models.identification.readers.accelerations import read_klipper_log
from stillpath.models.identification.readers.settings import ReadSettings
from stillpath.models.identification.readers.tables import Table
from stillpath.models.identification.types import AccelerationLog

__all__ = ["BELTS", "is_shaketune", "read_shaketune"]

_PICKLED = re.compile(rb"\x80[\x02-\x05].{0,40}name.{1,120}samples", re.DOTALL)
_FIRST_LINE = re.compile(rb'\s*\{\s*"name"\s*:\s*"[^"\n]{0,200}"\s*,\s*"samples"\s*:')
BELTS = {"a": "1.000,-1.000", "b": "1.000,1.000"}
_AXES = {"axis_x": "x", "axis_y": "y", "belt_a": BELTS["a"], "belt_b": BELTS["b"]}
"""The directions of the tests, by the label with which a recording's name begins."""
_LABEL = re.compile(rf"({'|'.join(_AXES)})(?:_|$)", re.IGNORECASE)


class _Recording(BaseModel):
    name: str
    samples: Annotated[list[tuple[float, float, float, float]], FailFast()]


def is_shaketune(content: bytes) -> bool:
    """Whether the unpacked content is a recording of Shake&Tune."""
    return any(kind.match(content) is not None for kind in (_FIRST_LINE, _PICKLED))


def read_shaketune(
    content: bytes, name: str, axis: str | None, settings: ReadSettings
) -> tuple[AccelerationLog, ...]:
    """Read the unpacked lines of a .stdata file, one recording each.

    A line is a JSON object of a name and samples of (time [s], x, y, z [mm/s^2]). The test is
    Klipper's own (shaketune/helpers/accelerometer.py and resonance_test.py, 2025-04-18); its
    other commands record no resonance test.

    Parameters
    ----------
    axis : str, optional
        Tested axis of recordings whose name does not say it.

    Raises
    ------
    ModelError
        Naming the line, if it is no recording of a resonance test in the plane, or one that no
        raw log may be. If it is from a Shake&Tune before 2025-02, whose files are pickles of
        Python, which are programs.
    """
    if _PICKLED.match(content):
        raise ModelError(
            f"{name}: from a Shake&Tune before 2025-02, in a format that is not safe to read: "
            "update Shake&Tune and measure again, or measure with TEST_RESONANCES OUTPUT=raw_data"
        )
    return tuple(
        _read_recording(line, name, number, axis, settings)
        for number, line in enumerate(content.splitlines(), start=1)
        if line.strip()
    )


def _read_recording(
    line: bytes, name: str, number: int, axis: str | None, settings: ReadSettings
) -> AccelerationLog:
    try:
        recording = _Recording.model_validate_json(line)
    except ValidationError as error:
        first = error.errors()[0]
        at = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in first["loc"])
        raise ModelError(
            f"{name}, line {number}, {at.lstrip('.') or 'as a whole'}: {first['msg']}; a recording "
            "of Shake&Tune is a name and samples of time, x, y and z: copy the file again"
        ) from None
    label = _LABEL.match(recording.name)
    if axis is None and label is None:
        raise ModelError(
            f"{name}: its recording {recording.name!r:.80} is no resonance test of X or Y (those "
            "are named axis_X and axis_Y); measure with AXES_SHAPER_CALIBRATION, or give the axis "
            "that was tested"
        )
    rows = [f"{t!r},{x!r},{y!r},{z!r}" for t, x, y, z in recording.samples]
    table = Table(
        source=name,
        names=("time", "accel_x", "accel_y", "accel_z"),
        rows=rows,
        lines=list(range(1, len(rows) + 1)),
        delimiter=",",
    )
    tested = _AXES[label[1].lower()] if label else axis
    return read_klipper_log(table, tested, settings)
