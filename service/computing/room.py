"""Where the API has things computed: a bounded number of processes, each for one question.

The process of the API moves bytes and rows. What takes processor or memory goes into a process with
limits that the system keeps; it is ended when its time is over or its asker has hung up, and others
do not notice.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from anyio import CapacityLimiter, to_thread

from service.computing.process import BROKE, DONE, OUTGROWN, REFUSED, work
from service.computing.turns import TooMany, Turns, Waited
from service.processes import OF_THE_SERVICE, loaded_context

if TYPE_CHECKING:
    from multiprocessing.connection import Connection
    from multiprocessing.context import ForkServerProcess, SpawnProcess

__all__ = ["Broke", "LimitReached", "Refused", "Room", "RoomLimits", "TooMany", "Waited"]

_LOOK_S = 0.1
_MIB = 1 << 20
_LARGEST_ANSWER_BYTES = 64 << 20


@dataclass(frozen=True, slots=True)
class RoomLimits:
    """What one computation may take, and the settings that say so, for messages."""

    seconds: float
    memory_bytes: int
    seconds_setting: str = "STILLPATH_MAX_COMPUTING_S"
    memory_setting: str = "STILLPATH_MAX_COMPUTING_BYTES"


class Refused(Exception):
    """What was asked cannot be computed: an error of the house, `reason` if it has one."""

    def __init__(self, detail: str, reason: Any = None) -> None:
        super().__init__(detail)
        self.reason = reason


class LimitReached(Exception):
    """The computation took too long or too much memory; the message says which, and what to do."""


class Broke(RuntimeError):
    """The computation broke, which is ours; its process has written the log."""


class Room:
    """The processes.

    Parameters
    ----------
    processes : int
        How many compute at once.
    limits : RoomLimits
        Of each.
    """

    def __init__(self, processes: int, limits: RoomLimits) -> None:
        self._limits = limits
        self._turns = Turns(processes)
        self._threads = CapacityLimiter(processes)
        self._ended = threading.Event()

    async def compute(self, owner: str, task: str, given: dict[str, Any], *, remedy: str) -> Any:
        """Return what a task returns, when its owner's turn has come.

        Cancelled, it ends the process at once.

        Parameters
        ----------
        owner : str
            Of whom others' turns come in between.
        task : str
            ``module:name`` of a `service.computing.process.Task`.
        given : dict
        remedy : str
            What to do when a limit is reached, for its message.

        Raises
        ------
        Refused, LimitReached, Broke, TooMany, Waited
        """
        async with self._turns.turn(owner):
            nobody_waits = threading.Event()
            running = asyncio.ensure_future(
                to_thread.run_sync(
                    self._run, task, given, remedy, nobody_waits.is_set, limiter=self._threads
                )
            )
            try:
                return await asyncio.shield(running)
            except asyncio.CancelledError:
                nobody_waits.set()
                # The place is free when the process is gone, not before.
                with contextlib.suppress(BaseException):
                    await running
                raise

    def close(self) -> None:
        """End what computes."""
        self._ended.set()

    def _run(
        self, task: str, given: dict[str, Any], remedy: str, unwanted: Callable[[], bool]
    ) -> Any:
        if self._ended.is_set():
            raise Broke("the service ends")
        context = loaded_context(*OF_THE_SERVICE)
        ours, theirs = context.Pipe()
        process = context.Process(
            target=work, args=(theirs, task, given, self._limits.memory_bytes), daemon=True
        )
        began = time.monotonic()
        try:
            with ours:
                process.start()
                theirs.close()
                while not ours.poll(_LOOK_S):
                    if unwanted() or self._ended.is_set():
                        raise Broke("nobody waits for it")
                    if time.monotonic() - began > self._limits.seconds:
                        raise self._too_long(remedy)
                ended, answer = self._received(ours, process, remedy)
        finally:
            _end(process)
        if ended == DONE:
            return answer
        if ended == REFUSED:
            raise Refused(answer["detail"], answer["reason"])
        if ended == OUTGROWN:
            raise self._too_large(remedy)
        raise Broke(f"{task} broke; see the log")

    def _received(
        self, ours: Connection, process: ForkServerProcess | SpawnProcess, remedy: str
    ) -> tuple[str, Any]:
        try:
            ended, answer = json.loads(ours.recv_bytes(_LARGEST_ANSWER_BYTES))
        except (EOFError, ConnectionError):
            # Libraries in C end their process where memory is refused them, each in its own way.
            process.join(_LOOK_S)
            raise self._too_large(remedy, f"its process ended, {process.exitcode}") from None
        return (ended if ended in (DONE, REFUSED, OUTGROWN) else BROKE), answer

    def _too_long(self, remedy: str) -> LimitReached:
        limit = f"{self._limits.seconds:g} s ({self._limits.seconds_setting})"
        return LimitReached(f"It was stopped after {limit}, the limit. {remedy}")

    def _too_large(self, remedy: str, how: str = "no more was given") -> LimitReached:
        limit = f"{self._limits.memory_bytes // _MIB} MiB ({self._limits.memory_setting})"
        return LimitReached(f"It needs more memory than {limit}, the limit: {how}. {remedy}")


def _end(process: ForkServerProcess | SpawnProcess) -> None:
    if process.pid is None:
        return
    process.kill()
    process.join()
    process.close()
