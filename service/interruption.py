"""Turn Ctrl-C, SIGTERM and SIGHUP into an exception that is neither lost nor harmful.

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
    """Turn SIGINT, SIGTERM and SIGHUP into `Interrupted`; yield a check to call now and then."""
    received: list[int] = []

    def check() -> None:
        if received:
            raise Interrupted(received[0])

    def remember(number: int, _: FrameType | None) -> None:
        check()
        received.append(number)

    with _handled_by(remember):
        yield check


@contextmanager
def interruptible_at_once() -> Iterator[None]:
    """Raise `Interrupted` immediately, for work in plain Python that mostly waits."""

    def stop(number: int, _: FrameType | None) -> None:
        raise Interrupted(number)

    with _handled_by(stop):
        yield


@contextmanager
def _handled_by(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Handle what asks for the end, as far as it is not ignored, as `nohup` has it."""
    asking = [getattr(signal, name, None) for name in ("SIGINT", "SIGTERM", "SIGHUP")]
    before = {
        number: signal.signal(number, handler)
        for number in asking
        if number is not None and signal.getsignal(number) != signal.SIG_IGN
    }
    try:
        yield
    finally:
        for number, former in before.items():
            signal.signal(number, former)
