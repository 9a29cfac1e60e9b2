"""The tables of the service. Every moment is in seconds since the epoch."""

from __future__ import annotations

from sqlalchemy import (
    JSON,
    BigInteger,
    Boolean,
    Column,
    Float,
    ForeignKey,
    Index,
    Integer,
    MetaData,
    String,
    Table,
    Text,
    UniqueConstraint,
    false,
)

__all__ = [
    "LONGEST_STAGE",
    "audit",
    "deliveries",
    "documents",
    "jobs",
    "keys",
    "leases",
    "metadata",
    "seen_time",
    "submissions",
]

LONGEST_STAGE = 64

metadata = MetaData(
    naming_convention={
        "ix": "%(column_0_label)s_index",
        "uq": "%(table_name)s_%(column_0_name)s_unique",
        "pk": "%(table_name)s_pkey",
        "fk": "%(table_name)s_%(column_0_name)s_fkey",
    }
)

jobs = Table(
    "jobs",
    metadata,
    Column("id", String(32), primary_key=True),
    Column("owner", String(64), nullable=False),
    Column("batch", String(64)),
    Column("machine", String(255), nullable=False),
    Column("machine_revision", String(64), nullable=False),
    Column("options", JSON, nullable=False),
    Column("dedupe_key", String(64), nullable=False),
    Column("priority", Integer, nullable=False, default=0),
    Column("source_name", String(255), nullable=False),
    Column("source_bytes", BigInteger, nullable=False),
    Column("source_sha256", String(64), nullable=False),
    Column("result_name", String(255), nullable=False),
    # Where this job's results lie in the storage; empty until they do.
    Column("output", String(255)),
    Column("output_bytes", BigInteger),
    Column("result_bytes", BigInteger),
    Column("result_sha256", String(64)),
    # The figures that lists show.
    Column("summary", JSON(none_as_null=True)),
    Column("state", String(16), nullable=False),
    Column("attempt", Integer, nullable=False, default=0),
    Column("losses", Integer, nullable=False, default=0),
    Column("worker", String(255)),
    Column("stage", String(LONGEST_STAGE), nullable=False),
    Column("progress", Float, nullable=False, default=0.0),
    Column("eta_s", Float),
    Column("problem", JSON(none_as_null=True)),
    Column("created_at", Float, nullable=False),
    Column("started_at", Float),
    Column("heartbeat_at", Float),
    Column("finished_at", Float),
    Column("webhook", Text),
    Column("printer", String(64)),
    Column("print_after", Boolean, nullable=False, default=False),
    # By `seen_time`: since when the job is known to be over.
    Column("kept_from_s", Float),
    # What is computed.
    Column("kind", String(16), nullable=False, server_default="compensation"),
    Column("room_bytes", BigInteger),
    # Whether a print that was asked for is not started after all.
    Column("held_back", Boolean, nullable=False, server_default=false()),
    Index("jobs_by_state", "state", "priority", "created_at"),
    Index("jobs_by_owner", "owner", "created_at"),
    Index("jobs_by_age", "created_at"),
    Index("jobs_by_dedupe_key", "owner", "dedupe_key"),
)
"""One row for each job that was accepted and not yet deleted."""

submissions = Table(
    "submissions",
    metadata,
    Column("owner", String(64), primary_key=True),
    Column("idempotency_key", String(255), primary_key=True),
    Column("fingerprint", String(64), nullable=False),
    Column("job_id", String(32), nullable=False),
    Column("created_at", Float, nullable=False),
    # By `seen_time`.
    Column("kept_from_s", Float),
)
"""Which job the request with an Idempotency-Key led to."""

keys = Table(
    "keys",
    metadata,
    Column("id", String(16), primary_key=True),
    Column("owner", String(64), nullable=False),
    Column("name", String(120), nullable=False),
    Column("sha256", String(64), nullable=False, unique=True),
    Column("scopes", String(64), nullable=False),
    Column("created_at", Float, nullable=False),
    Column("expires_at", Float),
    Column("revoked_at", Float),
    Column("used_at", Float),
)
"""API keys; of the key itself only a digest."""

audit = Table(
    "audit",
    metadata,
    Column("id", Integer, primary_key=True, autoincrement=True),
    Column("at", Float, nullable=False, index=True),
    Column("owner", String(64), nullable=False),
    Column("key_id", String(16)),
    Column("remote", String(64)),
    Column("action", String(64), nullable=False),
    Column("subject", String(255)),
    Column("details", JSON(none_as_null=True)),
)
"""Who did what; rows are only ever added."""

deliveries = Table(
    "deliveries",
    metadata,
    Column("id", Integer, primary_key=True, autoincrement=True),
    Column("job_id", String(32), ForeignKey("jobs.id", ondelete="CASCADE"), nullable=False),
    # webhook or printer
    Column("kind", String(16), nullable=False),
    Column("target", Text, nullable=False),
    # waiting, sending (claimed until next_at), done or failed
    Column("state", String(16), nullable=False, index=True),
    Column("attempts", Integer, nullable=False, default=0),
    Column("next_at", Float, nullable=False),
    Column("error", Text),
    UniqueConstraint("job_id", "kind"),
)
"""Webhooks and uploads to printers that are due, and what became of them."""

leases = Table(
    "leases",
    metadata,
    Column("name", String(32), primary_key=True),
    Column("holder", String(64), nullable=False),
    Column("expires_at", Float, nullable=False),
)
"""Which process does what only one may do at a time."""

seen_time = Table(
    "seen_time",
    metadata,
    Column("name", String(32), primary_key=True),
    Column("seconds", Float, nullable=False),
)
"""How long the service has been running, in all: clocks are not to be trusted."""

documents = Table(
    "documents",
    metadata,
    Column("path", String(255), primary_key=True),
    Column("content", Text, nullable=False),
    Column("created_at", Float, nullable=False),
)
"""Machines and identifications, where several computers share them."""
