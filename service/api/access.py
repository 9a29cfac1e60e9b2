"""Access rights of routes: `Reader`, `Submitter` or `Admin` as a parameter.

`Watcher` is a reader whose requests are not rate-limited, for following a job; `Uploader` is a
submitter who holds an upload slot until the response; `Operator` is an admin, or anyone on this
computer if no keys are required; `Fetcher` is a reader, or a signed link in place of his key.
"""

from __future__ import annotations

import hmac
import time
from collections.abc import AsyncIterator
from contextlib import suppress
from typing import Annotated, NoReturn

from fastapi import Depends, Query, Request
from fastapi.security import APIKeyHeader, HTTPAuthorizationCredentials, HTTPBearer

from stillpath.service.api.body_timeout import body_timeout_of
from stillpath.service.api.limits import CallerLimits, name_of
from stillpath.service.api.problems import NO_KEY, Problem
from stillpath.service.database.errors import DatabaseAway
from stillpath.service.security.audit import AuditLog
from stillpath.service.security.callers import LOCAL, Caller, Scope
from stillpath.service.security.keys import Key, KeyStore
from stillpath.service.settings import is_loopback

__all__ = [
    "Admin",
    "Fetcher",
    "Operator",
    "Reader",
    "Submitter",
    "Uploader",
    "Watcher",
    "link_query",
]

_LINK_S = 3600.0
"""How long a link may be used: a slow download that breaks off begins again with it."""

_ABOUT = (
    "A key of this service (`sp_...`). Not needed if the service only answers its own computer."
)
_CHALLENGE = 'Bearer realm="stillpath"'

_Bearer = Annotated[
    HTTPAuthorizationCredentials | None,
    Depends(HTTPBearer(auto_error=False, scheme_name="bearer", description=_ABOUT)),
]
_Header = Annotated[
    str | None,
    Depends(
        APIKeyHeader(name="X-Api-Key", auto_error=False, scheme_name="key", description=_ABOUT)
    ),
]


async def _shown(bearer: _Bearer, header: _Header) -> str | None:
    return bearer.credentials if bearer is not None else header


_Shown = Annotated[str | None, Depends(_shown)]


# Each of these queries the database, so they are plain functions, which run in a thread.


def _reader(request: Request, shown: _Shown) -> Caller:
    return _allowed(request, shown, Scope.READ)


def _watcher(request: Request, shown: _Shown) -> Caller:
    return _allowed(request, shown, Scope.READ, counted=False)


def _submitter(request: Request, shown: _Shown) -> Caller:
    return _allowed(request, shown, Scope.SUBMIT)


def _admin(request: Request, shown: _Shown) -> Caller:
    return _allowed(request, shown, Scope.ADMIN)


def _operator(request: Request, shown: _Shown) -> Caller:
    remote = _remote(request)
    # Check the name too: a foreign page can make this computer's browser send requests. Where keys
    # are required, a proxy on this computer may pass on any name.
    here = is_loopback(remote or "") and is_loopback(request.url.hostname or "")
    if shown is None and here and not request.app.state.keys_required:
        return _local(remote)
    return _allowed(request, shown, Scope.ADMIN)


Reader = Annotated[Caller, Depends(_reader)]
Watcher = Annotated[Caller, Depends(_watcher)]
Submitter = Annotated[Caller, Depends(_submitter)]
Admin = Annotated[Caller, Depends(_admin)]
Operator = Annotated[Caller, Depends(_operator)]


async def _uploader(request: Request, caller: Submitter) -> AsyncIterator[Caller]:
    limits: CallerLimits = request.app.state.limits
    with limits.uploading(caller, body_timeout_of(request.scope)):
        yield caller


Uploader = Annotated[Caller, Depends(_uploader)]


def link_query(request: Request, caller: Caller, job_id: str) -> dict[str, str]:
    """Return what in an address stands for the caller's key, for a job's result and nothing else.

    Browsers send no key with what they download themselves, and a page has no room for a large
    file. Empty where no key is needed.
    """
    until = f"{time.time() + _LINK_S:.0f}"
    keys: KeyStore = request.app.state.keys
    signed = keys.sign(caller.key_id or "", _linked(job_id, until))
    if signed is None:
        return {}
    key, signature = signed
    return {"key": key.id, "until": until, "signature": signature}


def _fetcher(
    request: Request,
    job_id: str,
    shown: _Shown,
    key: Annotated[str, Query(max_length=64, description="Of a signed link.")] = "",
    until: Annotated[str, Query(pattern=r"^[0-9]{1,12}$", description="Of a signed link.")] = "0",
    signature: Annotated[str, Query(max_length=64, description="Of a signed link.")] = "",
) -> Caller:
    if not signature:
        return _allowed(request, shown, Scope.READ)
    keys: KeyStore = request.app.state.keys
    signed = keys.sign(key, _linked(job_id, until))
    right = signed is not None and hmac.compare_digest(signed[1].encode(), signature.encode())
    if signed is None or not right or int(until) < time.time():
        _turn_away(
            request,
            Caller("-", frozenset(), remote=_remote(request)),
            "The link has expired or was changed; get another one from the page of the job.",
        )
    return _with_scope(request, _holder(request, signed[0]), Scope.READ)


Fetcher = Annotated[Caller, Depends(_fetcher)]


def _linked(job_id: str, until: str) -> str:
    return f"result of {job_id} until {until}"


def _allowed(request: Request, shown: str | None, scope: Scope, *, counted: bool = True) -> Caller:
    """Return the caller, or raise `Problem`: 401 for a wrong key, 403 for a missing scope."""
    return _with_scope(request, _caller(request, shown), scope, counted=counted)


def _with_scope(request: Request, caller: Caller, scope: Scope, *, counted: bool = True) -> Caller:
    if counted:
        limits: CallerLimits = request.app.state.limits
        limits.take(name_of(caller))
    if not caller.may(scope):
        _deny(
            request,
            caller,
            403,
            "Not allowed",
            f"This needs a key with scope {scope.value!r}; the key {caller.key_id} has "
            f"{', '.join(sorted(caller.scopes))}.",
        )
    return caller


def _caller(request: Request, shown: str | None) -> Caller:
    remote = _remote(request)
    if shown is None:
        if not request.app.state.keys_required:
            return _local(remote)
        _turn_away(
            request,
            Caller("-", frozenset(), remote=remote),
            NO_KEY,
        )
    keys: KeyStore = request.app.state.keys
    key = keys.find(shown)
    if key is None:
        _turn_away(
            request,
            Caller("-", frozenset(), remote=remote),
            "This service does not know the key that came with the request.",
        )
    return _holder(request, key)


def _holder(request: Request, key: Key) -> Caller:
    """Return who has a key, unless it is no longer valid."""
    remote = _remote(request)
    refusal = key.refusal(time.time())
    if refusal is not None:
        # Counted by address, which a revoked key must not circumvent.
        who = Caller(key.owner, frozenset(), remote=remote)
        _turn_away(request, who, f"{refusal} Ask for a new one.")
    keys: KeyStore = request.app.state.keys
    with suppress(DatabaseAway):  # failing to record the use must not refuse the request
        keys.used(key)
    return key.caller(remote)


def _turn_away(request: Request, who: Caller, detail: str) -> NoReturn:
    limits: CallerLimits = request.app.state.limits
    limits.take(name_of(who))
    _deny(request, who, 401, "Unauthorized", detail)


def _deny(request: Request, who: Caller, status: int, title: str, detail: str) -> NoReturn:
    audit: AuditLog = request.app.state.audit
    route = getattr(request.scope.get("route"), "path", request.url.path)
    audit.denied(who, f"{request.method} {route}", f"{status} {title}")
    headers = {"WWW-Authenticate": _CHALLENGE} if status == 401 else {}
    raise Problem(status, title, detail, headers=headers)


def _local(remote: str | None) -> Caller:
    return Caller(LOCAL.owner, LOCAL.scopes, remote=remote)


def _remote(request: Request) -> str | None:
    return None if request.client is None else request.client.host
