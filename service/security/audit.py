"""The audit log of who did what. Rows are only ever added."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import structlog
from sqlalchemy import Engine, insert, select

from stillpath.service.database.errors import DatabaseAway
from stillpath.service.database.tables import audit
from stillpath.service.database.transactions import reading, writing
from stillpath.service.security.callers import Caller

if TYPE_CHECKING:
    from fastapi import Request

__all__ = ["AuditEntry", "AuditLog", "record", "tell"]

_DENIED_SECONDS = 60.0
_DENIED_KEPT = 4096


@dataclass(frozen=True, slots=True)
class AuditEntry:
    """One row.

    Attributes
    ----------
    id : int
        Grows; the cursor of pages.
    at : float
        Seconds since the epoch.
    owner : str
        Who; ``-`` if nobody knows.
    key_id : str or None
        By which key; None: on this computer, without one.
    remote : str or None
        Address of the other side.
    action : str
        For instance ``submit``, ``cancel``, ``delete``, ``machine.change``, ``printer.accept``,
        ``key.revoke``, ``key.withdraw`` (it could not be shown), ``denied``.
    subject : str or None
        What it was done to: the id of a job or key, the name of a machine, a route.
    details : dict
        For instance the machine's revision and the source's sha256.
    """

    id: int
    at: float
    owner: str
    key_id: str | None
    remote: str | None
    action: str
    subject: str | None
    details: dict[str, Any]


class AuditLog:
    """The audit log in the database."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._denied: OrderedDict[tuple[str | None, ...], float] = OrderedDict()
        self._lock = threading.Lock()

    def add(self, caller: Caller, action: str, subject: str | None, **details: Any) -> None:
        """Write a row.

        Raises
        ------
        DatabaseAway
        """
        self._write(self.row(caller, action, subject, **details))

    def row(
        self, caller: Caller, action: str, subject: str | None, **details: Any
    ) -> dict[str, Any]:
        """Return a row to be written in the transaction of the action."""
        return {
            "at": time.time(),
            "owner": caller.owner,
            "key_id": caller.key_id,
            "remote": None if caller.remote is None else caller.remote[:64],
            "action": action[:64],
            "subject": None if subject is None else subject[:255],
            "details": details or None,
        }

    def note(self, caller: Caller, action: str, subject: str | None, **details: Any) -> None:
        """Write a row, and the same into the log.

        The action has already happened, so a database failure is logged, not raised.
        """
        row = self.row(caller, action, subject, **details)
        try:
            self._write(row)
        except DatabaseAway as error:
            _log(row).error("audit row lost", action=action, reason=str(error))
        else:
            tell(row)

    def denied(self, caller: Caller, route: str, why: str) -> None:
        """Record a refused request, at most once a minute per network and reason.

        Without that limit anyone could fill the disk.
        """
        what = (caller.network, caller.key_id, why)
        now = time.time()
        with self._lock:
            # Less than nothing where the clock was set back.
            if 0 <= now - self._denied.get(what, 0.0) < _DENIED_SECONDS:
                return
            self._denied[what] = now
            self._denied.move_to_end(what)
            if len(self._denied) > _DENIED_KEPT:
                self._denied.popitem(last=False)
        self.note(caller, "denied", route, why=why)

    def _write(self, row: dict[str, Any]) -> None:
        with writing(self._engine) as connection:
            connection.execute(insert(audit).values(row))

    def page(
        self, *, limit: int = 100, before: int | None = None, action: str | None = None
    ) -> list[AuditEntry]:
        """Return rows, the newest first.

        Parameters
        ----------
        limit : int
            At most so many.
        before : int, optional
            Only rows whose id is smaller.
        action : str, optional
            Only rows of this action.
        """
        if action is not None and "\0" in action:
            return []  # none holds one; databases refuse it
        query = select(audit).order_by(audit.c.id.desc()).limit(limit)
        if before is not None:
            query = query.where(audit.c.id < before)
        if action is not None:
            query = query.where(audit.c.action == action)
        with reading(self._engine) as connection:
            rows = connection.execute(query).mappings().all()
        return [AuditEntry(**{**row, "details": row["details"] or {}}) for row in rows]


def tell(row: Mapping[str, Any]) -> None:
    """Write a row that stands in the database into the log."""
    _log(row).info("audit", action=row["action"])


def record(
    request: Request, caller: Caller, action: str, subject: str | None = None, **details: Any
) -> None:
    """Write what a request did into the audit log. Blocks: async routes call it in a thread."""
    log: AuditLog = request.app.state.audit
    log.note(caller, action, subject, **details)


def _log(row: Mapping[str, Any]) -> Any:
    known = {name: row[name] for name in ("owner", "key_id", "remote", "subject")}
    return structlog.get_logger("audit").bind(**known, details=row["details"] or {})
