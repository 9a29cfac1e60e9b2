"""Readers of measurement and model files; see `read_measurements`."""

from stillpath.models.identification.readers.assumed_test import (
    date_in_name,
    excitation_for,
    excitation_notes,
)
from stillpath.models.identification.readers.reading import read_content, read_measurements
from stillpath.models.identification.readers.settings import (
    ReadSettings,
    direction_of,
    tested_axis,
)

__all__ = [
    "ReadSettings",
    "date_in_name",
    "direction_of",
    "excitation_for",
    "excitation_notes",
    "read_content",
    "read_measurements",
    "tested_axis",
]
