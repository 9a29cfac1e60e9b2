"""The output folder: results, reports, and records of what was done; a kill leaves it whole.

Work is done in a folder of its own below ``.stillpath/work``. It counts from the moment its record
lies there, written whole; what follows (moving report, result and record to their places) is
finished by the next one who opens the folder.
"""

from __future__ import annotations

import errno
import hashlib
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from stillpath.pipeline.files import replacing, sync
from stillpath.service.instance_lock import exclusive
from stillpath.service.storage.base import sha256_of

__all__ = ["Figures", "Outcome", "OutputFolder", "Scratch", "State", "Trouble"]

State = Literal["done", "done before", "failed"]
Trouble = Literal["", "file", "machine", "computer", "work"]
"""Whose fault a failure is: the file's, the machine's (or options'), or the computer's; or the work
itself broke (a process that died, memory, time, an error of the program) and may do so again."""

_RECORD = "record.json"


class Figures(BaseModel):
    """What a summary shows of one file: seconds of printing, contour error (rms) in um."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    original_s: float | None = None
    written_s: float | None = None
    before_um: float | None = None
    shaper_um: float | None = None
    after_um: float | None = None
    put_back: int | None = None
    warnings: list[str] = []


class Outcome(BaseModel):
    """What became of one file for one machine; what was done is kept as its record.

    Attributes
    ----------
    key : str
        Digest of input, machine, options and version: the same key means the same result.
    output, report : str
        Paths below the output folder; empty for what failed.
    error : str
        Why it failed, else empty.
    took_s, cpu_s : float
        Seconds of the clock, and of the processor where it was done here.
    """

    model_config = ConfigDict(extra="ignore", frozen=True)

    state: State
    source: str
    machine: str
    machine_revision: str = ""
    version: str = ""
    source_sha256: str = ""
    key: str = ""
    output: str = ""
    output_sha256: str = ""
    report: str = ""
    figures: Figures = Figures()
    trouble: Trouble = ""
    error: str = ""
    took_s: float = 0.0
    cpu_s: float = 0.0


class Scratch:
    """Where one file is worked on: `result` and `report` are to be made there."""

    def __init__(self, folder: Path, name: str) -> None:
        self.folder = folder
        self.result = folder / f"result{''.join(Path(name).suffixes[-2:])}"
        self.report = folder / "report"


class OutputFolder:
    """The output of a batch or of a watched folder; `opened` gives it to one process at a time."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self._records = root / ".stillpath" / "records"
        self._work = root / ".stillpath" / "work"

    @classmethod
    @contextmanager
    def opened(cls, root: Path) -> Iterator[OutputFolder]:
        """Make the folder if need be, keep others out, and finish what a kill left half done.

        Raises
        ------
        OSError
            EBUSY if another batch or watch writes there.
        """
        root.mkdir(parents=True, exist_ok=True)
        with _alone(root):
            folder = cls(root)
            folder._records.mkdir(exist_ok=True)
            folder._work.mkdir(exist_ok=True)
            folder._recover()
            yield folder

    def recorded(self, output: str) -> Outcome | None:
        """Return what was done for a place below the folder, if anything was."""
        return _read(self._record(output))

    def note(self, output: str, outcome: Outcome) -> None:
        """Keep an outcome that has no files, a failure, for the place where they would lie.

        What lies there from before stays ours.
        """
        known = self.recorded(output)
        before = known.output_sha256 if known else ""
        _write(self._record(output), outcome.model_copy(update={"output_sha256": before}))

    def is_there(self, outcome: Outcome) -> bool:
        """Return whether a recorded result still lies in its place, unchanged."""
        path = self.root / outcome.output
        return path.is_file() and sha256_of(path) == outcome.output_sha256

    def scratch(self, output: str) -> Scratch:
        """Return an empty folder to work in."""
        folder = self._work / _short(output)
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        return Scratch(folder, output)

    def keep(self, scratch: Scratch, outcome: Outcome) -> None:
        """Make what lies in `scratch` the result: from here on the work is done.

        Raises
        ------
        OSError
            EEXIST if a file that we did not write is in its place; it stays.
        """
        self._check_place(outcome)
        sync(scratch.result)
        _write(scratch.folder / _RECORD, outcome)
        self._place(scratch.folder, outcome)

    def drop(self, scratch: Scratch) -> None:
        """Delete what lies in `scratch`, unless it counts as done already."""
        if (scratch.folder / _RECORD).exists():
            return
        shutil.rmtree(scratch.folder, ignore_errors=True)

    def _recover(self) -> None:
        for folder in self._work.iterdir():
            outcome = _read(folder / _RECORD)
            if outcome is not None:
                # Where a printer's share is away, the others' files go on; this one is done again.
                with suppress(OSError):
                    self._place(folder, outcome)
            elif folder.is_dir():  # or what a file manager leaves everywhere
                shutil.rmtree(folder)

    def _place(self, folder: Path, outcome: Outcome) -> None:
        """Move everything to its place; may be done again after it was broken off anywhere.

        What lies on another disk, such as a printer's share where a machine's results belong, is
        copied; the originals go last, with their folder.
        """
        scratch = Scratch(folder, outcome.output)
        if scratch.report.is_dir():
            report = self.root / outcome.report
            report.parent.mkdir(parents=True, exist_ok=True)
            shutil.rmtree(report, ignore_errors=True)
            try:
                scratch.report.replace(report)
            except OSError as error:
                if error.errno != errno.EXDEV:
                    raise
                shutil.copytree(scratch.report, report)
        if scratch.result.exists():
            target = self.root / outcome.output
            target.parent.mkdir(parents=True, exist_ok=True)
            try:
                scratch.result.replace(target)
            except OSError as error:
                if error.errno != errno.EXDEV:
                    raise
                with replacing(target) as temporary:
                    shutil.copyfile(scratch.result, temporary)
            sync(target.parent)
        (folder / _RECORD).replace(self._record(outcome.output))
        sync(self._records)
        shutil.rmtree(folder)

    def _check_place(self, outcome: Outcome) -> None:
        target = self.root / outcome.output
        if not target.exists():
            return
        known = self.recorded(outcome.output)
        ours = {outcome.output_sha256, known.output_sha256 if known else ""}
        if not target.is_file() or sha256_of(target) not in ours:
            raise FileExistsError(
                errno.EEXIST,
                "is in the way and was changed or not written by this command; move it away",
                str(target),
            )

    def _record(self, output: str) -> Path:
        return self._records / f"{_short(output)}.json"


@contextmanager
def _alone(root: Path) -> Iterator[None]:
    with ExitStack() as kept:
        try:
            kept.enter_context(exclusive(root / ".stillpath"))
        except OSError as error:
            if error.errno != errno.EBUSY:
                raise
            raise OSError(
                errno.EBUSY,
                "another batch or watch writes here; let it end, or choose another --output",
                str(root),
            ) from None
        yield


def _read(path: Path) -> Outcome | None:
    try:
        return Outcome.model_validate_json(path.read_bytes())
    except (FileNotFoundError, NotADirectoryError, ValidationError):
        return None


def _write(path: Path, outcome: Outcome) -> None:
    with replacing(path) as temporary:
        temporary.write_text(outcome.model_dump_json(indent=1), encoding="utf-8")


def _short(output: str) -> str:
    return hashlib.sha256(output.encode("utf-8", "surrogateescape")).hexdigest()[:32]
