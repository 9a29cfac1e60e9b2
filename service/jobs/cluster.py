"""Run jobs on worker processes: our own (a Dask `LocalCluster`), or those of a remote scheduler.

Dask only runs jobs; their list and outcome are in the database. Relevant properties of Dask:

- A task is run again if its worker dies, even if it had finished, as long as its future is held:
  so futures are dropped when they are done, and jobs are claimed in the database.
- Cancelling a task does not stop a running one: so workers check the database.
- Workers end when their scheduler does: so `stillpath worker` starts them again.
- A worker of a `LocalCluster` that is away for longer than ``lost-worker-timeout`` is abandoned:
  so that timeout is long, and we replace workers ourselves.
- Anyone who can reach a scheduler can run code on its workers: so ours listens on loopback only,
  and a remote one must be in a closed network or behind TLS (``tls://..``, Dask's own settings).
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import structlog

from stillpath.service.jobs.state import Job
from stillpath.service.jobs.task import Runner
from stillpath.service.jobs.worker import run_job
from stillpath.service.jobs.worker_setup import quiet_dask
from stillpath.service.processes import METHOD, OF_THE_SERVICE, loaded_context
from stillpath.service.settings import Settings

if TYPE_CHECKING:
    from distributed import Client, Future, LocalCluster

__all__ = ["DASK_SETTINGS", "Cluster", "ClusterAway", "prepare_dask", "runner_name"]

_TIMEOUT_S = 10
_SECRETS = {"first_key", "webhook_secret"}

DASK_SETTINGS: dict[str, Any] = {
    # We count losses ourselves.
    "distributed.scheduler.allowed-failures": 0,
    "distributed.scheduler.work-stealing": False,
    "distributed.scheduler.active-memory-manager.start": False,
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
    # A job's memory is watched by the job (`service.jobs.watch`).
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": False,
    "distributed.worker.profile.enabled": False,
    "distributed.worker.preload": ["stillpath.service.jobs.worker_setup"],
    "distributed.worker.multiprocessing-method": METHOD,
    # They end together with this process.
    "distributed.worker.daemon": True,
    # `service.environment` sets the environment.
    "distributed.nanny.pre-spawn-environ": {},
    # Jobs block the event loop for minutes.
    "distributed.admin.tick.limit": "1h",
    # The default of 50 ticks a second is then useless overhead.
    "distributed.admin.tick.interval": "5s",
    "distributed.admin.tick.cycle": "30s",
    "distributed.admin.system-monitor.interval": "10s",
    "distributed.admin.system-monitor.gil.enabled": False,
    "distributed.deploy.lost-worker-timeout": "1h",
    "distributed.comm.timeouts.connect": f"{_TIMEOUT_S}s",
    "distributed.diagnostics.nvml": False,
}


class ClusterAway(RuntimeError):
    """The scheduler does not respond; a retry may help."""


class Cluster:
    """The workers of a service."""

    def __init__(self, settings: Settings, runner: Runner) -> None:
        self._settings = settings
        self._runner = runner_name(runner)
        self._client: Client | None = None
        self._local: LocalCluster | None = None

    @property
    def is_own(self) -> bool:
        """Whether the workers are processes of this service."""
        return self._settings.scheduler is None

    @property
    def is_connected(self) -> bool:
        """Whether jobs can be submitted."""
        return self._client is not None and self._client.status == "running"

    def connect(self) -> None:
        """Start the workers, or connect to the scheduler.

        Raises
        ------
        ClusterAway
        """
        prepare_dask()
        from distributed import Client

        try:
            if self.is_own and self._local is None:
                self._local = self._start()
            self._client = Client(
                self._local or self._settings.scheduler, timeout=_TIMEOUT_S, set_as_default=False
            )
        except (OSError, TimeoutError, RuntimeError) as error:
            self.disconnect()
            where = self._settings.scheduler or "of this service"
            raise ClusterAway(f"the scheduler {where} does not answer: {error}") from error

    def slots(self) -> int:
        """Return how many jobs can run at once.

        Raises
        ------
        ClusterAway
        """
        with self._explained() as client:
            threads = client.sync(client.scheduler.ncores, callback_timeout=_TIMEOUT_S)
            slots = int(sum(threads.values()))
            wanted = self._settings.workers + self._settings.computing_processes
            if self._local is not None and slots < wanted:
                _start_missing(self._local, wanted)
        return slots

    def submit(self, job: Job, when_done: Callable[[], object]) -> Future:
        """Submit a job; `when_done` is called from another thread when its task has ended.

        Raises
        ------
        ClusterAway
        """
        given = None
        if self.is_own:
            given = self._settings.model_dump(mode="json", exclude=_SECRETS)
        with self._explained() as client:
            future = client.submit(
                run_job,
                job.id,
                given,
                self._runner,
                key=f"job-{job.id}-{job.attempt}",
                priority=job.priority,
                pure=False,
            )
            future.add_done_callback(lambda _: when_done())
        return future

    def disconnect(self) -> None:
        """Disconnect from a remote scheduler; jobs running there continue."""
        client, self._client = self._client, None
        if client is not None:
            with contextlib.suppress(Exception):  # it may be dead already
                client.close(timeout=2)

    def close(self) -> None:
        """Disconnect from the scheduler, and kill our own workers immediately."""
        local, self._local = self._local, None
        if local is not None:
            # Includes workers that are still starting, unlike `workers`.
            for nanny in list(local._created):
                # A graceful shutdown would finish their jobs first.
                _kill(getattr(nanny, "pid", None))
        self.disconnect()
        if local is not None:
            with contextlib.suppress(Exception):
                local.close(timeout=5)

    def _start(self) -> LocalCluster:
        from distributed import LocalCluster

        return LocalCluster(
            # `slots` starts them without waiting, which would also delay a shutdown.
            n_workers=0,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            scheduler_kwargs={"dashboard": False, "dashboard_address": "127.0.0.1:0"},
            memory_limit=0,
            local_directory=str(self._settings.data_dir / "scratch"),
            silence_logs=logging.CRITICAL,
        )

    @contextlib.contextmanager
    def _explained(self) -> Any:
        client = self._client
        if client is None or not self.is_connected:
            raise ClusterAway("the scheduler is not connected")
        try:
            yield client
        except Exception as error:  # what Dask raises here is not documented
            raise ClusterAway(f"the scheduler does not answer: {error!r}") from error


def prepare_dask() -> None:
    """Configure Dask for this process, before anything of `distributed` is used."""
    import dask

    dask.config.set(DASK_SETTINGS)
    from distributed.utils import get_mp_context  # its import sets up logs

    get_mp_context()  # sets its preload list once; set ours afterwards
    loaded_context(*OF_THE_SERVICE)
    quiet_dask()


def runner_name(runner: Runner) -> str:
    """Return the ``module:name`` of a runner."""
    return f"{runner.__module__}:{runner.__qualname__}"


def _start_missing(local: LocalCluster, workers: int) -> None:
    """Start missing workers, also replacing dead ones, without waiting for them."""
    from distributed.core import Status

    def drop() -> None:
        for name, nanny in list(local.workers.items()):
            if nanny.status in (Status.closed, Status.failed):
                del local.workers[name]

    local.loop.add_callback(drop)
    local.scale(workers)


def _kill(pid: int | None) -> None:
    if pid is None:
        return
    structlog.get_logger("cluster").debug("worker ended", pid=pid)
    with contextlib.suppress(OSError):
        os.kill(pid, getattr(signal, "SIGKILL", signal.SIGTERM))
