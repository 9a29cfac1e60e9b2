"""OctoPrint's side of the work: its files, its printer, its metadata."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

from octoprint.filemanager import FileDestinations
from octoprint.filemanager.util import AbstractFileWrapper

from .choices import is_stamped, result_name, timeout_of
from .client import Failure
from .compensators import ByCommand, Made, OnServer
from .worker import Host

if TYPE_CHECKING:
    from collections.abc import Callable

    from .ledger import Entry, Ledger
    from .reports import Reports

__all__ = ["METADATA", "OctoPrintHost"]

METADATA = "stillpath"
"""Key of our metadata of a file, of the original and of what was made of it."""

_LOCAL = FileDestinations.LOCAL


class OctoPrintHost(Host):
    """What the worker asks, answered by OctoPrint.

    Parameters
    ----------
    plugin : object
        Our plugin, with what OctoPrint gave it.
    show : callable
        Is told when something has changed that people see.
    """

    def __init__(
        self, plugin: Any, ledger: Ledger, reports: Reports, show: Callable[[Entry], object]
    ) -> None:
        self._files, self._printer = plugin._file_manager, plugin._printer
        self._settings, self._logger = plugin._settings, plugin._logger
        self._ledger, self._reports, self._show = ledger, reports, show

    def source(self, entry: Entry) -> Path | None:
        """Return where the original lies."""
        return self.disk_path(entry.path)

    def disk_path(self, path: str) -> Path | None:
        """Return where a file of the storage lies; None: it does not exist."""
        try:
            if not self._files.file_exists(_LOCAL, path):
                return None
        except ValueError:  # it leads out of the storage
            return None
        return Path(self._files.path_on_disk(_LOCAL, path))

    def busy_with(self, entry: Entry) -> str:
        """Let the program on this computer wait for a print; a server does not disturb it."""
        if entry.where == "command" and self._is_printing():
            return "waiting for the end of the print"
        return ""

    def compensator(
        self,
        entry: Entry,
        tell: Callable[[str, float | None], object],
        note: Callable[..., object],
    ) -> OnServer | ByCommand:
        """Return a server or the program, as `where` was set when the file came.

        A file is processed with the machine, method and server that were set when it was uploaded;
        key, patience and program are read when its work begins.
        """
        get = self._settings.get
        if entry.where == "command":
            return ByCommand(entry, str(get(["command"]) or "").strip(), tell)
        timeout_s = timeout_of({"timeout_s": get(["timeout_s"])})
        return OnServer(entry, str(get(["key"]) or "").strip(), timeout_s, tell, note)

    def occupied(self, entry: Entry) -> str:
        """Wait while what was made before is printed: the printer reads it."""
        job = (self._printer.get_current_job() or {}).get("file") or {}
        target = result_name(entry.path)
        if self._is_printing() and (job.get("origin"), job.get("path")) == (_LOCAL, target):
            return f"waiting until {target} is printed"
        return ""

    def deliver(self, entry: Entry, made: Made) -> None:
        """Put the result into the storage, with its metadata, and print it if that was asked."""
        target = result_name(entry.path)
        self._check_place(target)
        about = self._files.get_metadata(_LOCAL, entry.path) or {}
        more = {}
        if about.get("display"):
            more["display"] = result_name(about["display"])
        if about.get("user"):  # OctoPrint 1.11 and later
            more["user"] = about["user"]
        # OctoPrint analyses what was made; of the times ours counts, for it follows the firmware.
        analysis = {} if made.time_s is None else {"estimatedPrintTime": made.time_s}
        added = self._files.add_file(
            _LOCAL,
            target,
            _Whole(target.rpartition("/")[2], made.path),
            allow_overwrite=True,
            analysis=analysis,
            **more,
        )
        if made.page:
            self._reports.add(entry.id, made.page)
        self._describe(entry, added, made)
        self._ledger.change(entry, result=added, message=made.sentence, has_report=bool(made.page))
        self._print(entry, added)

    def show(self, entry: Entry) -> None:
        """Tell people how an entry stands."""
        self._show(entry)

    def sweep(self) -> None:
        """Delete reports of files that are gone."""
        kept = {entry.id for entry in self._ledger.entries()}
        tree = self._files.list_files(_LOCAL, recursive=True)
        self._reports.keep_only(kept | set(_report_ids(tree.get(_LOCAL) or {})))

    def _check_place(self, target: str) -> None:
        """Raise if somebody's own file lies where the result would."""
        there = self.disk_path(target)
        if there is None or is_stamped(there):
            return
        # OctoPrint's get_additional_metadata returns nothing (1.11.8, filemanager/__init__.py).
        ours = (self._files.get_metadata(_LOCAL, target) or {}).get(METADATA) or {}
        if "source" not in ours:
            raise Failure(f"{target} already exists and was not made by Stillpath; rename it")

    def _describe(self, entry: Entry, added: str, made: Made) -> None:
        """Write down where the file comes from, and where its report is."""
        files, link = self._files, f"plugin/stillpath/reports/{entry.id}"
        about = {
            "source": entry.path,
            "machine": entry.machine,
            "method": entry.options.get("method", ""),
            "summary": made.sentence,
            "version": str(made.figures.get("version", "")),
            "report": entry.id if made.page else "",
            "job": entry.job,
        }
        known = (files.get_metadata(_LOCAL, added) or {}).get("links") or []
        links = [one for one in known if one.get("rel") != "web"]  # of an earlier result
        note = f"Compensated by Stillpath from {entry.path}: {made.sentence.rstrip('.')}."
        if made.page:
            links.append({"rel": "web", "href": link})
            note += f" Report: {link}"
        for path, key, value in (
            (added, METADATA, about),
            # OctoPrint 2.0's add_link does nothing (filemanager/storage/common.py, 2.0.0rc7).
            (added, "links", links),
            (added, "notes", [{"text": note}]),
            (entry.path, METADATA, {"result": added}),
        ):
            files.set_additional_metadata(_LOCAL, path, key, value, overwrite=True)

    def _print(self, entry: Entry, added: str) -> None:
        if not entry.print_after:
            return
        if self._ledger.is_cancelled(entry):  # or uploaded again, or deleted
            self._ledger.disarm(entry, "it was cancelled, replaced or deleted meanwhile")
            return
        if not self._printer.is_ready():
            self._ledger.disarm(entry, "the printer is not ready")
            return
        self._ledger.change(entry, print_after=False)  # else it would stop itself
        self._printer.select_file(added, False, printAfterSelect=True)

    def _is_printing(self) -> bool:
        return bool(self._printer.is_printing() or self._printer.is_paused())


class _Whole(AbstractFileWrapper):
    """A file that is in its place whole or not at all, also from another disk."""

    def __init__(self, filename: str, path: Path) -> None:
        super().__init__(filename)
        self._path = path

    def save(self, path: str, permissions: int | None = None) -> None:  # noqa: ARG002
        # Hidden: OctoPrint does not list it, and nobody prints it.
        target = Path(path)
        part = target.with_name(f".{target.name}.part")
        try:
            with self._path.open("rb") as source, part.open("wb") as copy:
                shutil.copyfileobj(source, copy, 1 << 20)
                copy.flush()
                os.fsync(copy.fileno())
            part.replace(target)
        finally:
            if part.exists():
                part.unlink()

    def stream(self) -> Any:
        return self._path.open("rb")


def _report_ids(tree: dict[str, Any]) -> list[str]:
    """Return the reports that files of a listing name."""
    found = []
    for node in tree.values():
        ours = node.get(METADATA)
        if isinstance(ours, dict) and ours.get("report"):
            found.append(str(ours["report"]))
        found += _report_ids(node.get("children") or {})
    return found
