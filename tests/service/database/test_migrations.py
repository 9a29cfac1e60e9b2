"""The schema: migrations lead to the tables, and only to databases of this version."""

from __future__ import annotations

from pathlib import Path

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Engine, inspect, text

from stillpath.service.database import migrations
from stillpath.service.database.engine import database_url, migrate, open_database
from stillpath.service.database.errors import StoreError
from stillpath.service.database.migrations import LATEST
from stillpath.service.database.tables import metadata
from stillpath.service.database.transactions import reading, writing
from stillpath.service.jobs.store import JobStore
from stillpath.service.settings import Settings
from tests.service.database.examples import make_job


def schema_of(engine: Engine) -> object:
    with reading(engine) as connection:
        look = inspect(connection)
        return {
            name: (
                [(c["name"], str(c["type"]), c["nullable"]) for c in look.get_columns(name)],
                look.get_pk_constraint(name),
                sorted(look.get_indexes(name), key=str),
                sorted(look.get_unique_constraints(name), key=str),
                look.get_foreign_keys(name),
            )
            for name in look.get_table_names()
        }


def test_migrations_lead_to_the_tables(engine: Engine):
    """A new database gets the tables at once; one that is migrated ends with the same."""
    made_at_once = schema_of(engine)
    with writing(engine) as connection:
        for table in reversed(metadata.sorted_tables):
            connection.execute(text(f"DROP TABLE {table.name}"))
        connection.execute(text("DELETE FROM alembic_version"))
    migrate(engine)
    assert schema_of(engine) == made_at_once
    with reading(engine) as connection:
        context = MigrationContext.configure(connection, opts={"compare_type": True})
        assert compare_metadata(context, metadata) == []


def test_the_latest_is_the_last():
    folder = Path(migrations.__file__).parent
    assert ScriptDirectory(str(folder)).get_heads() == [LATEST]


def test_a_migration_that_fails_leaves_nothing(settings: Settings, engine: Engine):
    """As if somebody had made a table of the last migration's by hand."""
    with writing(engine) as connection:
        for table in reversed(metadata.sorted_tables):
            connection.execute(text(f"DROP TABLE {table.name}"))
        connection.execute(text("DELETE FROM alembic_version"))
        connection.execute(text("CREATE TABLE leases (name TEXT)"))
    with pytest.raises(StoreError, match="leases"):
        open_database(settings)
    with reading(engine) as connection:
        assert set(inspect(connection).get_table_names()) == {"alembic_version", "leases"}
    with writing(engine) as connection:
        connection.execute(text("DROP TABLE leases"))
    migrate(engine)
    assert JobStore(engine).add(make_job())


def test_a_newer_schema_is_refused(settings: Settings, engine: Engine):
    with writing(engine) as connection:
        connection.execute(text("UPDATE alembic_version SET version_num = '9999'"))
    with pytest.raises(StoreError, match=r"schema 9999, .* up to 0\d+: a newer Stillpath"):
        open_database(settings)


def test_what_is_no_database(tmp_path: Path):
    (tmp_path / "stillpath.sqlite3").write_bytes(b"G1 X1\n" * 999)
    with pytest.raises(StoreError, match=r"stillpath\.sqlite3 cannot be read: .*not a database"):
        open_database(Settings(data_dir=tmp_path))


@pytest.mark.parametrize(
    ("given", "words"), [("nonsense", "not an address"), ("mysql://host/x", "begins with mysql")]
)
def test_an_address_of_something_else(tmp_path: Path, given: str, words: str):
    with pytest.raises(StoreError, match=f"STILLPATH_DATABASE_URL .*{words}"):
        open_database(Settings(data_dir=tmp_path, database_url=given))


def test_where_the_database_is(tmp_path: Path):
    assert database_url(Settings(data_dir=tmp_path)).database == str(tmp_path / "stillpath.sqlite3")
    for given in ("postgresql", "postgres", "postgresql+psycopg"):
        url = database_url(Settings(data_dir=tmp_path, database_url=f"{given}://u@h/d"))
        assert str(url) == "postgresql+psycopg://u@h/d"
    elsewhere = Settings(data_dir=tmp_path, database_url=f"sqlite:///{tmp_path / 'own' / 'db'}")
    engine = open_database(elsewhere)
    engine.dispose()
    assert (tmp_path / "own" / "db").exists()
