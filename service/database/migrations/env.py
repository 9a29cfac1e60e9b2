"""Called by Alembic: runs the migrations in the transaction that the caller has begun."""

from alembic import context

from stillpath.service.database.tables import metadata

# SQLite can undo changes of its schema too; Alembic's default is made for its older driver.
context.configure(
    connection=context.config.attributes["connection"],
    target_metadata=metadata,
    transactional_ddl=True,
)
context.run_migrations()
