"""Setup of every Dask worker process (a *preload* there): lower priority, no foreign signals."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
from typing import Any

__all__ = ["dask_setup", "quiet_dask"]

_NICENESS = 10


async def dask_setup(worker: Any) -> None:
    """Set up a worker process; Dask calls it by this name."""
    quiet_dask()
    if hasattr(os, "nice"):
        # Uploads, and a firmware's host on the same computer, take precedence.
        os.nice(_NICENESS)
    # Ctrl-C reaches the whole process group; the service ends its workers itself.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if not hasattr(signal, "SIGKILL"):
        return  # Windows
    loop = asyncio.get_running_loop()
    closing: set[asyncio.Task[Any]] = set()

    def close() -> None:
        # The job goes back to the queue: its watch notices that the worker closes.
        closing.add(loop.create_task(worker.close(timeout=5, reason="SIGTERM")))

    # Supervisors send SIGTERM to all processes at once.
    loop.add_signal_handler(signal.SIGTERM, close)


def quiet_dask() -> None:
    """Silence Dask's own logs; relevant events are logged with the job's id."""
    for name in ("distributed", "distributed.client", "tornado", "tornado.application"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
