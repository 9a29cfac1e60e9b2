"""From a request to the room where things are computed, and back: limits as ordinary problems."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from typing import Any, TypeVar

from fastapi import Request
from starlette.requests import ClientDisconnect

from service.api.problems import Problem
from service.computing.room import Broke, LimitReached, Refused, Room, TooMany, Waited
from service.security.callers import Caller

__all__ = ["computed", "while_there"]

_T = TypeVar("_T")


async def computed(
    request: Request,
    room: Room,
    caller: Caller,
    task: str,
    given: dict[str, Any],
    *,
    refused: str,
    remedy: str,
) -> Any:
    """Return what a task of `service.computing.tasks` returns, while the caller waits for it.

    Parameters
    ----------
    request : Request
        Its body must have been read; when its sender hangs up, the computation ends.
    room : Room
    caller : Caller
        Whose turn it is.
    task : str
        Name of the function.
    given : dict
    refused : str
        Title of the problem when what was asked cannot be computed.
    remedy : str
        What to do when a limit is reached.

    Raises
    ------
    Problem
        422 for what is refused and for a limit that is reached, 429 if too many wait, 500.
    """
    name = f"service.computing.tasks:{task}"
    try:
        return await while_there(request, room.compute(caller.owner, name, given, remedy=remedy))
    except Refused as error:
        extra = {} if error.reason is None else {"reason": error.reason}
        raise Problem(422, refused, str(error), **extra) from None
    except LimitReached as error:
        raise Problem(422, "A limit is reached", str(error)) from None
    except (TooMany, Waited) as error:
        raise Problem(
            429,
            "Too many wait",
            f"{error}; ask again later, one after the other.",
            headers={"Retry-After": "30"},
        ) from None
    except Broke:
        raise Problem(
            500, "Internal error", "The computation broke; the service's log holds the details."
        ) from None


async def while_there(request: Request, work: Coroutine[Any, Any, _T]) -> _T:
    """Return what `work` returns; cancel it when the caller hangs up.

    Raises
    ------
    ClientDisconnect
    """
    working = asyncio.ensure_future(work)
    gone = asyncio.ensure_future(_gone(request))
    try:
        await asyncio.wait((working, gone), return_when=asyncio.FIRST_COMPLETED)
        if not working.done():
            raise ClientDisconnect
        return working.result()
    finally:
        for task in (working, gone):
            task.cancel()
        await asyncio.gather(working, gone, return_exceptions=True)


async def _gone(request: Request) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass
