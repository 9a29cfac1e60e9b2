"""Turn Ctrl-C and SIGTERM into an exception that is neither lost nor harmful.

What a signal handler raises vanishes, or leaves half-made objects, when the signal arrives inside a
callback from C or a compiler. The first signal is therefore only recorded, and raised at the next
progress report; a second one is raised immediately.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

__all__ = ["Interrupted", "interruptible", "interruptible_at_once"]


class Interrupted(BaseException):
    """The process was asked to stop; no `Exception`, so that nobody handles it on the way out."""

    def __init__(self, number: int) -> None:
        super().__init__(f"signal {number}")
        self.exit_code = 128 + number


@contextmanager
def interruptible() -> Iterator[Callable[[], None]]:
    """Turn SIGINT and SIGTERM into `Interrupted`; yield a check to call now and then."""
    received: list[int] = []

    def check() -> None:
        if received:
            raise Interrupted(received[0])

    def remember(number: int, _: FrameType | None) -> None:
        check()
        received.append(number)

    before = {number: signal.signal(number, remember) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield check
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def interruptible_at_once() -> Iterator[None]:
    """Raise `Interrupted` immediately, for work in plain Python that mostly waits."""

    def stop(number: int, _: FrameType | None) -> None:
        raise Interrupted(number)

    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
