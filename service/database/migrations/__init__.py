"""How the schema of the database grew, for Alembic; `service.database.engine.migrate` runs it.

A change of `service.database.tables` needs a new file in `versions` and a new `LATEST`; a test
compares the two.
"""

__all__ = ["LATEST"]

LATEST = "0004"
"""Revision that `service.database.tables` describes."""
