"""Logs: one line per event on stderr, for a person on a terminal and as JSON elsewhere."""

from __future__ import annotations

import asyncio
import logging
import sys
from typing import TextIO, cast

import structlog
from structlog.typing import Processor

from stillpath.service.security.masking import mask_secrets

__all__ = ["configure_logging"]


def configure_logging() -> None:
    """Set up structlog for a process of the service."""
    renderer: Processor = structlog.processors.JSONRenderer()
    if sys.stderr.isatty():
        renderer = structlog.dev.ConsoleRenderer(exception_formatter=structlog.dev.plain_traceback)
    structlog.configure(
        processors=[
            structlog.contextvars.merge_contextvars,
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            # Text without the values of variables, and then nothing after the mask but output.
            structlog.processors.format_exc_info,
            mask_secrets,
            renderer,
        ],
        logger_factory=structlog.WriteLoggerFactory(file=cast("TextIO", _Stderr())),
    )
    logging.basicConfig(handlers=[_Forward()], level=logging.WARNING)


class _Forward(logging.Handler):
    """Passes what libraries log on, so that it looks like everything else."""

    def emit(self, record: logging.LogRecord) -> None:
        error = record.exc_info[1] if record.exc_info else None
        if isinstance(error, asyncio.CancelledError):
            return  # a request that was in progress when the service stopped
        told = structlog.get_logger(record.name)
        told.log(record.levelno, record.getMessage(), exc_info=error)


class _Stderr:
    """Whatever stderr is at the moment of writing, so that a redirection ends when it should."""

    def write(self, text: str) -> int:
        return sys.stderr.write(text)

    def flush(self) -> None:
        sys.stderr.flush()
