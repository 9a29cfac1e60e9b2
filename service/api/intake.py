"""Turn an upload into a queued job; a failure leaves nothing behind."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import time
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from anyio import CapacityLimiter, to_thread
from fastapi import Request
from starlette.concurrency import run_in_threadpool

from stillpath.applications.machines.resolve import PinnedMachine, Resolver
from stillpath.applications.machines.revision import NotApproved, UnknownMachine
from stillpath.models.errors import ModelError
from stillpath.pipeline.files import result_name
from stillpath.service.api.problems import Problem
from stillpath.service.api.schemas import JobQuery
from stillpath.service.api.uploads import Upload, receive_upload
from stillpath.service.database.errors import DatabaseAway
from stillpath.service.deliveries.checking import Checker
from stillpath.service.deliveries.printers import Printer, printer_for
from stillpath.service.deliveries.targets import TargetRefused, check_webhook
from stillpath.service.jobs.state import Job
from stillpath.service.jobs.store import JobStore
from stillpath.service.jobs.submissions import (
    IdempotencyConflict,
    Quota,
    QuotaExceeded,
    SpaceExceeded,
)
from stillpath.service.security.audit import AuditLog, tell
from stillpath.service.security.callers import Caller
from stillpath.service.settings import Settings
from stillpath.service.storage.base import Storage, StorageError
from stillpath.service.storage.disk import Disk
from stillpath.version import build

__all__ = ["Intake", "Taken"]

_STORED_AT_ONCE = 12
"""Uploads that are stored in parallel: this may take minutes, and threads are shared by all
requests."""

_PLATE = re.compile(r"[1-9][0-9]{0,3}")

_ASKED_AT_ONCE = 8
"""Printers that are queried in parallel before uploads."""


@dataclass(frozen=True, slots=True)
class Taken:
    """A job, whether it is new, and how many jobs are ahead of it."""

    job: Job
    is_new: bool
    upload: Upload
    queue_position: int


class Intake:
    """Takes uploads in.

    The file is stored durably before the job is published, so every visible job has its file.

    Parameters
    ----------
    printers : mapping
        Printers that results may be sent to, by name.
    checker : Checker
        Compares a job's printer with its machine; differences go into the report.
    disk : Disk
        Disk that holds the uploads.

    Attributes
    ----------
    folder : Path
        Folder for uploads that are still arriving.
    """

    def __init__(
        self,
        settings: Settings,
        store: JobStore,
        storage: Storage,
        machines: Resolver,
        printers: Mapping[str, Printer],
        audit: AuditLog,
        checker: Checker,
        disk: Disk,
    ) -> None:
        self._settings = settings
        self._audit = audit
        self._checker = checker
        self._store = store
        self._storage = storage
        self._machines = machines
        self._printers = printers
        self._quota = Quota(settings.max_jobs_per_owner, settings.max_bytes_per_owner)
        self._disk = disk
        self.folder = settings.data_dir / "incoming"
        self._turns = CapacityLimiter(_STORED_AT_ONCE)
        self._printers_asked = CapacityLimiter(_ASKED_AT_ONCE)
        build()  # of the code that runs, not of what an update puts in its place

    def prepare(self) -> None:
        """Make the folder of uploads on their way, and delete what a killed service left there."""
        self.folder.mkdir(parents=True, exist_ok=True)
        if self._settings.scheduler is not None:
            return  # it may be shared; the sweep knows what is old
        for leftover in self.folder.iterdir():
            if leftover.is_dir():
                shutil.rmtree(leftover, ignore_errors=True)
            else:
                leftover.unlink(missing_ok=True)

    async def take(
        self,
        request: Request,
        wanted: JobQuery,
        caller: Caller,
        *,
        idempotency_key: str | None = None,
    ) -> Taken:
        """Read the body of a request and return its job.

        Parameters
        ----------
        wanted : JobQuery
            `print` and the plate may also come as form fields, as with OctoPrint.

        Raises
        ------
        Problem
            408, 413, 422, 429 or 507; nothing of the upload is left then.
        """
        # A printer may respond slowly, and threads are shared by all requests.
        limiter = None if wanted.printer is None else self._printers_asked
        job_id = uuid.uuid4().hex
        with self._incoming(job_id) as incoming:
            pinned = await to_thread.run_sync(
                self._admit, wanted, caller, incoming, idempotency_key, limiter=limiter
            )
            upload = await receive_upload(
                request, incoming, max_bytes=self._settings.max_upload_bytes, disk=self._disk
            )
            with_print = _with_fields(wanted, upload)
            if with_print != wanted:
                wanted = with_print
                await run_in_threadpool(self._check_targets, wanted)
            taken = await to_thread.run_sync(
                self._accept,
                job_id,
                incoming,
                upload,
                wanted,
                pinned,
                caller,
                idempotency_key,
                limiter=self._turns,
            )
        request.app.state.metrics.upload_bytes.inc(upload.size_bytes)
        if taken.is_new:
            request.app.state.workforce.notify()
        return taken

    def _admit(
        self, wanted: JobQuery, caller: Caller, incoming: Path, idempotency_key: str | None
    ) -> PinnedMachine:
        """Refuse what can be refused before the body is read; store the machine with the upload.

        Doing this first shortens the wait after the body was sent.
        """
        self._check_targets(wanted)
        pinned = self._pinned(wanted)
        if not self._is_known(caller, idempotency_key):
            self._check_room(caller)
        self._disk.check()
        pinned.write(incoming.with_suffix(".machine"))
        return pinned

    def _accept(
        self,
        job_id: str,
        incoming: Path,
        upload: Upload,
        wanted: JobQuery,
        pinned: PinnedMachine,
        caller: Caller,
        idempotency_key: str | None,
    ) -> Taken:
        """Store the upload and add its job, unless the same one is there."""
        idempotency = None
        if idempotency_key is not None:
            idempotency = (idempotency_key, _fingerprint(wanted, upload))
            earlier = self._earlier(caller, *idempotency)
            if earlier is not None:
                return self._taken(earlier, False, upload)
        dedupe_key = _dedupe_key(wanted, upload, pinned)
        shared = not wanted.fresh and wanted.webhook is None and wanted.printer is None
        if shared and idempotency is None:  # with a key, `add` looks, and notes the key
            same = self._store.find_same(caller.owner, dedupe_key)
            if same is not None:
                return self._taken(same, False, upload)
        job = Job(
            id=job_id,
            owner=caller.owner,
            batch=wanted.batch,
            machine=wanted.machine,
            machine_revision=pinned.machine.revision,
            options=wanted.options(),
            dedupe_key=dedupe_key,
            priority=wanted.priority,
            source_name=upload.name,
            source_bytes=upload.size_bytes,
            source_sha256=upload.sha256,
            result_name=upload.name if wanted.method == "live" else result_name(upload.name),
            created_at=time.time(),
            webhook=wanted.webhook,
            printer=wanted.printer,
            print_after=wanted.print,
        )
        audit_row = self._audit.row(
            caller,
            "submit",
            job_id,
            machine=wanted.machine,
            revision=pinned.machine.revision,
            source_sha256=upload.sha256,
        )
        (source,) = job.sources
        files = {job.machine_file: incoming.with_suffix(".machine"), source: incoming}
        added = self._add(job, files, idempotency=idempotency, shared=shared, audit_row=audit_row)
        if added.id == job_id:
            tell(audit_row)
        return self._taken(added, added.id == job_id, upload)

    def ask(self, job: Job, files: Mapping[str, Path]) -> Job:
        """Put a job other than a compensation in the queue, unless the owner has the same one.

        Parameters
        ----------
        files : mapping
            Storage keys to local files, which are moved there.

        Returns
        -------
        Job
            `job`, or the same one: done, or under way.

        Raises
        ------
        Problem
            429 or 507.
        NoRoom
        """
        same = self._store.find_same(job.owner, job.dedupe_key)
        if same is not None:
            return same
        self._disk.check()
        return self._add(job, files, shared=True)

    def _add(
        self,
        job: Job,
        files: Mapping[str, Path],
        *,
        shared: bool,
        idempotency: tuple[str, str] | None = None,
        audit_row: Mapping[str, Any] | None = None,
    ) -> Job:
        """Store files, then publish their job; return it, or the equivalent existing one."""
        added: Job | None = None
        try:
            self._storage.put_all(files)
            with _as_problems():
                added = self._store.add(
                    job,
                    idempotency=idempotency,
                    limits=self._quota,
                    shared=shared,
                    audit_row=audit_row,
                )
        except IdempotencyConflict:
            raise _conflict(idempotency and idempotency[0]) from None
        finally:
            if added is None or added.id != job.id:
                self._undo(job)
        return added

    def _taken(self, job: Job, is_new: bool, upload: Upload) -> Taken:
        return Taken(job, is_new, upload, self._store.queue_position(job))

    def _undo(self, job: Job) -> None:
        """Delete what was stored for a job that was refused, or replaced by an existing one.

        The sweep deletes what cannot be deleted now. If the database failed it may have stored the
        job nevertheless: then its files stay.
        """
        with suppress(DatabaseAway, StorageError):
            if self._store.get(job.id) is None:
                self._storage.delete(job.files)

    def _check_targets(self, wanted: JobQuery) -> None:
        """Refuse targets that are not allowed."""
        try:
            if wanted.webhook is not None:
                check_webhook(wanted.webhook, self._settings)
            if wanted.printer is not None:
                printer_for(self._printers, wanted.printer, start=wanted.print)
        except TargetRefused as error:
            raise Problem(422, "Target not allowed", str(error)) from None
        if wanted.print and wanted.printer is None:
            raise Problem(
                422,
                "Printer required",
                "`print` needs a printer: name one of /v1/printers as well (in a slicer by its "
                "address), or upload without printing.",
            )

    def _earlier(self, caller: Caller, key: str, fingerprint: str) -> Job | None:
        """Return the job that the same request led to before."""
        found = self._store.submitted(caller.owner, key)
        if found is None:
            return None
        known, job = found
        if known != fingerprint:
            raise _conflict(key)
        return job

    def _is_known(self, caller: Caller, key: str | None) -> bool:
        """Return whether the request may already have its job, which needs no space."""
        return key is not None and self._store.submitted(caller.owner, key) is not None

    def _check_room(self, caller: Caller) -> None:
        """Refuse before the body is read; adding the job checks again, in its transaction."""
        with _as_problems():
            self._quota.check(caller.owner, *self._store.usage(caller.owner))

    def _pinned(self, wanted: JobQuery) -> PinnedMachine:
        """Return the job's machine, with warnings about it and about its printer."""
        name = wanted.machine
        try:
            found = self._machines.for_job(name)
        except UnknownMachine:
            known = ", ".join(self._machines.names())
            detail = f"No machine is called {name[:80]!r}. Known: {known}."
            raise Problem(422, "Unknown machine", detail) from None
        except NotApproved as error:
            raise Problem(422, "Machine not approved", str(error)) from None
        except ModelError as error:
            raise Problem(422, "Machine not usable", str(error)) from None
        printer = None if wanted.printer is None else self._printers.get(wanted.printer)
        if printer is None:
            return found
        lines = self._checker.lines(printer, found.machine, method=wanted.method)
        return found.model_copy(update={"warnings": (*found.warnings, *lines)})

    @contextmanager
    def _incoming(self, job_id: str) -> Iterator[Path]:
        """Yield a file for a current upload, deleted afterwards in any case.

        So is what lies beside it with the suffix ``.machine``.
        """
        incoming = self.folder / f"{job_id}.upload"
        try:
            yield incoming
        finally:
            incoming.unlink(missing_ok=True)
            incoming.with_suffix(".machine").unlink(missing_ok=True)


def _with_fields(wanted: JobQuery, upload: Upload) -> JobQuery:
    """Take `print` and the plate from the form, as printers' own APIs do.

    OrcaSlicer names the plate of a package, from 1 (src/slic3r/Utils/OctoPrint.cpp, 2026); other
    files have none. Other parameters are refused: they would be ignored without a word.
    """
    misplaced = sorted((upload.fields.keys() & JobQuery.model_fields.keys()) - {"print"})
    if misplaced:
        raise Problem(
            422,
            "Invalid parameter",
            f"{', '.join(misplaced)}: parameters belong in the address (?{misplaced[0]}=...), and "
            "the form holds the file alone.",
        )
    taken: dict[str, Any] = {}
    if upload.fields.get("print", "").strip().lower() in ("true", "1", "yes", "on"):
        taken["print"] = True
    plate = upload.fields.get("plateindex", "").strip()
    if wanted.plate is None and _PLATE.fullmatch(plate) and upload.name.lower().endswith(".3mf"):
        taken["plate"] = int(plate)
    return wanted.model_copy(update=taken) if taken else wanted


def _dedupe_key(wanted: JobQuery, upload: Upload, pinned: PinnedMachine) -> str:
    """Return a key that is equal for jobs with the same result."""
    return _digest(
        upload.sha256,
        upload.name,  # stands in the report
        pinned.machine.revision,
        wanted.options(),
        wanted.batch,  # a list of a batch must be whole
        build(),
    )


def _fingerprint(wanted: JobQuery, upload: Upload) -> str:
    """Return a digest that is equal for identical requests."""
    return _digest(upload.sha256, upload.name, wanted.model_dump(exclude={"name"}))


def _digest(*parts: object) -> str:
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


@contextmanager
def _as_problems() -> Iterator[None]:
    """Turn a quota that is full into a problem document."""
    try:
        yield
    except SpaceExceeded as error:
        raise Problem(507, "No space left", str(error)) from None
    except QuotaExceeded as error:
        raise Problem(429, "Quota exceeded", str(error), headers={"Retry-After": "30"}) from None


def _conflict(key: str | None) -> Problem:
    return Problem(
        422,
        "Idempotency-Key used before",
        f"The Idempotency-Key {key!r:.80} belongs to another file or to other parameters; take a "
        "new key for a new request.",
    )
