"""Routes of keys and of the audit log, for admins."""

from __future__ import annotations

import time
from dataclasses import asdict
from datetime import datetime
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response
from pydantic import BaseModel, ConfigDict, Field

from stillpath.service.api.access import Admin
from stillpath.service.api.problems import Problem, responses
from stillpath.service.security.audit import AuditEntry, AuditLog, record
from stillpath.service.security.callers import Scope
from stillpath.service.security.keys import OWNER_PATTERN, Key, KeyRefused, KeyStore

__all__ = ["router"]

_DAY_S = 86400.0
_NO_STORE = {"Cache-Control": "no-store"}

router = APIRouter(prefix="/v1", tags=["keys"])


class KeyCreate(BaseModel):
    """Properties of a new API key."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "examples": [
                {
                    "name": "slicer in the workshop",
                    "owner": "ada",
                    "scopes": ["read", "submit"],
                    "expires_in_days": 365,
                }
            ]
        },
    )

    name: str = Field(min_length=1, max_length=120, description="What it is for.")
    owner: str = Field(
        pattern=OWNER_PATTERN, description="Owner of the jobs that are submitted with it."
    )
    scopes: list[Scope] = Field(min_length=1, max_length=8)
    expires_in_days: float | None = Field(
        default=None, gt=0, le=36500, allow_inf_nan=False, description="By default never."
    )


class KeyView(BaseModel):
    """A key as lists show it."""

    id: str = Field(description="Identifies the key; it is not the secret.")
    name: str
    owner: str
    scopes: list[Scope]
    created_at: datetime
    expires_at: datetime | None
    revoked_at: datetime | None
    used_at: datetime | None = Field(description="Last use; may be a minute behind.")

    @classmethod
    def of(cls, key: Key) -> KeyView:
        """Return the view of a key."""
        return cls.model_validate(_fields(key))


class NewKey(KeyView):
    """A key that was just made."""

    key: str = Field(description="The key itself. It is not kept and cannot be shown again.")


class AuditView(BaseModel):
    """An entry of the audit log."""

    id: int
    at: datetime
    owner: str = Field(description="Owner of the key; `-` if unknown.")
    key_id: str | None
    remote: str | None
    action: str
    subject: str | None
    details: dict[str, Any]

    @classmethod
    def of(cls, entry: AuditEntry) -> AuditView:
        """Return the view of a row."""
        return cls.model_validate(entry, from_attributes=True)


class AuditPage(BaseModel):
    """Entries of the audit log, newest first."""

    entries: list[AuditView]
    next_before: int | None = Field(description="`before` of the next page; null: there is none.")


@router.get("/keys", responses=responses(401, 403, 429), summary="List API keys")
def list_keys(request: Request, _: Admin) -> list[KeyView]:
    """Return all keys ever made, oldest first, without their secrets."""
    return [KeyView.of(key) for key in _keys(request).list()]


@router.post(
    "/keys",
    status_code=201,
    responses=responses(401, 403, 413, 422, 429),
    summary="Create an API key",
)
def create_key(request: Request, response: Response, asked: KeyCreate, caller: Admin) -> NewKey:
    """Create a key and return it. It cannot be shown again."""
    days = asked.expires_in_days
    try:
        key, secret = _keys(request).create(
            name=asked.name,
            owner=asked.owner,
            scopes=asked.scopes,
            expires_at=None if days is None else time.time() + days * _DAY_S,
        )
    except KeyRefused as error:
        raise Problem(422, "Invalid key", str(error)) from None
    record(
        request,
        caller,
        "key.create",
        key.id,
        owner=key.owner,
        name=key.name,
        scopes=sorted(key.scopes),
    )
    response.headers.update(_NO_STORE)
    return NewKey.model_validate(_fields(key) | {"key": secret})


@router.delete(
    "/keys/{key_id}",
    status_code=204,
    responses=responses(401, 403, 404, 429),
    summary="Revoke an API key",
)
def revoke_key(request: Request, key_id: str, caller: Admin) -> Response:
    """Revoke a key permanently. It stays in the list."""
    key = _keys(request).revoke(key_id)
    if key is None:
        raise Problem(404, "No such key", f"There is no key {key_id[:32]!r}; GET /v1/keys.")
    record(request, caller, "key.revoke", key.id, owner=key.owner, name=key.name)
    return Response(status_code=204)


@router.get(
    "/audit",
    tags=["audit"],
    responses=responses(401, 403, 422, 429),
    summary="List audit log entries",
)
def read_audit(
    request: Request,
    _: Admin,
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
    before: Annotated[
        int | None, Query(ge=1, le=2**53, description="`next_before` of the page before.")
    ] = None,
    action: Annotated[
        str | None, Query(max_length=64, description="For instance `submit` or `denied`.")
    ] = None,
) -> AuditPage:
    """Return entries of the audit log, newest first."""
    log: AuditLog = request.app.state.audit
    found = log.page(limit=limit + 1, before=before, action=action)
    shown = found[:limit]
    return AuditPage(
        entries=[AuditView.of(entry) for entry in shown],
        next_before=shown[-1].id if len(found) > limit else None,
    )


def _keys(request: Request) -> KeyStore:
    keys: KeyStore = request.app.state.keys
    return keys


def _fields(key: Key) -> dict[str, Any]:
    return asdict(key) | {"scopes": sorted(key.scopes)}
