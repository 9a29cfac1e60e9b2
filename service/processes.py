"""Processes that compensate are forked from one that has already loaded the libraries.

To load numba, scipy and our own modules takes longer than many a print does. One process loads
them, and all others begin as its copies: they start at once, and share its memory.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from multiprocessing.context import ForkServerContext, SpawnContext

__all__ = ["METHOD", "OF_THE_SERVICE", "limit_memory", "loaded_context", "quiet_tracker"]

OF_THE_SERVICE = (
    "distributed",
    "stillpath.service.jobs.worker",
    "stillpath.service.jobs.computations_preloaded",
)
"""Modules for the processes of a service; all of them are copies of the same one."""

METHOD = "forkserver" if sys.platform == "linux" else "spawn"
"""Windows has no fork, and on macOS libraries of the system do not bear one."""


def loaded_context(*more: str) -> ForkServerContext | SpawnContext:
    """Return what starts such processes; the first start loads the libraries.

    On Windows and macOS each process loads them itself.

    Parameters
    ----------
    *more : str
        Modules to be loaded too.
    """
    if sys.platform != "linux":
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["stillpath.service.preloaded", *more])
    return context


def limit_memory(max_bytes: int) -> None:
    """Let the system refuse this process more memory; where it cannot (macOS, Windows), do nothing.

    What is counted is private memory that may be written (RLIMIT_DATA): libraries and the addresses
    that compilers keep free are none.

    Parameters
    ----------
    max_bytes : int
        Beside what the process holds now; a limit set before no longer counts.
    """
    if sys.platform != "linux":
        return
    import resource

    status = Path("/proc/self/status").read_text()
    held_kib = next(int(line.split()[1]) for line in status.splitlines() if line[:6] == "VmData")
    most = (held_kib << 10) + max_bytes
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    if hard != resource.RLIM_INFINITY:
        most = min(most, hard)
    resource.setrlimit(resource.RLIMIT_DATA, (most, hard))


def quiet_tracker() -> None:
    """Start Python's tracker of semaphores with nothing to say; before any thread.

    It tidies up after processes that were killed, which is all there is to do, and would write
    about it, with tracebacks, among our logs.
    """
    if sys.platform == "win32":
        return
    from multiprocessing import resource_tracker

    kept = os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        resource_tracker.ensure_running()
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)
