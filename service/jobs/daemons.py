"""Processes of a service on several computers: scheduler and workers."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import socket
import sys
from collections.abc import Iterator

import structlog

from stillpath.applications.machines.settings import ENV_PREFIX
from stillpath.service.jobs.cluster import prepare_dask
from stillpath.service.settings import Settings

__all__ = ["run_scheduler", "run_workers"]

_RETRY_S = 1.0
_CLOSE_S = 10.0


def run_scheduler(host: str, port: int) -> None:
    """Run a Dask scheduler until SIGINT or SIGTERM.

    It has no state that is not in the database, so it may be killed and restarted.

    Raises
    ------
    OSError
        If the address cannot be bound.
    """
    prepare_dask()
    from distributed import Scheduler

    async def main() -> None:
        with _stop_signal() as stopped:
            async with Scheduler(
                host=host, port=port, dashboard=False, dashboard_address="127.0.0.1:0"
            ) as scheduler:
                sys.stdout.write(f"stillpath scheduler: {scheduler.address}\n")
                sys.stdout.flush()
                await stopped.wait()

    try:
        asyncio.run(main())
    except RuntimeError as error:  # Dask's, around what the system says
        if not isinstance(cause := error.__cause__, OSError):
            raise
        where = f"{host}:{port} ({cause.strerror})"
        raise OSError(
            cause.errno,
            f"the scheduler cannot listen on {where}; choose another --port, or an address of this "
            "computer as --host",
        ) from None


def run_workers(settings: Settings) -> None:
    """Run `settings.workers` worker processes until SIGINT or SIGTERM.

    They wait for the scheduler, and restart when it does. Jobs running at the end go back to the
    queue.
    """
    prepare_dask()
    if settings.scheduler is None:
        raise ValueError("workers need a scheduler")
    # The processes read their settings themselves.
    os.environ[ENV_PREFIX + "SCHEDULER"] = settings.scheduler
    os.environ[ENV_PREFIX + "DATA_DIR"] = str(settings.data_dir)
    asyncio.run(_keep_workers(settings))


async def _keep_workers(settings: Settings) -> None:
    with _stop_signal() as stopped:
        sys.stdout.write(f"stillpath worker: {settings.workers} for {settings.scheduler}\n")
        sys.stdout.flush()
        await asyncio.gather(*(_keep_worker(settings, stopped) for _ in range(settings.workers)))


async def _keep_worker(settings: Settings, stopped: asyncio.Event) -> None:
    from distributed import Nanny

    log = structlog.get_logger("workers")
    while not stopped.is_set():
        try:
            nanny = Nanny(
                settings.scheduler,
                nthreads=1,
                memory_limit=0,
                local_directory=str(settings.data_dir / "scratch"),
                name=f"{socket.gethostname()}-{os.urandom(4).hex()}",
                silence_logs=logging.CRITICAL,
            )
            log.info("worker starts", scheduler=settings.scheduler)
            await _one_life(nanny, stopped)
        except Exception as error:  # what Dask raises here is not documented
            log.warning("worker ended", reason=repr(error))
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(stopped.wait(), _RETRY_S)


async def _one_life(nanny: object, stopped: asyncio.Event) -> None:
    async def start_and_finish() -> None:
        await nanny  # type: ignore[misc]
        await nanny.finished()  # type: ignore[attr-defined]

    life = asyncio.create_task(start_and_finish())
    end = asyncio.create_task(stopped.wait())
    try:
        await asyncio.wait({life, end}, return_when=asyncio.FIRST_COMPLETED)
    finally:
        end.cancel()
        if not life.done():
            life.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await life
        await nanny.close(timeout=_CLOSE_S)  # type: ignore[attr-defined]
    if life.done() and not life.cancelled():
        life.result()


@contextlib.contextmanager
def _stop_signal() -> Iterator[asyncio.Event]:
    """Yield an event that SIGINT and SIGTERM set."""
    stopped = asyncio.Event()
    loop = asyncio.get_running_loop()
    with contextlib.ExitStack() as stack:
        for number in (signal.SIGINT, signal.SIGTERM):
            with contextlib.suppress(NotImplementedError):  # Windows: KeyboardInterrupt
                loop.add_signal_handler(number, stopped.set)
                stack.callback(loop.remove_signal_handler, number)
        yield stopped
