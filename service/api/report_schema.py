"""Routes of documents that are published beside the API's own description."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter
from starlette.concurrency import run_in_threadpool

__all__ = ["router"]

router = APIRouter(prefix="/v1/schemas", tags=["results"])


@router.get("/report.json", summary="Fetch the schema of report.json")
async def report_schema() -> dict[str, Any]:
    """Return the JSON schema of a job's report."""
    return await run_in_threadpool(_schema)


def _schema() -> dict[str, Any]:
    from stillpath.reports import report_schema

    return report_schema()
