"""The worker processes: our own (a Dask `LocalCluster`), or those of a scheduler elsewhere.

Dask only runs jobs; which there are, and how they ended, is in the database. What is known of Dask
and matters here:

- A task is run again if its worker dies, even one that had finished, as long as somebody holds its
  future: so futures are dropped when they are done, and a job is claimed in the database.
- Cancelling a task does not stop one that runs: so workers ask the database.
- Workers end when their scheduler does: so `stillpath worker` starts them again.
- A worker of a `LocalCluster` that is away for longer than ``lost-worker-timeout`` is written off
  for good: so that is long, and we have it replaced ourselves.
- Whoever reaches a scheduler can run anything on its workers: so ours listens on loopback only, and
  one elsewhere belongs into a closed network or behind TLS (``tls://..``, Dask's own settings).
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import structlog

from stillpath.service.jobs.preload import quiet_dask
from stillpath.service.jobs.state import Job
from stillpath.service.jobs.task import Runner
from stillpath.service.jobs.worker import run_job
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
    "distributed.worker.preload": ["stillpath.service.jobs.preload"],
    "distributed.worker.multiprocessing-method": METHOD,
    # They die with us.
    "distributed.worker.daemon": True,
    # `service.environment` knows better.
    "distributed.nanny.pre-spawn-environ": {},
    # Jobs compute for minutes without letting the event loop in.
    "distributed.admin.tick.limit": "1h",
    # Fifty ticks a second, and what they cost, tell nobody anything then.
    "distributed.admin.tick.interval": "5s",
    "distributed.admin.tick.cycle": "30s",
    "distributed.admin.system-monitor.interval": "10s",
    "distributed.admin.system-monitor.gil.enabled": False,
    "distributed.deploy.lost-worker-timeout": "1h",
    "distributed.comm.timeouts.connect": f"{_TIMEOUT_S}s",
    "distributed.diagnostics.nvml": False,
}


class ClusterAway(RuntimeError):
    """The scheduler does not answer; trying again later may help."""


class Cluster:
    """Workers, once they are connected.

    Parameters
    ----------
    settings : Settings
    runner : Runner
    """

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
        """Whether jobs can be handed over."""
        return self._client is not None and self._client.status == "running"

    def connect(self) -> None:
        """Start the workers, or find the scheduler.

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
        """Hand a job over; `when_done` is called from another thread when its task is over.

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
        """Let go of the scheduler elsewhere; what runs there goes on."""
        client, self._client = self._client, None
        if client is not None:
            with contextlib.suppress(Exception):  # it may be dead; nothing is lost with it
                client.close(timeout=2)

    def close(self) -> None:
        """Let go of the scheduler, and end our own workers at once, whatever they do."""
        local, self._local = self._local, None
        if local is not None:
            # Those that only start belong to it; `workers` would leave them out.
            for nanny in list(local._created):
                # Asked kindly, they would finish their jobs first.
                _kill(getattr(nanny, "pid", None))
        self.disconnect()
        if local is not None:
            with contextlib.suppress(Exception):
                local.close(timeout=5)

    def _start(self) -> LocalCluster:
        from distributed import LocalCluster

        return LocalCluster(
            # `slots` has them started, without waiting: an end of the service would wait too.
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
    """Set Dask up for this process; before anything of `distributed` is used."""
    import dask

    dask.config.set(DASK_SETTINGS)
    from distributed.utils import get_mp_context  # its import sets up logs

    get_mp_context()  # it chooses once what is loaded beforehand; what is chosen last counts
    loaded_context(*OF_THE_SERVICE)
    quiet_dask()


def runner_name(runner: Runner) -> str:
    """Return the ``module:name`` of a runner."""
    return f"{runner.__module__}:{runner.__qualname__}"


def _start_missing(local: LocalCluster, workers: int) -> None:
    """Start workers up to a number, also for those that ended for good; does not wait for them."""
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
