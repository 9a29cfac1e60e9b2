"""Tables of measured frequency responses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stillpath.models.errors import ModelError
from stillpath.models.identification.readers.checks import check_long, check_rising
from stillpath.models.identification.readers.settings import ReadSettings
from stillpath.models.identification.readers.tables import Table
from stillpath.models.identification.types import FrequencyResponse

__all__ = ["is_response", "read_responses"]

_LEAST_POINTS, _MOST_POINTS, _MOST_RESPONSES = 8, 50_000, 200
_FREQUENCY = ("freq_hz", "f_hz", "frequency_hz", "frequency", "freq", "f")
_MAGNITUDE = ("mag", "mag_abs", "magnitude", "gain")
_DECIBEL = ("mag_db", "magnitude_db", "gain_db")
_DEGREES = ("phase_deg", "phase")
_RADIANS = ("phase_rad",)
_REAL, _IMAGINARY = ("real", "re"), ("imag", "im", "imaginary")
_COHERENCE = ("coherence", "coh")
_DEVIATION = ("sd", "std")
_LABEL = ("label", "amplitude", "run", "position", "id")


def is_response(table: Table) -> bool:
    """Whether there is a frequency and a magnitude or a real part."""
    return bool(_found(table, _FREQUENCY) and _found(table, _MAGNITUDE + _DECIBEL + _REAL))


def read_responses(
    table: Table, axis: str | None, settings: ReadSettings
) -> tuple[FrequencyResponse, ...]:
    """Read frequency with magnitude (absolute or dB) and phase, or real and imaginary part.

    The phase may be wrapped or not. A column of labels (amplitude, run, position) or axes
    makes one response for each of its values.

    Raises
    ------
    ModelError
        For a missing column, frequencies that do not rise, or a magnitude that looks like dB
        without being declared as dB.
    """
    check_long(table, _LEAST_POINTS, "frequencies", _MOST_POINTS)
    frequency = _needed(table, _FREQUENCY)
    f_hz = table.numbers([frequency])[:, 0]
    response = _response(table, settings)
    coherence, sd = _optional(table, _COHERENCE), _optional(table, _DEVIATION)
    for name, column, most in (("coherence", coherence, 1.0), ("sd", sd, np.inf)):
        outside = np.flatnonzero((column < 0) | (column > most))
        if len(outside):
            raise table.at(
                int(outside[0]), f"{name} {column[outside[0]]:g} is not between 0 and {most:g}"
            )
    labels, axes = _texts(table, _LABEL), _texts(table, ("axis",))
    results = []
    different = dict.fromkeys(zip(labels, axes, strict=True))
    if len(different) > _MOST_RESPONSES:
        raise ModelError(
            f"{table.source}: {len(different)} labels and axes, at most {_MOST_RESPONSES} are "
            "read; split the file"
        )
    for label, own in different:
        chosen = np.array([pair == (label, own) for pair in zip(labels, axes, strict=True)])
        part = table.picked(np.flatnonzero(chosen))
        check_long(part, _LEAST_POINTS, f"frequencies of {label or own or 'the response'}")
        check_rising(f_hz[chosen], part, frequency)
        if f_hz[chosen][0] < 0:
            raise part.at(0, f"frequency {f_hz[chosen][0]:g} is negative")
        if not np.abs(response[chosen]).any():
            raise ModelError(f"{table.source}: the response {label} is zero throughout")
        results.append(
            FrequencyResponse(
                f_hz=f_hz[chosen],
                response=response[chosen],
                sd=sd[chosen],
                coherence=coherence[chosen],
                axis=own.lower() or axis,
                label=label,
                source=table.source,
                notes=table.notes,
            )
        )
    return tuple(results)


def _response(table: Table, settings: ReadSettings) -> NDArray[np.complex128]:
    if _found(table, _REAL):
        parts = table.numbers([_needed(table, _REAL), _needed(table, _IMAGINARY)])
        return np.asarray(parts[:, 0] + 1j * parts[:, 1], np.complex128)
    name = _needed(table, _MAGNITUDE + _DECIBEL)
    phase = _needed(table, _DEGREES + _RADIANS)
    magnitude, angle = table.numbers([name, phase]).T
    in_db = name in _DECIBEL or settings.magnitude_unit == "dB"
    if in_db:
        beyond = np.flatnonzero(np.abs(magnitude) > 400.0)
        if len(beyond):
            raise table.at(int(beyond[0]), f"{name} {magnitude[beyond[0]]:g} dB is beyond 400 dB")
        magnitude = 10.0 ** (magnitude / 20.0)
    elif (magnitude < 0).any():
        row = int(np.argmax(magnitude < 0))
        raise table.at(
            row,
            f"{name} is negative ({magnitude[row]:g}): if it is in dB, call the column mag_db or "
            "give magnitude_unit 'dB'",
        )
    radians = angle if phase in _RADIANS else np.deg2rad(angle)
    return np.asarray(magnitude * np.exp(1j * radians), np.complex128)


def _found(table: Table, names: tuple[str, ...]) -> str | None:
    return next((name for name in names if name in table.names), None)


def _needed(table: Table, names: tuple[str, ...]) -> str:
    return _found(table, names) or table.names[table.index(names[0])]


def _optional(table: Table, names: tuple[str, ...]) -> NDArray[np.float64]:
    name = _found(table, names)
    return table.numbers([name])[:, 0] if name else np.full(len(table.rows), np.nan)


def _texts(table: Table, names: tuple[str, ...]) -> list[str]:
    name = _found(table, names)
    return table.texts(name) if name else [""] * len(table.rows)
