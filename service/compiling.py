"""Report that kernels are being compiled, which takes minutes, once per computer.

Numba compiles a kernel at its first call and caches it on disk. Meanwhile the work stands still,
and its measured pace does not predict the remaining time.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from numba.core.event import Listener, install_listener

from stillpath.pipeline.progress import Progress, ProgressCallback

__all__ = ["STAGE", "compiling_reported"]

STAGE = "compiling for this computer (once, some minutes)"

_QUIET_S = 15.0
"""Time without compiling after which the remaining time is reported again."""


@contextmanager
def compiling_reported(callback: ProgressCallback) -> Iterator[ProgressCallback]:
    """Yield a progress callback that says when this process compiles instead of working.

    Parameters
    ----------
    callback : callable
        Receives both. An exception raised during compilation is deferred to the next progress
        report.
    """
    told = _CompileListener(callback)
    with install_listener("numba:compile", told):
        yield told


class _CompileListener(Listener):
    def __init__(self, callback: ProgressCallback) -> None:
        self._callback = callback
        self._latest = Progress("starting", 0.0, 0.0, 0.0, None)
        self._began = time.monotonic()
        self._raised: BaseException | None = None
        self._depth = 0
        self._since = 0.0
        self._compiled_s = 0.0

    def __call__(self, progress: Progress) -> None:
        """Report progress; the remaining time is based on the pace without compiling."""
        if self._raised is not None:
            raise self._raised
        self._latest = progress
        if self._compiled_s and progress.eta_s is not None:
            progress = replace(progress, eta_s=self._left_s(progress))
        self._callback(progress)

    def on_start(self, event: Any) -> None:  # noqa: ARG002
        """Report that a kernel is being compiled, which may involve others."""
        if self._depth == 0:
            self._since = time.monotonic()
        self._depth += 1
        elapsed_s = time.monotonic() - self._began
        latest = self._latest
        try:
            self._callback(Progress(STAGE, latest.fraction, latest.print_seconds, elapsed_s, None))
        except BaseException as error:
            self._raised = error

    def on_end(self, event: Any) -> None:  # noqa: ARG002
        """Count the time of a compilation."""
        self._depth -= 1
        if self._depth == 0:
            now = time.monotonic()
            self._compiled_s += now - self._since
            self._since = now

    def _left_s(self, progress: Progress) -> float | None:
        """Return the remaining time, None while more compilation is likely."""
        if time.monotonic() - self._since < _QUIET_S:
            return None
        worked_s = max(progress.elapsed_s - self._compiled_s, 0.0)
        return worked_s * (1.0 - progress.fraction) / max(progress.fraction, 1e-9)
