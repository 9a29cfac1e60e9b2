"""Figures for Prometheus: of requests, counted here, and of jobs, read from the store."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

from fastapi import APIRouter, Request
from prometheus_client import CollectorRegistry, Counter, Histogram, generate_latest
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.exposition import CONTENT_TYPE_LATEST
from prometheus_client.registry import Collector
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from stillpath.service.api.access import Operator
from stillpath.service.api.problems import responses
from stillpath.service.database.errors import StoreError

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

    from stillpath.service.jobs.store import JobStore

__all__ = ["Metrics", "RequestMetrics", "router"]

_SETTLED_S = 5.0
"""Jobs that ended longer ago have been written down by every worker."""
_JOB_BUCKETS_S = (1, 2, 5, 10, 20, 60, 120, 300, 600, 1800, 3600, 7200, 14400)

router = APIRouter(tags=["health"])


@router.get(
    "/metrics",
    response_class=Response,
    responses={
        200: {"content": {"text/plain": {"example": 'stillpath_jobs{state="queued"} 0.0\n'}}},
        **responses(401, 403, 429),
    },
    openapi_extra={"security": [{"bearer": []}, {"key": []}, {}]},
    summary="Metrics for Prometheus",
)
async def read_metrics(request: Request, _: Operator) -> Response:
    """Return counters and gauges as text; for a key with the scope admin, or this computer."""
    metrics: Metrics = request.app.state.metrics
    text = await run_in_threadpool(metrics.exposition)
    return Response(text, headers={"Content-Type": CONTENT_TYPE_LATEST})


class Metrics(Collector):
    """The figures of one application.

    Parameters
    ----------
    store : callable
        Returns the `JobStore`, which is there once the application runs.
    workers, watchers : callable
        Return how many there are; None: it is not known.
    free_bytes : callable
        Returns what is free on the disk; None: it is not looked at.
    """

    def __init__(
        self,
        store: Callable[[], JobStore],
        workers: Callable[[], int | None],
        watchers: Callable[[], int],
        free_bytes: Callable[[], int | None] = lambda: None,
    ) -> None:
        self._free_bytes = free_bytes
        self._store, self._workers, self._watchers = store, workers, watchers
        self._lock = threading.Lock()
        self._read_until = time.time() - _SETTLED_S
        self._registry = CollectorRegistry()
        self._registry.register(self)
        self.requests = Counter(
            "stillpath_http_requests",
            "Requests by route and status",
            ("method", "route", "status"),
            registry=self._registry,
        )
        self.request_seconds = Histogram(
            "stillpath_http_request_seconds",
            "Until the answer began",
            ("method", "route"),
            registry=self._registry,
        )
        self.upload_bytes = Counter(
            "stillpath_upload_bytes", "Bytes of files that were taken in", registry=self._registry
        )
        self._job_seconds = Histogram(
            "stillpath_job_seconds",
            "From the start of the last attempt to the end, by how it ended",
            ("state",),
            buckets=_JOB_BUCKETS_S,
            registry=self._registry,
        )

    def exposition(self) -> bytes:
        """Return all figures as Prometheus reads them."""
        with self._lock:
            return generate_latest(self._registry)

    def describe(self) -> list[Metric]:
        """Return nothing: what is read from the store is not asked for before it is there."""
        return []

    def collect(self) -> Iterator[Metric]:
        """Yield what is read from the store; without a database only that it is away."""
        watchers = self._watchers()
        yield GaugeMetricFamily("stillpath_sse_watchers", "Clients that watch jobs", value=watchers)
        workers = self._workers()
        if workers is not None:
            yield GaugeMetricFamily("stillpath_workers", "Worker processes", value=workers)
        now = time.time()
        try:
            counts = self._store().counts()
            oldest = self._store().oldest_queued_at()
            for_room, most_bytes = self._store().waiting_for_room()
            ended = self._store().ended_between(self._read_until, now - _SETTLED_S)
        except StoreError:
            yield GaugeMetricFamily(
                "stillpath_database_up", "Whether the database responds", value=0
            )
            return
        yield GaugeMetricFamily("stillpath_database_up", "Whether the database responds", value=1)
        self._read_until = now - _SETTLED_S
        for job in ended:
            if job.started_at is not None and job.finished_at is not None:
                seconds = max(job.finished_at - job.started_at, 0.0)  # the clock may be set back
                self._job_seconds.labels(job.state.value).observe(seconds)
        jobs = GaugeMetricFamily("stillpath_jobs", "Jobs by state", labels=("state",))
        for state, count in counts.items():
            jobs.add_metric((state.value,), count)
        yield jobs
        yield GaugeMetricFamily(
            "stillpath_jobs_waiting_for_room", "Jobs that wait for disk space", value=for_room
        )
        yield GaugeMetricFamily(
            "stillpath_room_wanted_bytes",
            "Least disk space that the largest of these needs",
            value=most_bytes,
        )
        free_bytes = self._free_bytes()
        if free_bytes is not None:
            yield GaugeMetricFamily(
                "stillpath_disk_free_bytes", "Free on the disk of the service", value=free_bytes
            )
        yield GaugeMetricFamily(
            "stillpath_queue_oldest_seconds",
            "How long the oldest queued job has been waiting",
            value=0.0 if oldest is None else max(now - oldest, 0.0),
        )


class RequestMetrics:
    """ASGI middleware that counts requests by the route's template, never by what a caller wrote.

    Parameters
    ----------
    app : ASGI application
    """

    def __init__(self, app: ASGIApp, *, metrics: Metrics) -> None:
        self._app = app
        self._metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:  # noqa: D102 - ASGI
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        began = time.perf_counter()
        told = False

        async def sent(message: Message) -> None:
            nonlocal told
            if message["type"] == "http.response.start" and not told:
                told = True
                self._note(scope, message["status"], time.perf_counter() - began)
            await send(message)

        await self._app(scope, receive, sent)

    def _note(self, scope: Scope, status: int, seconds: float) -> None:
        route: Any = scope.get("route")
        name = getattr(route, "path", None) or "none"
        method = scope["method"] if scope["method"] in _METHODS else "other"
        self._metrics.requests.labels(method, name, status).inc()
        self._metrics.request_seconds.labels(method, name).observe(seconds)


_METHODS = ("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS")
