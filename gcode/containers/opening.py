"""Open any print file as plain G-code, and write it back in its original container.

The text is spooled to disk, in files without a name, of which nothing is left even if the process
is killed.
"""

from __future__ import annotations

import contextlib
import io
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from stillpath.gcode.containers.bgcode import BinaryGcode
from stillpath.gcode.containers.sniff import Kind, foreign, kind_named, sniff
from stillpath.gcode.containers.threemf import ThreeMf
from stillpath.gcode.errors import GcodeError
from stillpath.gcode.slicers.facts import SlicerFacts, read_facts

__all__ = ["Container", "ShareCallback", "open_text", "rewriting"]

ShareCallback = Callable[[float], None]
"""Is given the share that is done, now and then; may raise to stop the work."""

_COMPARED_BYTES = 1 << 20
_NAMES = {Kind.TEXT: "plain G-code", Kind.BGCODE: "binary G-code", Kind.THREEMF: "a 3MF package"}


@dataclass(frozen=True, slots=True)
class Container:
    """The container of a text.

    Attributes
    ----------
    text : BinaryIO
        The G-code, seekable, open as long as the block of `open_text`.
    """

    kind: Kind
    source: Path
    text: BinaryIO
    _packed: BinaryGcode | ThreeMf | None

    def facts(self) -> SlicerFacts:
        """Return the facts that the file states about itself, in its text or container."""
        if isinstance(self._packed, BinaryGcode):
            return self._packed.facts()
        return read_facts(self.text)

    def delay(self, seconds: float) -> None:
        """Record that the print takes longer than the container states."""
        if self._packed is not None:
            self._packed.delay_s = seconds

    def write(self, text: BinaryIO, target: Path, progress: ShareCallback = lambda _: None) -> None:
        """Write a text in the same kind of container, keeping everything else of the original.

        If the text has not changed, the file does not change either.

        Parameters
        ----------
        text : BinaryIO
            Seekable; all of it is written.
        target : Path
            Is written in place: guard it.
        progress : callable, optional

        Raises
        ------
        GcodeError
            The container cannot hold this text.
        """
        text.seek(0)
        if self._packed is None:
            _copy(text, target)
        elif _same(text, self.text):
            with self.source.open("rb") as original:
                _copy(original, target)
        else:
            size = max(text.seek(0, io.SEEK_END), 1)
            text.seek(0)
            with target.open("wb") as file:
                self._packed.write(text, file, lambda done: progress(done / size))

    def write_plain(self, text: BinaryIO, target: Path) -> None:
        """Write plain G-code, with what the container knows as comments where it has a form."""
        text.seek(0)
        if self._packed is None:
            _copy(text, target)
            return
        with target.open("wb") as file:
            self._packed.write_plain(text, file)


@contextlib.contextmanager
def open_text(
    path: Path,
    *,
    plate: int | None = None,
    folder: Path | None = None,
    progress: ShareCallback = lambda _: None,
) -> Iterator[Container]:
    """Open a print file of any kind for reading its G-code.

    Parameters
    ----------
    path : Path
        Plain or binary G-code or a sliced 3MF package, whatever its name.
    plate : int, optional
        Plate of a package with several.
    folder : Path, optional
        Where the text is spooled; the system's folder for temporary files by default.
    progress : callable, optional

    Yields
    ------
    Container
        With the text at its beginning.

    Raises
    ------
    GcodeError
        The file is something else, or the container is damaged, of an unknown kind, or lacks the
        plate.
    """
    kind = sniff(path)
    if plate is not None and kind is not Kind.THREEMF:
        raise GcodeError(f"a plate was chosen, but the file is {_NAMES[kind]} and has no plates")
    if kind is Kind.TEXT:
        if (found := foreign(path)) is not None:
            what, remedy = found
            raise GcodeError(f"the file is {what}, not G-code; {remedy}")
        with path.open("rb") as text:
            yield Container(kind, path, text, None)
        return
    with tempfile.TemporaryFile(dir=folder) as spool:
        packed = (
            BinaryGcode(path, spool, progress)
            if kind is Kind.BGCODE
            else ThreeMf(path, spool, progress, plate)
        )
        spool.seek(0)
        yield Container(kind, path, spool, packed)


@contextlib.contextmanager
def rewriting(
    container: Container, target: Path, *, name: Path, progress: ShareCallback = lambda _: None
) -> Iterator[BinaryIO]:
    """Yield a file for the new text; when the block ends well, `target` holds it in its container.

    Parameters
    ----------
    target : Path
        Is written in place: guard it.
    name : Path
        Final path of the target, whose folder holds temporary files. If it is a name of plain
        G-code and the source's is not, plain G-code is written.
    progress : callable, optional

    Raises
    ------
    GcodeError
        The name asks for another container than the source's.
    """
    plain = _asks_for_plain(container, name)
    if container.kind is Kind.TEXT:
        with target.open("wb") as text:
            yield text
        return
    with tempfile.TemporaryFile(dir=name.parent) as spool:
        yield spool
        if plain:
            container.write_plain(spool, target)
        else:
            container.write(spool, target, progress)


def _asks_for_plain(container: Container, name: Path) -> bool:
    wanted = kind_named(name)
    if wanted in (None, container.kind) or name.suffix.lower() == container.source.suffix.lower():
        return False
    if wanted is Kind.TEXT:
        return True
    kinds = _NAMES[container.kind], _NAMES[wanted or Kind.TEXT]
    raise GcodeError(
        f"{name.name} is a name of {kinds[1]}, and the input is {kinds[0]}: it can be written as "
        "it came or as plain G-code; choose another name"
    )


def _same(one: BinaryIO, other: BinaryIO) -> bool:
    one.seek(0)
    other.seek(0)
    while (data := one.read(_COMPARED_BYTES)) == other.read(_COMPARED_BYTES):
        if not data:
            return True
    return False


def _copy(source: BinaryIO, target: Path) -> None:
    with target.open("wb") as file:
        while data := source.read(_COMPARED_BYTES):
            file.write(data)
