"""Request and response models of the API."""

from __future__ import annotations

from dataclasses import fields
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from stillpath.pipeline.options import Options
from stillpath.service.deliveries.targets import read_url
from stillpath.service.jobs.state import Job, JobKind, JobState

if TYPE_CHECKING:
    from stillpath.service.deliveries.rows import Delivery

__all__ = [
    "DeliveryView",
    "Health",
    "JobPage",
    "JobQuery",
    "JobView",
    "LayerIndex",
    "Links",
    "ResultLink",
]

_FIELDS = {field.name for field in fields(Job)}
_EXAMPLE: dict[str, Any] = {
    "id": "5f2c8e0e6c0d4a3f9d1b7a52c4e86f10",
    "kind": "compensation",
    "state": "running",
    "stage": "compensating",
    "room_bytes": None,
    "progress": 0.42,
    "eta_s": 3.1,
    "queue_position": None,
    "attempt": 1,
    "losses": 0,
    "owner": "anna",
    "batch": None,
    "priority": 0,
    "machine": "ender3",
    "machine_revision": "3f6a2c1b9d04",
    "options": {
        "method": "fbf",
        "basis": "ce-opt",
        "robust": "auto",
        "along": None,
        "plate": None,
        "tolerance_um": 2.0,
        "times": "new",
        "dialect": None,
    },
    "source_name": "gear.gcode",
    "source_bytes": 645932,
    "source_sha256": "9f86d081884c7d659a2feaa0c55ad015a3bf4f1b2b0b822cd15d6c15b0f00a08",
    "result_name": "gear.stillpath.gcode",
    "result_bytes": None,
    "summary": None,
    "webhook": None,
    "printer": None,
    "print": False,
    "created_at": "2025-01-31T12:00:00Z",
    "started_at": "2025-01-31T12:00:00Z",
    "finished_at": None,
    "error": None,
    "deliveries": [],
    "links": {
        "self": "/v1/jobs/5f2c8e0e6c0d4a3f9d1b7a52c4e86f10",
        "events": "/v1/jobs/5f2c8e0e6c0d4a3f9d1b7a52c4e86f10/events",
        "result": None,
        "report": None,
        "report_json": None,
        "layers": None,
        "trajectories": None,
    },
}


def _is_line(text: str) -> str:
    """Refuse what would break a line of a log, or a database."""
    if any(ord(character) < 32 or ord(character) == 127 for character in text):
        raise ValueError("control characters are not allowed")
    return text


Line = Annotated[str, AfterValidator(_is_line)]


class JobQuery(Options):
    """Parameters of a job, beside the file.

    An unknown name is refused: a misspelt `budget_um` must not become a job without one.
    """

    machine: Line = Field(
        max_length=255, description="A name from `/v1/machines`.", examples=["ender3"]
    )
    name: str = Field(
        default="upload.gcode",
        max_length=255,
        description="File name, for a raw body.",
        examples=["gear.gcode"],
    )
    priority: int = Field(
        default=0, ge=-100, le=100, description="Higher ones go first; more than 0 needs `admin`."
    )
    batch: Line | None = Field(
        default=None,
        min_length=1,
        max_length=64,
        description="Label of a group of jobs; `GET /v1/jobs?batch=` lists them.",
    )
    fresh: bool = Field(
        default=False,
        description="Do the work again, even if the same file was done with the same machine, "
        "options and version before.",
    )
    webhook: Line | None = Field(
        default=None,
        max_length=2000,
        description="Address that is notified when the job ends; one of "
        "`STILLPATH_WEBHOOK_TARGETS`.",
    )
    printer: Line | None = Field(
        default=None,
        max_length=64,
        description="Printer of `/v1/printers` that the result is sent to.",
    )
    print: bool = Field(default=False, description="Whether that printer starts to print it.")

    def options(self) -> dict[str, Any]:
        """Return the settings of the compensation among the parameters."""
        return self.model_dump(include=set(Options.model_fields))


class Links(BaseModel):
    """Addresses of a job; those of its results are set once it is done."""

    self: str
    events: str
    result: str | None = None
    report: str | None = None
    report_json: str | None = None
    layers: str | None = None
    trajectories: str | None = None


class ResultLink(BaseModel):
    """Where a result can be fetched without a key."""

    href: str = Field(
        description="Address of the result, valid for an hour and as long as the key.",
        examples=["/v1/jobs/5f2c8e0e6c0d4a3f9d1b7a52c4e86f10/result?key=3f6a2c&until=1764547200"],
    )


class DeliveryView(BaseModel):
    """A webhook or an upload to a printer, and what became of it."""

    kind: Literal["webhook", "printer"]
    target: str = Field(description="The printer, or the webhook's address without its path.")
    state: Literal["waiting", "sending", "done", "failed"]
    attempts: int
    next_at: datetime | None = Field(description="Time of the next attempt; null: there is none.")
    error: str | None = Field(description="Error of the last attempt.")

    @classmethod
    def of(cls, delivery: Delivery) -> DeliveryView:
        """Return the view of a delivery."""
        kind, target = delivery.kind, delivery.target
        return cls.model_validate(
            {
                "kind": kind,
                "target": str(read_url(target)) if kind == "webhook" else target,
                "state": delivery.state,
                "attempts": delivery.attempts,
                "next_at": _moment(delivery.next_at) if delivery.state == "waiting" else None,
                "error": delivery.error,
            }
        )


class JobView(BaseModel):
    """A job as its owner sees it."""

    model_config = ConfigDict(json_schema_extra={"examples": [_EXAMPLE]})

    id: str
    kind: JobKind = Field(
        default=JobKind.COMPENSATION,
        description="What is computed; jobs of other kinds than `compensation` have a result only.",
    )
    state: JobState
    stage: str = Field(description="Current stage, for display.")
    room_bytes: int | None = Field(
        default=None,
        description="Least disk space that it needs, while it waits for space.",
    )
    progress: float = Field(ge=0, le=1)
    eta_s: float | None = Field(description="Seconds still needed; null while unknown.")
    queue_position: int | None = Field(description="Jobs before this one while it is queued.")
    attempt: int = Field(description="How often it was started.")
    losses: int = Field(
        default=0, description="How often its worker was lost; a restart of the service is no loss."
    )
    owner: str
    batch: str | None
    priority: int
    machine: str
    machine_revision: str = Field(description="Revision of the machine that is used.")
    options: dict[str, Any]
    source_name: str
    source_bytes: int
    source_sha256: str
    result_name: str
    result_bytes: int | None
    summary: dict[str, Any] | None = Field(
        description="Once it is done: print times in s, contour errors in um, warnings."
    )
    webhook: str | None
    printer: str | None
    print: bool
    created_at: datetime
    started_at: datetime | None
    finished_at: datetime | None
    error: dict[str, Any] | None = Field(
        description="Why the job failed, as a problem document (RFC 9457)."
    )
    deliveries: list[DeliveryView] = Field(
        default=[],
        description="Notifications and uploads after its end; empty in lists and events.",
    )
    links: Links

    @classmethod
    def of(cls, job: Job, queue_position: int | None = None) -> JobView:
        """Return the view of a job."""
        here = f"/v1/jobs/{job.id}"
        done = job.state is JobState.DONE
        made = ["result"]
        if job.kind is JobKind.COMPENSATION:
            made += ["report", "report.json", "layers", "trajectories"]
        links = {name.replace(".", "_"): f"{here}/{name}" for name in made if done}
        stored = {name: getattr(job, name) for name in cls.model_fields.keys() & _FIELDS}
        shown = {
            "stage": _stage(job),
            "room_bytes": job.room_bytes if job.waits_for_room else None,
            "queue_position": queue_position,
            "print": job.print_after,
            "error": job.problem,
            "links": Links(self=here, events=f"{here}/events", **links),
        }
        return cls.model_validate(stored | shown)


class JobPage(BaseModel):
    """Jobs, newest first, and where the next ones are."""

    jobs: list[JobView]
    next: str | None = Field(description="`cursor` of the next page; null: there is none.")


class LayerIndex(BaseModel):
    """Index of the tiles of a print."""

    model_config = ConfigDict(extra="allow")

    version: int
    channels: list[str]
    scale_um: float = Field(description="One unit of the errors in the tiles.")
    bounds_mm: list[float] = Field(description="x and y of the lower left, then the upper right.")
    layers: list[dict[str, Any]]


class Health(BaseModel):
    """Answer of the health checks."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [{"status": "ok", "version": "0.7.0", "build": "0.7.0+5f2c8e0e1a2b"}]
        }
    )

    status: str
    version: str
    build: Annotated[str, Field(description="Version, and a digest of the code that computes.")]


def _stage(job: Job) -> str:
    needed_mib = (job.room_bytes or 0) >> 20
    if job.waits_for_room and needed_mib:
        return f"{job.stage}: more than {needed_mib} MiB are needed"
    return job.stage


def _moment(seconds: float | None) -> datetime | None:
    return None if seconds is None else datetime.fromtimestamp(seconds, UTC)
