"""`stillpath serve`, and its parts on several computers: `stillpath scheduler`, `... worker`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stillpath.cli.own_machines import service_settings
from stillpath.models.errors import ModelError

if TYPE_CHECKING:
    from stillpath.service.settings import Settings

__all__ = ["scheduler", "serve", "worker"]

DataOption = Annotated[
    Path | None, typer.Option(help="Database, uploads, results [STILLPATH_DATA_DIR].")
]
WorkersOption = Annotated[int | None, typer.Option(help="Worker processes [STILLPATH_WORKERS].")]


def serve(
    host: Annotated[str, typer.Option(help="Address to bind.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="0: any free one.")] = 8000,
    data_dir: DataOption = None,
    workers: WorkersOption = None,
) -> None:
    """Serve HTTP: a page at /, the API under /v1.

    An address that other computers can reach asks its callers for a key. All settings:
    docs/running.md.
    """
    settings = _settings(data_dir=data_dir, workers=workers)
    _check_storage(settings)

    from stillpath.service.deliveries.printers import PrinterFileError
    from stillpath.service.security.keys import KeyRefused, UnsafeBinding
    from stillpath.service.server import serve_forever

    try:
        serve_forever(settings, host, port)
    except (UnsafeBinding, KeyRefused, PrinterFileError) as error:
        raise typer.TyperException(str(error)) from None


def scheduler(
    host: Annotated[
        str,
        typer.Option(help="Address to bind. Whoever reaches it can run anything on the workers."),
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="0: any free one.")] = 8786,
) -> None:
    """Run the scheduler of a service on several computers."""
    from stillpath.service.jobs.daemons import run_scheduler
    from stillpath.service.logs import configure_logging

    configure_logging()
    run_scheduler(host, port)


def worker(
    scheduler: Annotated[
        str | None,
        typer.Option(help="For instance tcp://host:8786 [STILLPATH_SCHEDULER]."),
    ] = None,
    workers: WorkersOption = None,
    data_dir: Annotated[
        Path | None, typer.Option(help="For files that are being made [STILLPATH_DATA_DIR].")
    ] = None,
) -> None:
    """Do jobs for a service on several computers. Database and storage: as for `serve`."""
    settings = _settings(data_dir=data_dir, workers=workers, scheduler=scheduler)
    if settings.scheduler is None:
        raise typer.TyperException(
            "which scheduler? Say --scheduler tcp://host:8786, or set STILLPATH_SCHEDULER"
        )
    _check_storage(settings)

    from stillpath.service.jobs.daemons import run_workers
    from stillpath.service.logs import configure_logging

    configure_logging()
    run_workers(settings)


def _check_storage(settings: Settings) -> None:
    """Refuse an address that names no storage; whether it answers is for later."""
    from stillpath.service.storage.factory import open_storage

    try:
        open_storage(settings)
    except ValueError as error:
        raise typer.TyperException(str(error)) from None


def _settings(**given: Any) -> Settings:
    try:
        return service_settings(**given)
    except ModelError as error:
        raise typer.TyperException(str(error)) from None
