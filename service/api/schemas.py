"""Request and response models of the API."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    model_validator,
)

from stillpath.compensation.defaults import DEFAULT_BASIS, DEFAULT_METHOD
from stillpath.models.complaints import complaint
from stillpath.pipeline.options import (
    DEFAULT_TOLERANCE_UM,
    BasisName,
    BudgetUm,
    DialectName,
    MaxMb,
    MethodName,
    Options,
    RobustMode,
    Where,
)
from stillpath.service.deliveries.targets import read_url
from stillpath.service.jobs.state import Job, JobKind, JobState

if TYPE_CHECKING:
    from stillpath.service.deliveries.rows import Delivery

__all__ = ["DeliveryView", "Health", "JobPage", "JobQuery", "JobView", "LayerIndex", "Links"]

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


class JobQuery(BaseModel):
    """Parameters of a job, beside the file.

    A name that is not known is refused: a misspelt `budget_um` must not become a job without one.
    """

    model_config = ConfigDict(extra="forbid")

    machine: Line = Field(
        max_length=255, description="A name from `/v1/machines`.", examples=["ender3"]
    )
    method: MethodName = Field(
        default=DEFAULT_METHOD,
        description="`fbf` (limited-preview filtered basis functions), `npz-ignore`, `zmetc`, "
        "`zpetc`, `ebzpetc`, `ts` (approximate inverses), `shaper:NAME` (zv, mzv, ei, 2hump_ei, "
        "3hump_ei) or `none`; with `+ripple` appended the machine's ripple is undone as well. "
        "`advise` leaves all moves as they are and adds firmware commands. `live` leaves the file "
        "as it is, which is then the result too, and predicts the compensation inside Klipper.",
    )
    basis: BasisName = Field(default=DEFAULT_BASIS, description="Basis functions of `fbf`.")
    robust: RobustMode = Field(
        default="auto",
        description="What `fbf` is designed for: all plants that explain the measurement, with as "
        "much of a shaper's smoothing as they ask for (`auto`), the nominal plant (`off`), or the "
        "machine's plant set by least squares (`ensemble`) or for its worst member (`minimax`).",
    )
    along: Annotated[float, Field(ge=0.01, le=1, allow_inf_nan=False)] | None = Field(
        default=None,
        description="Weight of errors along the path against those across it, for `fbf`; "
        "less than the default, 1, takes longer.",
    )
    tolerance_um: float = Field(
        default=DEFAULT_TOLERANCE_UM,
        ge=0.5,
        le=50,
        allow_inf_nan=False,
        description="How far the written path may be from the computed one.",
    )
    where: Where = Field(
        default="all",
        description="What is compensated: everything, what is `visible` (outer walls, top and "
        "bottom surfaces), or outer `walls`. The rest stays as sliced, and the file is smaller.",
    )
    max_mb: MaxMb | None = Field(
        default=None,
        description="The most that the G-code may have, in millions of bytes: what is visible is "
        "compensated, then less exactly (tolerances of 8 and 16 um), then outer walls alone, until "
        "it fits.",
    )
    budget_um: BudgetUm | None = Field(
        default=None,
        description="Contour error that every feature may have, rms of the worst plant of the "
        "machine's set: the print becomes as fast as that allows. By default it keeps its speeds.",
    )
    compare_live: bool = Field(
        default=False,
        description="Whether the report of a compensated file says too what the compensation "
        "inside Klipper would make of the sliced file. The print is planned once more for it.",
    )
    plate: Annotated[int, Field(ge=1, le=10_000)] | None = Field(
        default=None, description="Which plate of a 3MF package with several."
    )
    times: Literal["new", "kept"] = Field(
        default="new", description="Whether the slicer's times in the file follow the new motion."
    )
    dialect: DialectName | None = Field(
        default=None,
        description="How the file is read; by default as the machine's firmware reads it.",
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
        description="What several jobs have in common; `GET /v1/jobs?batch=` finds them.",
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

    @model_validator(mode="after")
    def _fit_together(self) -> JobQuery:
        try:
            self.options()
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            raise ValueError(complaint(first, repeat=False)) from None
        return self

    def options(self) -> Options:
        """Return the settings of the compensation among the parameters."""
        return Options.model_validate(self.model_dump(include=set(Options.model_fields)))


class Links(BaseModel):
    """Where to go from here; what comes of a job is there once it is done."""

    self: str
    events: str
    result: str | None = None
    report: str | None = None
    report_json: str | None = None
    layers: str | None = None
    trajectories: str | None = None


class DeliveryView(BaseModel):
    """A webhook or an upload to a printer, and what became of it."""

    kind: Literal["webhook", "printer"]
    target: str = Field(description="The printer, or the webhook's address without its path.")
    state: Literal["waiting", "sending", "done", "failed"]
    attempts: int
    next_at: datetime | None = Field(description="When it is tried again; null: it is not.")
    error: str | None = Field(description="What went wrong the last time.")

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
    stage: str = Field(description="What is being done, for a person.")
    room_bytes: int | None = Field(
        default=None,
        description="Room on the disk that it needs at least, while it waits for that.",
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
    machine_revision: str = Field(description="Names the state of the machine that is used.")
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
        default=[], description="What goes out once it is over; empty in lists and events."
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
        return cls(
            id=job.id,
            kind=job.kind,
            state=job.state,
            stage=_stage(job),
            room_bytes=job.room_bytes if job.waits_for_room else None,
            progress=job.progress,
            eta_s=job.eta_s,
            queue_position=queue_position,
            attempt=job.attempt,
            losses=job.losses,
            owner=job.owner,
            batch=job.batch,
            priority=job.priority,
            machine=job.machine,
            machine_revision=job.machine_revision,
            options=job.options,
            source_name=job.source_name,
            source_bytes=job.source_bytes,
            source_sha256=job.source_sha256,
            result_name=job.result_name,
            result_bytes=job.result_bytes,
            summary=job.summary,
            webhook=job.webhook,
            printer=job.printer,
            print=job.print_after,
            created_at=datetime.fromtimestamp(job.created_at, UTC),
            started_at=_moment(job.started_at),
            finished_at=_moment(job.finished_at),
            error=job.problem,
            links=Links(self=here, events=f"{here}/events", **links),
        )


class JobPage(BaseModel):
    """Jobs, newest first, and where the next ones are."""

    jobs: list[JobView]
    next: str | None = Field(description="`cursor` of the next page; null: there is none.")


class LayerIndex(BaseModel):
    """What tiles of the print there are."""

    model_config = ConfigDict(extra="allow")

    version: int
    channels: list[str]
    scale_um: float = Field(description="One unit of the errors in the tiles.")
    bounds_mm: list[float] = Field(description="x and y of the lower left, then the upper right.")
    layers: list[dict[str, Any]]


class Health(BaseModel):
    """Answer of the health checks."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"status": "ok", "version": "0.7"}]})

    status: str
    version: str


def _stage(job: Job) -> str:
    needed_mib = (job.room_bytes or 0) >> 20
    if job.waits_for_room and needed_mib:
        return f"{job.stage}: more than {needed_mib} MiB are needed"
    return job.stage


def _moment(seconds: float | None) -> datetime | None:
    return None if seconds is None else datetime.fromtimestamp(seconds, UTC)
