"""Send due deliveries: one thread claims them, and a few send."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import structlog
from sqlalchemy import Engine

from stillpath.applications.machines.resolve import PinnedMachine
from stillpath.compensation.defaults import DEFAULT_METHOD
from stillpath.models.errors import ModelError
from stillpath.models.machine import Machine
from stillpath.service.database.errors import DatabaseAway
from stillpath.service.deliveries import rows
from stillpath.service.deliveries.checking import Checker, PrinterUnknown
from stillpath.service.deliveries.http_requests import Reply, Unanswered, Unreached
from stillpath.service.deliveries.printers import Printer, printer_for, upload, what_started
from stillpath.service.deliveries.rows import Delivery
from stillpath.service.deliveries.targets import TargetRefused, check_webhook
from stillpath.service.deliveries.webhooks import send_webhook
from stillpath.service.jobs.state import START_WITHIN_S, Job
from stillpath.service.jobs.store import JobStore
from stillpath.service.settings import Settings
from stillpath.service.storage.base import Storage, StorageError, sha256_of

__all__ = ["Sender", "SendingTimes"]

_AT_ONCE = 4
_STOP_S = 5.0
_GROWTH, _MOST_STEPS = 3.0, 20
_LONGEST_WAIT_S = 6 * 3600.0
# Status codes after which a retry is useless.
_PERMANENT_STATUSES = frozenset((400, 401, 404, 405, 410, 413, 414, 415, 422))


@dataclass(frozen=True, slots=True)
class SendingTimes:
    """When deliveries are tried, and tried again.

    Attributes
    ----------
    first_wait_s : float
        Wait before the second attempt; each later wait is three times as long, up to 6 h.
    claim_s : float
        Time without a sign of life after which a sender counts as dead.
    poll_s : float
        How often the table is polled.
    start_within_s : float
        A print that cannot start so soon after its job was done is not started later, when nobody
        may be there to watch; its file is uploaded all the same.
    """

    first_wait_s: float = 5.0
    attempts: int = 10
    claim_s: float = 60.0
    poll_s: float = 1.0
    start_within_s: float = START_WITHIN_S

    def wait_s(self, attempts: int) -> float:
        """Return how long the next attempt waits after so many (1, 2, ...)."""
        growth = _GROWTH ** min(attempts - 1, _MOST_STEPS)
        return min(self.first_wait_s * growth, _LONGEST_WAIT_S)


class Sender:
    """Sends webhooks, and results to printers.

    Every process of the service may have one; a claim on the row decides who sends what. What
    cannot be delivered is tried again after 5 s, 15 s, 45 s, ... 6 h, ten times in all. A webhook
    may arrive twice. An upload that shall start a print is never repeated unless the printer was
    not reached: a second print could begin on top of the first. What was submitted earlier never
    replaces a later file of its name on a printer, however long it had to wait.

    Before a printer gets a file it is compared with the file's machine
    (`service.deliveries.checking`): what differs is noted, and where that makes a print unsafe, the
    file is uploaded and not started.

    Parameters
    ----------
    printers : mapping
        From `service.deliveries.printers.load_printers`.
    checker : Checker, optional
        Without one, printers are not looked at.
    """

    def __init__(
        self,
        engine: Engine,
        store: JobStore,
        storage: Storage,
        settings: Settings,
        printers: Mapping[str, Printer],
        checker: Checker | None = None,
        times: SendingTimes = SendingTimes(),
    ) -> None:
        self._engine = engine
        self._store = store
        self._storage = storage
        self._settings = settings
        self._printers = printers
        self._checker = checker
        self._times = times
        self._log = structlog.get_logger("deliveries")
        self._wake = threading.Event()
        self._stopping = threading.Event()
        self._main: threading.Thread | None = None
        # What is being sent, and until when it is claimed; touched by the main thread only.
        self._sending: dict[threading.Thread, tuple[Delivery, float]] = {}
        self._seen_at = math.inf
        """Last clock reading; the clock may have been set back while no service ran."""

    def start(self) -> None:
        """Begin to send."""
        self._main = threading.Thread(target=self._run, name="deliveries", daemon=True)
        self._main.start()

    def stop(self) -> None:
        """Stop sending; wait briefly for deliveries in progress.

        Longer ones are left to the next start, as if the process had been killed.
        """
        self._stopping.set()
        self._wake.set()
        if self._main is not None:
            self._main.join()
        deadline = time.monotonic() + _STOP_S
        for thread in self._sending:
            thread.join(max(0.0, deadline - time.monotonic()))

    def notify(self) -> None:
        """Look at the table now."""
        self._wake.set()

    def deliveries_of(self, job_id: str) -> list[Delivery]:
        """Return what goes out for a job, and how that stands."""
        return rows.deliveries_of(self._engine, [job_id]).get(job_id, [])

    def _run(self) -> None:
        away = False
        while not self._stopping.is_set():
            try:
                self._keep_claims()
                self._look_at_clock()
                claimed = len(self._sending) < _AT_ONCE and self._claim()
                away = False
            except DatabaseAway as error:
                if not away:
                    self._log.warning("no deliveries for now", reason=str(error))
                away, claimed = True, False
            except Exception:  # otherwise the thread would end silently and send nothing more
                self._log.exception("deliveries broke")
                claimed = False
            if not claimed:
                self._wake.wait(self._times.poll_s)
                self._wake.clear()

    def _keep_claims(self) -> None:
        now = time.time()
        for thread, (claimed, until) in list(self._sending.items()):
            if not thread.is_alive():
                del self._sending[thread]
            elif not self._times.claim_s / 2 <= until - now <= self._times.claim_s:
                until = now + self._times.claim_s
                rows.prolong(self._engine, claimed, until=until)
                self._sending[thread] = (claimed, until)

    def _look_at_clock(self) -> None:
        """If the clock was set back, shorten waits accordingly."""
        now = time.time()
        if now < self._seen_at:
            times = self._times
            waiting = [now + times.wait_s(k) for k in range(1, _MOST_STEPS + 2)]
            rows.bring_forward(self._engine, waiting=waiting, sending=now + times.claim_s)
        self._seen_at = now

    def _claim(self) -> bool:
        now = time.time()
        until = now + self._times.claim_s
        found = rows.claim(self._engine, now=now, until=until)
        if found is None:
            return False
        thread = threading.Thread(
            target=self._deliver, args=found, name=f"delivery-{found[0].id}", daemon=True
        )
        self._sending[thread] = (found[0], until)
        thread.start()
        return True

    def _deliver(self, claimed: Delivery, unknown_before: bool) -> None:
        """Send one delivery and record the outcome."""
        log = self._log.bind(
            job=claimed.job_id, delivery=claimed.id, kind=claimed.kind, attempt=claimed.attempts
        )
        try:
            state, error = self._outcome(claimed, unknown_before)
        except Exception as broken:
            log.error("delivery broke", exc_info=broken)
            state, error = "waiting", "the service broke; its log holds the details"
        wait_s = 0.0
        if state == "waiting":
            wait_s = self._times.wait_s(claimed.attempts)
            if claimed.attempts >= self._times.attempts:
                state, error = "failed", f"{error}; given up after {claimed.attempts} attempts"
        log.info("delivery", state=state, reason=error)
        self._settle(claimed, state, time.time() + wait_s, error)

    def _settle(self, claimed: Delivery, state: str, next_at: float, error: str | None) -> None:
        """Record the outcome; if the database is away, try for as long as the claim holds."""
        deadline = time.monotonic() + self._times.claim_s
        while True:
            try:
                rows.settle(self._engine, claimed, state, next_at=next_at, error=error)
                return
            except DatabaseAway:
                if time.monotonic() > deadline or self._stopping.wait(1.0):
                    return

    def _outcome(self, claimed: Delivery, unknown_before: bool) -> tuple[str, str | None]:
        """Send, and return the row's next state and error."""
        job = self._store.get(claimed.job_id)
        if job is None:
            return "failed", "the job was deleted"
        starts = claimed.kind == "printer" and job.print_after and not job.held_back
        if starts and unknown_before:
            return "failed", _unknown("the service was stopped while it sent")
        try:
            if claimed.kind == "webhook":
                return _judged(self._send_webhook(claimed, job))
            while rows.is_behind(self._engine, claimed, job, now=time.time()):
                if self._stopping.wait(self._times.poll_s):
                    return "waiting", f"an earlier {job.result_name} is on its way"
            later = rows.overtaken(self._engine, claimed, job)
            if later is not None:
                return _outdated(claimed, job, later)
            return self._send_to_printer(job, claimed.target)
        except TargetRefused as error:
            return "failed", str(error)
        except FileNotFoundError:
            return "failed", "the files of the job are gone"
        except (Unreached, StorageError) as error:
            return "waiting", str(error)
        except Unanswered as error:
            return ("failed", _unknown(str(error))) if starts else ("waiting", str(error))

    def _send_webhook(self, claimed: Delivery, job: Job) -> Reply:
        target = check_webhook(claimed.target, self._settings)
        secret = self._settings.webhook_secret
        assert secret is not None  # check_webhook has seen to it
        return send_webhook(
            job, target, secret.get_secret_value(), delivery=claimed.id, now=time.time()
        )

    def _send_to_printer(self, job: Job, name: str) -> tuple[str, str | None]:
        printer = printer_for(self._printers, name, start=job.print_after)
        warnings, unsafe = self._looked_at(printer, job)
        why_not = self._why_not_started(job, unsafe)
        starts = job.print_after and why_not is None
        with contextlib.ExitStack() as copy:
            file = copy.enter_context(self._storage.local(job.result))
            if sha256_of(file) != job.result_sha256:
                return "failed", "the result in the storage is damaged; submit the file again"
            copy.enter_context(_once(starts, job))
            reply = upload(printer, file, job.result_name, sha256=job.result_sha256, start=starts)
            state, error = _judged(reply)
            begun = what_started(printer, reply) if starts else None
        if starts and reply.status >= 500:  # perhaps of a proxy that lost patience
            return "failed", _unknown(error or "")
        if starts and state == "waiting":  # a busy printer: the retry would follow its print
            return "failed", (
                f"{error}; not tried again, because that would start a print later: send it again"
            )
        if state == "done":
            told = why_not if job.print_after and why_not else begun
            error = "; ".join([*([told] if told else ()), *unsafe, *warnings]) or None
        return state, error

    def _why_not_started(self, job: Job, unsafe: list[str]) -> str | None:
        """Return why a print is not started that was asked for, or None."""
        if unsafe:
            return "uploaded, but not started, because it may be unsafe"
        if job.held_back:
            return (
                "uploaded, but not started: for an hour or more the job could not be done (no "
                "service, no worker, or no room on the disk), and nobody may be there; start it at "
                "the printer"
            )
        # The age is unknown where a clock was set back.
        if abs(time.time() - (job.finished_at or 0.0)) > self._times.start_within_s:
            return (
                "uploaded, but not started: it was done more than "
                f"{self._times.start_within_s:.0f} s ago, and nobody may be there; start it "
                "at the printer"
            )
        return None

    def _looked_at(self, printer: Printer, job: Job) -> tuple[list[str], list[str]]:
        """Return findings about a printer, and those that make a print unsafe.

        OctoPrint cannot be compared: the request is carried out.
        """
        if self._checker is None or printer.kind != "moonraker":
            return [], []
        try:
            machine = self._machine(job)
            method = str(job.options.get("method", DEFAULT_METHOD))
            found = self._checker.check(printer, machine, method=method).findings
        except (PrinterUnknown, ModelError) as error:
            # Whether its limits and macros are what the file needs is not known then.
            return [], [f"the printer was not compared with its machine: {error}"]
        return (
            [finding.text for finding in found if not finding.unsafe],
            [finding.text for finding in found if finding.unsafe],
        )

    def _machine(self, job: Job) -> Machine:
        """Return the machine that the job was done with."""
        with contextlib.ExitStack() as copy:
            file = Path("none")
            with contextlib.suppress(FileNotFoundError):
                file = copy.enter_context(self._storage.local(job.machine_file))
            return PinnedMachine.read(file, job.machine, job.machine_revision).machine


@contextlib.contextmanager
def _once(starts: bool, job: Job) -> Iterator[None]:
    """If an upload starts a print, turn unexpected errors into `Unanswered`."""
    try:
        yield
    except (TargetRefused, Unreached, Unanswered):
        raise
    except Exception as error:
        if not starts:
            raise
        structlog.get_logger("deliveries").error("delivery broke", job=job.id, exc_info=error)
        raise Unanswered("the service broke while it sent; its log holds the details") from error


def _judged(reply: Reply) -> tuple[str, str | None]:
    if 200 <= reply.status < 300:
        return "done", None
    said = " ".join(reply.text.split())[:300]
    error = f"answered with status {reply.status}" + (f": {said}" if said else "")
    if 300 <= reply.status < 400:
        return "failed", f"answered with status {reply.status}; redirects are not followed"
    return ("failed" if reply.status in _PERMANENT_STATUSES else "waiting"), error


def _outdated(claimed: Delivery, job: Job, later: str) -> tuple[str, str]:
    """Return the outcome for a file that a `later` one overtook: done, or still being sent."""
    if later == "sending":
        return "waiting", f"a later {job.result_name} is on its way to {claimed.target}"
    return "failed", (
        f"{claimed.target} has a later {job.result_name} already, which this one would replace; "
        "submit the file again to send it all the same"
    )


def _unknown(why: str) -> str:
    return (
        f"{why}; the print may or may not have started, so this is not retried: check the printer"
    )
