"""One computation in a process of its own, as the process sees it: limits first, then the work.

It begins as a copy of a process that has loaded the libraries (`service.processes`), so that to
start it costs little, and what it took is free when it ends. Nothing is unpickled from it: the
answer is JSON.
"""

from __future__ import annotations

import json
import os
import pkgutil
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

__all__ = ["BROKE", "DONE", "OUTGROWN", "REFUSED", "Task", "work"]

DONE, REFUSED, OUTGROWN, BROKE = "done", "refused", "outgrown", "broke"
"""How a computation ended: with an answer, because of what was asked, of memory, of us."""

Task = Callable[[dict[str, Any]], Any]
"""Takes and returns what JSON can hold; importable by its name."""

_NICENESS = 10
_ENDED = 1


def work(connection: Connection, task: str, given: dict[str, Any], max_bytes: int) -> None:
    """Do a task and send how it ended.

    Parameters
    ----------
    connection : Connection
        The asker's end is closed when nobody wants the answer any more: then the process ends.
    task : str
        ``module:name`` of a `Task`.
    given : dict
    max_bytes : int
        Memory that the computation may take, beside what is loaded already.
    """
    from service.environment import prepare_environment
    from service.logs import configure_logging
    from service.processes import limit_memory

    prepare_environment()
    configure_logging()
    if hasattr(os, "nice"):
        os.nice(_NICENESS)
    threading.Thread(target=_end_with_asker, args=(connection,), daemon=True).start()
    limit_memory(max_bytes)
    ended, answer = _outcome(task, given)
    connection.send_bytes(json.dumps([ended, answer]).encode())
    # Nothing is to be tidied up, and what is left over of a full memory could only get stuck.
    connection.close()
    os._exit(0)


def _outcome(task: str, given: dict[str, Any]) -> tuple[str, Any]:
    from compensation.base import DesignError
    from gcode.errors import GcodeError
    from models.errors import ModelError

    try:
        found: Task = pkgutil.resolve_name(task)
        return DONE, found(given)
    except (DesignError, GcodeError, ModelError) as error:
        return REFUSED, {"detail": str(error), "reason": getattr(error, "reason", None)}
    except MemoryError:
        return OUTGROWN, None
    except Exception:
        import structlog

        structlog.get_logger("computing").exception("computation broke", task=task)
        return BROKE, None


def _end_with_asker(connection: Connection) -> None:
    """End the process as soon as the other end is closed; nothing ever comes from there."""
    try:
        connection.poll(None)
        connection.recv_bytes()
    except (EOFError, OSError):
        os._exit(_ENDED)
