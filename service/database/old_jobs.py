"""Takes over the jobs of a data directory of version 0.1, which kept them in `jobs.sqlite3`."""

from __future__ import annotations

import contextlib
import hashlib
import json
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from sqlalchemy import Engine

from stillpath.service.database import tables
from stillpath.service.database.engine import StoreError, insert, writing
from stillpath.service.security.callers import LOCAL

__all__ = ["take_over"]

_OLD = "jobs.sqlite3"
_SCHEMA = 1
_KEPT = (
    *("id", "machine", "source_name", "result_name", "source_bytes", "created_at", "state"),
    *("attempt", "losses", "stage", "progress", "eta_s", "started_at", "finished_at"),
)


def take_over(data_dir: Path, engine: Engine) -> None:
    """Copy the jobs in one transaction, then put ``.imported`` behind the old database's name.

    If the process is killed between the two, the next start does it again: what was copied is
    there already, and nobody has changed it meanwhile, as this comes before everything else. The
    files stay where they are, ``jobs/ID``.

    Raises
    ------
    StoreError
        If it cannot be read; nothing has changed then.
    """
    old = data_dir / _OLD
    with writing(engine) as connection:
        if not old.exists():  # another process was faster, and waited for by our BEGIN
            return
        for row in _rows(old, data_dir):
            connection.execute(insert(connection, tables.jobs).values(row).on_conflict_do_nothing())
    with contextlib.suppress(FileNotFoundError):
        old.rename(old.with_name(f"{_OLD}.imported"))


def _rows(old: Path, data_dir: Path) -> Iterator[dict[str, Any]]:
    try:
        with contextlib.closing(sqlite3.connect(old, timeout=30.0)) as connection:
            (version,) = connection.execute("PRAGMA user_version").fetchone()
            if version not in (0, _SCHEMA):
                raise StoreError(
                    f"{old}: schema {version}, known is {_SCHEMA}; move the file away, or use "
                    "another data directory"
                )
            # What its write-ahead log still holds must not stay behind under the old name.
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()
            connection.row_factory = sqlite3.Row
            found = connection.execute("SELECT * FROM jobs").fetchall() if version else []
    except sqlite3.DatabaseError as error:
        raise StoreError(
            f"{old}: cannot be read ({error}); restore it from a backup, or move it away to go on "
            "without its jobs"
        ) from error
    for row in found:
        yield _new_row(row, data_dir / "jobs" / row["id"])


def _new_row(old: sqlite3.Row, folder: Path) -> dict[str, Any]:
    row: dict[str, Any] = {name: old[name] for name in _KEPT}
    row |= {name: old[name] and json.loads(old[name]) for name in ("options", "problem")}
    source, result = folder / "source" / row["source_name"], folder / "result" / row["result_name"]
    is_done = row["state"] == "done" and result.is_file()
    return row | {
        "owner": LOCAL.owner,
        "machine_revision": _machine_revision(folder / "machine.json"),
        # Never equal to one of this version: it would have to be of the same program.
        "dedupe_key": f"old-{row['id']}",
        "source_sha256": _sha256(source) if source.is_file() else "",
        "output": f"jobs/{row['id']}" if is_done else None,
        "output_bytes": _size(folder / "result", folder / "report") if is_done else None,
        "result_bytes": result.stat().st_size if is_done else None,
        "result_sha256": _sha256(result) if is_done else None,
    }


def _machine_revision(file: Path) -> str:
    from stillpath.applications.machines.resolve import PinnedMachine
    from stillpath.models.errors import ModelError

    try:
        return PinnedMachine.read(file, "").machine.revision if file.is_file() else ""
    except ModelError:
        return ""


def _sha256(file: Path) -> str:
    with file.open("rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()


def _size(*folders: Path) -> int:
    return sum(p.stat().st_size for f in folders for p in f.rglob("*") if p.is_file())
