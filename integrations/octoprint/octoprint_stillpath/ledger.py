"""The list of files on their way, kept on disk: what a restart of OctoPrint interrupts goes on."""

from __future__ import annotations

import json
import logging
import os
import threading
import time
import uuid
from dataclasses import asdict, dataclass, field, fields
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

__all__ = ["Entry", "Ledger"]

_LOGGER = logging.getLogger("octoprint.plugins.stillpath")
"""The plugin's, as OctoPrint names it."""
_KEPT = 20


@dataclass
class Entry:
    """A file on its way.

    Attributes
    ----------
    path : str
        Of the original in OctoPrint's storage `local`.
    options : dict
        Of the job.
    where : str
        ``server`` or ``command``.
    server : str
        Address; the key is read from the settings when it is needed, and never stored here.
    state : str
        ``waiting``, ``working``; ``done``, ``failed`` or ``cancelled``, which are final.
    stage, progress, message : str, float or None, str
        For people.
    job : str
        Id on the server, once it is known.
    is_ours : bool
        The job was made for this entry, so that nobody else waits for it.
    print_after : bool
        Print the result when it is there.
    not_printed : str
        Why it will not be printed, although that was asked for.
    result : str
        Path of what was made, in the storage.
    id : str
        Of this entry; no other text may name it in an address.
    tries : int
        How many jobs of it were given up; each makes the next one another request for the server.
    begun : int
        How often a program of this computer began with it and no orderly end followed.
    is_cancelled : bool
        Its end was asked for while it was worked on.
    version : list of int
        Size and time of change of the original when it was taken; empty: not known.
    """

    path: str
    machine: str
    options: dict[str, Any]
    where: str = "server"
    server: str = ""
    state: str = "waiting"
    stage: str = ""
    progress: float | None = None
    message: str = ""
    job: str = ""
    is_ours: bool = False
    print_after: bool = False
    not_printed: str = ""
    result: str = ""
    has_report: bool = False
    tries: int = 0
    begun: int = 0
    is_cancelled: bool = False
    version: list[int] = field(default_factory=list)
    at: float = field(default_factory=time.time)
    id: str = field(default_factory=lambda: uuid.uuid4().hex)

    @property
    def is_over(self) -> bool:
        """Nothing more will happen."""
        return self.state in ("done", "failed", "cancelled")

    def disarm(self, reason: str) -> None:
        """Do not print the result, if that was asked for."""
        if self.print_after:
            self.print_after, self.not_printed = False, reason


class Ledger:
    """Entries, oldest first. Safe to use from several threads.

    Parameters
    ----------
    path : Path
        The file. One that cannot be read is put aside; `trouble` says so, and what could not be
        written. Then the list is in memory only.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._changed = threading.Condition(threading.RLock())
        self.trouble = ""
        self._entries = self._read()

    def entries(self) -> list[Entry]:
        """Return all entries."""
        with self._changed:
            return list(self._entries)

    def open(self) -> list[Entry]:
        """Return the entries that are not over."""
        return [entry for entry in self.entries() if not entry.is_over]

    def find(self, entry_id: str) -> Entry | None:
        """Return an entry."""
        return next((entry for entry in self.entries() if entry.id == entry_id), None)

    def add(self, entry: Entry) -> None:
        """Append an entry; of those that are over, the oldest are forgotten."""
        with self._changed:
            over = [known for known in self._entries if known.is_over]
            forgotten = {known.id for known in over[: max(0, len(over) + 1 - _KEPT)]}
            self._entries = [known for known in self._entries if known.id not in forgotten]
            self._entries.append(entry)
            self._write()
            self._changed.notify_all()

    def forget(self) -> None:
        """Drop what is over."""
        with self._changed:
            self._entries = [entry for entry in self._entries if not entry.is_over]
            self._write()

    def change(self, entry: Entry, **values: Any) -> None:
        """Set attributes of an entry, and write them down."""
        with self._changed:
            for name, value in values.items():
                setattr(entry, name, value)
            self._write()

    def begin(self, entry: Entry) -> bool:
        """Note that an entry is worked on; False: it is over already."""
        with self._changed:
            if not entry.is_over:
                self.change(entry, state="working", message="")
            return not entry.is_over

    def cancel(self, entry: Entry) -> None:
        """End an entry: at once if it waits, else the worker is asked for it."""
        with self._changed:
            if entry.state == "waiting":
                self.change(entry, state="cancelled", stage="", progress=None)
            elif not entry.is_over:
                self.change(entry, is_cancelled=True)

    def is_cancelled(self, entry: Entry) -> bool:
        """Return whether its end was asked for."""
        with self._changed:
            return entry.is_cancelled

    def disarm(self, entry: Entry, reason: str) -> None:
        """Do not print the result of an entry."""
        with self._changed:
            entry.disarm(reason)
            self._write()

    def wait_for_work(self, is_stopped: Callable[[], bool]) -> Entry | None:
        """Return the next waiting entry when there is one; None: stopped."""
        with self._changed:
            while not is_stopped():
                for entry in self._entries:
                    if not entry.is_over:
                        return entry
                self._changed.wait(1.0)
        return None

    def wake(self) -> None:
        """Let `wait_for_work` look again."""
        with self._changed:
            self._changed.notify_all()

    def _read(self) -> list[Entry]:
        try:
            known = {f.name for f in fields(Entry)}
            documents = json.loads(self._path.read_text("utf-8"))["entries"]
            return [
                Entry(**{name: value for name, value in document.items() if name in known})
                for document in documents
            ]
        except FileNotFoundError:
            return []
        except OSError as error:  # of another user's rights, for instance
            self._tell_trouble(f"{self._path} cannot be read: {error}")
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            aside = self._path.with_suffix(".unreadable")
            self._path.replace(aside)
            self._tell_trouble(
                f"{self._path.name} cannot be read ({error}); it is now {aside.name}"
            )
        return []

    def _write(self) -> None:
        """Write all entries, whole or not at all."""
        part = self._path.with_suffix(".part")
        try:
            with part.open("w", encoding="utf-8") as file:
                json.dump({"entries": [asdict(entry) for entry in self._entries]}, file, indent=1)
                file.flush()
                os.fsync(file.fileno())
            part.replace(self._path)
        except OSError as error:
            self._tell_trouble(f"{self._path.name} cannot be written: {error}")

    def _tell_trouble(self, text: str) -> None:
        if text != self.trouble:  # once, and not at every change of an entry
            _LOGGER.error(text)
        self.trouble = text
