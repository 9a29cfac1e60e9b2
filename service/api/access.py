"""What a route asks of its caller: one of `Reader`, `Submitter` and `Admin` as a parameter."""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends, Request

from service.security.callers import LOCAL, Caller

__all__ = ["Admin", "Reader", "Submitter"]


def _reader(_: Request) -> Caller:
    return LOCAL


def _submitter(_: Request) -> Caller:
    return LOCAL


def _admin(_: Request) -> Caller:
    return LOCAL


Reader = Annotated[Caller, Depends(_reader)]
Submitter = Annotated[Caller, Depends(_submitter)]
Admin = Annotated[Caller, Depends(_admin)]
