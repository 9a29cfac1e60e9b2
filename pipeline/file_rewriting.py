"""Open the files that a rewrite needs, and put the new file in place when it is complete."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from stillpath.gcode.containers.opening import Container, open_text, rewriting
from stillpath.pipeline.files import check_unchanged, replacing
from stillpath.pipeline.measuring.layer_files import LayerWriter, written_layers
from stillpath.pipeline.measuring.measure import CHANNELS
from stillpath.pipeline.progress import ProgressCallback, progress_to

__all__ = ["FileRewriting", "file_rewriting"]


@dataclass(slots=True)
class FileRewriting:
    """The open files of a rewrite.

    Attributes
    ----------
    container : Container
        The file as it is, its G-code in `text`.
    text : binary file
        Receives the new G-code.
    spool : binary file
        Seekable; holds the new G-code until its times are known.
    sizes : dict
        File size fields of a `Result`; filled when the new file is complete.
    """

    container: Container
    text: BinaryIO
    spool: BinaryIO
    layers: LayerWriter | None
    sizes: dict[str, int] = field(default_factory=dict)


@contextlib.contextmanager
def file_rewriting(
    source: Path,
    target: Path,
    *,
    plate: int | None,
    layers: Path | None,
    progress: ProgressCallback | None,
) -> Iterator[FileRewriting]:
    """Open the files of a rewrite; layers and target are put in place at the end.

    Raises
    ------
    GcodeError
        The container is damaged, or cannot be what the target is called.
    OSError
        Also when another program changes the source before the target is in place.
    """
    began = source.stat()
    unpacking = progress_to(progress, "unpacking", 0.0)
    packing = progress_to(progress, "packing", 1.0)
    # The layers, for which a disk may have no room, are put in place after the check, too.
    with replacing(target) as temporary, contextlib.ExitStack() as files:
        with (
            open_text(source, plate=plate, folder=target.parent, progress=unpacking) as container,
            rewriting(container, temporary, name=target, progress=packing) as text,
            tempfile.TemporaryFile(dir=target.parent) as spool,
        ):
            writer = None
            if layers is not None:
                writer = files.enter_context(written_layers(layers, CHANNELS))
            made = FileRewriting(container, text, spool, writer)
            yield made
        # Before the target is put in place: it may be the source.
        check_unchanged(source, began)
        made.sizes["original_bytes"] = began.st_size
        made.sizes["written_bytes"] = temporary.stat().st_size
