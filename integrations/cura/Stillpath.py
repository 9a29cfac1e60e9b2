"""Stillpath as a post-processing script of Cura.

Copy this file into the folder ``scripts`` of Cura's configuration folder (*Help, Show
configuration folder*) and restart Cura; *Extensions, Post processing, Modify G-code* then offers
it. Cura's own Python runs it, so it needs nothing but the standard library: the work is done by the
program `stillpath-post`, or by a server. Set-up: docs/slicer-setup.md.
"""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
import urllib.request
import uuid
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.error import HTTPError, URLError
from urllib.parse import quote, urlencode, urlsplit

from UM.Application import Application
from UM.Logger import Logger
from UM.Message import Message

from ..Script import Script  # Cura's

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from typing import BinaryIO

_PATIENCE_S = 30.0
_MARK = ";STILLPATH_ITEM:"
_MARK_LINE = re.compile(rf"^{_MARK}(\d+)\n", re.MULTILINE)

_SETTINGS: dict[str, dict[str, Any]] = {
    "where": {
        "label": "Work",
        "description": "Who does it: the program stillpath-post on this computer, or a server.",
        "type": "enum",
        "options": {"command": "on this computer", "server": "on a server"},
        "default_value": "command",
    },
    "command": {
        "label": "Program",
        "description": "Path of stillpath-post; `stillpath-post --setup` shows it.",
        "type": "str",
        "default_value": "stillpath-post",
        "enabled": "where == 'command'",
    },
    "server": {
        "label": "Server",
        "description": "Address of the server.",
        "type": "str",
        "default_value": "http://127.0.0.1:8000",
        "enabled": "where == 'server'",
    },
    "key": {
        "label": "Key",
        "description": "Key of the server, if it wants one. Cura stores it readably.",
        "type": "str",
        "default_value": "",
        "enabled": "where == 'server'",
    },
    "machine": {
        "label": "Machine",
        "description": "Machine of Stillpath. Empty, with the program: found by the printer's name "
        "in Cura, as its settings say.",
        "type": "str",
        "default_value": "",
    },
    "method": {
        "label": "Method",
        "description": "fbf compensates; a shaper does in the file what firmware shapers do.",
        "type": "enum",
        "options": {
            "fbf": "fbf",
            "zpetc": "zpetc",
            "zmetc": "zmetc",
            "ebzpetc": "ebzpetc",
            "npz-ignore": "npz-ignore",
            "ts": "ts",
            "shaper:zv": "shaper: zv",
            "shaper:mzv": "shaper: mzv",
            "shaper:ei": "shaper: ei",
            "shaper:2hump_ei": "shaper: 2hump_ei",
            "shaper:3hump_ei": "shaper: 3hump_ei",
            "advise": "advise (moves stay)",
            "none": "none",
        },
        "default_value": "fbf",
    },
    "robust": {
        "label": "Robust",
        "description": "What fbf is designed for: all plants that explain the measurement, "
        "the nominal plant, or the set as given.",
        "type": "enum",
        "options": {
            "auto": "automatic",
            "off": "nominal",
            "ensemble": "set",
            "minimax": "worst of the set",
        },
        "default_value": "auto",
        "enabled": "method == 'fbf'",
    },
    "tolerance_um": {
        "label": "Tolerance",
        "description": "How far the written path may be from the computed one.",
        "unit": "\u00b5m",
        "type": "float",
        "default_value": 2.0,
        "minimum_value": "0.5",
        "maximum_value": "50",
    },
    "budget_um": {
        "label": "Budget",
        "description": "Contour error that may become speed, or that advice keeps walls within. "
        "0: none; the print is as quick as it was sliced.",
        "unit": "\u00b5m",
        "type": "float",
        "default_value": 0.0,
        "minimum_value": "0",
        "maximum_value": "1000",
    },
    "features": {
        "label": "Compensate",
        "description": "What is compensated. The rest stays as sliced, and the file is smaller. "
        "Everywhere with a budget.",
        "type": "enum",
        "options": {
            "all": "everywhere",
            "visible": "outer walls, top and bottom",
            "walls": "outer walls",
        },
        "default_value": "all",
    },
    "times": {
        "label": "Times",
        "description": "Times in the G-code: of the compensated print, or as Cura wrote them.",
        "type": "enum",
        "options": {"new": "new", "kept": "as sliced"},
        "default_value": "new",
    },
    "reports": {
        "label": "Folder of reports",
        "description": "A page with figures for every print is written there. Empty: none.",
        "type": "str",
        "default_value": "",
    },
}


class Stillpath(Script):
    """Compensates the G-code when Cura saves or sends it."""

    def getSettingDataString(self) -> str:
        """Return the settings panel as Cura's JSON."""
        panel = {
            "name": "Stillpath",
            "key": "Stillpath",
            "metadata": {},
            "version": 2,
            "settings": _SETTINGS,
        }
        return json.dumps(panel)

    def execute(self, data: list[str]) -> list[str]:
        """Return the layers compensated; after a failure, which is shown, as sliced.

        Parameters
        ----------
        data : list of str
            Header, start, one item per layer, end; each holds many lines.
        """
        try:
            with tempfile.TemporaryDirectory(prefix="stillpath-") as folder:
                made = self._compensated(data, Path(folder))
        except Exception as error:  # Cura would only log it and print what was sliced
            Logger.log("e", "Stillpath: %s", error)
            _show(
                f"The print is NOT compensated: {error}\n\nCura takes the G-code as processed: "
                "slice again to try again.",
                "ERROR",
            )
            return data
        return made

    def _compensated(self, data: list[str], folder: Path) -> list[str]:
        if not any(item.strip() for item in data):
            raise Failure("there is no G-code")
        began = time.monotonic()
        source, target = folder / "print.gcode", folder / "print.stillpath.gcode"
        text, marks = _joined(data)
        source.write_bytes(text.encode("utf-8", "surrogateescape"))
        name = _job_name()
        try:
            if self._value("where") == "server":
                report = self._on_server(source, target, name)
            else:
                report = self._by_program(source, name)
                target = source
        except Failure as failure:
            raise Failure(_with_lines_of(str(failure), text)) from None
        written = target.read_bytes().decode("utf-8", "surrogateescape")
        made = _parted(written, marks, len(data))
        seconds = (
            f"Compensated in {time.monotonic() - began:.0f} s; the preview shows the original."
        )
        _show(seconds + (f"\n\nReport: {report}" if report else ""), "POSITIVE")
        return made

    def _on_server(self, source: Path, target: Path, name: str) -> str:
        """Let a server compensate, and return where the report is."""
        if not self._value("machine"):
            raise Failure("no machine is chosen; the server needs its name")
        why: list[str] = []
        client = Service(
            self._value("server"), self._value("key"), timeout_s=_PATIENCE_S, no_report=why.append
        )
        options = {"machine": self._value("machine"), "name": name, **self._options()}
        wanted = bool(self._value("reports"))
        page = client.compensate(source, target, options, with_report=wanted)
        if why:
            return f"none ({why[0]})"
        return self._write_report(page, name) if wanted else ""

    def _write_report(self, page: bytes, name: str) -> str:
        folder = Path(self._value("reports")).expanduser()
        target = folder / f"{Path(name).stem}.stillpath.html"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            target.write_bytes(page)
        except OSError as error:  # the print is right all the same
            return f"none, it cannot be written ({error})"
        return str(target)

    def _by_program(self, source: Path, name: str) -> str:
        """Run stillpath-post, which replaces the file, and return where it put the report."""
        arguments = ["--on-error", "fail", "--printer", _printer_name()]
        if self._value("machine"):
            arguments += ["--machine", self._value("machine")]
        for option, value in self._options().items():
            arguments += [f"--{option.replace('_', '-')}", str(value)]
        reports = self._value("reports")
        arguments += ["--reports", reports] if reports else ["--no-report"]
        try:
            done = subprocess.run(
                [*_command(self._value("command")), *arguments, str(source)],
                stdin=subprocess.DEVNULL,
                capture_output=True,
                env=_environment(name),
                creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
                check=False,
            )
        except OSError as error:
            raise Failure(f"{self._value('command')} cannot be run: {error}") from None
        said = done.stderr.decode("utf-8", "replace").strip().splitlines()
        if done.returncode:
            reason = said[-1] if said else "it does not say why"
            raise Failure(f"{reason} (exit code {done.returncode})")
        told = re.search(r"report: (.+)", done.stdout.decode("utf-8", "replace"))
        return told[1].strip() if told else ""

    def _options(self) -> dict[str, Any]:
        names = ("method", "robust", "tolerance_um", "times")
        options = {name: self._value(name) for name in names}
        if self._value("budget_um"):
            options["budget_um"] = self._value("budget_um")
        if self._value("features") != "all":
            options["where"] = self._value("features")
        return options if options["method"] == "fbf" else {**options, "robust": "auto"}

    def _value(self, key: str) -> Any:
        """Return a setting; what Cura read back from its own files is text."""
        value = self.getSettingValueByKey(key)
        if value is None:
            value = _SETTINGS[key]["default_value"]
        if _SETTINGS[key]["type"] == "float":
            return float(str(value).replace(",", "."))
        return str(value).strip()


def _joined(data: list[str]) -> tuple[str, list[int]]:
    """Return the text of all items, with a comment before each, and which items have one.

    An item that does not begin on a new line goes on with the one before it.
    """
    parts, marks = [], []
    fresh = True
    for number, item in enumerate(data):
        if _MARK in item:
            raise Failure(f"the G-code holds {_MARK} already")
        if number and fresh and item:
            parts.append(f"{_MARK}{number}\n")
            marks.append(number)
        parts.append(item)
        fresh = item.endswith("\n") if item else fresh
    return "".join(parts), marks


def _parted(text: str, marks: list[int], count: int) -> list[str]:
    """Cut a text at its marks into as many items as there were."""
    first, *rest = _MARK_LINE.split(text)
    if [int(number) for number in rest[::2]] != marks:
        raise Failure("the layers cannot be told apart in the compensated file")
    items = [first, *[""] * (count - 1)]
    for number, item in zip(marks, rest[1::2]):  # noqa: B905 - as long as each other
        items[number] = item
    return items


def _with_lines_of(reason: str, text: str) -> str:
    """Count the lines in a message without our marks, as they are in the file that Cura saves."""

    def counted(found: re.Match[str]) -> str:
        number = int(found[1])
        before = text.split("\n", number)[:number]
        return f"line {number - sum(line.startswith(_MARK) for line in before)}"

    return re.sub(r"\bline (\d+)", counted, reason)


def _command(text: str) -> list[str]:
    """Return the words of a command; a path with spaces needs no quotes if nothing follows it."""
    if Path(text).is_file() or shutil.which(text):
        return [text]
    try:
        words = shlex.split(text, posix=os.name == "posix")
    except ValueError:
        raise Failure(f"the setting Program is {text!r}: a quote is not closed") from None
    words = [word.strip("\"'") for word in words]
    return [str(Path(word).expanduser()) if word.startswith("~/") else word for word in words]


def _environment(name: str) -> dict[str, str]:
    """Return an environment for programs that are not Cura's: without its libraries and Python."""
    environment = dict(os.environ)
    if getattr(sys, "frozen", False):
        for variable in ("PYTHONHOME", "PYTHONPATH", "LD_LIBRARY_PATH", "DYLD_LIBRARY_PATH"):
            environment.pop(variable, None)
            before = environment.pop(f"{variable}_ORIG", None)  # where PyInstaller keeps it
            if before:
                environment[variable] = before
    return {
        **environment,
        "PYTHONUTF8": "1",
        "SLIC3R_PP_HOST": "Cura",
        "SLIC3R_PP_OUTPUT_NAME": name,
    }


def _job_name() -> str:
    with contextlib.suppress(Exception):  # a name is no reason to fail
        name = Application.getInstance().getPrintInformation().jobName
        if name:
            return f"{name}.gcode"
    return "cura.gcode"


def _printer_name() -> str:
    with contextlib.suppress(Exception):
        return str(Application.getInstance().getGlobalContainerStack().getName())
    return ""


def _show(text: str, kind: str) -> None:
    kinds = getattr(Message, "MessageType", None)  # Cura 4.11 and later
    more = {} if kinds is None else {"message_type": getattr(kinds, kind)}
    lifetime_s = 0 if kind == "ERROR" else 30
    Message(text, title="Stillpath", lifetime=lifetime_s, **more).show()


# Client of the service: the same in slicers/, cura/ and octoprint/.


class Failure(Exception):
    """It was not done: one line for the user; code 1: another try may help, 2: it will not."""

    def __init__(self, message: object, code: int = 2) -> None:
        super().__init__(" ".join(str(message).split()))
        self.code = code


class Service:
    """A Stillpath server.

    Parameters
    ----------
    address : str
        As in a browser: ``http://127.0.0.1:8000``.
    key : str
        Sent as a bearer token; empty for none.
    timeout_s : float
        How long the server may be silent, or away while a job is there, before it is given up.
    tell : callable
        Is told the stage, and the share that is done or None; may raise to stop the work.
    no_report : callable
        Is told why there is no report, if it cannot be fetched: the print is right all the same.
    """

    _FIRST_PATIENCE_S = 3.0
    _BUSY = (408, 429, 502, 503, 504)
    _LONGEST_PAUSE_S = 2.0
    _MAX_RESTARTS = 3
    """How many times a transfer that broke off midway gets its full patience again."""

    def __init__(
        self,
        address: str,
        key: str = "",
        timeout_s: float = 60.0,
        tell: Callable[[str, float | None], object] = lambda _stage, _share: None,
        no_report: Callable[[str], object] = lambda _reason: None,
    ) -> None:
        address, key = address.strip().rstrip("/"), key.strip()
        host = _host_of(address)
        if not host:
            raise Failure(f"{address!r} is not the address of a server, like http://127.0.0.1:8000")
        if not (key.isascii() and key.isprintable()):
            raise Failure("the key holds characters that no key has; copy it again")
        self._address = address
        self._headers = {"Authorization": f"Bearer {key}"} if key else {}
        self._timeout_s = timeout_s
        self._tell, self._no_report = tell, no_report
        # A key must not follow a redirection to somewhere else, and no proxy leads to ourselves.
        handlers: list[Any] = [_Web()]
        if host in ("localhost", "127.0.0.1", "::1"):
            handlers.append(urllib.request.ProxyHandler({}))
        self._opener = urllib.request.build_opener(*handlers)

    def compensate(
        self,
        source: Path,
        target: Path,
        options: Mapping[str, Any],
        wait_s: float | None = None,
        with_report: bool = True,
    ) -> bytes:
        """Send a file, wait, fetch the result and return the page of the report, if there is one.

        Parameters
        ----------
        source, target : Path
            The target is written in place: guard it.
        options : dict
            `machine`, `name` (of the file, in the report) and other parameters of a job.
        wait_s : float, optional
            Give up after this time.

        Raises
        ------
        Failure
        """
        self._tell("asking the server", None)
        machine = quote(options["machine"], safe="")
        # Whether address, key and machine are right is known before a long upload.
        self._ask("GET", f"/v1/machines/{machine}", min(self._FIRST_PATIENCE_S, self._timeout_s))
        path = f"/v1/jobs/{quote(self._send(source, options), safe='')}"
        try:
            self._fetch(path, self._wait(path, wait_s), target)
            return self._report(f"{path}/report") if with_report else b""
        finally:
            self._forget(path)

    def _send(self, source: Path, options: Mapping[str, Any]) -> str:
        # A job of our own: it is deleted afterwards, also if others send the same file.
        options = {**options, "fresh": "true"}
        job, _ = self._upload(source, options, uuid.uuid4().hex)
        size = source.stat().st_size
        if job.get("source_bytes") != size:
            self._forget(f"/v1/jobs/{quote(job['id'], safe='')}")
            raise Failure(f"sent {size} bytes, but {job.get('source_bytes')} arrived", 1)
        return job["id"]

    def _upload(
        self, source: Path, options: Mapping[str, Any], key: str
    ) -> tuple[dict[str, Any], bool]:
        """Return the job that the server makes of a file, and whether it is a new one.

        Sent again with the same key, it is one job all the same.
        """
        query = urlencode({**options, "name": options["name"][-255:]}, errors="replace")
        is_new = False

        def take(answer: Any) -> bytes:
            nonlocal is_new
            is_new = answer.status == 202
            return _read(answer)

        with source.open("rb") as file:
            size = source.stat().st_size
            body = _CountedFile(file, size, lambda share: self._tell("sending", share), key)
            answer = self._ask("POST", f"/v1/jobs?{query}", self._timeout_s, body, take)
        return self._document(answer), is_new

    def _wait(self, path: str, wait_s: float | None) -> dict[str, Any]:
        """Return the job when it is done."""
        began, pause_s = time.monotonic(), 0.1
        while True:
            job = self._document(self._ask("GET", path, self._timeout_s))
            state = job.get("state")
            if state == "done":
                return job
            if state in ("failed", "cancelled"):
                problem = job.get("error") or {}
                reason = problem.get("detail") or f"the job was {state} on the server"
                raise Failure(reason, 1 if str(problem.get("status")).startswith("5") else 2)
            if wait_s is not None and time.monotonic() - began > wait_s:
                raise Failure(f"not done within {wait_s:.0f} s; given up", 1)
            waiting = job.get("queue_position")
            stage = f"waiting behind {waiting} jobs" if waiting else job.get("stage") or "waiting"
            self._tell(stage, job.get("progress"))
            time.sleep(pause_s)
            pause_s = min(1.5 * pause_s, self._LONGEST_PAUSE_S)

    def _fetch(self, path: str, job: Mapping[str, Any], target: Path) -> None:
        """Write the result of a job to a file, all of it and nothing else.

        A transfer that breaks off goes on where it did: results may have gigabytes.
        """
        expected, tag = job.get("result_bytes") or 0, ""

        def missing() -> dict[str, str]:
            begun = tag and 0 < file.tell() < expected
            return {"Range": f"bytes={file.tell()}-", "If-Range": tag} if begun else {}

        def save(answer: Any) -> bytes:
            nonlocal tag
            if answer.status != 206:
                file.seek(0)
                file.truncate()
                tag = answer.headers.get("ETag") or ""
            while chunk := _read(answer, 1 << 18):
                file.write(chunk)
                self._tell("fetching", min(file.tell() / max(expected, 1), 1.0))
            # What a proxy answers instead may well be whole: only the job knows the size.
            if not expected or file.tell() != expected:
                raise _Broken(f"{file.tell()} of {expected} bytes came", midway=bool(tag))
            return b""

        try:
            with target.open("wb") as file:
                self._ask("GET", f"{path}/result", self._timeout_s, take=save, more=missing)
        except OSError as error:  # of a full disk, which does not say where
            error.filename = str(target)
            raise

    def _report(self, path: str) -> bytes:
        """Return a report; empty, once `no_report` was told why, if there is none."""
        try:
            return self._ask("GET", path, self._timeout_s)
        except Failure as failure:
            self._no_report(str(failure))
            return b""

    def _forget(self, path: str) -> None:
        """Delete the job, unless it is gone, or the server: nobody wants it any more."""
        with contextlib.suppress(Failure, _Broken):
            self._open("DELETE", path, timeout_s=min(5.0, self._timeout_s)).close()

    def _ask(
        self,
        method: str,
        path: str,
        patience_s: float,
        body: _CountedFile | None = None,
        take: Callable[[Any], bytes] = lambda answer: _read(answer),
        more: Callable[[], Mapping[str, str]] = dict,
    ) -> bytes:
        """Return what is taken of the answer; what may pass by itself is tried for some time.

        `more` gives further headers of each try.
        """
        deadline, pause_s = time.monotonic() + patience_s, 0.2
        restarts_left = self._MAX_RESTARTS
        while True:
            began = time.monotonic()
            try:
                with self._open(method, path, body, more()) as answer:
                    return take(answer)
            except _Broken as error:
                broken = error
            # To send a large file may take all patience, before the server says that it is busy.
            is_long = broken.pause_s is not None and time.monotonic() - began > patience_s / 2
            if (broken.midway or is_long) and restarts_left:
                deadline = time.monotonic() + self._timeout_s
                restarts_left -= 1
            wait_s = max(pause_s, broken.pause_s or 0.0)
            if time.monotonic() + wait_s > deadline:
                raise Failure(self._given_up(broken), 1)
            state = "does not answer" if broken.pause_s is None else "is busy"
            self._tell(f"the server {state}; trying again", None)
            time.sleep(wait_s)
            pause_s = min(2 * pause_s, self._LONGEST_PAUSE_S)

    def _given_up(self, broken: _Broken) -> str:
        if broken.pause_s is not None:
            return f"{self._address} could not take the request: {broken}"
        return (
            f"no answer from {self._address}: {broken}; is the service running there "
            "(`stillpath serve`), and is the address right (--server)?"
        )

    def _open(
        self,
        method: str,
        path: str,
        body: _CountedFile | None = None,
        more: Mapping[str, str] = {},
        timeout_s: float | None = None,
    ) -> Any:
        """Return the open answer; raise `Failure` if it is no, `_Broken` if there is none."""
        headers = {**self._headers, **more}
        if body is not None:
            headers["Content-Type"] = "application/octet-stream"
            headers["Content-Length"] = str(body.size)
            headers["Idempotency-Key"] = body.key
            body.rewind()
        request = urllib.request.Request(
            self._address + path, data=body, headers=headers, method=method
        )
        try:
            return self._opener.open(request, timeout=timeout_s or self._timeout_s)
        except HTTPError as error:
            with error:
                problem = _problem(error)
                if error.code in self._BUSY:
                    reason = problem.get("detail") or f"{error.code} {error.reason}"
                    asked = error.headers.get("Retry-After") or ""
                    pause_s = float(asked) if asked.isascii() and asked.isdigit() else 0.0
                    raise _Broken(str(reason), pause_s=pause_s) from None
                raise self._refusal(error, problem) from None
        except (OSError, http.client.HTTPException) as error:
            # Not where all was sent, and the server only says nothing.
            broke_off = isinstance(error, (URLError, ConnectionError, http.client.HTTPException))
            midway = body is not None and body.is_begun and broke_off
            raise _Broken(str(getattr(error, "reason", "") or error), midway) from None

    def _document(self, answer: bytes) -> dict[str, Any]:
        """Return what a server says of a job; what is used of it must be of its kind."""
        document = _object(answer)
        said = {name: kind for name, kind in _JOB.items() if document.get(name) is not None}
        if "id" not in said or not all(isinstance(document[n], said[n]) for n in said):
            raise Failure(f"{self._address} answers, but not as a Stillpath server", 1)
        return document

    def _refusal(self, error: HTTPError, problem: Mapping[str, Any]) -> Failure:
        """Return the error for an answer of status 300 or above."""
        reason = problem.get("detail") or f"{self._address} answers {error.code} {error.reason}"
        if error.code == 401:
            reason = f"the server does not accept the key (401): {reason}"
        elif 300 <= error.code < 400:
            reason = f"{self._address} has moved to {error.headers.get('Location')}; name that"
        elif problem.get("title") == "No such job":
            reason = f"the job was cancelled on the server: {reason}"
        return Failure(reason, 2 if error.code < 500 else 1)


_JOB: dict[str, Any] = {
    "id": str,
    "state": str,
    "stage": str,
    "error": dict,
    "progress": (int, float),
    "source_bytes": int,
    "result_bytes": int,
    "queue_position": int,
}
"""What is used of a job, and its kinds."""


class _Broken(Exception):
    """There is no good answer, or not all of it: another try may bring it.

    `midway`: it broke off; `pause_s`: how long the server wants to be left alone, if it answered.
    """

    def __init__(self, reason: str, midway: bool = False, pause_s: float | None = None) -> None:
        super().__init__(reason)
        self.midway, self.pause_s = midway, pause_s


def _host_of(address: str) -> str:
    """Return the host of an address that a server may have, or an empty text."""
    try:
        parts = urlsplit(address)
        fits = parts.scheme in ("http", "https") and parts.port != 0 and parts.path.isascii()
    except ValueError:  # a port that is not a number, half an IPv6 address
        return ""
    return (parts.hostname or "") if fits and address.isprintable() and " " not in address else ""


def _read(answer: Any, size: int | None = None) -> bytes:
    try:
        return bytes(answer.read(size))
    except (OSError, http.client.HTTPException) as error:
        raise _Broken(str(error) or type(error).__name__, midway=True) from None


def _problem(error: HTTPError) -> dict[str, Any]:
    """Return the problem document (RFC 9457) of an answer, empty if there is none."""
    try:
        return _object(_read(error, 1 << 16))
    except _Broken:
        return {}


def _object(answer: bytes) -> dict[str, Any]:
    """Return a JSON object, empty for anything else."""
    with contextlib.suppress(ValueError, RecursionError):
        if isinstance(found := json.loads(answer), dict):
            return found
    return {}


class _EarlyAnswer(http.client.HTTPConnection):
    """Reads the answer even if the server does not take the whole request."""

    def send(self, data: Any) -> None:
        if self.sock is None:
            self.connect()
        with contextlib.suppress(ConnectionError):
            super().send(data)


class _EarlyAnswerTls(_EarlyAnswer, http.client.HTTPSConnection):
    pass


class _Web(
    urllib.request.HTTPHandler, urllib.request.HTTPSHandler, urllib.request.HTTPRedirectHandler
):
    def http_open(self, request: Any) -> Any:
        return self.do_open(_EarlyAnswer, request)

    def https_open(self, request: Any) -> Any:
        return self.do_open(_EarlyAnswerTls, request)

    def redirect_request(self, *_: Any) -> None:
        """Go nowhere else."""


class _CountedFile:
    """A file that tells which share of it has been read, and the key of its job."""

    def __init__(
        self, file: BinaryIO, size: int, tell: Callable[[float], object], key: str
    ) -> None:
        self._file, self.size, self._tell, self.key = file, size, tell, key

    @property
    def is_begun(self) -> bool:
        return self._file.tell() > 0

    def rewind(self) -> None:
        self._file.seek(0)

    def read(self, size: int = -1) -> bytes:
        self._tell(min(self._file.tell() / max(self.size, 1), 1.0))
        return self._file.read(size)


# End of the client.
