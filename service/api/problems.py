"""Every error is answered as application/problem+json (RFC 9457)."""

from __future__ import annotations

import errno
import json
from collections.abc import Mapping
from http import HTTPStatus
from typing import Any

import structlog
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.responses import Response
from starlette.routing import Match

from stillpath.models.complaints import complaint
from stillpath.service.database.errors import DatabaseAway, DatabaseFull
from stillpath.service.jobs.problems import PROBLEM_MEDIA_TYPE, problem, problem_of
from stillpath.service.storage.base import StorageError
from stillpath.service.storage.disk import DISK_FULL, NoRoom

__all__ = ["NO_KEY", "Problem", "install", "not_ready", "problem_response", "responses"]

NO_KEY = (
    "No key came with the request. Send one as 'Authorization: Bearer sp_...' or "
    "'X-Api-Key: sp_...'; `stillpath keys create` makes one."
)

_UNWRITABLE = (errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO)
"""Error numbers of a disk that was made read-only, given to somebody else, or is broken."""
_METHODS = ("DELETE", "GET", "HEAD", "PATCH", "POST", "PUT")


class Problem(Exception):  # named as in RFC 9457
    """Raise it anywhere in a request; it becomes the answer.

    Parameters
    ----------
    headers : dict, optional
    **extra
        Further members of the document.
    """

    def __init__(
        self,
        status: int,
        title: str,
        detail: str,
        *,
        headers: Mapping[str, str] | None = None,
        **extra: Any,
    ) -> None:
        super().__init__(detail)
        self.document = problem(status, title, detail, **extra)
        self.headers = dict(headers or {})

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> Problem:
        """Return the problem of a document, as jobs keep them."""
        known = {name: value for name, value in document.items() if name != "type"}
        return cls(known.pop("status"), known.pop("title"), known.pop("detail"), **known)


def not_ready(part: str) -> str:
    """Return the detail for a part of the service that does not answer."""
    return f"{part}: see the log of the service"


def problem_response(
    document: Mapping[str, Any], headers: Mapping[str, str] | None = None
) -> Response:
    """Return the answer for a problem document."""
    return Response(
        json.dumps(dict(document)),  # ASCII: what a caller wrote may be no text
        status_code=int(document["status"]),
        headers=dict(headers or {}),
        media_type=PROBLEM_MEDIA_TYPE,
    )


def install(app: FastAPI) -> None:
    """Make an application answer every error with a problem document."""

    @app.exception_handler(Problem)
    async def _problem(_: Request, error: Problem) -> Response:
        return problem_response(error.document, error.headers)

    @app.exception_handler(HTTPException)
    async def _http(request: Request, error: HTTPException) -> Response:
        title = HTTPStatus(error.status_code).phrase
        detail = str(error.detail)
        headers = dict(error.headers or {})
        if error.status_code == HTTPStatus.METHOD_NOT_ALLOWED:
            headers["Allow"] = _allowed(request)
        if detail == title:
            called = f"{request.method} {request.url.path}"
            detail = f"{called}: {title.lower()}; /openapi.json lists what there is."
        return problem_response(problem(error.status_code, title, detail), headers)

    @app.exception_handler(DatabaseAway)
    async def _no_database(request: Request, error: DatabaseAway) -> Response:
        return _away(request, "Database unavailable", "The database does not answer", error)

    @app.exception_handler(DatabaseFull)
    async def _full_database(request: Request, error: DatabaseFull) -> Response:
        return _full(request, error)

    @app.exception_handler(StorageError)
    async def _no_storage(request: Request, error: StorageError) -> Response:
        if error.errno in DISK_FULL:
            return _full(request, error)
        return _away(request, "Storage unavailable", "The storage does not answer", error)

    @app.exception_handler(OSError)
    async def _system(request: Request, error: OSError) -> Response:
        if error.errno in DISK_FULL:
            return _full(request, error)
        if error.errno == errno.EFBIG:
            return problem_response(problem_of(error), {"Connection": "close"})
        if error.errno in _UNWRITABLE:
            return _away(request, "Disk unavailable", "The data directory cannot be used", error)
        raise error

    @app.exception_handler(ClientDisconnect)
    async def _gone(_: Request, __: ClientDisconnect) -> Response:
        return Response(status_code=400)  # nobody reads it

    @app.exception_handler(RequestValidationError)
    async def _invalid(_: Request, error: RequestValidationError) -> Response:
        found = [_field(entry) for entry in error.errors()]
        detail = "; ".join(f"{entry['name']}: {entry['message']}" for entry in found)
        return problem_response(problem(422, "Invalid parameter", detail, errors=found))

    @app.exception_handler(Exception)
    async def _crash(request: Request, error: Exception) -> Response:
        structlog.get_logger("api").error(
            "request broke", method=request.method, path=request.url.path, exc_info=error
        )
        return problem_response(problem(500, "Internal error", "The service failed; see its log."))


def responses(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Return the OpenAPI entries for the problems a route may answer with."""
    return {
        status: {
            "description": HTTPStatus(status).phrase,
            "content": {PROBLEM_MEDIA_TYPE: {"schema": _SCHEMA, "example": _EXAMPLES.get(status)}},
        }
        for status in statuses
    }


def _allowed(request: Request) -> str:
    """Return the methods that the path takes; its first route knows only its own."""
    scopes = {method: {**request.scope, "method": method} for method in _METHODS}
    return ", ".join(
        method
        for method, scope in scopes.items()
        if any(route.matches(scope)[0] is Match.FULL for route in request.app.routes)
    )


def _away(request: Request, title: str, what: str, error: Exception) -> Response:
    structlog.get_logger("api").error(
        title, method=request.method, path=request.url.path, reason=str(error)
    )
    detail = f"{what}; try again in a while. The service's log says more."
    return problem_response(problem(503, title, detail), {"Retry-After": "5"})


def _full(request: Request, error: Exception) -> Response:
    structlog.get_logger("api").error("disk full", path=request.url.path, reason=str(error))
    detail = "The disk of the service is full. Delete old jobs, or make room on it."
    if isinstance(error, NoRoom):
        detail = f"{error.message[0].upper()}{error.message[1:]}."
    return problem_response(problem(507, "No space left", detail), {"Connection": "close"})


def _field(entry: Mapping[str, Any]) -> dict[str, str]:
    place = entry.get("loc", ())
    return {
        "name": ".".join(str(part) for part in place[1:]) or str(place[0] if place else "request"),
        "message": complaint(entry),
    }


_SCHEMA: dict[str, Any] = {
    "type": "object",
    "required": ["type", "title", "status", "detail"],
    "properties": {
        "type": {"type": "string"},
        "title": {"type": "string", "description": "The kind of problem."},
        "status": {"type": "integer"},
        "detail": {"type": "string", "description": "What, where, the limit and the remedy."},
        "line": {"type": "integer", "description": "Line of the G-code, from 1."},
        "text": {"type": "string", "description": "That line."},
    },
}
_EXAMPLES: dict[int, dict[str, Any]] = {
    document["status"]: document
    for document in (
        problem(400, "Bad Request", "There was an error parsing the body."),
        problem(401, "Unauthorized", NO_KEY),
        problem(403, "Not allowed", "This needs a key with scope 'admin'."),
        problem(404, "No such job", "There is no job 3f0c. Jobs are gone once they are deleted."),
        problem(
            408,
            "Request Timeout",
            "Fewer than 1024 bytes of the body came within 30 s. Send it again over a better "
            "connection.",
        ),
        problem(409, "Job not finished", "The job is running. Ask again when its state is done."),
        problem(412, "Precondition failed", "Machine 'mine' is at \"3f6a\" (revision 4)."),
        problem(413, "File too large", "The upload is larger than 1073741824 bytes."),
        problem(416, "No such range", "The file has 120 bytes; bytes=500- lies outside."),
        problem(
            422,
            "Invalid parameter",
            "tolerance_um: must be at least 0.5 µm (given: '0.1')",
        ),
        problem(
            428,
            "Precondition required",
            "Machine 'mine' exists already. Take another name, or change it on its page (over "
            "HTTP: with its ETag as If-Match, so that nobody's change is lost).",
        ),
        problem(429, "Too many requests", "More than 1200 requests in a minute. Wait 1 s."),
        problem(503, "Not ready", not_ready("database")),
        problem(507, "No space left", "The disk of the service is full. Delete old jobs."),
    )
}
