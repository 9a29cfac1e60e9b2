"""A shared poller for all job watchers: one query each half second for any number of them."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
from collections.abc import AsyncGenerator
from dataclasses import dataclass, field

import structlog
from sse_starlette import ServerSentEvent
from starlette.concurrency import run_in_threadpool

from stillpath.service.api.schemas import JobView
from stillpath.service.jobs.state import JobState
from stillpath.service.jobs.store import JobStore

__all__ = ["Hub", "Snapshot"]

_EVERY_S = 0.5


@dataclass(frozen=True, slots=True)
class Snapshot:
    """A job at one moment, ready to be sent.

    Attributes
    ----------
    tag : str
        Identifies the content, equal in every process of the service.
    message : bytes
        The server-sent event, encoded once for all who watch.
    is_final : bool
        Nothing more will come.
    """

    tag: str
    message: bytes
    is_final: bool


@dataclass(slots=True, eq=False)
class _Channel:
    """The latest state of one job; slow watchers skip intermediate states."""

    watchers: int = 0
    latest: Snapshot | None = None
    changed: asyncio.Event = field(default_factory=asyncio.Event)

    def publish(self, snapshot: Snapshot) -> None:
        if self.latest is None or self.latest.tag != snapshot.tag:
            self.latest = snapshot
            self.changed.set()
            self.changed = asyncio.Event()


class Hub:
    """Tells watchers how jobs stand."""

    def __init__(self, store: JobStore) -> None:
        self._store = store
        self._channels: dict[str, _Channel] = {}
        self._wanted = asyncio.Event()
        self._poller: asyncio.Task[None] | None = None

    async def start(self) -> None:
        """Start the poller in the running event loop."""
        self._poller = asyncio.create_task(self._poll(), name="hub")

    async def stop(self) -> None:
        """End the poller."""
        if self._poller is not None:
            self._poller.cancel()
            await asyncio.wait([self._poller])
            self._poller = None

    @property
    def watchers(self) -> int:
        """Number of watchers."""
        return sum(channel.watchers for channel in self._channels.values())

    def nudge(self) -> None:
        """Poll immediately, because something has changed."""
        if self._channels:
            self._wanted.set()

    async def watch(self, job_id: str, seen: str | None = None) -> AsyncGenerator[Snapshot, None]:
        """Yield the job as it stands, then whenever it changes; ends after its final state.

        Parameters
        ----------
        seen : str, optional
            Tag of the snapshot that the watcher knows already.
        """
        channel = self._channels.setdefault(job_id, _Channel())
        channel.watchers += 1
        try:
            if channel.latest is None:
                self._wanted.set()
            while True:
                changed, snapshot = channel.changed, channel.latest
                # Final states are repeated: the watcher may have missed the end of the stream.
                if snapshot is not None and (snapshot.tag != seen or snapshot.is_final):
                    seen = snapshot.tag
                    yield snapshot
                    if snapshot.is_final:
                        return
                    continue
                await changed.wait()
        finally:
            channel.watchers -= 1
            if not channel.watchers and self._channels.get(job_id) is channel:
                del self._channels[job_id]

    async def _poll(self) -> None:
        log = structlog.get_logger("hub")
        while True:
            # Without watchers nothing is asked. `wait_for` would lose a cancellation that comes
            # together with a nudge (until Python 3.12).
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(_EVERY_S if self._channels else None):
                    await self._wanted.wait()
            self._wanted.clear()
            channels = dict(self._channels)
            if not channels:
                continue
            try:
                found = await run_in_threadpool(self._snapshots, list(channels))
            except Exception as error:  # the database may be away for a while
                log.warning("jobs cannot be watched", reason=str(error))
                await asyncio.sleep(_EVERY_S)
                continue
            for job_id, channel in channels.items():
                channel.publish(found[job_id])

    def _snapshots(self, job_ids: list[str]) -> dict[str, Snapshot]:
        jobs = self._store.many(job_ids)
        positions: dict[str, int] = {}
        if any(job.state is JobState.QUEUED for job in jobs.values()):
            positions = self._store.queue_positions()
        return {
            job_id: _snapshot(JobView.of(jobs[job_id], positions.get(job_id)))
            if job_id in jobs
            else _gone(job_id)
            for job_id in job_ids
        }


def _snapshot(view: JobView) -> Snapshot:
    text = view.model_dump_json()
    tag = hashlib.sha256(text.encode()).hexdigest()[:16]
    event = ServerSentEvent(text, event="job", id=tag, sep="\n")
    return Snapshot(tag, event.encode(), view.state.is_final)


def _gone(job_id: str) -> Snapshot:
    event = ServerSentEvent(f'{{"id":"{job_id}"}}', event="gone", sep="\n")
    return Snapshot("gone", event.encode(), is_final=True)
