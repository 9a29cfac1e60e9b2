"""The route of the filter for live printing, as `stillpath klipper export` writes it."""

from __future__ import annotations

from fastapi import APIRouter, Request
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from stillpath.service.api.access import Reader
from stillpath.service.api.computing import WAITING, ComputeRequest, read_result, run_and_wait
from stillpath.service.api.machines import Name, to_print_with
from stillpath.service.api.problems import Problem, responses
from stillpath.service.jobs.state import JobKind

__all__ = ["router"]

_NAME = "stillpath.json"

router = APIRouter(prefix="/v1/machines/{name}", tags=["machines"])


@router.get(
    f"/{_NAME}",
    response_class=Response,
    responses={
        200: {"content": {"application/json": {}}, "description": "The file"},
        **WAITING,
        **responses(404, 422),
    },
    summary="Fetch the filter for live printing",
)
async def read_live_filter(request: Request, name: Name, caller: Reader) -> Response:
    """Return the file that the extra inside Klipper reads, byte by byte as the command writes it.

    The machine is the one that jobs are done with. The first request for a machine takes some
    seconds. A machine that cannot print live is refused (422).
    """
    machine = await run_in_threadpool(to_print_with, request, name)
    if machine.live_refusal is not None:
        raise Problem(422, "Live printing not available", machine.live_refusal)
    job = await run_and_wait(
        request,
        caller,
        ComputeRequest(
            kind=JobKind.LIVE,
            machine=name,
            document=machine,
            revision=machine.revision,
            options={},
            result_name=_NAME,
        ),
    )
    document = await read_result(request, job)
    headers = {"Content-Disposition": f'attachment; filename="{_NAME}"'}
    return Response(await run_in_threadpool(_text, document), 200, headers, "application/json")


# What is imported here takes a second, which the service's start need not wait for.


def _text(document: dict[str, object]) -> str:
    from stillpath.applications.live.export import export_text

    return export_text(document)
