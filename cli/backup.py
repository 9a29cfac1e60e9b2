"""`stillpath backup`, `restore` and `migrate`. Heavy imports wait until a command needs them."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stillpath.cli.own_machines import service_settings
from stillpath.models.errors import ModelError

if TYPE_CHECKING:
    from stillpath.service.settings import Settings

__all__ = ["backup", "migrate", "restore"]

DataDir = Annotated[
    Path | None, typer.Option("--data-dir", help="The service's data [STILLPATH_DATA_DIR].")
]


def backup(
    target: Annotated[
        Path, typer.Argument(metavar="TARGET", help="A new .tar or .tar.gz, or a folder for it.")
    ],
    data_dir: DataDir = None,
) -> None:
    """Write the service's data to one file, also while it runs."""
    from stillpath.service.backup.archive import BackupError, back_up

    settings = _of_one_computer(data_dir)
    if target.is_dir():
        target /= f"stillpath-{datetime.now().astimezone():%Y%m%d-%H%M%S}.tar"
    elif not target.suffix:
        raise ModelError(f"there is no folder {target}; make it, or name a new .tar file")
    try:
        manifest = back_up(settings.data_dir, target)
    except BackupError as error:
        raise ModelError(str(error)) from None
    typer.echo(
        f"{target}: {manifest.jobs} jobs, {len(manifest.files)} files, "
        f"{manifest.size_bytes / 1e6:.1f} MB"
    )


def restore(
    source: Annotated[Path, typer.Argument(metavar="SOURCE", exists=True, dir_okay=False)],
    data_dir: DataDir = None,
) -> None:
    """Fill an empty data directory from a backup; the service must not run."""
    from stillpath.service.backup.archive import BackupError
    from stillpath.service.backup.archive import restore as restore_archive

    settings = _of_one_computer(data_dir)
    try:
        manifest = restore_archive(source, settings.data_dir)
    except BackupError as error:
        raise ModelError(str(error)) from None
    typer.echo(
        f"{settings.data_dir}: {manifest.jobs} jobs, {len(manifest.files)} files, checked; "
        f"written by version {manifest.version}"
    )


def migrate(data_dir: DataDir = None) -> None:
    """Bring the database to the schema of this version; `serve` does so at its start, too."""
    from stillpath.service.database.engine import open_database
    from stillpath.service.database.errors import StoreError
    from stillpath.service.database.migrations import LATEST

    try:
        open_database(service_settings(data_dir=data_dir)).dispose()
    except StoreError as error:
        raise ModelError(str(error)) from None
    typer.echo(f"schema {LATEST}")


def _of_one_computer(data_dir: Path | None) -> Settings:
    settings = service_settings(data_dir=data_dir)
    if settings.database_url is not None or settings.storage_url is not None:
        raise ModelError(
            "database or files are not in the data directory (STILLPATH_DATABASE_URL, "
            "STILLPATH_STORAGE_URL): back them up with their own tools, pg_dump first, then the "
            "bucket; docs/running.md says how"
        )
    return settings
