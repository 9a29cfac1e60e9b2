"""The thread that does one file after the other. It knows nothing of OctoPrint."""

from __future__ import annotations

import hashlib
import shutil
import tempfile
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING

from .client import Failure
from .compensators import ByCommand, Made, OnServer

if TYPE_CHECKING:
    from collections.abc import Callable
    from logging import Logger

    from .ledger import Entry, Ledger

__all__ = ["Cancelled", "Host", "Worker"]

_SHOWN_EVERY_S = 0.5
_LOOKS_EVERY_S = 1.0
_MOST_BEGINNINGS = 3


class Cancelled(Exception):
    """Somebody asked for the end of one file."""


class _Stopped(Exception):
    """OctoPrint ends; what is under way goes on with its next start."""


class Host:
    """What the worker asks of the program around it."""

    def source(self, entry: Entry) -> Path | None:
        """Return where the original lies; None: it is gone."""
        raise NotImplementedError

    def busy_with(self, entry: Entry) -> str:
        """Return why the work must wait before it begins; empty: it need not."""
        raise NotImplementedError

    def compensator(
        self,
        entry: Entry,
        tell: Callable[[str, float | None], object],
        note: Callable[..., object],
    ) -> OnServer | ByCommand:
        """Return who does the work."""
        raise NotImplementedError

    def occupied(self, entry: Entry) -> str:
        """Return why the result cannot be put in its place now; empty: it can."""
        raise NotImplementedError

    def deliver(self, entry: Entry, made: Made) -> None:
        """Put the result beside the original."""
        raise NotImplementedError

    def show(self, entry: Entry) -> None:
        """Tell people how an entry stands."""
        raise NotImplementedError


class Worker:
    """Does what the ledger holds, oldest first.

    Parameters
    ----------
    folder : Path
        For what lives as long as a job; it is emptied at the start.
    """

    def __init__(self, ledger: Ledger, host: Host, folder: Path, logger: Logger) -> None:
        self._ledger, self._host, self._folder = ledger, host, folder
        self._logger = logger
        self._stopping = threading.Event()
        self._shown_at = 0.0
        self._thread = threading.Thread(target=self._run, name="stillpath", daemon=True)

    def start(self) -> None:
        """Begin, with what an earlier run has left."""
        self._thread.start()

    def stop(self, within_s: float = 3.0) -> None:
        """Stop between two steps; what is under way stays in the ledger."""
        self._stopping.set()
        self._ledger.wake()
        if self._thread.is_alive():
            self._thread.join(within_s)

    def _run(self) -> None:
        shutil.rmtree(self._folder, ignore_errors=True)
        while True:
            entry = self._ledger.wait_for_work(self._stopping.is_set)
            if entry is None:
                return
            try:
                self._do(entry)
            except _Stopped:
                return

    def _do(self, entry: Entry) -> None:
        """Bring an entry to its end."""
        change = self._ledger.change
        if not self._ledger.begin(entry):
            return
        try:
            self._attempt(entry)
        except _Stopped:
            change(entry, begun=0)
            raise
        except Cancelled:
            change(entry, state="cancelled", stage="", progress=None)
        except Failure as failure:
            self._logger.warning("%s: %s", entry.path, failure)
            change(entry, state="failed", stage="", progress=None, message=str(failure))
        except Exception as error:  # whatever it is, it must be seen, and the next file goes on
            self._logger.exception("%s: unexpected", entry.path)
            reason = f"{type(error).__name__}: {error}"
            change(entry, state="failed", stage="", progress=None, message=reason)
        else:
            self._logger.info("%s: %s", entry.path, entry.message)
            change(entry, state="done", stage="", progress=None)
        self._host.show(entry)

    def _attempt(self, entry: Entry) -> None:
        compensator = self._host.compensator(
            entry,
            lambda stage, share: self._tell(entry, stage, share),
            lambda **values: self._ledger.change(entry, **values),
        )
        try:
            source = self._source(entry)
            self._wait_while(entry, self._host.busy_with)
            self._note_begun(entry)
            digest = self._digest(entry, source)
            self._folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(dir=str(self._folder)) as folder:
                made = compensator.run(source, Path(folder), entry.path.rpartition("/")[2])
                self._wait_while(entry, self._host.occupied)
                if self._digest(entry, self._source(entry)) != digest:
                    raise Failure("the file was changed meanwhile; what was made of it is not kept")
                self._host.deliver(entry, made)
        except Cancelled:
            compensator.cancel()  # also a job that an earlier run of OctoPrint has left
            raise

    def _note_begun(self, entry: Entry) -> None:
        """Count beginnings on this computer: one that the work freezes is switched off and on."""
        if entry.where != "command":
            return
        if entry.begun >= _MOST_BEGINNINGS:
            raise Failure(
                f"this computer or OctoPrint went down {entry.begun} times while it was processed, "
                "perhaps for want of memory; let a server do it, or ask for it again"
            )
        self._ledger.change(entry, begun=entry.begun + 1)

    def _source(self, entry: Entry) -> Path:
        self._check(entry)  # an entry whose file is deleted is cancelled
        source = self._host.source(entry)
        if source is None:
            raise Failure("the file is gone: it was moved or deleted meanwhile")
        return source

    def _wait_while(self, entry: Entry, reason: Callable[[Entry], str]) -> None:
        while True:
            why = reason(entry)
            self._tell(entry, why, None)
            if not why:
                return
            self._stopping.wait(_LOOKS_EVERY_S)

    def _tell(self, entry: Entry, stage: str, share: float | None) -> None:
        """Show progress, not too often; raise if the work shall end."""
        self._check(entry)
        now = time.monotonic()
        if stage == entry.stage and now - self._shown_at < _SHOWN_EVERY_S:
            return
        self._shown_at = now
        # Not worth a write to an SD card.
        entry.stage, entry.progress = stage, share
        self._host.show(entry)

    def _check(self, entry: Entry) -> None:
        if self._stopping.is_set():
            raise _Stopped
        if self._ledger.is_cancelled(entry):
            raise Cancelled

    def _digest(self, entry: Entry, path: Path) -> bytes:
        digest = hashlib.sha256()
        with path.open("rb") as file:
            for chunk in iter(lambda: file.read(1 << 20), b""):
                digest.update(chunk)
                self._check(entry)
        return digest.digest()
