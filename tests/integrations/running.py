"""A server that runs beside the tests."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tests.service.test_server import until

__all__ = ["Running"]


class Running:
    """A server, where its jobs lie, and how it is called."""

    def __init__(self, client: Any, data: Path) -> None:
        self.client, self.jobs = client, data / "jobs"
        self.address = str(client.base_url).rstrip("/")
        self.arguments = ("--server", self.address, "--machine", "ender3")

    def odd(self, oddity: str) -> tuple[str, ...]:
        return ("--server", f"{self.address}/{oddity}", "--machine", "ender3")

    def job_ids(self) -> list[str]:
        return [p.name for p in self.jobs.iterdir()] if self.jobs.is_dir() else []

    def running_job(self) -> str:
        def find() -> str | None:
            for job in self.job_ids():
                answer = self.client.get(f"/v1/jobs/{job}")
                if answer.status_code == 200 and answer.json()["state"] == "running":
                    return job
            return None

        return until(find)
