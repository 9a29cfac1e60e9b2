"""`stillpath keys ...` and `stillpath audit`. They work on the database, running service or not."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stillpath.cli.own_machines import service_settings, who
from stillpath.models.errors import ModelError

if TYPE_CHECKING:
    from sqlalchemy import Engine

__all__ = ["app", "audit"]

DataDir = Annotated[
    Path | None, typer.Option(help="Of the service, with SQLite [STILLPATH_DATA_DIR].")
]

app = typer.Typer(help="Keys of the service: who may call it.", rich_markup_mode=None)


@app.command()
def create(
    name: Annotated[str, typer.Argument(help="What it is for: `slicer of Ada`.")],
    owner: Annotated[str, typer.Option(help="Whose jobs its jobs are.")],
    scope: Annotated[
        list[str] | None,
        typer.Option(help="read, submit or admin; may be repeated. [default: read and submit]"),
    ] = None,
    days: Annotated[
        float | None,
        typer.Option(min=0.01, max=36500, help="How long it is good. [default: always]"),
    ] = None,
    data_dir: DataDir = None,
) -> None:
    """Make a key and print it, this once. Nothing else goes to stdout."""
    import time

    from stillpath.service.security.callers import Scope

    known = [each.value for each in Scope]
    for wanted in scope or ():
        if wanted not in known:
            raise ModelError(f"there is no scope {wanted!r}; there are {', '.join(known)}")
    scopes = [Scope(wanted) for wanted in scope or ("read", "submit")]
    expires_at = None if days is None else time.time() + days * 86400
    with _opened(data_dir) as engine:
        key, secret = _store(engine).create(
            name=name, owner=owner, scopes=scopes, expires_at=expires_at
        )
        _show(engine, key, secret)
    typer.echo(f"key {key.id} of {owner}; it cannot be shown again", err=True)


@app.command("list")
def list_keys(data_dir: DataDir = None) -> None:
    """List the keys, without the keys themselves."""
    with _opened(data_dir) as engine:
        found = _store(engine).list()
    rows = [
        (
            key.id,
            key.owner,
            key.name,
            " ".join(sorted(key.scopes)),
            _moment(key.created_at),
            _moment(key.expires_at),
            _moment(key.used_at),
            _moment(key.revoked_at),
        )
        for key in found
    ]
    _print_table(("id", "owner", "name", "scopes", "made", "expires", "last use", "revoked"), rows)


@app.command()
def revoke(
    key_id: Annotated[str, typer.Argument(metavar="ID", help="From `stillpath keys list`.")],
    data_dir: DataDir = None,
) -> None:
    """End a key at once and for good."""
    with _opened(data_dir) as engine:
        key = _store(engine).revoke(key_id)
        if key is None:
            raise ModelError(f"there is no key {key_id!r}; `stillpath keys list` shows them")
        _note(engine, "key.revoke", key)
    typer.echo(f"key {key.id} of {key.owner} is revoked")


@app.command()
def first(data_dir: DataDir = None) -> None:
    """Make the first key, with all scopes, before the service's first start, and print it."""
    with _opened(data_dir, may_be_new=True) as engine:
        store = _store(engine)
        secret = store.create_first()
        if secret is None:
            raise ModelError(
                "there are keys already; `stillpath keys create NAME --owner OWNER --scope admin` "
                "makes another"
            )
        _show(engine, store.find(secret), secret)


def audit(
    last: Annotated[int, typer.Option(min=1, max=100_000, help="How many rows.")] = 50,
    action: Annotated[
        str | None, typer.Option(help="Only these: submit, cancel, delete, denied, ...")
    ] = None,
    data_dir: DataDir = None,
) -> None:
    """Show who did what with the service, the newest first."""
    from stillpath.service.security.audit import AuditLog

    with _opened(data_dir) as engine:
        found = AuditLog(engine).page(limit=last, action=action)
    rows = [
        (
            _moment(row.at),
            row.owner,
            row.key_id or "",
            row.remote or "",
            row.action,
            row.subject or "",
            " ".join(f"{name}={value}" for name, value in row.details.items()),
        )
        for row in found
    ]
    _print_table(("at", "owner", "key", "from", "action", "on", "details"), rows)


@contextmanager
def _opened(data_dir: Path | None, *, may_be_new: bool = False) -> Iterator[Engine]:
    from stillpath.service.database.engine import SQLITE_FILE, open_database
    from stillpath.service.database.errors import StoreError
    from stillpath.service.security.keys import KeyRefused

    settings = service_settings(data_dir=data_dir)
    is_new = settings.database_url is None and not (settings.data_dir / SQLITE_FILE).exists()
    if is_new and not may_be_new:
        raise ModelError(
            f"there is no database in {settings.data_dir}; name the service's --data-dir"
        )
    try:
        engine = open_database(settings)
        try:
            yield engine
        finally:
            engine.dispose()
    except (StoreError, KeyRefused) as error:
        raise ModelError(str(error)) from None


def _store(engine: Engine) -> Any:
    from stillpath.service.security.keys import KeyStore

    return KeyStore(engine)


def _show(engine: Engine, key: Any, secret: str) -> None:
    """Print a key; one that cannot be shown is withdrawn, as nobody could ever use it.

    Raises
    ------
    OSError
        Also where nobody reads any more.
    """
    _note(engine, "key.create", key)
    out = sys.stdout.buffer  # `sys.stdout` swallows that its reader has gone
    try:
        out.write(f"{secret}\n".encode())
        out.flush()
    except OSError:
        _store(engine).withdraw(key)
        _note(engine, "key.withdraw", key)
        raise


def _note(engine: Engine, action: str, key: Any) -> None:
    """Write into the audit log what was done here, by whoever may read the database."""
    from stillpath.service.security.audit import AuditLog
    from stillpath.service.security.callers import LOCAL, Caller

    caller = Caller(LOCAL.owner, LOCAL.scopes, remote="command line")
    AuditLog(engine).add(
        caller,
        action,
        key.id,
        owner=key.owner,
        name=key.name,
        scopes=sorted(key.scopes),
        by=who(None),
    )


def _moment(seconds: float | None) -> str:
    if seconds is None:
        return ""
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M:%S")


def _print_table(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> None:
    """Print columns by tabs where a program reads, as a table on a terminal."""
    if not sys.stdout.isatty():
        for row in (head, *rows):
            typer.echo("\t".join(" ".join(cell.split()) for cell in row))
        return
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(*head)
    for row in rows:
        table.add_row(*(Text(cell) for cell in row))
    Console(highlight=False).print(table)
