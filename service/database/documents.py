"""Documents in the database, where several computers share them."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from sqlalchemy import ColumnElement, Connection, Engine, func, select, text, update

from stillpath.applications.machines.documents import DocumentFolder, Documents
from stillpath.service.database.engine import database_url
from stillpath.service.database.tables import documents
from stillpath.service.database.transactions import insert, reading, writing

if TYPE_CHECKING:
    from stillpath.service.settings import Settings

__all__ = ["DocumentTable", "open_documents"]

_ROW = documents.c


def open_documents(settings: Settings, engine: Engine, name: str) -> Documents:
    """Return the place of the machines or the identifications.

    Parameters
    ----------
    engine : sqlalchemy.Engine
        Of the same settings.
    name : {"machines", "identifications", "printers"}

    Returns
    -------
    Documents
        In the database if that is PostgreSQL, else a folder in the data directory.
    """
    if database_url(settings).get_backend_name() == "sqlite":
        return DocumentFolder(Path(settings.data_dir) / name)
    return DocumentTable(engine, name)


class DocumentTable:
    """`applications.machines.documents.Documents` in the table ``documents``.

    Parameters
    ----------
    root : str
        First part of all paths in the table.
    """

    def __init__(self, engine: Engine, root: str) -> None:
        self._engine = engine
        self._root = root

    def folders(self, within: str = "") -> list[str]:
        """See `Documents`."""
        return sorted({path.partition("/")[0] for path in self._below(within) if "/" in path})

    def names(self, folder: str) -> list[str]:
        """See `Documents`."""
        return sorted(path for path in self._below(folder) if "/" not in path)

    def read(self, path: str) -> bytes:
        """See `Documents`."""
        query = select(documents.c.content).where(_ROW.path == self._key(path))
        with reading(self._engine) as connection:
            content = connection.execute(query).scalar()
        if content is None:
            raise FileNotFoundError(f"{self.place(path)} is not there")
        return str(content).encode()

    def create(self, path: str, text: str, *, beside: str | None = None) -> None:
        """See `Documents`."""
        with writing(self._engine) as connection:
            _one_at_a_time(connection)
            if beside is not None and not self._holds(connection, _ROW.path == self._key(beside)):
                raise FileNotFoundError(f"{self.place(beside)} is gone")
            if self._holds(connection, _ROW.path == self._key(path)):
                raise FileExistsError(f"{self.place(path)} already exists")
            connection.execute(documents.insert().values(self._row(path, text)))

    def create_folder(self, folder: str, contents: Mapping[str, str]) -> None:
        """See `Documents`."""
        with writing(self._engine) as connection:
            _one_at_a_time(connection)
            self._must_be_empty(connection, folder)
            rows = [self._row(f"{folder}/{name}", text) for name, text in contents.items()]
            connection.execute(documents.insert(), rows)

    def move(self, folder: str, target: str) -> None:
        """See `Documents`."""
        old, new = self._key(folder), self._key(target)
        with writing(self._engine) as connection:
            _one_at_a_time(connection)
            self._must_be_empty(connection, target)
            moved = connection.execute(
                update(documents)
                .where(_is_below(old))
                .values(path=new + func.substr(_ROW.path, len(old) + 1))
            )
            if not moved.rowcount:
                raise FileNotFoundError(f"{self.place(folder)} is not there")

    def replace(self, path: str, text: str) -> None:
        """See `Documents`."""
        row = self._row(path, text)
        with writing(self._engine) as connection:
            statement = insert(connection, documents).values(row)
            connection.execute(statement.on_conflict_do_update(index_elements=["path"], set_=row))

    def place(self, path: str) -> str:
        """See `Documents`."""
        return f"{self._key(path)} in the database"

    def _key(self, path: str) -> str:
        return f"{self._root}/{path}" if path else self._root

    def _row(self, path: str, text: str) -> dict[str, object]:
        return {"path": self._key(path), "content": text, "created_at": time.time()}

    def _below(self, folder: str) -> list[str]:
        key = self._key(folder)
        with reading(self._engine) as connection:
            found = connection.execute(select(_ROW.path).where(_is_below(key))).scalars()
            return [path[len(key) + 1 :] for path in found]

    def _holds(self, connection: Connection, condition: ColumnElement[bool]) -> bool:
        return connection.execute(select(_ROW.path).where(condition).limit(1)).first() is not None

    def _must_be_empty(self, connection: Connection, folder: str) -> None:
        if self._holds(connection, _is_below(self._key(folder))):
            raise FileExistsError(f"{self.place(folder)} already exists")


def _is_below(key: str) -> ColumnElement[bool]:
    # LIKE would need escapes, and it overlooks upper case on SQLite.
    return func.substr(_ROW.path, 1, len(key) + 1) == f"{key}/"


def _one_at_a_time(connection: Connection) -> None:
    """Let writers wait for each other, as SQLite's do anyway; readers do not wait."""
    if connection.dialect.name == "postgresql":
        connection.execute(text("LOCK TABLE documents IN SHARE ROW EXCLUSIVE MODE"))
