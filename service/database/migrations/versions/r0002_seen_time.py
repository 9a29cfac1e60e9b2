"""Add `seen_time` and the columns `kept_from_s`, so that expiry does not depend on the clock."""

import sqlalchemy as sa
from alembic import op

__all__ = ["down_revision", "revision", "upgrade"]

revision = "0002"
down_revision = "0001"


def upgrade() -> None:
    """Add a table and two columns; what is over already is kept from now on."""
    op.create_table(
        "seen_time",
        sa.Column("name", sa.String(length=32), nullable=False),
        sa.Column("seconds", sa.Float(), nullable=False),
        sa.PrimaryKeyConstraint("name", name=op.f("seen_time_pkey")),
    )
    op.add_column("jobs", sa.Column("kept_from_s", sa.Float(), nullable=True))
    op.add_column("submissions", sa.Column("kept_from_s", sa.Float(), nullable=True))
