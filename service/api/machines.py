"""Routes of machines: the library, the user's own with their revisions, approval."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import date
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header, Path, Query, Request, Response
from starlette.concurrency import run_in_threadpool

from stillpath.applications.machines.diff import diff
from stillpath.applications.machines.drift import drift
from stillpath.applications.machines.resolve import Resolver
from stillpath.applications.machines.revision import Conflict, Revision, UnknownMachine
from stillpath.applications.machines.store import MachineStore
from stillpath.models.errors import ModelError
from stillpath.models.machine import Machine
from stillpath.models.provenance import SourceFile
from stillpath.models.store import builtin_machines, load_machine, read_machine
from stillpath.service.api.access import Admin, Reader
from stillpath.service.api.file_responses import matches
from stillpath.service.api.machine_views import (
    DiffView,
    HistoryView,
    MachineSummary,
    RevisionDocument,
    RevisionView,
)
from stillpath.service.api.problems import Problem, responses
from stillpath.service.api.uploads import receive_document
from stillpath.service.security.audit import record
from stillpath.service.security.callers import Caller

__all__ = [
    "Author",
    "Edit",
    "Message",
    "Name",
    "as_problems",
    "look_up",
    "router",
    "store_revision",
    "to_print_with",
]

_LARGEST_BYTES = 4_000_000
_BODY = {
    "requestBody": {
        "required": True,
        "description": "The machine document; its `name` must match the address.",
        "content": {"application/json": {"schema": {"$ref": "#/components/schemas/Machine"}}},
    }
}
_ETAG = {"headers": {"ETag": {"schema": {"type": "string"}, "description": "The revision."}}}

Name = Annotated[
    str, Path(description="A name of `/v1/machines`.", examples=["ender3"], max_length=255)
]
Author = Annotated[
    str | None,
    Query(
        min_length=1,
        max_length=100,
        description="Who makes the change; by default the owner of the key.",
        examples=["anna"],
    ),
]
Message = Annotated[str, Query(max_length=2000, description="Reason for the change.")]
Number = Annotated[int, Path(ge=1, le=999_999, description="Number of a revision.")]
IfMatch = Annotated[
    str | None, Header(description="ETag of the state that the change is based on, or `*`.")
]

router = APIRouter(prefix="/v1/machines", tags=["machines"])


@dataclass(frozen=True, slots=True)
class Edit:
    """Who changes a machine, why, and which state of it."""

    author: Author = None
    message: Message = ""
    if_match: IfMatch = None


def look_up(request: Request, name: str) -> Machine:
    """Return the newest state of a machine, approved or not; raise `Problem` if there is none."""
    with as_problems():
        return _machines(request).to_look_at(name).machine


def to_print_with(request: Request, name: str) -> Machine:
    """Return the machine that jobs are done with; raise `Problem` if there is none."""
    with as_problems():
        return _machines(request).for_job(name).machine


def store_revision(
    request: Request,
    response: Response,
    name: str,
    caller: Caller,
    edit: Edit,
    make: Callable[[Machine | None], Machine],
    *,
    sources: Sequence[SourceFile] = (),
) -> RevisionView:
    """Store what is made of a machine's current state as its next revision, and fill the answer.

    Parameters
    ----------
    make : callable
        Is given the current machine, None if there is none of that name.

    Raises
    ------
    Problem
        409 for a built-in machine, 412 or 428 as `edit.if_match` demands.
    ModelError
    """
    store = _store(request)
    expected = _expected(store, name, edit.if_match)
    machine = make(store.current(name).machine if expected else None)
    made = store.add_revision(
        name,
        machine,
        author=edit.author or caller.owner,
        message=edit.message,
        sources=sources,
        expected=expected,
    )
    _note(request, caller, "change", made)
    if expected == 0:
        response.status_code = 201
        response.headers["Location"] = f"/v1/machines/{name}"
    return _changed(store, response, made)


@router.get("", summary="List the machines")
def list_machines(request: Request, _: Reader) -> list[MachineSummary]:
    """Return the machines a job can name: the library, then the user's own."""
    store = _store(request)
    own = [_own_summary(store, name) for name in store.names()]
    library = [name for name in builtin_machines() if name not in store]
    return [*(MachineSummary.of(load_machine(name)) for name in library), *own]


@router.get(
    "/{name}",
    response_model=Machine,
    responses={200: _ETAG, 304: {"description": "Not Modified"}, **responses(404, 422)},
    summary="Get a machine",
)
def show_machine(
    request: Request,
    response: Response,
    name: Name,
    _: Reader,
    if_none_match: Annotated[str | None, Header()] = None,
) -> Any:
    """Return the whole document of a machine: travel, limits, firmware, plants."""
    machine = look_up(request, name)
    response.headers["ETag"] = _etag(machine)
    if matches(if_none_match, _etag(machine)):
        return Response(status_code=304, headers={"ETag": _etag(machine)})
    return machine


@router.put(
    "/{name}",
    response_model=RevisionView,
    responses={
        200: {"description": "The new revision", **_ETAG},
        201: {"description": "The first revision of a new machine", "model": RevisionView, **_ETAG},
        **responses(403, 409, 412, 413, 422, 428),
    },
    openapi_extra=_BODY,
    summary="Create or update a machine",
)
async def put_machine(
    request: Request,
    response: Response,
    name: Name,
    caller: Admin,
    edit: Annotated[Edit, Depends()],
) -> RevisionView:
    """Store a document as a new revision of the machine.

    To change an existing machine, send the ETag of the state that the change is based on as
    `If-Match`. An unchanged document makes no revision.
    """
    await run_in_threadpool(_expected, _store(request), name, edit.if_match)  # before the body
    content = await receive_document(request, max_bytes=_LARGEST_BYTES)
    with as_problems():
        machine = read_machine(content)
        return await run_in_threadpool(
            store_revision, request, response, name, caller, edit, lambda _: machine
        )


@router.delete(
    "/{name}",
    status_code=204,
    responses=responses(403, 404, 409, 412),
    summary="Delete a machine",
)
def delete_machine(
    request: Request, name: Name, caller: Admin, if_match: IfMatch = None
) -> Response:
    """Move a machine with its history to the trash of the data directory.

    `stillpath machines restore NAME` brings it back.
    """
    store = _store(request)
    with as_problems():
        _check_state(store, name, if_match)
        store.delete(name)
    record(request, caller, "machine.delete", name)
    return Response(status_code=204)


@router.get("/{name}/revisions", responses=responses(404, 409, 422), summary="List the revisions")
def list_revisions(
    request: Request,
    name: Name,
    _: Reader,
    since: Annotated[
        date | None, Query(description="Look for drift from this day on (after a rebuild).")
    ] = None,
) -> HistoryView:
    """Return who changed a machine when and why, and whether its resonances moved."""
    store = _store(request)
    with as_problems():
        _check_own(store, name)
        history, approvals = store.history(name), store.approvals(name)
        return HistoryView(
            revisions=[RevisionView.of(r, approvals.get(r.number)) for r in history],
            drift=drift(history, since=since),
        )


@router.get(
    "/{name}/revisions/{number}", responses=responses(404, 409, 422), summary="Get a revision"
)
def show_revision(request: Request, name: Name, number: Number, _: Reader) -> RevisionDocument:
    """Return a state of a machine with its document."""
    store = _store(request)
    with as_problems():
        _check_own(store, name)
        found = store.revision(name, number)
        return RevisionDocument(revision=_view(store, found), machine=found.machine)


@router.get("/{name}/diff", responses=responses(404, 409, 422), summary="Compare two revisions")
def show_diff(
    request: Request,
    name: Name,
    _: Reader,
    before: Annotated[int, Query(alias="from", ge=1)],
    after: Annotated[int, Query(alias="to", ge=1)],
) -> DiffView:
    """Return what revision `to` changed against `from`, in words and figures."""
    store = _store(request)
    with as_problems():
        _check_own(store, name)
        old, new = store.revision(name, before), store.revision(name, after)
        return DiffView(before=before, after=after, changes=diff(old.machine, new.machine))


@router.post(
    "/{name}/revisions/{number}/approve",
    responses=responses(403, 404, 409, 422),
    summary="Approve a revision",
)
def approve_revision(
    request: Request,
    name: Name,
    number: Number,
    caller: Admin,
    author: Author = None,
    message: Message = "",
) -> RevisionView:
    """Approve a revision for use in jobs. An existing approval is kept."""
    store = _store(request)
    with as_problems():
        _check_own(store, name)
        store.approve(name, number, author=author or caller.owner, message=message)
        found = store.revision(name, number)
        _note(request, caller, "approve", found)
        return _view(store, found)


@router.post(
    "/{name}/revisions/{number}/rollback",
    responses={200: _ETAG, **responses(403, 404, 409, 412, 422)},
    summary="Roll back to a revision",
)
def roll_back(
    request: Request,
    response: Response,
    name: Name,
    number: Number,
    caller: Admin,
    author: Author = None,
    message: Message = "",
    if_match: IfMatch = None,
) -> RevisionView:
    """Restore an earlier state as a new revision."""
    store = _store(request)
    with as_problems():
        expected = _check_state(store, name, if_match)
        by = author or caller.owner
        made = store.roll_back(name, number, author=by, message=message, expected=expected)
        _note(request, caller, "change", made)
        return _changed(store, response, made)


def _note(request: Request, caller: Caller, what: str, made: Revision) -> None:
    """Write down who did something to a machine."""
    name, revision = made.machine.name, made.machine.revision
    record(request, caller, f"machine.{what}", name, revision=revision, number=made.number)


def _machines(request: Request) -> Resolver:
    machines: Resolver = request.app.state.machines
    return machines


def _store(request: Request) -> MachineStore:
    return _machines(request).store


def _own_summary(store: MachineStore, name: str) -> MachineSummary:
    try:
        return MachineSummary.own(store.current(name), store.approvals(name))
    except ModelError as error:
        return MachineSummary.damaged(name, error)


def _view(store: MachineStore, revision: Revision) -> RevisionView:
    approvals = store.approvals(revision.machine.name)
    return RevisionView.of(revision, approvals.get(revision.number))


def _changed(store: MachineStore, response: Response, made: Revision) -> RevisionView:
    response.headers["ETag"] = _etag(made.machine)
    return _view(store, made)


def _expected(store: MachineStore, name: str, if_match: str | None) -> int:
    """Return the revision that a PUT is made on, 0 for a new machine; check its precondition."""
    with as_problems():
        if name in builtin_machines():
            raise _built_in(name)
        if name not in store:
            if if_match is not None:
                raise _failed(f"There is no machine {name!r:.80}; add it without If-Match.")
            return 0
        if if_match is None:
            raise Problem(
                428,
                "Precondition required",
                f"Machine {name!r} exists already. Take another name, or change it on its page "
                "(over HTTP: with its ETag as If-Match, so that nobody's change is lost).",
            )
        return _check_state(store, name, if_match)


def _check_state(store: MachineStore, name: str, if_match: str | None) -> int:
    """Return the number of the current revision.

    Raise `Problem` 412 if `if_match` is given and names another state.
    """
    _check_own(store, name)
    current = store.current(name)
    if if_match is not None and not matches(if_match, _etag(current.machine)):
        raise _failed(
            f"Machine {name!r} is at {_etag(current.machine)} (revision {current.number}), not "
            f"{if_match[:80]}. Fetch it, make the change on that, and try again."
        )
    return current.number


def _check_own(store: MachineStore, name: str) -> None:
    """Refuse a built-in machine; a user may have one of a name that was built in later."""
    if name in builtin_machines() and name not in store:
        raise _built_in(name)


def _built_in(name: str) -> Problem:
    return Problem(
        409,
        "Built-in machine",
        f"{name!r} is a built-in machine: it has no revisions and cannot be changed. Take "
        "another name for yours.",
    )


def _etag(machine: Machine) -> str:
    return f'"{machine.revision}"'


def _failed(detail: str) -> Problem:
    return Problem(412, "Precondition failed", detail)


@contextmanager
def as_problems() -> Iterator[None]:
    """Turn the errors of models and of the store into problem documents."""
    try:
        yield
    except UnknownMachine as error:
        raise Problem(404, "Unknown machine", str(error)) from None
    except Conflict as error:
        raise _failed(str(error)) from None
    except ModelError as error:
        raise Problem(422, "Machine not usable", str(error)) from None
