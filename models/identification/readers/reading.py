"""Reads files of measurements and models; their kind follows from the content, not the name."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

from stillpath.models.errors import ModelError
from stillpath.models.identification.readers.accelerations import (
    is_klipper_log,
    is_m956,
    read_klipper_log,
    read_m956,
)
from stillpath.models.identification.readers.drives import is_drive, read_drives
from stillpath.models.identification.readers.matlab import is_matlab
from stillpath.models.identification.readers.model_files import read_json_models, read_matlab_models
from stillpath.models.identification.readers.responses import is_response, read_responses
from stillpath.models.identification.readers.settings import ReadSettings, direction_of
from stillpath.models.identification.readers.spectra import MOST_BINS, is_spectrum, read_spectrum
from stillpath.models.identification.readers.tables import Table, as_table, check_size
from stillpath.models.identification.types import Measurement

__all__ = ["LARGEST_BYTES", "read_content", "read_measurements"]

LARGEST_BYTES = 200_000_000
_LARGEST_MODEL_BYTES = 16_000_000
_HEAD_BYTES = 16_384

_DIRECTION = r"-?\d+\.\d+,-?\d+\.\d+(?:,-?\d+\.\d+)?"
_KLIPPER_NAME = re.compile(
    rf"(?:raw_data|resonances|calibration_data)_(?:axis=)?({_DIRECTION}|[xyz])(?=[_.]|$)"
)
_ANY_NAME = re.compile(rf"(?:^|[_-])(?:axis[=_-]?)?({_DIRECTION}|[xyz])(?=[_.-]|$)")
_LOOKED_FOR = (
    "Klipper's raw log (#time,accel_x,accel_y,accel_z), resonances or calibration data "
    "(freq,psd_x,...), M956 (Sample,X,Y,Z), a swept sine (time_s,cmd_acc,meas_acc), a frequency "
    "response (freq_hz, mag or mag_db with phase_deg, or real with imag), JSON and MATLAB models"
)


def read_measurements(
    path: Path, *, axis: str | None = None, settings: ReadSettings | None = None
) -> tuple[Measurement, ...]:
    """Read a file of any known format.

    Parameters
    ----------
    path : Path
        Its name is used for the axis (resonances_x_..., raw_data_axis=1.000,1.000_...), and
        for messages.
    axis : str, optional
        Tested axis; goes before the settings and the name.
    settings : ReadSettings, optional
        What the file does not carry.

    Raises
    ------
    ModelError
        Naming file, line and column, if the file is not of a known format, cannot be used, or
        is larger than `LARGEST_BYTES`.
    """
    try:
        size = path.stat().st_size
        if size > LARGEST_BYTES:
            raise ModelError(f"{path.name}: {size} bytes, more than {LARGEST_BYTES} are not read")
        content = path.read_bytes()
    except OSError as error:
        raise ModelError(f"cannot read {path.name}: {error.strerror}") from None
    return read_content(content, path.name, axis=axis, settings=settings)


def read_content(
    content: bytes, name: str, *, axis: str | None = None, settings: ReadSettings | None = None
) -> tuple[Measurement, ...]:
    """Read the content of a file called `name`; see `read_measurements`."""
    settings = settings or ReadSettings()
    if not content.strip():
        raise ModelError(f"{name}: the file is empty")
    named = _axis_in_name(name)
    axis = axis or settings.axis or named
    if axis is not None:
        axis = axis.strip().lower()
        direction_of(axis, allow_z=True)
    found = _from_content(content, name, axis, settings)
    if named in (None, axis):
        return found
    note = f"its name says axis {named}; it was taken as axis {axis}"
    return tuple(replace(one, notes=(*one.notes, note)) for one in found)


def _from_content(
    content: bytes, name: str, axis: str | None, settings: ReadSettings
) -> tuple[Measurement, ...]:
    is_json = content.lstrip(b"\xef\xbb\xbf \t\r\n")[:1] in (b"{", b"[")
    if (is_json or is_matlab(content)) and len(content) > _LARGEST_MODEL_BYTES:
        raise ModelError(
            f"{name}: {len(content)} bytes, at most {_LARGEST_MODEL_BYTES} are read of a model; "
            "give the model alone, without what it was made from"
        )
    if is_matlab(content):
        return read_matlab_models(content, name, axis, settings)
    if is_json:
        return read_json_models(content, name, axis, settings)
    check_size(content, name)
    _check_spectrum(content, name)
    table = as_table(content.decode("utf-8-sig", errors="replace"), name)
    return _from_table(table, axis, settings)


def _check_spectrum(content: bytes, name: str) -> None:
    """Refuse a spectrum of far too many lines by its beginning, before all is taken apart."""
    lines = content.count(b"\n")
    head = content[: content.rfind(b"\n", 0, _HEAD_BYTES) + 1]
    if lines <= MOST_BINS or not head:
        return
    table = as_table(head.decode("utf-8-sig", errors="replace"), name)
    others = (is_klipper_log, is_m956, is_response)
    rows = lines - head.count(b"\n") + len(table.rows)
    if is_spectrum(table) and not any(other(table) for other in others) and rows > MOST_BINS:
        raise ModelError(
            f"{name}: {rows} frequencies, at most {MOST_BINS} are read; give the file as it was "
            "written, or fewer"
        )


def _from_table(table: Table, axis: str | None, settings: ReadSettings) -> tuple[Measurement, ...]:
    if is_klipper_log(table):
        return (read_klipper_log(table, axis, settings),)
    if is_m956(table):
        return (read_m956(table, axis, settings),)
    if is_response(table):
        return read_responses(table, axis, settings)
    if is_spectrum(table):
        return (read_spectrum(table, axis, settings),)
    if is_drive(table, settings):
        return read_drives(table, axis, settings)
    hint = ""
    if "position_mm" in table.names:
        hint = "; of a pass ripple is learnt: say what repeats (--ripple NAME:PITCH)"
    elif table.names and len(table.rows) > 1:
        hint = (
            "; if it records a command and what followed, say which columns (time_column, "
            "command_column, measured_column)"
        )
    raise ModelError(
        f"{table.source}: not a known format; looked for {_LOOKED_FOR}{hint}. The first line is "
        f"{table.first_line[:80]!r}"
    )


def _axis_in_name(name: str) -> str | None:
    found = _KLIPPER_NAME.search(name.lower()) or _ANY_NAME.search(name.lower())
    if found is None:
        return None
    try:
        direction_of(found[1], allow_z=True)
    except ModelError:
        return None
    return found[1]
