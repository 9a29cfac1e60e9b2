"""Hostile requests at every route that computes, and a look at the API meanwhile."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx2
import psutil

__all__ = [
    *("CONTROLLERS", "MEASUREMENTS", "SENDER", "Seen", "deep", "hostile_requests", "loop"),
    *("spectrum", "watched"),
]

SENDER = [sys.executable, str(Path(__file__).with_name("sender.py"))]
MEASUREMENTS = "/v1/machines/any/measurements?trial=true&base=ender3&axis=x"
CONTROLLERS = "/v1/machines/galvo-40khz/controllers"


@dataclass
class Seen:
    """What the API was like meanwhile.

    Attributes
    ----------
    slowest_s : float
        How long the slowest `/healthz` took.
    busiest_s : float
        The most CPU time that the API's own thread, in which all requests are answered, took
        between a `/healthz` and its answer: how long that was held up. On a computer that has
        other things to do an answer takes longer, and this stays as it is.
    largest_bytes : int
    failures : list of str
    """

    slowest_s: float = 0.0
    busiest_s: float = 0.0
    largest_bytes: int = 0
    failures: list[str] = field(default_factory=list)


@contextlib.contextmanager
def watched(client: httpx2.Client, process: subprocess.Popen[str]) -> Iterator[Seen]:
    """Ask how the API is, all the time; no process but its own counts, and none more than once."""
    seen, over = Seen(), threading.Event()
    api = psutil.Process(process.pid)

    def look() -> None:
        with httpx2.Client(base_url=client.base_url, timeout=30) as own:
            while not over.wait(0.05):
                busy_s, began = own_thread_s(process.pid), time.monotonic()
                status = own.get("/healthz").status_code
                seen.slowest_s = max(seen.slowest_s, time.monotonic() - began)
                seen.busiest_s = max(seen.busiest_s, own_thread_s(process.pid) - busy_s)
                seen.largest_bytes = max(seen.largest_bytes, api.memory_info().rss)
                if status != 200:
                    seen.failures.append(f"healthz {status}")

    thread = threading.Thread(target=look)
    thread.start()
    try:
        yield seen
    finally:
        over.set()
        thread.join()


def own_thread_s(pid: int) -> float:
    """CPU time of a process' first thread, user and system (Linux)."""
    stat = Path(f"/proc/{pid}/task/{pid}/stat").read_text()
    ticks = stat.rpartition(")")[2].split()[11:13]
    return sum(map(int, ticks)) / os.sysconf("SC_CLK_TCK")


def spectrum(rows: int) -> dict[str, Any]:
    text = "freq,psd_x,psd_y,psd_z,psd_xyz\n"
    text += "".join(f"{5 + 0.0002 * n:.4f},1.{n % 9},1,1,3\n" for n in range(rows))
    return {"files": {"file": ("resonances_x.csv", text.encode())}}


def deep(levels: int) -> dict[str, Any]:
    return {"files": {"file": ("model.json", b'{"a":' * levels)}}


def loop(states: int) -> dict[str, Any]:
    """Return a controller's request with a machine of many states."""
    plant = {"num": [1.0] * states, "den": [1.0] + [1e-3] * states}
    document = {"name": "galvo-40khz", "title": "t", "source": "s", "loop": plant, "plant": plant}
    return {"json": {"method": "fmsdob", "targets_hz": [2000.0] * 8, "loop": document}}


def hostile_requests(
    client: httpx2.Client, trajectories: str
) -> list[Callable[[], httpx2.Response]]:
    """Return requests that cost much to answer, the first two with too many rows.

    `trajectories` is the link of a job that is done.
    """
    return [
        lambda: client.post(MEASUREMENTS, **spectrum(1_000_000)),
        lambda: client.post(MEASUREMENTS, **spectrum(20_000)),
        lambda: client.post(MEASUREMENTS, **deep(100_000)),
        lambda: client.post(CONTROLLERS, **loop(400)),
        lambda: client.post(CONTROLLERS, **loop(60_000)),
        lambda: client.get("/v1/machines/ender3/design?axis=x&robust=minimax&basis=bspline"),
        lambda: client.get("/v1/machines/ender3/design?axis=y&robust=ensemble"),
        lambda: client.get("/v1/machines/voron-v0/stillpath.json"),
        lambda: client.get(trajectories),
    ]
