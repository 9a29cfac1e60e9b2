"""Refuses query parameters that a route does not take: a misspelt filter would select all."""

from __future__ import annotations

from fastapi import Request
from fastapi.exceptions import RequestValidationError
from starlette.concurrency import run_in_threadpool

__all__ = ["refuse_unknown_parameters"]


async def refuse_unknown_parameters(request: Request) -> None:
    """Compare a request with what ``/openapi.json`` says of its route.

    Raises
    ------
    RequestValidationError
        As for a parameter that is known and wrong.
    """
    given = request.query_params
    if not given:
        return
    route = request.scope["route"]
    described = request.app.openapi_schema or await run_in_threadpool(request.app.openapi)
    operations = described["paths"][route.path_format]
    method = request.method.lower()
    parameters = operations[method if method in operations else "get"].get("parameters", [])
    known = {one["name"] for one in parameters if one["in"] == "query"}
    unknown = [name for name in given if name not in known]
    if unknown:
        raise RequestValidationError(
            [
                {"type": "extra_forbidden", "loc": ("query", name), "input": given[name]}
                for name in unknown
            ]
        )
