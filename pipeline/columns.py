"""Write tables with one row per sample incrementally, as npz or CSV."""

from __future__ import annotations

import contextlib
import shutil
import tempfile
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Protocol

import numpy as np

from stillpath.pipeline.files import replacing

__all__ = ["TableWriter", "csv_table", "npz_table"]


class TableWriter(Protocol):
    """A table that takes rows."""

    def write(self, columns: Mapping[str, np.ndarray]) -> None:
        """Add rows: arrays of one length by name, the same names in the same order every time."""

    def clear(self) -> None:
        """Remove all rows."""


@contextlib.contextmanager
def npz_table(target: Path, types: Mapping[str, str]) -> Iterator[TableWriter]:
    """Yield a table that becomes an npz file of one array per column, whole or not at all.

    Parameters
    ----------
    target : Path
        Columns are buffered in unnamed files beside it.
    types : mapping
        Names of the columns and their types, as ``<f8``.
    """
    with replacing(target) as temporary, contextlib.ExitStack() as stack:
        columns = {
            name: stack.enter_context(tempfile.TemporaryFile(dir=target.parent)) for name in types
        }
        table = _Npz(columns, types)
        yield table
        with zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:
            for name, column in columns.items():
                # ZipInfo's fixed date keeps equal tables byte-identical.
                entry = zipfile.ZipInfo(f"{name}.npy")
                with archive.open(entry, "w", force_zip64=True) as out:
                    header = {"descr": types[name], "fortran_order": False, "shape": (table.rows,)}
                    np.lib.format.write_array_header_1_0(out, header)
                    column.seek(0)
                    shutil.copyfileobj(column, out, 1 << 20)


@contextlib.contextmanager
def csv_table(target: Path, formats: Mapping[str, str]) -> Iterator[TableWriter]:
    """Yield a table that becomes a CSV file with a line of names, whole or not at all.

    Parameters
    ----------
    formats : mapping
        Names of the columns and how a value is written, as ``%.3f``.
    """
    with replacing(target) as temporary, temporary.open("w", encoding="ascii", newline="\n") as out:
        names, line = (",".join(words) + "\n" for words in (formats, formats.values()))
        out.write(names)
        yield _Csv(out, len(names), line)


class _Npz:
    def __init__(self, files: Mapping[str, IO[bytes]], types: Mapping[str, str]) -> None:
        self._files, self._types = files, types
        self.rows = 0

    def write(self, columns: Mapping[str, np.ndarray]) -> None:
        for name, values in columns.items():
            self._files[name].write(np.ascontiguousarray(values, self._types[name]).tobytes())
        self.rows += len(next(iter(columns.values())))

    def clear(self) -> None:
        for file in self._files.values():
            file.seek(0)
            file.truncate()
        self.rows = 0


class _Csv:
    def __init__(self, file: IO[str], header: int, line: str) -> None:
        self._file, self._header, self._line = file, header, line

    def write(self, columns: Mapping[str, np.ndarray]) -> None:
        rows = zip(*(values.tolist() for values in columns.values()), strict=True)
        self._file.write("".join(self._line % row for row in rows))

    def clear(self) -> None:
        self._file.seek(self._header)
        self._file.truncate()
