"""Who does the work: a server, or a program on this computer."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import shlex
import shutil
import subprocess
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from .client import Failure, Service, _Broken

if TYPE_CHECKING:
    from collections.abc import Callable

    from .ledger import Entry

__all__ = ["ByCommand", "Made", "OnServer"]

_LOOKS_EVERY_S = 0.25
_ENDS_WITHIN_S = 10.0
_NICENESS = 10


@dataclass
class Made:
    """What came of a file.

    Attributes
    ----------
    path : Path
        The compensated file, in a folder that goes away.
    page : bytes
        The report as a page.
    figures : dict
        The report as figures, as ``/v1/schemas/report.json`` describes them.
    """

    path: Path
    page: bytes = b""
    figures: dict[str, Any] = field(default_factory=dict)

    @property
    def time_s(self) -> float | None:
        """How long the motion of the print takes, by the firmware's rules."""
        return _positive(self.figures.get("time_s"))

    @property
    def warnings(self) -> list[str]:
        """What the report warns of."""
        found = self.figures.get("warnings")
        return [str(warning) for warning in found] if isinstance(found, list) else []

    @property
    def sentence(self) -> str:
        """What was reached, for people."""
        parts = []
        before, after = self._contour_um("before"), self._contour_um("after")
        if before is not None and after is not None:
            parts.append(f"contour error {before:.1f} \u2192 {after:.1f} \u00b5m")
        original_s = _positive(self.figures.get("original_time_s"))
        if original_s is not None and self.time_s is not None:
            parts.append(f"print time {original_s:.0f} \u2192 {self.time_s:.0f} s")
        parts += [f"warning: {warning}" for warning in self.warnings[:3]]
        return "; ".join(parts) or "done"

    def _contour_um(self, name: str) -> float | None:
        for channel in self.figures.get("channels") or []:
            if isinstance(channel, dict) and channel.get("name") == name:
                return _positive((channel.get("extruding") or {}).get("contour_rms_um"))
        return None


class OnServer(Service):
    """A job on a server, from the file to its result. One object does one job.

    Parameters
    ----------
    entry : Entry
        Its job is taken up again if it has one.
    key : str
        Of the server.
    timeout_s : float
        Patience with a server that does not answer.
    tell : callable
        Is told the stage and the share that is done or None; may raise to stop the work.
    note : callable
        Is told what to write down: attributes of the entry.
    """

    def __init__(
        self,
        entry: Entry,
        key: str,
        timeout_s: float,
        tell: Callable[[str, float | None], object],
        note: Callable[..., object],
    ) -> None:
        self._unreported: list[str] = []
        super().__init__(entry.server, key, timeout_s, tell, self._unreported.append)
        self._entry, self._note = entry, note

    def run(self, source: Path, folder: Path, name: str) -> Made:
        """Do the work.

        Parameters
        ----------
        source : Path
            The original, which is only read.
        folder : Path
            Of the result.
        name : str
            Of the file, for people; the server shows it.

        Raises
        ------
        Failure
            With the server's reason.
        """
        if self._entry.job and not self._is_there(source):
            self._note(tries=self._entry.tries + 1, job="", is_ours=False)
        if not self._entry.job:
            self._submit(source, name)
        target = folder / f"result{source.suffix}"
        self._fetch(self._path, self._wait(self._path, None), target)
        made = Made(target, self._report(f"{self._path}/report"), self._figures())
        if self._unreported:
            made.figures["warnings"] = [f"no report: {self._unreported[0]}", *made.warnings]
        return made

    def cancel(self) -> None:
        """Stop the job, if it is there and nobody else's; errors do not matter any more."""
        if self._entry.job and self._entry.is_ours:
            with contextlib.suppress(Failure, _Broken):
                self._open("POST", f"{self._path}/cancel", timeout_s=5.0).close()

    def machines(self) -> list[dict[str, str]]:
        """Return name and title of the machines there are."""
        try:
            found = json.loads(self._ask("GET", "/v1/machines", 3.0))
        except ValueError:
            found = None
        if not isinstance(found, list):
            raise Failure(f"{self._address} answers, but not as a Stillpath server", 1)
        return [
            {"name": str(machine["name"]), "title": str(machine.get("title") or "")}
            for machine in found
            if isinstance(machine, dict) and machine.get("name")
        ]

    @property
    def _path(self) -> str:
        return f"/v1/jobs/{quote(self._entry.job, safe='')}"

    def _is_there(self, source: Path) -> bool:
        """Return whether the job of an interrupted entry still is, and of the file as it is now.

        Raises if nobody answers.
        """
        self._tell("asking the server", None)
        try:
            job = self._document(self._ask("GET", self._path, self._timeout_s))
        except Failure as failure:
            if failure.code == 2:
                return False
            raise
        if job.get("source_sha256") != _sha256(source):
            self.cancel()  # it was replaced while nobody looked
            return False
        return job.get("state") not in ("failed", "cancelled")

    def _submit(self, source: Path, name: str) -> None:
        self._tell("asking the server", None)
        machine = quote(self._entry.machine, safe="")
        # Whether address, key and machine are right is known before a long upload.
        self._ask("GET", f"/v1/machines/{machine}", self._FIRST_PATIENCE_S)
        # Sent twice after a lost answer, or by an OctoPrint that was restarted: one job.
        key = f"{self._entry.id}-{self._entry.tries}"
        options = {"machine": self._entry.machine, **self._entry.options, "name": name}
        job, is_new = self._upload(source, options, key)
        self._note(job=job["id"], is_ours=is_new)
        if job.get("source_bytes") != source.stat().st_size:
            self.cancel()
            raise Failure(f"{job.get('source_bytes')} bytes arrived, not all of the file", 1)

    def _figures(self) -> dict[str, Any]:
        try:
            found = json.loads(self._report(f"{self._path}/report.json"))
        except ValueError:
            found = None
        return found if isinstance(found, dict) else {}


class ByCommand:
    """The program `stillpath` on this computer.

    Parameters
    ----------
    command : str
        Of the program; options may follow.
    tell : callable
        As of `OnServer`.
    """

    def __init__(
        self, entry: Entry, command: str, tell: Callable[[str, float | None], object]
    ) -> None:
        self._entry, self._tell = entry, tell
        self._command = _words(command)
        if not self._command:
            raise Failure("the setting Program is empty; it is the path of stillpath")

    def run(self, source: Path, folder: Path, name: str) -> Made:  # noqa: ARG002 - as OnServer
        """Do the work; see `OnServer`."""
        target, report = folder / f"result{source.suffix}", folder / "report"
        arguments = ["compensate", str(source), "-o", str(target), "--report", str(report)]
        arguments += ["--machine", self._entry.machine]
        for option, value in self._entry.options.items():
            if option == "times":
                arguments += ["--keep-times"] if value == "kept" else []
            else:
                arguments += [f"--{option.replace('_', '-')}", str(value)]
        self._execute([*self._command, *arguments], folder / "said")
        try:
            figures = json.loads((report / "report.json").read_text("utf-8"))
            return Made(target, (report / "report.html").read_bytes(), figures)
        except (OSError, ValueError) as error:  # a full disk: the print is right all the same
            return Made(target, figures={"warnings": [f"no report: {error}"]})

    def cancel(self) -> None:
        """Nothing is left to stop: the program ends with `run`."""

    def _execute(self, words: list[str], said: Path) -> None:
        """Run a program, tell what it says, and raise its last line if it fails."""
        environment = {**os.environ, "PYTHONUTF8": "1", "NO_COLOR": "1"}
        with said.open("wb") as log:
            try:
                process = subprocess.Popen(
                    words,
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=log,
                    env=environment,
                    creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
                )
            except OSError as error:
                raise Failure(f"{words[0]} cannot be run: {error.strerror or error}") from None
        try:
            # A print that runs meanwhile must not wait for us.
            with contextlib.suppress(OSError, AttributeError):
                os.setpriority(os.PRIO_PROCESS, process.pid, _NICENESS)
            while process.poll() is None:
                self._tell(*_progress(said))
                time.sleep(_LOOKS_EVERY_S)
        finally:
            _end(process)
        if process.returncode:
            lines = said.read_text("utf-8", "replace").strip().splitlines()
            reason = lines[-1] if lines else "it does not say why"
            raise Failure(f"{reason} (exit code {process.returncode})")


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        for chunk in iter(lambda: file.read(1 << 20), b""):
            digest.update(chunk)
    return digest.hexdigest()


def _progress(said: Path) -> tuple[str, float | None]:
    """Return stage and share of the last line like ``stillpath: compensating 42 %, 3 s left``."""
    with said.open("rb") as file:
        file.seek(max(0, said.stat().st_size - 1000))
        lines = file.read().decode("utf-8", "replace").splitlines()
    for line in reversed(lines):
        found = re.match(r"stillpath: (.+) (\d+) %", line)
        if found:
            return found[1], int(found[2]) / 100
    return "working on this computer", None


def _end(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(_ENDS_WITHIN_S)
        except subprocess.TimeoutExpired:
            process.kill()
    process.wait()


def _words(text: str) -> list[str]:
    """Return the words of a command; a path with spaces needs no quotes if nothing follows it."""
    if Path(text).is_file() or shutil.which(text):
        return [text]
    try:
        words = shlex.split(text, posix=os.name == "posix")
    except ValueError:
        raise Failure(f"the setting Program is {text!r}: a quote is not closed") from None
    words = [word.strip("\"'") for word in words]
    return [str(Path(word).expanduser()) if word.startswith("~/") else word for word in words]


def _positive(value: Any) -> float | None:
    return float(value) if isinstance(value, (int, float)) and value >= 0 else None
