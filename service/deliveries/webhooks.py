"""Webhooks: signed notifications that a job is over."""

from __future__ import annotations

import hashlib
import hmac
import json
from datetime import UTC, datetime
from typing import Any

from stillpath.service.deliveries.http_requests import Reply, post
from stillpath.service.deliveries.targets import Target
from stillpath.service.jobs.state import Job

__all__ = ["SIGNATURE", "SignatureRefused", "body_of", "send_webhook", "sign", "verify"]

SIGNATURE = "Stillpath-Signature"
"""Name of the header that holds the signature."""

_TIMEOUT_S = 10.0


class SignatureRefused(ValueError):
    """The signature does not match the secret, or is too old."""


def body_of(job: Job) -> bytes:
    """Return the body of the notification about an ended job: always the same bytes."""
    here = f"/v1/jobs/{job.id}"
    told: dict[str, Any] = {
        "event": f"job.{job.state.value}",
        "job": {
            "id": job.id,
            "state": job.state.value,
            "owner": job.owner,
            "batch": job.batch,
            "machine": job.machine,
            "machine_revision": job.machine_revision,
            "options": job.options,
            "source_name": job.source_name,
            "source_bytes": job.source_bytes,
            "source_sha256": job.source_sha256,
            "result_name": job.result_name,
            "result_bytes": job.result_bytes,
            "result_sha256": job.result_sha256,
            "summary": job.summary,
            "error": job.problem,
            "created_at": _moment(job.created_at),
            "finished_at": _moment(job.finished_at),
            "links": {"self": here}
            | ({} if job.output is None else {n: f"{here}/{n}" for n in ("result", "report")}),
        },
    }
    return json.dumps(told, sort_keys=True, separators=(",", ":")).encode()


def sign(secret: str, at: int, body: bytes) -> str:
    """Return the value of the header `SIGNATURE`: ``t=SECONDS,v1=HEX``.

    The HMAC-SHA256 is of the seconds since the epoch, a dot, and the body, so that neither can be
    altered.
    """
    digest = hmac.new(secret.encode(), b"%d." % at + body, hashlib.sha256).hexdigest()
    return f"t={at},v1={digest}"


def verify(secret: str, header: str, body: bytes, *, now: float, tolerance_s: float = 300) -> None:
    """Check a webhook, as its receiver does.

    Use `Stillpath-Delivery` to recognise a repeat within the tolerance.

    Raises
    ------
    SignatureRefused
    """
    parts = dict(part.strip().partition("=")[::2] for part in header.split(","))
    moment = parts.get("t", "")
    if not (moment.isascii() and moment.isdecimal() and len(moment) < 13):
        raise SignatureRefused(f"the header {SIGNATURE} is not t=SECONDS,v1=HEX")
    expected = sign(secret, int(moment), body)
    if not hmac.compare_digest(expected.encode(), f"t={moment},v1={parts.get('v1', '')}".encode()):
        raise SignatureRefused("the signature does not match this secret, time and body")
    if abs(now - int(moment)) > tolerance_s:
        raise SignatureRefused(f"it was signed more than {tolerance_s:.0f} s ago: a replay")


def send_webhook(job: Job, target: Target, secret: str, *, delivery: int, now: float) -> Reply:
    """Notify a target that a job is over.

    Raises
    ------
    TargetRefused, Unreached, Unanswered
        See `service.deliveries.http_requests.post`.
    """
    body = body_of(job)
    headers = {
        "Content-Type": "application/json",
        SIGNATURE: sign(secret, int(now), body),
        "Stillpath-Delivery": f"{job.id}-{delivery}",
        "Stillpath-Event": f"job.{job.state.value}",
    }
    return post(target, headers=headers, content=body, timeout_s=_TIMEOUT_S)


def _moment(seconds: float | None) -> str | None:
    return None if seconds is None else datetime.fromtimestamp(seconds, UTC).isoformat()
