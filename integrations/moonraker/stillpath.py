"""Stillpath in Moonraker: what is uploaded is compensated by a server, as a second file.

A component of Moonraker 0.10 or later, linked into the folder of its components; set-up and
settings: docs/klipper.md. `part.gcode` becomes `part.sp.gcode` beside it; the upload itself is only
read. The work is done by a Stillpath server, to which `slicers/stillpath_post.py` takes a copy.

Moonraker is told of a G-code processor, so that it recognises finished files by their first lines
and names it in their metadata. It is one that never runs: Moonraker holds the answer to an upload
back until processors are done. Instead, files are taken when their metadata are there, one at a
time; those that wait are kept on disk and survive a restart.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import re
import shutil
import sys
from pathlib import Path
from typing import Any

IDENT = r"^; Processed by stillpath (?P<version>\S+)"
_SUFFIXES = (".gcode", ".gco", ".g")
_MARK = ".sp"
"""Before the suffix, which stays: files that differ in it only do not meet."""
_KEPT = 50
_PROGRESS = re.compile(r"stillpath-post: (?P<stage>.*?)(?: (?P<percent>\d+) %)?$")
_OPTIONS = (
    "method",
    "basis",
    "robust",
    "along",
    "tolerance_um",
    "budget_um",
    "where",
    "max_mb",
    "times",
)
_WAITING = ("queued", "running")
_IDLE = ("standby", "complete", "cancelled")
_BUSY = ("printing", "paused")
_STOP_S = 10.0
_WITHOUT_STREAM = ("none", "advise")
# Of 2026-04-27 to 2026-05-04: SHAPER_FREQ_X=0 does not switch the shaper off
# (klippy/extras/input_shaper.py, db10e92e9 to 77d5d942e).
_KEEPS_SHAPER = re.compile(r"v0\.13\.0-6(3[1-9]|4[01])-g")


class Refused(Exception):
    """A file is not taken, or came to nothing; the message is for the user."""


class Stillpath:
    """The component.

    Parameters
    ----------
    config : ConfigHelper
        The section ``[stillpath]`` of moonraker.conf.
    """

    def __init__(self, config: Any) -> None:
        self.server = config.get_server()
        self._files = self.server.lookup_component("file_manager")
        if not hasattr(self._files.get_metadata_storage(), "register_gcode_processor"):
            raise config.error(
                "[stillpath] needs Moonraker 0.10, or one of 2025-02-14 or later, and this one is "
                "older: update it, or let the slicer call Stillpath (docs/slicer-setup.md)"
            )
        self._address = config.get("server", "http://127.0.0.1:8000")
        self._machine = config.get("machine")
        self._key = config.load_template("key", "").render()
        self._options = {name: config.get(name, None) for name in _OPTIONS}
        self._auto = config.getboolean("auto", True)
        self._print_after = config.getboolean("print_after", False)
        self._wait_s = config.getfloat("wait", 14400.0, above=0.0)
        script = Path(__file__).resolve().parents[1] / "slicers" / "stillpath_post.py"
        self._script = Path(config.get("script", str(script))).expanduser()
        if not self._script.is_file():
            raise config.error(
                f"[stillpath] script: there is no file {self._script}; link this component from a "
                "copy of the whole repository, or name the file"
            )
        self._folder = Path(self.server.get_app_args()["data_path"]) / "stillpath"
        (self._folder / "reports").mkdir(parents=True, exist_ok=True)
        self._jobs: dict[str, dict[str, Any]] = {}
        self._wake = asyncio.Event()
        self._worker: asyncio.Task[None] | None = None
        self._process: asyncio.subprocess.Process | None = None
        self._taken = (0, 0)  # of the file that is worked on, when it was
        self._register()

    def _register(self) -> None:
        self._files.get_metadata_storage().register_gcode_processor(
            "stillpath",
            {
                "name": "stillpath",
                "command": [sys.executable, str(self._script), "{gcode_file_path}"],
                "timeout": 1.0,
                "ident": {"regex": IDENT, "location": "header"},
                "enabled": False,  # it is asked for `ident` all the same
            },
        )
        self._files.register_directory("stillpath", str(self._folder / "reports"))
        server = self.server
        server.register_event_handler("file_manager:metadata_processed", self._on_metadata)
        server.register_event_handler("job_state:state_changed", self._on_print)
        server.register_notification("stillpath:changed")
        server.register_endpoint("/server/stillpath/status", ["GET"], self._status)
        server.register_endpoint("/server/stillpath/process", ["POST"], self._asked_to_process)
        server.register_endpoint("/server/stillpath/cancel", ["POST"], self._asked_to_cancel)
        server.register_remote_method("stillpath_process", self._macro_process)
        server.register_remote_method("stillpath_cancel", self._macro_cancel)

    async def component_init(self) -> None:
        """Take up what was left, and begin to work."""
        for entry in self._left():
            with contextlib.suppress(Refused):  # deleted meanwhile
                job = self._enqueue(entry["file"], False, force=True)
                if entry.get("print_after"):
                    job["held"] = "Moonraker was restarted meanwhile"
        self._worker = asyncio.create_task(self._work())

    async def close(self) -> None:
        """Stop; what is not done is taken up at the next start."""
        if self._worker is not None:
            self._worker.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._worker

    # What comes in

    def _on_metadata(self, file: str) -> None:
        known = self._files.get_metadata_storage().get(file, None) or {}
        if not self._auto or "stillpath" in known.get("file_processors", ()):
            return
        with contextlib.suppress(Refused):  # no print file, or one of ours
            self._enqueue(file, self._print_after)

    def _on_print(self, _: Any, __: dict[str, Any], now: dict[str, Any]) -> None:
        if now.get("state") in _BUSY:
            for job in self._jobs.values():
                self._hold(job, "another print began meanwhile")

    async def _status(self, _: Any) -> dict[str, Any]:
        return {"server": self._address, "machine": self._machine, "jobs": self._listed()}

    async def _asked_to_process(self, request: Any) -> dict[str, Any]:
        return self._ask(
            request.get_str("filename"), request.get_boolean("print_after", self._print_after)
        )

    async def _asked_to_cancel(self, request: Any) -> dict[str, Any]:
        return await self._cancel(request.get_str("filename"))

    async def _macro_process(self, filename: str = "", print_after: Any = None) -> None:
        prints = self._print_after if print_after is None else str(print_after) in ("1", "True")
        with contextlib.suppress(self.server.error):  # the console has it
            self._ask(filename, prints)

    async def _macro_cancel(self, filename: str = "") -> None:
        with contextlib.suppress(self.server.error):
            await self._cancel(filename)

    def _ask(self, file: str, print_after: bool) -> dict[str, Any]:
        file = file.strip("/")  # one file, one job
        try:
            return dict(self._enqueue(file, print_after, force=True))
        except Refused as error:
            self._tell(f"{file}: {error}")
            raise self.server.error(str(error), 400) from None

    async def _cancel(self, file: str) -> dict[str, Any]:
        job = self._jobs.get(file.strip("/"))
        if job is None or job["state"] not in _WAITING:
            raise self.server.error(f"{file} is not being compensated", 404)
        running = job["state"] == "running"
        self._hold(job, "it was cancelled")
        self._change(job, "cancelled", reason="cancelled")
        if running:
            self._stop()
        return dict(job)

    def _enqueue(self, file: str, print_after: bool, force: bool = False) -> dict[str, Any]:
        source, result = self._paths(file)
        version = _state_of(source)
        known = self._jobs.get(file)
        if not force and known is not None and known["version"] == version:
            # Moonraker tells of a file some time after it came, and whenever it reads it again.
            raise Refused("it was asked for already")
        if known is not None and known["state"] in _WAITING:
            # It was uploaded again: what is made of the earlier one will not be kept.
            known["again"] = known["state"] == "running" and version != self._taken
            known["version"] = version
            if print_after and (force or not known["held"]):
                self._arm(known)
            elif not print_after:
                known.update(print_after=False, held="")
            self._save()
            return known
        if not force and result.is_file() and _state_of(result)[1] == version[1]:
            raise Refused(f"{result.name} was made of it")
        job = {
            "file": file,
            "version": version,
            "result": result.relative_to(self._root()).as_posix(),
            "print_after": False,
            "held": "",
            "stage": "",
            "progress": 0.0,
        }
        if print_after:
            self._arm(job)
        self._jobs.pop(file, None)  # to the end of the line
        self._jobs[file] = job
        self._change(job, "queued")
        self._wake.set()
        return job

    def _arm(self, job: dict[str, Any]) -> None:
        """Let the result be printed, if the printer is idle when that is asked for."""
        job.update(print_after=True, held="")
        state = self.server.lookup_component("job_state").get_last_stats().get("state")
        if state not in _IDLE:
            self._hold(job, f"the printer was {state or 'away'} when the file came")

    def _hold(self, job: dict[str, Any], why: str) -> None:
        """Do not print the result, if that was asked for: what lies on the bed nobody knows."""
        if job["print_after"] and job.get("state", "queued") in _WAITING:
            job.update(print_after=False, held=why)

    def _root(self) -> Path:
        return Path(self._files.get_directory("gcodes")).resolve()

    def _paths(self, file: str) -> tuple[Path, Path]:
        """Return the paths of a print file and of its result, or say why it is none.

        Links in gcodes are followed, as Moonraker follows them: to a memory stick, for instance.
        """
        source = self._root() / file.strip("/")
        try:
            if ".." in source.parts or not source.is_file():
                raise Refused("there is no such file in gcodes")
        except OSError as error:  # a name longer than any
            raise Refused(str(error)) from None
        if source.stem.lower().endswith(_MARK):
            raise Refused("it was compensated already; take the original")
        if source.suffix.lower() not in _SUFFIXES:
            raise Refused(f"its name does not end in {', '.join(_SUFFIXES)}")
        return source, source.with_name(source.stem + _MARK + source.suffix)

    # The work

    async def _work(self) -> None:
        while True:
            job = next((job for job in self._jobs.values() if job["state"] == "queued"), None)
            if job is None:
                self._wake.clear()
                await self._wake.wait()
                continue
            self._change(job, "running")
            try:
                await self._compensate(job)
                # A cancel that came when all was done comes too late.
                self._change(job, "done", progress=1.0)
                if not job.get("again"):
                    await self._after(job)
            except (Refused, OSError) as error:
                if job["state"] != "cancelled":
                    self._change(job, "failed", reason=str(error))
            except asyncio.CancelledError:
                raise
            except Exception as error:
                # A worker that ended would never do anything again, and say nothing.
                reason = f"a bug of Stillpath: {type(error).__name__}: {error}"
                self._change(job, "failed", reason=reason)
            if job.get("again") and job["state"] in ("failed", "done"):
                with contextlib.suppress(Refused):  # gone
                    self._enqueue(job["file"], job["print_after"], force=True)

    async def _compensate(self, job: dict[str, Any]) -> None:
        loop = asyncio.get_running_loop()
        source, result = self._paths(job["file"])
        self._taken = _state_of(source)
        await self._check_free(job["result"], result)
        work = self._folder / "work"
        copy = work / source.name
        try:
            await loop.run_in_executor(None, _copied, source, copy)
            await self._run(job, copy)
            if not await loop.run_in_executor(None, _is_stamped, copy):
                raise Refused("what came back is not marked as compensated; it was not kept")
            await self._check_free(job["result"], result)
            if job["state"] == "cancelled":
                raise Refused("cancelled")
            await loop.run_in_executor(None, _placed, copy, result, source, self._taken)
        finally:
            await loop.run_in_executor(None, lambda: shutil.rmtree(work, ignore_errors=True))

    async def _run(self, job: dict[str, Any], copy: Path) -> None:
        """Let stillpath_post.py send the copy and replace it by the result."""
        settings = copy.with_name("post.toml")
        settings.write_text("")  # not those of a user who slices on this computer
        command = [
            sys.executable, str(self._script), "--server", self._address, "--machine",
            self._machine, "--config", str(settings), "--wait", f"{self._wait_s:g}",
        ]  # fmt: skip
        for name, value in self._options.items():
            if value is not None:
                command += [f"--{name.replace('_', '-')}", value]
        environment = {k: v for k, v in os.environ.items() if not k.startswith("SLIC3R_")}
        environment["STILLPATH_KEY"] = self._key  # not where `ps` shows it
        environment["TMPDIR"] = str(copy.parent)  # /tmp may be memory, which a print needs
        process = await asyncio.create_subprocess_exec(
            *command,
            str(copy),
            env=environment,
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
        )
        assert process.stdout is not None
        assert process.stderr is not None
        self._process = process
        try:
            if job["state"] == "cancelled":
                self._stop()
            said = asyncio.ensure_future(process.stderr.read())
            async for line in process.stdout:
                self._progressed(job, line.decode(errors="replace").strip())
            reason = (await said).decode(errors="replace").strip()
            code = await process.wait()
        finally:
            await self._ended(process)
            self._process = None
        if code != 0:
            last = reason.splitlines()[-1] if reason else f"stillpath_post.py ended with {code}"
            raise Refused(last.replace("stillpath-post: ", "", 1))
        report = copy.with_name(f"{copy.stem}.stillpath.html")
        if report.is_file():
            # In the folder of the file: others may have the same name.
            own = report.name if copy.suffix == ".gcode" else f"{copy.name}.stillpath.html"
            name = Path(job["result"]).parent / own
            kept = self._folder / "reports" / name
            kept.parent.mkdir(parents=True, exist_ok=True)
            shutil.move(str(report), str(kept))
            job["report"] = f"stillpath/{name.as_posix()}"

    def _stop(self) -> None:
        if self._process is not None and self._process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                self._process.terminate()

    @staticmethod
    async def _ended(process: asyncio.subprocess.Process) -> None:
        """See to it that the process ends: it cancels its job on the server."""
        if process.returncode is not None:
            return
        with contextlib.suppress(ProcessLookupError):
            process.terminate()
        try:
            await asyncio.wait_for(process.wait(), _STOP_S)
        except asyncio.TimeoutError:  # noqa: UP041 - another one before Python 3.11
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            await process.wait()

    async def _print_state(self) -> dict[str, Any]:
        apis = self.server.lookup_component("klippy_apis")
        found = await apis.query_objects({"print_stats": ["state", "filename"]}, default={})
        return dict(found.get("print_stats", {}))

    async def _keeps_shaper(self) -> str:
        """Return the version of a Klipper whose shaper stays on in compensated stretches, or ''."""
        apis = self.server.lookup_component("klippy_apis")
        version = str((await apis.get_klippy_info(default={})).get("software_version", ""))
        if self._options["method"] in _WITHOUT_STREAM or not _KEEPS_SHAPER.match(version):
            return ""
        found = await apis.query_objects({"configfile": ["settings"]}, default={})
        shaper = found.get("configfile", {}).get("settings", {}).get("input_shaper", {})
        return version if shaper.get("shaper_freq_x") or shaper.get("shaper_freq_y") else ""

    async def _check_free(self, name: str, result: Path) -> None:
        now = await self._print_state()
        if now.get("state") in _BUSY and now.get("filename") == name:
            raise Refused(f"{name} is being printed; compensate again after the print")
        if result.exists() and not _is_stamped(result):
            raise Refused(f"{name} already exists and was not made by Stillpath; rename it")

    async def _after(self, job: dict[str, Any]) -> None:
        """Print the result if that is wanted and the printer is idle."""
        if job["held"]:
            self._tell(f"{job['result']} was not started: {job['held']}")
        if version := await self._keeps_shaper():
            self._tell(
                f"do not print {job['result']} yet: Klipper {version} keeps its shaper on in "
                "compensated stretches, on top of the compensation; update Klipper"
            )
            return
        if not job["print_after"]:
            return
        state = (await self._print_state()).get("state")
        if state not in _IDLE:
            self._tell(f"{job['result']} was not started: the printer is {state or 'away'}")
            return
        try:
            await self.server.lookup_component("klippy_apis").start_print(job["result"])
        except self.server.error as error:
            self._tell(f"{job['result']} was not started: {error}")

    # What goes out

    def _progressed(self, job: dict[str, Any], line: str) -> None:
        found = _PROGRESS.match(line)
        if found is not None and found["percent"] is not None and job["state"] == "running":
            job.update(stage=found["stage"], progress=int(found["percent"]) / 100)
            self.server.send_event("stillpath:changed", dict(job))

    def _change(self, job: dict[str, Any], state: str, **more: Any) -> None:
        job.update(state=state, **more)
        over = [file for file, other in self._jobs.items() if other["state"] not in _WAITING]
        for file in over[:-_KEPT]:
            del self._jobs[file]
        self._save()
        self.server.send_event("stillpath:changed", dict(job))
        told = {
            "running": "is being compensated",
            "done": f"is compensated: {job['result']}",
            "failed": f"was NOT compensated: {job.get('reason')}",
            "cancelled": "was not compensated: cancelled",
        }.get(state)
        if told is not None:
            self._tell(f"{job['file']} {told}")

    def _tell(self, text: str) -> None:
        """Write to the console of Mainsail, Fluidd and the like."""
        self.server.send_event("server:gcode_response", f"// Stillpath: {text}")

    def _listed(self) -> list[dict[str, Any]]:
        return [dict(job) for job in self._jobs.values()]

    def _save(self) -> None:
        waiting = [
            {"file": job["file"], "print_after": job["print_after"]}
            for job in self._jobs.values()
            if job["state"] in _WAITING
        ]
        part = self._folder / "queue.json.part"
        try:
            part.write_text(json.dumps(waiting, indent=1), encoding="utf-8")
            part.replace(self._folder / "queue.json")
        except OSError as error:  # no reason not to work
            self._tell(f"a restart will forget the files that wait: {error}")

    def _left(self) -> list[dict[str, Any]]:
        try:
            found = json.loads((self._folder / "queue.json").read_text(encoding="utf-8"))
            return [entry for entry in found if isinstance(entry["file"], str)]
        except (OSError, ValueError, KeyError, TypeError):
            return []


def load_component(config: Any) -> Stillpath:
    """Return the component; Moonraker calls it."""
    return Stillpath(config)


def _state_of(file: Path) -> tuple[int, int]:
    """Return size and time of a file, which tell whether it is changed later."""
    try:
        found = file.stat()
    except FileNotFoundError:
        return 0, 0
    return found.st_size, found.st_mtime_ns


def _copied(source: Path, copy: Path) -> None:
    copy.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, copy)


def _is_stamped(file: Path) -> bool:
    with file.open("rb") as text:
        head = text.read(1 << 20).decode(errors="ignore")
    return re.search(IDENT, head, re.MULTILINE) is not None


def _placed(made: Path, result: Path, source: Path, taken: tuple[int, int]) -> None:
    """Put a file in its place, whole or not at all; Moonraker sees it by its last name only.

    Its time becomes that of the original. So it tells what it was made of, also where files are
    copied with their times or the computer's clock jumps.
    """
    part = result.with_name(f".{result.name[:40]}.part")
    try:
        shutil.copyfile(made, part)
        with part.open("rb+") as file:
            os.fsync(file.fileno())
        os.utime(part, ns=(taken[1], taken[1]))
        # At the last moment: copying to a slow card takes its time.
        if _state_of(source) != taken:
            raise Refused(
                "it was changed, moved or deleted while it was processed; the result was not kept"
            )
        part.replace(result)
    except BaseException:
        with contextlib.suppress(OSError):
            part.unlink()
        raise
