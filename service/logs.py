"""Logs: one line per event on stderr, for a person on a terminal and as JSON elsewhere."""

from __future__ import annotations

import sys

import structlog

__all__ = ["configure_logging"]


def configure_logging() -> None:
    """Set up structlog for a process of the service."""
    person = sys.stderr.isatty()
    structlog.configure(
        processors=[
            structlog.contextvars.merge_contextvars,
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            structlog.dev.ConsoleRenderer() if person else structlog.processors.dict_tracebacks,
            *([] if person else [structlog.processors.JSONRenderer()]),
        ],
        logger_factory=structlog.WriteLoggerFactory(file=sys.stderr),
    )
