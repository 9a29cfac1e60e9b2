"""What the API answers with."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from service.jobs.state import Job, JobState

__all__ = ["Health", "JobView", "Links"]


class Links(BaseModel):
    """Where to go from here; result and report are there once the job is done."""

    self: str
    result: str | None = None
    report: str | None = None
    report_json: str | None = None


class JobView(BaseModel):
    """A job as its owner sees it."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "id": "5f2c8e0e6c0d4a3f9d1b7a52c4e86f10",
                    "state": "running",
                    "stage": "compensating",
                    "progress": 0.42,
                    "eta_s": 3.1,
                    "queue_position": None,
                    "machine": "ender3",
                    "options": {
                        "method": "fbf",
                        "basis": "ce-opt",
                        "robust": "off",
                        "along": None,
                        "tolerance_um": 2.0,
                    },
                    "source_name": "gear.gcode",
                    "source_bytes": 645932,
                    "created_at": "2025-01-31T12:00:00Z",
                    "started_at": "2025-01-31T12:00:00Z",
                    "finished_at": None,
                    "error": None,
                    "links": {
                        "self": "/v1/jobs/5f2c8e0e6c0d4a3f9d1b7a52c4e86f10",
                        "result": None,
                        "report": None,
                        "report_json": None,
                    },
                }
            ]
        }
    )

    id: str
    state: JobState
    stage: str = Field(description="What is being done, for a person.")
    progress: float = Field(ge=0, le=1)
    eta_s: float | None = Field(description="Seconds still needed; null while unknown.")
    queue_position: int | None = Field(description="Jobs before this one while it is queued.")
    machine: str
    options: dict[str, Any]
    source_name: str
    source_bytes: int
    created_at: datetime
    started_at: datetime | None
    finished_at: datetime | None
    error: dict[str, Any] | None = Field(
        description="Why the job failed, as a problem document (RFC 9457)."
    )
    links: Links

    @classmethod
    def of(cls, job: Job, queue_position: int | None = None) -> JobView:
        """Return the view of a job."""
        here = f"/v1/jobs/{job.id}"
        done = job.state is JobState.DONE
        return cls(
            id=job.id,
            state=job.state,
            stage=job.stage,
            progress=job.progress,
            eta_s=job.eta_s,
            queue_position=queue_position,
            machine=job.machine,
            options=job.options,
            source_name=job.source_name,
            source_bytes=job.source_bytes,
            created_at=_moment(job.created_at),
            started_at=None if job.started_at is None else _moment(job.started_at),
            finished_at=None if job.finished_at is None else _moment(job.finished_at),
            error=job.problem,
            links=Links(
                self=here,
                result=f"{here}/result" if done else None,
                report=f"{here}/report" if done else None,
                report_json=f"{here}/report.json" if done else None,
            ),
        )


class Health(BaseModel):
    """Answer of the health checks."""

    status: str
    version: str


def _moment(seconds: float) -> datetime:
    return datetime.fromtimestamp(seconds, UTC)
