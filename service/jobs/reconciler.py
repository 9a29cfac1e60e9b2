"""Make the workers follow the database: dispatch jobs, and detect lost ones.

One thread of each API process. Of several, the one that holds the lease acts; all its state can be
reconstructed, so any other can take over.
"""

from __future__ import annotations

import contextlib
import threading
import time
import uuid
from typing import TYPE_CHECKING

import structlog

from stillpath.service.database.errors import DatabaseAway, DatabaseFull
from stillpath.service.jobs.cluster import Cluster, ClusterAway
from stillpath.service.jobs.room import RoomForJobs
from stillpath.service.jobs.state import START_WITHIN_S, Job, JobState, Lost
from stillpath.service.jobs.steadiness import Steadiness
from stillpath.service.jobs.store import JobStore
from stillpath.service.jobs.sweep import Sweep
from stillpath.service.settings import Settings
from stillpath.service.storage import Storage, StorageError
from stillpath.service.storage.disk import Disk

if TYPE_CHECKING:
    from distributed import Future

__all__ = ["Reconciler"]

_LEASE, _LEASE_S, _RENEW_S = "reconciler", 5.0, 2.0
"""A lease is renewed only once it is older than `_RENEW_S`: each write waits for the disk."""
_TICK_S = 0.5
_SWEEP_EVERY_S = 60.0
_GIVE_BACK_S = 1.5
"""Time for a closing worker to give its job back; it checks twice a second."""
_FORGIVEN_ENDS = 2
"""How often a job may have been under way when its service was killed or lost power before it is
suspected: a job that takes all memory of a small computer would freeze it after each start."""
_ENDED = "the service or the computer went down while the job was under way"
_RETRY_S, _LONGEST_RETRY_S = 0.5, 5.0
_OWN_GRACE_S, _GRACE_S = 60.0, 5.0
"""Time for which our own workers, which restart by themselves, and remote ones may be away before
the service is not ready."""


class Reconciler:
    """The reconciler thread.

    Attributes
    ----------
    slots : int
        Number of jobs that can run at once, as far as known.
    """

    def __init__(
        self, settings: Settings, store: JobStore, storage: Storage, cluster: Cluster
    ) -> None:
        self.slots = 0
        self._settings = settings
        self._store = store
        self._cluster = cluster
        self._holder = uuid.uuid4().hex
        self._wake = threading.Event()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="reconciler", daemon=True)
        self._sweeper = threading.Thread(target=self._run_sweeps, name="sweeper", daemon=True)
        self._log = structlog.get_logger("reconciler")
        self._disk = Disk(settings.data_dir, settings.disk_reserve_bytes)
        self._room = RoomForJobs(self._disk, storage, is_own_disk=cluster.is_own)
        self._steady = Steadiness()
        self._in_flight: dict[str, tuple[Job, Future]] = {}
        self._broken_since: dict[str, float] = {}
        self._has_lease = False
        self._leased_at = self._awake_at = 0.0
        self._able_at = _since_boot_s()
        # By the clock: when we began to be the service that runs.
        self._began_at = time.time()
        # Free slots after the last check; None during one.
        self._free: int | None = None
        self._took_over = False
        self._sweep = Sweep(settings, store, storage)
        self._trouble: str | None = None
        self._trouble_since = 0.0

    def start(self) -> None:
        """Start the threads."""
        self._trouble, self._trouble_since = "no worker has started yet", time.monotonic()
        self._thread.start()
        self._sweeper.start()

    def stop(self) -> None:
        """End the threads."""
        self._stopping.set()
        self._wake.set()
        self._thread.join()
        self._sweeper.join()

    def leave(self) -> None:
        """Return the jobs of our own, ended workers to the queue."""
        with contextlib.suppress(DatabaseAway):
            if self._cluster.is_own:
                for job, _ in self._in_flight.values():
                    self._give_back(job.id, job.attempt + 1, "the service stopped", blame=False)
            self._store.release(_LEASE, self._holder, time.time())
        self._forget()

    def notify(self) -> None:
        """Wake the thread for a new job, if a slot is free.

        If none is, the thread is woken when one becomes free.
        """
        if self._free != 0:
            self._wake.set()

    @property
    def trouble(self) -> str | None:
        """Return why jobs cannot be done now, or None.

        Starting workers are no reason: jobs submitted meanwhile are kept and done.
        """
        grace_s = _OWN_GRACE_S if self._cluster.is_own else _GRACE_S
        lasted_s = time.monotonic() - self._trouble_since
        return self._trouble if lasted_s > grace_s else None

    # The thread

    def _run(self) -> None:
        wait_s = _RETRY_S
        while not self._stopping.is_set():
            try:
                self._tick()
            except (DatabaseAway, ClusterAway) as error:
                self._set_trouble(str(error))
                is_full = isinstance(error, DatabaseAway) and self._disk.is_full
                if is_full or isinstance(error, DatabaseFull):
                    self._disk.give_up()  # jobs wait; the reserve lets their states be written
                self.slots = 0
                if isinstance(error, ClusterAway):
                    self._forget()
                    self._cluster.disconnect()
                self._stopping.wait(wait_s)
                # Count from the next try, which may be the first to work for a long time.
                self._steady.interrupt()
                wait_s = min(2 * wait_s, _LONGEST_RETRY_S)
            except Exception:
                self._log.exception("reconciler broke")
                self._stopping.wait(_LONGEST_RETRY_S)
            else:
                wait_s = _RETRY_S
                self._wake.wait(_TICK_S)
                self._wake.clear()

    def _tick(self) -> None:
        self._free = None
        if self._cluster.is_own and not self._took_over:
            self._take_over()
        if not self._cluster.is_connected:
            self._forget()
            self._cluster.connect()
            if self._stopping.is_set():
                return  # connecting may take long; do not start workers during a shutdown
        self.slots = self._cluster.slots()
        if not self.slots:
            self._set_trouble("no worker is connected to the scheduler")
        self._renew()
        if self.slots:  # and the database takes writes
            self._set_trouble(None)
        if not self._has_lease:
            self._free = 0
            self._forget()  # the holder of the lease submits them again
            return
        self._find_silent()
        self._collect()
        self._hand_over()

    def _forget(self) -> None:
        self._in_flight.clear()
        self._broken_since.clear()

    def _renew(self) -> None:
        """Take the lease, or renew it in good time."""
        now = time.monotonic()
        if not self._has_lease or now - self._leased_at > _RENEW_S:
            self._hold_back_starts()
            had_lease = self._has_lease
            self._has_lease = self._store.lease(_LEASE, self._holder, _LEASE_S, time.time())
            self._leased_at, self._awake_at = now, _since_boot_s()
            if not had_lease:
                self._began_at, self._able_at = time.time(), self._awake_at

    def _hold_back_starts(self) -> None:
        """After a long time without a service, start no print that nobody expects any more.

        A clock that is put right while we run (a board without a battery, once it has a network)
        says so of the time before we began: what was submitted since is expected. Where a clock
        was set back before we began (such a board, after a power cut), nobody knows how long that
        was.
        """
        now = time.time()
        latest = now - START_WITHIN_S
        until = self._store.leased_until(_LEASE)
        ran = self._has_lease and _since_boot_s() - self._awake_at < START_WITHIN_S
        jobs = 0
        if until < latest:
            jobs = self._store.hold_back_starts(min(latest, self._began_at) if ran else latest)
        elif not ran and until > now + START_WITHIN_S:
            jobs = self._store.hold_back_starts(self._began_at, now)
        if jobs:
            self._log.warning("prints will not be started: no service was running", jobs=jobs)

    def _note_able(self) -> None:
        """Note that jobs can be done; after a long time without workers or room, start no print."""
        now_s = _since_boot_s()
        if now_s - self._able_at > START_WITHIN_S:
            jobs = self._store.hold_back_starts(time.time() - START_WITHIN_S)
            if jobs:
                self._log.warning("prints will not be started: no job could be done", jobs=jobs)
        self._able_at = now_s

    def _take_over(self) -> None:
        """Requeue what ran when the previous service ended, together with its workers.

        Only if no other service uses the database (`service.instance_lock` guards the folder);
        otherwise lost jobs are detected by silence.
        """
        if self._store.engine.dialect.name == "sqlite":
            for job in self._store.in_state(JobState.RUNNING):
                suspect = job.attempt > _FORGIVEN_ENDS
                self._give_back(job.id, job.attempt, _ENDED, blame=suspect)
        self._took_over = True

    def _find_silent(self) -> None:
        timeout_s = self._settings.heartbeat_timeout_s
        if self._steady.lasts_s(timeout_s / 2) <= timeout_s:
            return
        for job in self._store.silent(time.time() - timeout_s):
            reason = f"nothing was heard of its worker {job.worker} for {timeout_s:g} s"
            # Our own workers end with their service: an earlier one began what we did not.
            ended = self._cluster.is_own and job.id not in self._in_flight
            blame = not ended or job.attempt > _FORGIVEN_ENDS
            self._give_back(job.id, job.attempt, _ENDED if ended else reason, blame=blame)

    def _collect(self) -> None:
        """Drop finished futures; a job that is still running then has lost its worker.

        A short grace period lets a closing worker give its job back.
        """
        now = time.monotonic()
        done = {
            job_id: pair
            for job_id, pair in self._in_flight.items()
            if pair[1].done()
            and (
                pair[1].status == "finished"
                or now - self._broken_since.setdefault(job_id, now) > _GIVE_BACK_S
            )
        }
        if not done:
            return
        rows = self._store.many(done)
        unclaimed = False
        for job_id, (job, future) in done.items():
            row = rows.get(job_id)
            if row is not None and row.attempt == job.attempt + 1:
                if row.state is JobState.RUNNING:
                    self._give_back(job_id, row.attempt, _reason(future))
            elif row is not None and row.state is JobState.QUEUED and row.attempt == job.attempt:
                unclaimed = True
                self._log.warning(
                    "the task ended before a worker claimed the job; it is submitted again",
                    job=job_id,
                    reason=_reason(future),
                )
            del self._in_flight[job_id]
            self._broken_since.pop(job_id, None)
        if unclaimed:
            self._stopping.wait(_RETRY_S)  # avoid a busy loop, whatever the reason

    def _hand_over(self) -> None:
        """Submit as many jobs as there are free workers.

        Not more: a job already waiting at Dask could not be overtaken by a more urgent one.
        """
        has_room = self._room.for_any()
        if self.slots and has_room:
            self._note_able()
        busy = {job.id: job for job in self._store.in_state(JobState.RUNNING)}
        busy |= {job_id: job for job_id, (job, _) in self._in_flight.items()}
        free = self.slots - len(busy)
        if free > 0 and has_room:
            # Short jobs may use any slot; some slots are reserved for them.
            long = sum(not job.kind.is_short for job in busy.values())
            kept = min(self._settings.computing_processes, self.slots - 1)
            free -= self._begin(free, short=True)
            free -= self._begin(min(free, self.slots - kept - long), short=False)
        self._free = max(free, 0)

    def _begin(self, most: int, *, short: bool) -> int:
        """Submit at most `most` jobs; return their number."""
        if most <= 0:
            return 0
        now, begun = time.monotonic(), 0
        exclude = [*self._in_flight, *self._room.waiting(now)]
        skipped = 0
        while begun < most:
            # However many wait for room: those behind them may have it.
            limit = most - begun + skipped
            jobs = self._store.next_queued(limit, short=short, exclude=exclude)
            for job in jobs:
                exclude.append(job.id)
                if job.waits_for_room and not self._room.for_retry(job, now):
                    skipped += 1
                elif begun < most:
                    self._in_flight[job.id] = (job, self._cluster.submit(job, self._wake.set))
                    begun += 1
            if len(jobs) < limit:
                break
        return begun

    def _give_back(self, job_id: str, attempt: int, reason: str, *, blame: bool = True) -> None:
        event = Lost(attempt, time.time(), reason, self._settings.max_attempts, blame)
        after = self._store.apply(job_id, event)
        if after is not None:
            self._log.warning(
                "worker lost", job=job_id, attempt=attempt, reason=reason, now=after.state.value
            )

    def _set_trouble(self, trouble: str | None) -> None:
        if trouble is None and self._trouble is not None:
            self._log.info("jobs are processed again", workers=self.slots)
        elif trouble is not None and self._trouble is None:
            self._trouble_since = time.monotonic()
            self._log.warning("no jobs are processed", reason=trouble)
        self._trouble = trouble

    # The second thread, for slow work

    def _run_sweeps(self) -> None:
        while True:
            if self._has_lease:
                try:
                    self._sweep.run()
                except (DatabaseAway, StorageError) as error:
                    self._log.warning("sweep broken off", reason=str(error))
                except Exception:
                    self._log.exception("sweep broke")
                pause = _SWEEP_EVERY_S
            else:
                self._sweep.pause()
                pause = _TICK_S
            if self._stopping.wait(pause):
                return


def _since_boot_s() -> float:
    """Return a time that nobody sets and that goes on while the computer sleeps, if it has one."""
    if hasattr(time, "CLOCK_BOOTTIME"):
        return time.clock_gettime(time.CLOCK_BOOTTIME)
    return time.time()


def _reason(future: Future) -> str:
    if future.status == "error":
        error = future.exception(timeout=5)
        if type(error).__name__ == "KilledWorker":
            return "its process ended, for which memory is the usual reason"
        return f"{type(error).__name__}: {error}"
    if future.status == "finished":
        return "its worker left it"
    return f"the scheduler {future.status} it"
