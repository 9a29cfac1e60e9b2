"""Routes of a job's results: the file, the report, the layers."""

from __future__ import annotations

import json
import threading
from collections import OrderedDict
from pathlib import PurePath
from typing import Annotated, Any
from urllib.parse import urlencode

from fastapi import APIRouter, Path, Request
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from stillpath.gcode.containers.sniff import Kind, kind_of
from stillpath.service.api.access import Fetcher, Reader, link_query
from stillpath.service.api.file_responses import (
    HEADERS,
    MEDIA,
    RANGES,
    damaged,
    stored,
    stored_result,
)
from stillpath.service.api.job_lookup import JobId, find_done
from stillpath.service.api.problems import Problem, responses
from stillpath.service.api.schemas import LayerIndex, ResultLink
from stillpath.service.jobs.state import JobKind
from stillpath.service.security.callers import Caller
from stillpath.service.storage.base import Storage

__all__ = ["Layers", "router"]

_KEPT = 32
_BINARY = {"schema": {"type": "string", "format": "binary"}}

router = APIRouter(prefix="/v1/jobs/{job_id}", tags=["results"])


class Layers:
    """Remembers where the tiles of the last prints lie: an output never changes once written."""

    def __init__(self, storage: Storage) -> None:
        self._storage = storage
        self._kept: OrderedDict[str, list[tuple[int, int]]] = OrderedDict()
        self._lock = threading.Lock()

    def spans(self, output: str) -> list[tuple[int, int]]:
        """Return first byte, and the one after the last, of each tile under an output.

        Raises
        ------
        FileNotFoundError
            If there are no layers.
        Problem
            If their list is damaged.
        """
        with self._lock:
            if output in self._kept:
                self._kept.move_to_end(output)
                return self._kept[output]
        key = f"{output}/report/layers.json"
        text = b"".join(self._storage.read(key, 0, self._storage.stat(key).size_bytes))
        try:
            layers = json.loads(text)["layers"]
            spans = [(layer["offset"], layer["offset"] + layer["bytes"]) for layer in layers]
        except (ValueError, KeyError, TypeError):
            raise damaged(key, "no list of layers") from None
        with self._lock:
            self._kept[output] = spans
            while len(self._kept) > _KEPT:
                self._kept.popitem(last=False)
        return spans


def _file(kinds: tuple[str, ...], description: str, *more: int) -> dict[int | str, dict[str, Any]]:
    """Return the OpenAPI entries of a route that answers with a stored file."""
    content = {
        kind: _BINARY if not kind.startswith(("text/", "application/json")) else {}
        for kind in kinds
    }
    part = RANGES[206] | {"content": content, "headers": HEADERS}
    return {
        200: {"description": description, "content": content, "headers": HEADERS},
        206: part,
        304: RANGES[304],
        **responses(404, 409, 416, *more),
    }


@router.get(
    "/result",
    response_class=Response,
    responses=_file(tuple(kind.value for kind in Kind), "The written file"),
    summary="Fetch the compensated G-code",
)
@router.head("/result", include_in_schema=False)
async def read_result(request: Request, job_id: JobId, caller: Fetcher) -> Response:
    """Stream the written file, in the format of the submitted one; `Range` is supported.

    For jobs of other kinds, this is their result.
    """
    job = await find_done(request, job_id, caller, of_any_kind=True)
    storage: Storage = request.app.state.storage
    if job.kind is JobKind.COMPENSATION:
        media_type = (await run_in_threadpool(_kind, storage, job.result)).value
    else:
        media_type = MEDIA[PurePath(job.result_name).suffix]
    return await stored_result(request, job, media_type)


@router.post(
    "/result/link",
    responses=responses(404, 409),
    summary="Make a link that fetches the compensated G-code without a key",
)
async def link_result(
    request: Request, response: Response, job_id: JobId, caller: Reader
) -> ResultLink:
    """Return a link for what sends no headers, such as a browser's own downloads.

    Whoever has it can fetch the result, for an hour and while the key is valid, and nothing else.
    """
    job = await find_done(request, job_id, caller, of_any_kind=True)
    # Here a page can say what is wrong with the file; of a download nobody reads the answer.
    await run_in_threadpool(request.app.state.verified.check, job)
    query = await run_in_threadpool(link_query, request, caller, job_id)
    response.headers["Cache-Control"] = "no-store"
    return ResultLink(href=f"/v1/jobs/{job_id}/result" + (f"?{urlencode(query)}" if query else ""))


@router.get(
    "/report",
    response_class=Response,
    responses=_file(("text/html",), "One self-contained HTML page"),
    summary="Fetch the report as a page",
)
@router.head("/report", include_in_schema=False)
async def read_report(request: Request, job_id: JobId, caller: Reader) -> Response:
    """Return one self-contained HTML page."""
    return await _part(request, job_id, caller, "report.html", "text/html")


@router.get(
    "/report.json",
    response_class=Response,
    responses=_file(("application/json",), "Every figure; `/v1/schemas/report.json`"),
    summary="Fetch the report's figures",
)
@router.head("/report.json", include_in_schema=False)
async def read_report_json(request: Request, job_id: JobId, caller: Reader) -> Response:
    """Return every figure of the report, measured on the written file."""
    return await _part(request, job_id, caller, "report.json", "application/json")


@router.get(
    "/layers",
    response_model=LayerIndex,
    responses={304: RANGES[304], **responses(404, 409)},
    summary="List the layers",
)
@router.head("/layers", include_in_schema=False)
async def read_layers(request: Request, job_id: JobId, caller: Reader) -> Response:
    """List the layers with height, features, errors and the size of their tiles."""
    return await _part(request, job_id, caller, "layers.json", "application/json")


@router.get(
    "/layers/{n}",
    response_class=Response,
    responses=_file(("application/octet-stream",), "The tile", 422),
    summary="Fetch one layer",
)
@router.head("/layers/{n}", include_in_schema=False)
async def read_layer(
    request: Request, job_id: JobId, n: Annotated[int, Path(ge=0, le=1_000_000)], caller: Reader
) -> Response:
    """Return the path of a layer with its errors, as columns of numbers (docs/http.md)."""
    job = await find_done(request, job_id, caller)
    storage: Storage = request.app.state.storage
    try:
        spans = await run_in_threadpool(request.app.state.layers.spans, job.output)
    except FileNotFoundError:
        spans = []
    if n >= len(spans):
        raise Problem(
            404,
            "No such layer",
            f"The job has {len(spans)} layers, counted from 0; there is no layer {n}.",
        )
    return await stored(
        request,
        storage,
        f"{job.output}/report/layers.bin",
        media_type="application/octet-stream",
        etag=f"{job.attempt}-{n}",
        span=spans[n],
    )


async def _part(
    request: Request, job_id: str, caller: Caller, name: str, media_type: str
) -> Response:
    job = await find_done(request, job_id, caller)
    return await stored(
        request,
        request.app.state.storage,
        f"{job.output}/report/{name}",
        media_type=media_type,
        etag=f"{job.id[:12]}-{job.attempt}-{name}",
    )


def _kind(storage: Storage, key: str) -> Kind:
    try:
        size = storage.stat(key).size_bytes
        return kind_of(b"".join(storage.read(key, 0, min(size, 4))))
    except FileNotFoundError:
        return Kind.TEXT  # whoever streams it says that it is gone
