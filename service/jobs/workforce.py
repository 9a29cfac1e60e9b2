"""Those who get jobs done, as the API sees them: start, stop, status."""

from __future__ import annotations

from stillpath.service.jobs.cluster import Cluster
from stillpath.service.jobs.reconciler import Reconciler
from stillpath.service.jobs.store import JobStore
from stillpath.service.jobs.task import Runner
from stillpath.service.jobs.worker import run_compensation
from stillpath.service.settings import Settings
from stillpath.service.storage import Storage

__all__ = ["Workforce"]


class Workforce:
    """The workers of a service, and the reconciler that gives them the jobs of a store.

    Parameters
    ----------
    storage : Storage
        Store and storage are the caller's to close, after `stop`.
    runner : Runner
        Does the work of a job in the worker process; replaceable in tests.
    """

    def __init__(
        self,
        settings: Settings,
        store: JobStore,
        storage: Storage,
        runner: Runner = run_compensation,
    ) -> None:
        self._cluster = Cluster(settings, runner)
        self._reconciler = Reconciler(settings, store, storage, self._cluster)

    def start(self) -> None:
        """Start the threads and return immediately; workers start in the background."""
        self._reconciler.start()

    def stop(self) -> None:
        """Stop. Jobs in our own workers go back to the queue, remote ones continue."""
        self._reconciler.stop()
        self._cluster.close()
        self._reconciler.leave()

    def notify(self) -> None:
        """Wake the reconciler: a job was added or removed."""
        self._reconciler.notify()

    @property
    def workers(self) -> int:
        """Number of jobs that can run at once, as far as known."""
        return self._reconciler.slots

    @property
    def not_ready_reason(self) -> str | None:
        """Why jobs are not done at the moment; None if they are."""
        return self._reconciler.trouble
