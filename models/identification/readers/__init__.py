"""Readers of measurement and model files; see `read_measurements`."""

from stillpath.models.identification.readers.assumed_test import (
    AssumedTest,
    assumed_test,
    date_in_name,
)
from stillpath.models.identification.readers.reading import (
    LARGEST_BYTES,
    read_content,
    read_measurements,
)
from stillpath.models.identification.readers.settings import (
    ReadSettings,
    direction_of,
    tested_axis,
)

__all__ = [
    "LARGEST_BYTES",
    "AssumedTest",
    "ReadSettings",
    "assumed_test",
    "date_in_name",
    "direction_of",
    "read_content",
    "read_measurements",
    "tested_axis",
]
