"""Remove advice from a file."""

from __future__ import annotations

from pathlib import Path

from stillpath.gcode.containers.opening import open_text, rewriting
from stillpath.gcode.errors import GcodeError
from stillpath.pipeline.advising.inserting import MARK
from stillpath.pipeline.files import check_unchanged, replacing

__all__ = ["remove_advice"]


def remove_advice(source: Path, target: Path, *, plate: int | None = None) -> int:
    """Write a file without the lines that `method=advise` has added.

    Parameters
    ----------
    source, target : Path
        Any print file; the target is of the same kind and written atomically. They may be the
        same file.
    plate : int, optional
        Which plate of a 3MF package with several.

    Returns
    -------
    int
        Number of lines removed.

    Raises
    ------
    GcodeError
        The file contains no advice.
    OSError
        Also when another program changes the source meanwhile.
    """
    removed, began = 0, source.stat()
    with (
        replacing(target) as temporary,
        open_text(source, plate=plate, folder=target.parent) as container,
    ):
        with rewriting(container, temporary, name=target) as text:
            container.text.seek(0)
            for line in container.text:
                if MARK in line:
                    removed += 1
                else:
                    text.write(line)
        if not removed:
            raise GcodeError(
                f"no line of the file holds {MARK.decode()!r}: there is no advice to remove"
            )
        check_unchanged(source, began)
    return removed
