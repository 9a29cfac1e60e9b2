"""Add the columns `kind` and `room_bytes` to the table `jobs`."""

import sqlalchemy as sa
from alembic import op

__all__ = ["down_revision", "revision", "upgrade"]

revision = "0003"
down_revision = "0002"


def upgrade() -> None:
    """Add two columns; all jobs so far are compensations."""
    op.add_column(
        "jobs",
        sa.Column("kind", sa.String(length=16), nullable=False, server_default="compensation"),
    )
    op.add_column("jobs", sa.Column("room_bytes", sa.BigInteger(), nullable=True))
