"""Processes that compensate are forked from one that has already loaded the libraries.

Loading numba, scipy and our own modules takes longer than processing many a print. One process
loads them, and all others are forked from it: they start immediately and share its memory.
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
"""Windows has no fork, and on macOS system libraries do not survive one."""


def loaded_context(*more: str) -> ForkServerContext | SpawnContext:
    """Return the context that starts such processes; the first start loads the libraries.

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
    """Limit the memory of this process; a no-op on macOS and Windows.

    Private writable memory counts (RLIMIT_DATA), but not libraries and address space reserved by
    compilers.

    Parameters
    ----------
    max_bytes : int
        In addition to current memory; replaces an earlier limit.
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
    """Start Python's resource tracker without output, before any thread.

    It cleans up after killed processes, and would otherwise write tracebacks into our logs.
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
