"""Add the column `held_back` to the table `jobs`."""

import sqlalchemy as sa
from alembic import op

__all__ = ["down_revision", "revision", "upgrade"]

revision = "0004"
down_revision = "0003"


def upgrade() -> None:
    """Add a column; of a print that was held back before, nobody knows that it was asked for."""
    op.add_column(
        "jobs",
        sa.Column("held_back", sa.Boolean(), nullable=False, server_default=sa.false()),
    )
