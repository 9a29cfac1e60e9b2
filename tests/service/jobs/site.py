"""A service without HTTP: its database and storage, and processes that do its work."""

from __future__ import annotations

import contextlib
import hashlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil

from stillpath.applications.machines.resolve import PinnedMachine
from stillpath.service.database.engine import open_database
from stillpath.service.database.errors import DatabaseAway
from stillpath.service.jobs.state import Cancelled, Job, JobState
from stillpath.service.jobs.store import JobStore
from stillpath.service.jobs.sweep import sweep_files
from stillpath.service.settings import Settings
from stillpath.service.storage.factory import open_storage
from tests.checkout import PYTHONPATH
from tests.service.database.examples import make_job

__all__ = ["ROOT", "STILLPATH", "Process", "Site", "until"]

ROOT = Path(__file__).resolve().parents[3]
STILLPATH = [sys.executable, "-c", "from stillpath.cli.main import main; main()"]
WORK = [sys.executable, str(Path(__file__).with_name("work_process.py"))]
PATIENCE_S = 600.0


class Site:
    """What the processes share, as a test sees it.

    Parameters
    ----------
    data_dir : Path
    **environment : str
        Settings (``database_url=...``) for all processes.
    """

    def __init__(self, data_dir: Path, **settings: str) -> None:
        data_dir.mkdir(parents=True, exist_ok=True)
        self.data_dir = data_dir
        self.settings = Settings(data_dir=data_dir, **settings)  # type: ignore[arg-type]
        self.environment = {
            "STILLPATH_DATA_DIR": str(data_dir),
            "PYTHONPATH": PYTHONPATH,
            **{f"STILLPATH_{name.upper()}": str(value) for name, value in settings.items()},
        }
        self.engine = open_database(self.settings)
        self.store = JobStore(self.engine)
        self.storage = open_storage(self.settings)

    def close(self) -> None:
        self.engine.dispose()

    def submit(self, text: str, machine: PinnedMachine | None = None, **fields: Any) -> str:
        """Do what the API does: the files first, then the row."""
        content = text.encode()
        given = {
            "created_at": time.time(),
            "source_name": "part.gcode",
            "source_bytes": len(content),
            "source_sha256": hashlib.sha256(content).hexdigest(),
        }
        job = make_job(**(given | fields))
        upload = self.data_dir / f"upload-{job.id}"
        upload.write_bytes(content)
        self.storage.put(f"jobs/{job.id}/source/part.gcode", upload)
        if machine is not None:
            pinned = self.data_dir / f"machine-{job.id}"
            machine.write(pinned)
            self.storage.put(job.machine_file, pinned)
        self.store.add(job)
        return job.id

    def cancel(self, job_id: str) -> Job | None:
        return self.store.apply(job_id, Cancelled(time.time()))

    def get(self, job_id: str) -> Job:
        job = self.store.get(job_id)
        assert job is not None
        return job

    def running(self, job_id: str) -> Job:
        """Wait until a job runs."""

        def ask() -> Job | None:
            job = self.get(job_id)
            assert not job.state.is_final, job
            return job if job.state is JobState.RUNNING else None

        return until(ask)

    def ended(self, job_id: str, seconds: float = PATIENCE_S) -> Job:
        """Wait until a job is over, whatever the database is up to meanwhile."""

        def ask() -> Job | None:
            with contextlib.suppress(DatabaseAway):
                job = self.get(job_id)
                return job if job.state.is_final else None
            return None

        return until(ask, seconds)

    def check_files(self) -> None:
        """Sweep; then there must be the whole result of every job that is done, and no more."""
        sweep_files(self.store, self.storage, is_old=lambda _: True)
        expected: set[str] = set()
        found = {stat.key: stat.size_bytes for stat in self.storage.list("jobs/")}
        for state in JobState:
            for job in self.store.in_state(state):
                expected.add(f"jobs/{job.id}/source/part.gcode")
                if state is not JobState.DONE:
                    assert job.output is None
                    continue
                result = f"{job.output}/result/{job.result_name}"
                outputs = {key for key in found if key.startswith(f"{job.output}/")}
                assert sum(found[key] for key in outputs) == job.output_bytes
                content = b"".join(self.storage.read(result, 0, found[result]))
                assert hashlib.sha256(content).hexdigest() == job.result_sha256
                assert len(content) == job.result_bytes
                assert content.startswith(b"; compensated\n")
                expected |= outputs
        assert set(found) == expected

    @contextlib.contextmanager
    def work(self, runner: str = "light", **settings: Any) -> Iterator[Process]:
        """Run the part of an API process that gets jobs done."""
        with self.process([*WORK, runner], **settings) as process:
            yield process

    @contextlib.contextmanager
    def command(self, *arguments: str, **settings: Any) -> Iterator[Process]:
        """Run a command of `stillpath`."""
        with self.process([*STILLPATH, *arguments], **settings) as process:
            yield process

    @contextlib.contextmanager
    def process(self, command: list[str], **settings: Any) -> Iterator[Process]:
        own = {f"STILLPATH_{name.upper()}": str(value) for name, value in settings.items()}
        process = Process(command, os.environ | self.environment | own, self.data_dir)
        try:
            yield process
        finally:
            process.end()


class Process:
    """A process whose first line on stdout says that it began."""

    def __init__(self, command: list[str], environment: dict[str, str], folder: Path) -> None:
        self._popen = subprocess.Popen(
            command, stdout=subprocess.PIPE, text=True, env=environment, cwd=folder
        )
        assert self._popen.stdout is not None
        self.said = self._popen.stdout.readline().strip()
        assert self.said, f"{command} ended with code {self._popen.wait()}"

    @property
    def pid(self) -> int:
        return self._popen.pid

    def family(self) -> list[psutil.Process]:
        """Return the processes that it started, and those that these did."""
        return psutil.Process(self.pid).children(recursive=True)

    def kill(self) -> None:
        """End it as if the power were cut."""
        self._popen.kill()
        self._popen.wait()

    def stop(self) -> int:
        """Ask it to end, and wait."""
        self._popen.send_signal(signal.SIGTERM)
        return self._popen.wait(PATIENCE_S)

    def end(self) -> None:
        """End it and all that it started."""
        family = []
        if self._popen.poll() is None:
            with contextlib.suppress(psutil.NoSuchProcess):
                family = self.family()
            self._popen.terminate()
            try:
                self._popen.wait(30)
            except subprocess.TimeoutExpired:
                self.kill()
        for process in family:
            with contextlib.suppress(psutil.NoSuchProcess):
                process.kill()
        if self._popen.stdout is not None:
            self._popen.stdout.close()


def until(wanted: Callable[[], Any], seconds: float = PATIENCE_S) -> Any:
    """Wait for something that is true, and return it."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        found = wanted()
        if found:
            return found
        time.sleep(0.05)
    raise AssertionError("waited in vain")
