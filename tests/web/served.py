"""A service in a process of its own, as `stillpath serve` runs it."""

from __future__ import annotations

import os
import re
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx2

from tests.checkout import PYTHONPATH
from tests.service.jobs.site import until
from tests.service.test_server import REAL

__all__ = ["GEAR", "PART", "PATIENCE_MS", "Service", "running"]

ROOT = Path(__file__).resolve().parents[2]
GEAR = ROOT / "examples" / "cura_ender3_gear24.gcode"
PART = GEAR.read_bytes().partition(b";LAYER:9\n")[0]
"""Its first nine layers."""
PATIENCE_MS = 240_000
"""For whatever a job or an identification takes on a loaded machine."""


@dataclass(frozen=True)
class Service:
    """A running service."""

    url: str
    api: httpx2.Client

    def submit(self, content: bytes, name: str, **query: Any) -> str:
        """Hand a file in; return the job's id."""
        asked = {"machine": "ender3", "name": name} | query
        answer = self.api.post("/v1/jobs", params=asked, content=content)
        assert answer.status_code in (200, 202), answer.text
        return str(answer.json()["id"])

    def finished(self, job_id: str) -> dict[str, Any]:
        """Wait until a job is over."""

        def ask() -> dict[str, Any] | None:
            job: dict[str, Any] = self.api.get(f"/v1/jobs/{job_id}").json()
            return job if job["state"] in ("done", "failed", "cancelled") else None

        return until(ask, PATIENCE_MS / 1e3)


@contextmanager
def running(data_dir: Path, key: str | None = None, **environment: str) -> Iterator[Service]:
    """Run `stillpath serve`; its log lies in the folder."""
    variables = os.environ | {"PYTHONPATH": PYTHONPATH} | environment
    headers = {} if key is None else {"X-Api-Key": key}
    data_dir.mkdir(parents=True, exist_ok=True)
    with (data_dir / "log").open("w") as log:
        process = subprocess.Popen(
            [*REAL, str(data_dir / "data")],
            stdout=subprocess.PIPE, stderr=log, text=True, env=variables, cwd=data_dir,
        )  # fmt: skip
        try:
            assert process.stdout is not None
            lines = iter(process.stdout.readline, "")
            url = next(
                u[1] for line in lines if (u := re.match(r"stillpath: (http\S+?)/?\s*$", line))
            )
            with httpx2.Client(base_url=url, timeout=60, headers=headers) as api:
                until(lambda: _is_ready(api), PATIENCE_MS / 1e3)
                yield Service(url, api)
        finally:
            process.terminate()
            process.wait(timeout=60)
            if process.stdout is not None:
                process.stdout.close()


def _is_ready(api: httpx2.Client) -> bool:
    try:
        return api.get("/readyz").status_code == 200
    except httpx2.TransportError:
        return False
