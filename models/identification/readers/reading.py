"""Reads files of measurements and models; their kind follows from the content, not the name."""

from __future__ import annotations

import re
from pathlib import Path

from stillpath.models.errors import ModelError
from stillpath.models.identification.readers.accelerations import (
    is_klipper_log,
    is_m956,
    read_klipper_log,
    read_m956,
)
from stillpath.models.identification.readers.compressed import unpacked
from stillpath.models.identification.readers.drives import is_drive, read_drives
from stillpath.models.identification.readers.matlab import is_matlab
from stillpath.models.identification.readers.model_files import read_json_models, read_matlab_models
from stillpath.models.identification.readers.responses import is_response, read_responses
from stillpath.models.identification.readers.settings import ReadSettings, direction_of
from stillpath.models.identification.readers.shaketune import (
    BELTS,
    is_shaketune,
    read_shaketune,
)
from stillpath.models.identification.readers.spectra import (
    GAINS_TEXT,
    MOST_BINS,
    is_gains,
    is_spectrum,
    read_spectrum,
)
from stillpath.models.identification.readers.tables import Table, as_table, check_size
from stillpath.models.identification.types import Measurement
from stillpath.models.user_files import as_utf8

__all__ = ["LARGEST_BYTES", "read_content", "read_measurements"]

LARGEST_BYTES = 200_000_000
"""Of a measurement, as a file, as an upload, and unpacked."""
_LARGEST_MODEL_BYTES = 16_000_000
_HEAD_BYTES = 16_384

_DIRECTION = r"-?\d+\.\d+,-?\d+\.\d+(?:,-?\d+\.\d+)?"
_KLIPPER_NAME = re.compile(
    rf"(?:raw_data|resonances|calibration_data)[_ -](?:axis=)?({_DIRECTION}|[xyz])(?=[_. ]|$)"
)
_STATED_NAME = re.compile(
    rf"(?<![a-z0-9])(?:axis[ =_-]?({_DIRECTION}|[xyz])|([xyz])[ _-]?axis)(?![a-z0-9])"
)
# belt_<date>_A.csv and belts_<date>_A.csv of Shake&Tune 1 to 4, and its shaketune-belt_A.csv.
_SECTION = re.compile(rb"(?m)^\[(?:printer|mcu|extruder|stepper_\w+|include [^\]\n]+)\]")
"""What Klipper's configuration consists of."""
_BELT_NAME = re.compile(r"(?:^|[_-])belts?_(?:\w+_)?([ab])(?=[_.]|$)")
# With the number of a repeat: of qidi-x-max-y1.csv, x alone would count.
_ANY_NAME = re.compile(rf"(?:^|[_-])({_DIRECTION}|[xyz])\d?(?=[_.-]|$)")
_LOOKED_FOR = (
    "Klipper's raw log (#time,accel_x,accel_y,accel_z), Shake&Tune's .stdata, resonances "
    "or calibration data (freq,psd_x,...), M956 (Sample,X,Y,Z), a swept sine "
    "(time_s,cmd_acc,meas_acc), a frequency response (freq_hz, mag or mag_db with phase_deg, or "
    "real with imag), JSON and MATLAB models"
)


def read_measurements(
    path: Path, *, settings: ReadSettings | None = None
) -> tuple[Measurement, ...]:
    """Read a file of any known format.

    Parameters
    ----------
    path : Path
        Its name is used for the axis (resonances_x_..., raw_data_axis=1.000,1.000_...), and
        for messages.
    settings : ReadSettings, optional
        What the file does not carry.

    Raises
    ------
    ModelError
        Naming file, line and column, if the file is not of a known format, cannot be used, is
        larger than `LARGEST_BYTES`, or says another axis than the settings.
    """
    try:
        size = path.stat().st_size
        if size > LARGEST_BYTES:
            raise ModelError(f"{path.name}: {size} bytes, more than {LARGEST_BYTES} are not read")
        content = path.read_bytes()
    except OSError as error:
        raise ModelError(f"cannot read {path.name}: {error.strerror}") from None
    return read_content(content, path.name, settings=settings)


def read_content(
    content: bytes, name: str, *, settings: ReadSettings | None = None
) -> tuple[Measurement, ...]:
    """Read the content of a file called `name`; see `read_measurements`.

    Raises
    ------
    ModelError
    """
    settings = settings or ReadSettings()
    content = unpacked(content, name, LARGEST_BYTES)
    content = as_utf8(content)
    if not content.strip():
        raise ModelError(f"{name}: the file is empty")
    named = _axes_in_name(name)
    if settings.axis is None:
        return _from_content(content, name, named[0] if len(named) == 1 else None, settings)
    asked = settings.axis.strip().lower()
    if named and not any(_are_parallel(asked, one) for one in named):
        raise ModelError(
            f"{name}: its name says axis {' or '.join(named)}, but it was given as axis {asked}; "
            "give no axis, or rename the file if the name is wrong"
        )
    found = _from_content(content, name, asked, settings)
    held = [one.axis for one in found if one.axis is not None and _is_axis(one.axis)]
    for axis in held:
        if not _are_parallel(asked, axis):
            raise ModelError(
                f"{name}: it holds axis {axis}, but was given as axis {asked}; give no axis"
            )
    return found


def _from_content(
    content: bytes, name: str, axis: str | None, settings: ReadSettings
) -> tuple[Measurement, ...]:
    if is_shaketune(content):
        return read_shaketune(content, name, axis, settings)
    if _SECTION.search(content, 0, _HEAD_BYTES):
        raise ModelError(
            f"{name}: a printer.cfg says limits and travel, and holds no measurement: make a "
            "machine of it (machines from-config, or Machines on the page), and identify that from "
            "the files of Klipper's TEST_RESONANCES"
        )
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
    if is_gains(table):
        raise ModelError(f"{table.source}: {GAINS_TEXT}")
    if is_spectrum(table):
        return (read_spectrum(table, axis, settings),)
    if is_drive(table, settings):
        return read_drives(table, axis, settings)
    hint = ""
    if "position_mm" in table.names:
        hint = "; of a pass ripple is learnt: say what repeats (--ripple NAME:PITCH)"
    elif {"x", "y", "z"} <= set(table.names):
        hint = (
            "; accelerations alone (OctoPrint's Pinput Shaping, adxl345spi) do not say what was "
            "commanded: type in the frequencies that the tool shows (machines from-m503, --fx and "
            "--fy), or record command and acceleration together"
        )
    elif table.names and len(table.rows) > 1:
        hint = (
            "; if it records a command and what followed, call those columns time_s, cmd_acc and "
            "meas_acc in its first line, or say which they are (time_column, command_column, "
            "measured_column)"
        )
    raise ModelError(
        f"{table.source}: not a known format; looked for {_LOOKED_FOR}{hint}. The first line is "
        f"{table.first_line[:80]!r}"
    )


def _axes_in_name(name: str) -> tuple[str, ...]:
    """Return the axis in Klipper's name of a file, else those it calls axis, else may mean."""
    name = name.lower()
    klipper, belt = _KLIPPER_NAME.search(name), _BELT_NAME.search(name)
    texts = [klipper[1]] if klipper else [BELTS[belt[1]]] if belt else []
    for pattern in (_STATED_NAME, _ANY_NAME):
        texts = texts or [next(filter(None, one.groups())) for one in pattern.finditer(name)]
    return tuple(dict.fromkeys(text for text in texts if _is_axis(text)))


def _is_axis(text: str) -> bool:
    try:
        direction_of(text, allow_z=True)
    except ModelError:
        return False
    return True


def _are_parallel(one: str, other: str) -> bool:
    if one == other:
        return True
    (a, b), (c, d) = (direction_of(text, allow_z=True) for text in (one, other))
    return abs(a * c + b * d) > 1 - 1e-6
