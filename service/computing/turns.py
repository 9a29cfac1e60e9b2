"""Whose turn it is: few places, owners one after the other, nobody waits without end."""

from __future__ import annotations

import asyncio
from collections import Counter, OrderedDict, deque
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

__all__ = ["TooMany", "Turns", "Waited"]

_REMEMBERED = 1000


class TooMany(Exception):
    """So many wait already that one more is refused."""


class Waited(Exception):
    """The turn did not come in time."""


class Turns:
    """Places that are given to owners in turn.

    Of those who wait, the owner with the fewest places goes first, then who was served longest ago.
    Where there are several places, one owner never has all of them: somebody else may come.

    Parameters
    ----------
    places : int
    waiting, waiting_of_one : int
        How many may wait, in all and of one owner.
    patience_s : float
        How long one waits.
    """

    def __init__(
        self, places: int, *, waiting: int = 64, waiting_of_one: int = 8, patience_s: float = 600.0
    ) -> None:
        self._places = places
        self._most, self._most_of_one = waiting, waiting_of_one
        self._patience_s = patience_s
        self._running: Counter[str] = Counter()
        self._lines: dict[str, deque[asyncio.Future[None]]] = {}
        # The last ones to be served, the latest at the end.
        self._served: OrderedDict[str, int] = OrderedDict()
        self._serving = 0

    @asynccontextmanager
    async def turn(self, owner: str) -> AsyncIterator[None]:
        """Wait for a place, and hold it for the `with` block.

        Raises
        ------
        TooMany, Waited
        """
        await self._wait(owner)
        try:
            yield
        finally:
            self._leave(owner)

    async def _wait(self, owner: str) -> None:
        line = self._lines.get(owner, ())
        waiting = sum(map(len, self._lines.values()))
        if len(line) >= self._most_of_one:
            raise TooMany(f"{len(line)} of yours wait already, the limit")
        if waiting >= self._most:
            raise TooMany(f"{waiting} wait already, the limit")
        mine: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._lines.setdefault(owner, deque()).append(mine)
        self._serve()
        try:
            async with asyncio.timeout(self._patience_s):
                await mine
        except BaseException as error:
            if mine.done() and not mine.cancelled():
                self._leave(owner)  # the place came at the same moment
            else:
                self._withdraw(owner, mine)
            if isinstance(error, TimeoutError):
                raise Waited(f"no place was free within {self._patience_s:g} s") from None
            raise

    def _serve(self) -> None:
        """Give free places to those whose turn it is."""
        most = max(1, self._places - 1)
        while self._running.total() < self._places:
            owners = [owner for owner in self._lines if self._running[owner] < most]
            if not owners:
                return
            owner = min(owners, key=lambda name: (self._running[name], self._served.get(name, 0)))
            next_one = self._lines[owner].popleft()
            if not self._lines[owner]:
                del self._lines[owner]
            if next_one.done():
                continue  # has gone away at this moment
            next_one.set_result(None)
            self._running[owner] += 1
            self._serving += 1
            self._served[owner] = self._serving
            self._served.move_to_end(owner)
            if len(self._served) > _REMEMBERED:
                self._served.popitem(last=False)

    def _leave(self, owner: str) -> None:
        self._running[owner] -= 1
        if not self._running[owner]:
            del self._running[owner]
        self._serve()

    def _withdraw(self, owner: str, mine: asyncio.Future[None]) -> None:
        line = self._lines.get(owner)
        if line is not None and mine in line:
            line.remove(mine)
            if not line:
                del self._lines[owner]
