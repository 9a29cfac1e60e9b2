#!/usr/bin/env python3
"""Stillpath as a post-processing script of PrusaSlicer, SuperSlicer, OrcaSlicer and BambuStudio.

The slicer appends the path of the sliced file, and the file is changed in place::

    stillpath-post [options] FILE                      on this computer (with the package stillpath)
    python3 stillpath_post.py --server URL [options] FILE             on a server (this file alone)

This file needs Python 3.8 or later and nothing else. A failure is one line on stderr and an exit
code that is not 0, and the file is as it was. Set-up: docs/slicer-setup.md.

Exit codes: 0 done, 1 the computer, the network or the server failed, 2 it cannot be done as it was
put (bad file, machine, option or key), 128 + n ended by signal n.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import http.client
import json
import os
import re
import shlex
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
import time
import traceback
import urllib.request
import uuid
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.error import HTTPError, URLError
from urllib.parse import quote, urlencode, urlsplit

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from typing import BinaryIO, NoReturn, TextIO

PROGRAM = "stillpath-post"
_OPTIONS = (
    *("method", "basis", "robust", "along", "tolerance_um", "budget_um"),
    *("where", "max_mb", "times", "plate"),
)
_SETTINGS = ("server", "key", "machine", "method", "reports", "log", "on_error", "timeout", "wait")
# What slicers call a printer, the most particular name first.
_PRINTER_NAMES = ("PHYSICAL_PRINTER_SETTINGS_ID", "PRINTER_SETTINGS_ID", "PRINTER_MODEL")
_SUFFIXES = (".gcode.3mf", ".gcode", ".bgcode", ".gco", ".g")
_FOLDER = "stillpath-post-"
_PART = ".stillpath.part"
# Nobody waits for a file that long, and copying one takes seconds.
_FOLDER_LEFT_S, _PART_LEFT_S = 7 * 86400.0, 3600.0
# Windows lets nobody rename a file that a virus scanner reads, which lasts for moments.
_WAITS_S = (0.1, 0.2, 0.5, 1.0, 2.0) if os.name == "nt" else ()
_SHOWN_EVERY_S, _SAID_EVERY_S = 0.1, 5.0  # on a terminal, elsewhere


class Stopped(BaseException):
    """A signal asked for the end; no `Exception`, so that nobody handles it on the way out."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.code = 128 + number


def main(arguments: Sequence[str] | None = None) -> int:
    """Process one file and return the exit code."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # a program without a console has no streams
            stream.reconfigure(errors="backslashreplace")
    parser = _parser()
    given = parser.parse_args(arguments)
    if given.file is None and not given.setup:
        parser.error("no FILE is given; slicers append it")
    voice = Voice(_path(given.log))
    try:
        with Signals() as signals:
            settings = Settings(given)
            voice.log = settings.log
            if given.setup:
                _set_up(settings, voice)
            else:
                _process(settings, voice, signals)
        return 0
    except Failure as failure:
        reason, code = str(failure), failure.code
    except OSError as error:
        reason, code = _of_system(error), 1
    except MemoryError:
        reason, code = "out of memory", 1
    except (Stopped, KeyboardInterrupt) as stop:
        voice.fail("interrupted; the file is as it was")
        return stop.code if isinstance(stop, Stopped) else 130
    except Exception as error:
        reason, code = f"a bug of Stillpath: {type(error).__name__}: {error}", 1
        voice.trace(traceback.format_exc())
    if given.on_error == "keep":
        voice.fail(f"NOT compensated, the file stays as sliced: {reason}")
        return 0
    voice.fail(reason)
    return code


def _process(settings: Settings, voice: Voice, signals: Signals) -> None:
    """Compensate the file in place and put the report where it belongs."""
    began = time.monotonic()
    path = settings.file.absolute()
    if not path.is_file():
        raise Failure(f"{path} is a folder" if path.is_dir() else f"there is no file {path}")
    # A link is followed, so that what it points to is replaced and not the link.
    path = path.resolve()
    if not path.stat().st_size:
        raise Failure(f"{path} is empty")
    job = PrintJob(settings.file, settings.printer)
    machine = settings.machine_for(job.printers)
    voice.note(
        f"{job.name} for {machine} (printer {(job.printers or ['not named'])[0]}, "
        f"flavour {job.flavour or 'not named'}, to {job.host})"
    )
    options = {**settings.job_options, "machine": machine, "name": job.name}
    if settings.server:
        page = _on_server(path, options, settings, voice)
    else:
        page = _here(path, options, voice, signals)
    # The file is replaced: from here on nothing fails.
    voice.note(f"{job.name} compensated in {time.monotonic() - began:.1f} s")
    if settings.report and page:
        _write_report(page, job, settings, voice)


def _here(
    path: Path, options: dict[str, Any], voice: Voice, signals: Signals
) -> Callable[[], bytes]:
    """Compensate on this computer, and return what makes the report; heavy imports begin here."""
    try:
        from stillpath.cli import post
    except ImportError:
        raise Failure(
            "the package stillpath is not installed for this Python; install it, or name a "
            f"server: --server URL ({sys.executable})"
        ) from None
    signals.deferred = True  # what a handler raises inside a compiler or a C library gets lost

    name = options.pop("name")

    def tell(stage: str, share: float | None) -> None:
        signals.check()
        voice.progress(stage, share)

    try:
        page = post.compensate_in_place(path, options, name=name, tell=tell)
    except post.Refused as error:
        raise Failure(error) from None
    finally:
        signals.deferred = False
    return lambda: page().encode()


def _on_server(
    path: Path, options: dict[str, Any], settings: Settings, voice: Voice
) -> Callable[[], bytes] | None:
    """Let a server compensate, replace the file, and return what gives the report, if there is."""
    before = path.stat()
    client = Service(
        settings.server,
        settings.key,
        settings.timeout,
        voice.progress,
        lambda reason: voice.fail(f"warning: no report: {reason}"),
    )
    # Fetch into a temporary folder first: a run that is killed meanwhile leaves nothing beside the
    # file.
    _delete_leftovers(Path(tempfile.gettempdir()), f"{_FOLDER}*", _FOLDER_LEFT_S)
    with tempfile.TemporaryDirectory(prefix=_FOLDER) as folder:
        fetched = Path(folder) / "result"
        page = client.compensate(path, fetched, options, settings.wait, settings.report)
        with replacing(path) as temporary:
            shutil.copyfile(str(fetched), str(temporary))
            now = path.stat()
            if (now.st_size, now.st_mtime_ns) != (before.st_size, before.st_mtime_ns):
                raise Failure(f"{path} was changed by somebody else while it was processed", 1)
    return (lambda: page) if page else None


def _delete_leftovers(folder: Path, pattern: str, left_s: float) -> None:
    """Delete what runs that were killed have left: temporary folders, and files beside prints."""
    for left in folder.glob(pattern):
        with contextlib.suppress(OSError):
            if time.time() - left.lstat().st_mtime > left_s:
                if left.is_dir():
                    shutil.rmtree(str(left))
                else:
                    left.unlink()


def _write_report(
    page: Callable[[], bytes], job: PrintJob, settings: Settings, voice: Voice
) -> None:
    """Write the report, or say why there is none: the print is right all the same."""
    folder = job.folder or settings.reports
    target = folder / f"{job.stem}.stillpath.html"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with replacing(target) as temporary:
            temporary.write_bytes(page())
        voice.note(f"report: {target}")
    except OSError as error:
        voice.fail(f"warning: no report: {_of_system(error)}")
    except (Stopped, KeyboardInterrupt):
        voice.fail("warning: no report: interrupted; the file is compensated")
    except Exception as error:
        voice.fail(f"warning: no report: a bug of Stillpath: {type(error).__name__}: {error}")
        voice.trace(traceback.format_exc())


@contextlib.contextmanager
def replacing(target: Path) -> Iterator[Path]:
    """Yield a temporary file beside `target` that takes its place when the block ends well."""
    prefix = f".{target.name[:40]}."  # a name may be as long as names can be
    _delete_leftovers(target.parent, f".*{_PART}", _PART_LEFT_S)
    handle, name = tempfile.mkstemp(prefix=prefix, suffix=_PART, dir=target.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        with contextlib.suppress(OSError):  # file systems of memory cards know no modes
            temporary.chmod(stat.S_IMODE(target.stat().st_mode) if target.exists() else 0o644)
        _put(temporary, target)
    except BaseException as error:
        with contextlib.suppress(OSError):
            temporary.unlink()
        if isinstance(error, OSError) and error.errno == errno.ENOSPC:
            error.filename = str(target)  # copying names the file that it reads
        raise


def _put(temporary: Path, target: Path) -> None:
    for wait_s in _WAITS_S:
        with contextlib.suppress(PermissionError):
            temporary.replace(target)
            return
        time.sleep(wait_s)
    temporary.replace(target)


class PrintJob:
    """What the slicer says of this file, in the environment and by its path.

    `SLIC3R_PP_OUTPUT_NAME` is the path of the finished file if `SLIC3R_PP_HOST` is ``File``, else
    its name on that host. A script that ran before may have left another name in
    ``FILE.output_name``; that file is read and left alone.
    """

    def __init__(
        self, file: Path, printer: str | None = None, environment: Mapping[str, str] = os.environ
    ) -> None:
        said = (_unquoted(environment.get(f"SLIC3R_{name}", "")) for name in _PRINTER_NAMES)
        self.printers = [printer] if printer else [name for name in said if name]
        self.flavour = environment.get("SLIC3R_GCODE_FLAVOR", "")
        self.host = environment.get("SLIC3R_PP_HOST", "File")
        output = Path(environment.get("SLIC3R_PP_OUTPUT_NAME") or file)
        renamed = _first_line(file.with_name(file.name + ".output_name"))
        if renamed:
            output = output.parent / renamed
        # BambuStudio names its own temporary file as the output; such names begin with a dot.
        output = Path(os.path.abspath(str(output)))  # noqa: PTH100 - resolve() follows links
        local = self.host == "File" and not output.name.startswith(".") and output.parent.is_dir()
        self.folder = output.parent if local else None
        name = output.name[: -len(".pp")] if output.name.endswith(".pp") else output.name
        name = name.lstrip(".") or "print.gcode"
        ending = next((end for end in _SUFFIXES if name.lower().endswith(end)), "")
        self.stem = name[: len(name) - len(ending)] or "print"
        self.name = name.encode("utf-8", "replace").decode()  # file systems know more than text


class Settings:
    """Options of the command line, then those of the settings file, then defaults."""

    def __init__(self, given: argparse.Namespace) -> None:
        self.path = Path(given.config) if given.config else default_settings_path()
        if given.config and not self.path.is_file() and not given.setup:
            raise Failure(f"there is no settings file {self.path}")
        read = read_settings(self.path) if self.path.is_file() else {}
        # First: it counts for whatever else is wrong with them.
        given.on_error = given.on_error or read.get("on_error", "fail")
        _check_settings(read, self.path)
        if given.on_error not in ("fail", "keep"):
            raise Failure(f"{self.path}: on_error is 'fail' or 'keep', not {given.on_error!r}")
        self.machines: dict[str, str] = read.pop("machines", {})
        self._machine, self._fallback = given.machine, read.pop("machine", None)
        self.file = Path(given.file or "")
        self.printer = given.printer
        self.server: str = "" if given.local else given.server or read.get("server", "")
        self.key: str = given.key or os.environ.get("STILLPATH_KEY", "") or read.get("key", "")
        self.timeout = _seconds("timeout", given.timeout, read.get("timeout")) or 60.0
        self.wait = _seconds("wait", given.wait, read.get("wait"))
        self.log = _path(given.log or read.get("log"))
        data = _user_dir("LOCALAPPDATA", "XDG_DATA_HOME", ".local/share")
        self.reports = _path(given.reports or read.get("reports")) or data / "stillpath" / "reports"
        self.report = not given.no_report
        chosen = {name: getattr(given, name) for name in _OPTIONS}
        chosen["method"] = chosen["method"] or read.get("method")
        self.job_options = {name: value for name, value in chosen.items() if value is not None}

    def machine_for(self, printers: Sequence[str]) -> str:
        """Return the machine for the slicer's names of the printer, the most particular first."""
        if self._machine:
            return str(self._machine)
        for printer in printers:
            if printer in self.machines:
                return self.machines[printer]
        for printer in printers:
            for pattern, machine in self.machines.items():
                words = (re.escape(part) for part in pattern.split("*"))
                if re.fullmatch(".*".join(words), printer, re.IGNORECASE | re.DOTALL):
                    return machine
        if self._fallback:
            return str(self._fallback)
        name = json.dumps(printers[0] if printers else "name of the printer", ensure_ascii=False)
        called = name if printers else "(the slicer does not name it)"
        raise Failure(
            f"no machine is set for the printer {called}: say --machine NAME, or write "
            f'{name} = "NAME" under [machines] in {self.path}'
        )


TEMPLATE = """\
# Settings of stillpath-post. What is said on the command line counts more.

# server = "http://127.0.0.1:8000"   # work there instead of on this computer
# key = "..."                        # its key; never in the slicer, which writes it into every file
# machine = "ender3"                 # for printers that are not listed below
# on_error = "keep"                  # print what was sliced if it fails ("fail": stop the export)
# reports = "~/stillpath-reports"    # reports of files that are sent to a printer
# log = "~/stillpath-post.log"       # Windows shows nobody what went wrong: it stands here

# What the slicer calls the printer, and the machine of Stillpath; * stands for anything.
[machines]
# "Creality Ender-3 *" = "mine"
# "Voron 2.4 250" = "voron-v24-250"
"""


def read_settings(path: Path) -> dict[str, Any]:
    """Return the settings of a TOML file, or raise `Failure` naming the line that is wrong.

    Before Python 3.11 there is no reader of TOML: then lines ``name = value`` with strings, numbers
    and ``[machines]`` are understood, as the template has them.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise Failure(f"{path} is not in UTF-8") from None
    try:
        import tomllib

        read = tomllib.loads(text)
    except ImportError:
        read = _plain_toml(text, path)
    except ValueError as error:
        raise Failure(f"{path}: {error}") from None
    return {name.replace("-", "_"): value for name, value in read.items()}


def _check_settings(read: Mapping[str, Any], path: Path) -> None:
    for name, value in read.items():
        if name == "machines":
            if not isinstance(value, dict) or not all(isinstance(v, str) for v in value.values()):
                raise Failure(f'{path}: [machines] holds lines "PRINTER" = "MACHINE"')
        elif name not in _SETTINGS:
            raise Failure(f"{path}: there is no setting {name!r}, but {', '.join(_SETTINGS)}")
        elif not isinstance(value, (int, float) if name in ("timeout", "wait") else str):
            raise Failure(f"{path}: {name} = {value!r} is of the wrong type")


_TOML_LINE = re.compile(
    r"""\s*(?:\[\s*(?P<table>\w+)\s*\]
    |(?P<name>[\w-]+|"(?:[^"\\]|\\.)*"|'[^']*')\s*=\s*
     (?P<value>"(?:[^"\\]|\\.)*"|'[^']*'|[+-]?\d+(?:\.\d+)?))?\s*(?:\#.*)?""",
    re.VERBOSE,
)


def _plain_toml(text: str, path: Path) -> dict[str, Any]:
    read: dict[str, Any] = {}
    table = read
    for number, line in enumerate(text.splitlines(), 1):
        try:
            found = _TOML_LINE.fullmatch(line)
            if found is None:
                raise ValueError(line)
            if found["table"]:
                table = read.setdefault(found["table"], {})
            elif found["name"]:
                name = found["name"]
                table[_toml_value(name) if name[0] in "\"'" else name] = _toml_value(found["value"])
        except (ValueError, TypeError):  # TypeError: what is meant as a table has a value already
            raise Failure(
                f"{path}, line {number}: cannot be read: {line.strip()[:80]} "
                "(write paths in single quotes)"
            ) from None
    return read


def _toml_value(text: str) -> Any:
    return text[1:-1] if text[0] == "'" else json.loads(text.lstrip("+"))


def default_settings_path(environment: Mapping[str, str] = os.environ) -> Path:
    """Return where the settings lie: the user's folder for settings, by platform."""
    if environment.get("STILLPATH_POST_CONFIG"):
        return Path(environment["STILLPATH_POST_CONFIG"])
    return _user_dir("APPDATA", "XDG_CONFIG_HOME", ".config") / "stillpath" / "post.toml"


def _user_dir(windows: str, xdg: str, fallback: str) -> Path:
    if sys.platform == "win32":
        return Path(os.environ.get(windows) or _home() / "AppData" / "Local")
    if sys.platform == "darwin":
        return _home() / "Library" / "Application Support"
    return Path(os.environ.get(xdg) or _home() / fallback)


def _home() -> Path:
    home = Path(os.path.expanduser("~"))  # noqa: PTH111 - as in `_path`
    if not home.is_absolute():
        raise Failure("this user has no home folder; set HOME to one")
    return home


def _set_up(settings: Settings, voice: Voice) -> None:
    """Make the settings file if there is none, and say what to paste into the slicer."""
    if not settings.path.exists():
        settings.path.parent.mkdir(parents=True, exist_ok=True)
        settings.path.touch(mode=0o600)  # it may come to hold a key
        settings.path.write_text(TEMPLATE, encoding="utf-8")
    program = Path(sys.argv[0]).absolute()
    windows = sys.platform == "win32"
    if program.suffix == ".py":
        command = [sys.executable, str(program)]
    else:  # the launcher that pip makes leaves the .exe out
        command = [str(program.with_suffix(".exe") if windows else program)]
    line = subprocess.list2cmdline(command) if windows else " ".join(map(shlex.quote, command))
    voice.out(f"settings: {settings.path}")
    voice.out(f"line for the slicer's field of post-processing scripts:\n  {line}")


class Voice:
    """Says how the work goes.

    Progress is one line that changes on a terminal, else a line now and then on stdout: slicers
    show stderr as the reason of a failure, so only that stands there.
    """

    def __init__(self, log: Path | None = None) -> None:
        self.log = log
        """File that everything but progress is appended to."""
        self._terminal = sys.stderr is not None and sys.stderr.isatty()
        self._every_s = _SHOWN_EVERY_S if self._terminal else _SAID_EVERY_S
        self._said_at = time.monotonic()
        self._line = False

    def progress(self, stage: str, share: float | None = None) -> None:
        """Say what is being done, and which share of it is."""
        now = time.monotonic()
        if now - self._said_at < self._every_s:
            return
        self._said_at = now
        text = stage if share is None else f"{stage} {100 * share:.0f} %"
        if self._terminal:
            self._line = True
            self._write(sys.stderr, f"\r{PROGRAM}: {text:<60}")
        else:
            self.out(f"{PROGRAM}: {text}")

    def note(self, text: str) -> None:
        """Say what the user may want to know."""
        self._say(sys.stdout, text)

    def fail(self, text: str) -> None:
        """Say what went wrong."""
        self._say(sys.stderr, text)

    def out(self, text: str) -> None:
        """Write one line to stdout."""
        self._write(sys.stdout, f"{text}\n")

    def trace(self, text: str) -> None:
        """Keep what only a programmer understands."""
        if self.log is None:
            self._write(sys.stderr, text)
        self._append(text)

    def _say(self, stream: TextIO | None, text: str) -> None:
        if self._line:
            self._write(sys.stderr, "\r" + 80 * " " + "\r")
            self._line = False
        self._write(stream, f"{PROGRAM}: {text}\n")
        self._append(text)

    def _append(self, text: str) -> None:
        if self.log is None:
            return
        try:
            with self.log.open("a", encoding="utf-8", errors="backslashreplace") as file:
                file.write(f"{time.strftime('%Y-%m-%d %H:%M:%S')} {text}\n")
        except OSError as error:
            self.log = None
            self._write(sys.stderr, f"{PROGRAM}: warning: no log: {_of_system(error)}\n")

    @staticmethod
    def _write(stream: TextIO | None, text: str) -> None:
        with contextlib.suppress(OSError, ValueError):  # nobody listens any more
            if stream is not None:
                stream.write(text)
                stream.flush()


class Signals:
    """Turns signals that ask for the end into `Stopped`, at once or, `deferred`, at `check`."""

    def __init__(self) -> None:
        self.deferred = False
        self._received = 0
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Signals:
        for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK"):
            number = getattr(signal, name, None)
            if number is not None and signal.getsignal(number) != signal.SIG_IGN:
                self._before[number] = signal.signal(number, self._on)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def check(self) -> None:
        """Raise `Stopped` if a signal came."""
        if self._received:
            raise Stopped(self._received)

    def _on(self, number: int, _: object) -> None:
        if self.deferred and not self._received:
            self._received = number
        else:
            raise Stopped(number)


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


def _parser() -> _Parser:
    parser = _Parser(
        prog=PROGRAM,
        description="Compensate a sliced file in place, as a post-processing script of a slicer.",
        epilog="Set-up of each slicer: docs/slicer-setup.md",
        allow_abbrev=False,
    )
    add = parser.add_argument
    add("file", metavar="FILE", nargs="?", help="the sliced file; slicers append it")
    add("--machine", "-m", metavar="M", help="machine; else by the slicer's printer name")
    add("--printer", metavar="NAME", help="the printer's name, if the slicer does not tell it")
    add("--server", metavar="URL", help="work on this server instead of on this computer")
    add("--local", action="store_true", help="on this computer, even if the settings name a server")
    add("--key", metavar="KEY", help="key of the server; better in the settings or STILLPATH_KEY")
    add("--method", metavar="M", help="as of `stillpath compensate`, and so the next nine")
    add("--basis", metavar="B")
    add("--robust", metavar="R")
    add("--along", metavar="W", type=float)
    for name in ("--tolerance-um", "--budget-um"):
        add(name, metavar="UM", type=float)
    add("--where", choices=("all", "visible", "walls"), help="what is compensated")
    add("--max-mb", metavar="MB", type=float)
    add("--times", choices=("new", "kept"), help="kept: the slicer's times stay in the file")
    add("--plate", metavar="N", type=int)
    add("--on-error", choices=("fail", "keep"), help="keep: print what was sliced, exit code 0")
    add("--reports", metavar="DIR", help="for reports of files that do not stay on this computer")
    add("--no-report", action="store_true", help="write no report")
    add("--log", metavar="FILE", help="append what happens to this file")
    add("--timeout", metavar="S", type=float, help="patience with a silent server [60]")
    add("--wait", metavar="S", type=float, help="give a job on a server up after this time")
    add("--config", metavar="FILE", help="settings [yours: --setup says where they are]")
    add("--setup", action="store_true", help="make the settings; show the line for the slicer")
    return parser


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        Voice().fail(f"{message} (--help lists the options)")
        raise SystemExit(2)


def _seconds(name: str, *given: float | None) -> float | None:
    """Return the first duration that was given."""
    value = next((value for value in given if value is not None), None)
    if value is not None and not 0 < value < 1e7:
        raise Failure(f"{name} is {value:g} s; give more than 0 and less than 10000000 s")
    return value


def _path(text: str | None) -> Path | None:
    # `Path.expanduser` raises where there is no such user, before anybody would hear of it.
    return Path(os.path.expanduser(text)) if text else None  # noqa: PTH111


def _first_line(path: Path) -> str:
    with contextlib.suppress(OSError), path.open(encoding="utf-8", errors="surrogateescape") as f:
        return f.readline().strip()
    return ""


def _unquoted(text: str) -> str:
    """Return the first value of a setting as slicers write it: in lists they may be quoted."""
    text = text.strip()
    inside = re.match(r'"((?:[^"\\]|\\.)*)"', text)
    return re.sub(r"\\(.)", r"\1", inside[1]) if inside else text


def _of_system(error: OSError) -> str:
    place = f"{error.filename}: " if error.filename else ""
    remedy = "; make room there" if error.errno == errno.ENOSPC else ""
    return f"{place}{error.strerror or error}{remedy}"


if __name__ == "__main__":
    sys.exit(main())
