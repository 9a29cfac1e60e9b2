"""The route of progress as server-sent events."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import aclosing
from typing import Annotated

from fastapi import APIRouter, Header, Request
from sse_starlette import EventSourceResponse, ServerSentEvent

from stillpath.service.api.access import Watcher
from stillpath.service.api.hub import Hub
from stillpath.service.api.job_lookup import JobId, find
from stillpath.service.api.problems import responses

__all__ = ["router"]

_RETRY = b"retry: 1000\n\n"
_HEARTBEAT_S = 15
_SEND_TIMEOUT_S = 30
_SCHEMA = {
    "type": "object",
    "properties": {
        "event": {"type": "string", "enum": ["job", "gone"]},
        "id": {"type": "string"},
        "data": {"type": "string", "description": "A `JobView` as JSON."},
        "retry": {"type": "integer"},
    },
}
_EXAMPLE = """\
retry: 1000

id: 5f2c8e0e6c0d4a3f
event: job
data: {"id": "5f2c8e0e6c0d4a3f9d1b7a52c4e86f10", "state": "running", "progress": 0.42}

"""

router = APIRouter(prefix="/v1/jobs", tags=["jobs"])


@router.get(
    "/{job_id}/events",
    response_class=EventSourceResponse,
    responses={
        200: {
            "description": "An event `job` for every change, with the job as `GET /v1/jobs/{id}` "
            "shows it; the stream ends with the job. `gone`: it was deleted.",
            "content": {
                "text/event-stream": {"schema": _SCHEMA, "example": _EXAMPLE},
            },
        },
        **responses(404),
    },
    summary="Watch a job",
)
async def watch_job(
    request: Request,
    job_id: JobId,
    caller: Watcher,
    last_event_id: Annotated[
        str | None, Header(description="Id of the last event received; browsers send it.")
    ] = None,
) -> EventSourceResponse:
    """Send the job as it stands, then every change until it is over."""
    await find(request, job_id, caller)
    hub: Hub = request.app.state.hub
    return EventSourceResponse(
        _events(hub, job_id, last_event_id),
        ping=_HEARTBEAT_S,
        ping_message_factory=lambda: ServerSentEvent(comment="still here", sep="\n"),
        send_timeout=_SEND_TIMEOUT_S,
        sep="\n",
    )


async def _events(hub: Hub, job_id: str, seen: str | None) -> AsyncIterator[bytes]:
    yield _RETRY
    async with aclosing(hub.watch(job_id, seen)) as snapshots:
        async for snapshot in snapshots:
            yield snapshot.message
