"""The files that benchmarks read, and the threads that they use."""

from __future__ import annotations

import gzip
import os
import sys
from pathlib import Path

__all__ = ["find_input", "one_thread_each", "plain_copy", "shared_folder"]

_READ_BYTES = 1 << 20


def shared_folder(given: Path | None = None) -> Path | None:
    """Return the folder of shared data: as given, $STILLPATH_SHARED, or beside the checkout."""
    root = Path(__file__).resolve().parent.parent
    named = os.environ.get("STILLPATH_SHARED")
    folder = given or (Path(named) if named else root.parent / "shared")
    return folder if folder.is_dir() else None


def one_thread_each() -> None:
    """Keep processes that work side by side to one thread each; libraries read it when loaded."""
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")


def find_input(name: str, shared: Path | None) -> Path:
    """Return a print file by path, or by its name in the shared corpus."""
    path = Path(name)
    if path.is_file():
        return path
    for folder in ("own", "third_party", "third-party"):
        for ending in (".gcode.gz", ".gcode"):
            if shared is not None and (shared / "corpus" / folder / f"{name}{ending}").is_file():
                return shared / "corpus" / folder / f"{name}{ending}"
    sys.exit(f"there is no file {name}, and no such name in the shared corpus")


def plain_copy(source: Path, folder: Path) -> Path:
    """Return the path of the file without compression, made in `folder` if need be."""
    if source.suffix != ".gz":
        return source
    target = folder / source.stem
    with gzip.open(source) as packed, target.open("wb") as out:
        while data := packed.read(_READ_BYTES):
            out.write(data)
    return target
