"""The service under hostile and unlucky hands, measured.

    python benchmarks/hostile_service.py [NAME ...] [--logs-mb 190]

Each case starts a service of its own, whose compensations are pretended and whose other jobs are
real, and prints a line: what was done, the API's peak memory, the slowest `/healthz` meanwhile, and
what became of it. Linux only; the full disk takes root (a tmpfs of 60 MB). "clock" takes minutes.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import resource
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import httpx2
import psutil

from tests.service.api.hostile_requests import (
    MEASUREMENTS,
    SENDER,
    Seen,
    hostile_requests,
    spectrum,
    watched,
)
from tests.service.test_server import PRETEND, finished, post, server, until

_MIB = 1 << 20
_LIMIT_MIB = 600
_DISK_MIB, _RESERVE_MIB = 60, 16
_DAY_S = 86400
_JUMPING = """
import runpy, sys, threading, time
from pathlib import Path
real, offset = time.time, [0.0]
time.time = lambda: real() + offset[0]
def follow():
    while True:
        try: offset[0] = float(Path(sys.argv[1], "offset").read_text())
        except (OSError, ValueError): pass
        time.sleep(0.1)
if __name__ == "__main__":
    threading.Thread(target=follow, daemon=True).start()
    sys.argv[0] = "SERVER"
    runpy.run_path(sys.argv[0], run_name="__main__")
"""


@dataclass
class Line:
    """One line of the table."""

    case: str
    became: str
    kept: bool
    seen: Seen | None = None

    def __str__(self) -> str:
        peak = slow = "-"
        if self.seen is not None:
            peak = f"{self.seen.largest_bytes // _MIB} MB"
            slow = f"{self.seen.slowest_s:.3f} s"
        verdict = "PASS" if self.kept else "MISS"
        return f"| {self.case} | {peak} | {slow} | {self.became} | {verdict} |"


def main() -> int:
    arguments = _arguments()
    names = arguments.name or list(_CASES)
    print("| case | API's peak | slowest `/healthz` | what became of it | |\n|---|---|---|---|---|")
    missed = 0
    for name in names:
        with tempfile.TemporaryDirectory() as folder:
            line = _CASES[name](Path(folder), arguments)
        missed += not line.kept
        print(line, flush=True)
    return 1 if missed else 0


def _routes(data: Path, _: argparse.Namespace) -> Line:
    """Every route that computes gets hostile files, under a hard limit of memory."""
    with server(PRETEND, data) as (client, process), ThreadPoolExecutor(24) as pool:
        done = finished(client, post(client, b"stamp"))
        resource.prlimit(process.pid, resource.RLIMIT_DATA, (_LIMIT_MIB * _MIB,) * 2)
        with watched(client, process) as seen:
            job = post(client, b"nap 5")
            asked = hostile_requests(client, done["links"]["trajectories"])
            codes = sorted(a.result().status_code for a in [pool.submit(one) for one in asked])
            other = finished(client, job)["state"]
    kept = set(codes) <= {200, 202, 422} and other == "done" and not seen.failures
    return Line(
        f"8 hostile requests at all routes that compute, API limited to {_LIMIT_MIB} MB",
        f"{codes}; another's job {other}",
        kept and seen.slowest_s < 0.5,
        seen,
    )


def _large_spectrum(data: Path, _: argparse.Namespace) -> Line:
    with server(PRETEND, data) as (client, process):
        finished(client, post(client, b"G1 X1"))
        with watched(client, process) as seen, _workers(process) as used:
            answer = client.post(MEASUREMENTS, **spectrum(1_000_000))
    refused = answer.status_code == 422
    return Line(
        "spectrum of 1 000 000 rows",
        f"{'refused' if refused else answer.status_code}; in the worker {used.cpu_s:.2f} CPU s, "
        f"peak {used.peak_bytes // _MIB} MB",
        refused and used.cpu_s < 5 and used.peak_bytes < 300 * _MIB,
        seen,
    )


def _six_logs(data: Path, given: argparse.Namespace) -> Line:
    with server(PRETEND, data) as (client, process), watched(client, process) as seen:
        job = post(client, b"nap 5")
        command = [*SENDER, str(client.base_url.port), MEASUREMENTS, str(given.logs_mb)]
        senders = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(6)]
        said = [sender.communicate()[0] for sender in senders]
        other = finished(client, job)["state"]
    refused = sum("samples are read" in text for text in said)
    return Line(
        f"six raw logs of {given.logs_mb} MB at once",
        f"{refused} refused for their length; another's job {other}",
        refused == 6 and other == "done" and seen.largest_bytes < 300 * _MIB,
        seen,
    )


def _stalled(data: Path, _: argparse.Namespace) -> Line:
    head = b"POST /v1/jobs?machine=ender3 HTTP/1.1\r\nHost: localhost\r\n"
    head += b"Content-Length: 100000\r\n\r\n"
    with server(PRETEND, data) as (client, process):
        address = ("127.0.0.1", client.base_url.port)
        with watched(client, process) as seen, contextlib.ExitStack() as stack:
            held = [stack.enter_context(socket.create_connection(address)) for _ in range(64)]
            for one in held:
                one.sendall(head + b"G1 X1\n")
            began = time.monotonic()

            def good() -> str:  # who is refused for want of a place comes again
                answer = client.post("/v1/jobs?machine=ender3", content=b"G1 X2")
                return answer.headers["location"] if answer.status_code == 202 else ""

            where = until(good, 30)
            good_s = time.monotonic() - began
            state = finished(client, where)["state"]
            for one in held:
                one.settimeout(90)
                with contextlib.suppress(OSError):
                    while one.recv(4096):
                        pass
            free_s = time.monotonic() - began
    return Line(
        "64 uploads that stop sending, beside a good one",
        f"the good one {state}, taken after {good_s:.1f} s; all places free after {free_s:.0f} s",
        state == "done" and free_s < 60,
        seen,
    )


def _full_disk(data: Path, _: argparse.Namespace) -> Line:
    size = f"size={_DISK_MIB}m"
    subprocess.run(["mount", "-t", "tmpfs", "-o", size, "none", str(data)], check=True)
    os.environ["STILLPATH_DISK_RESERVE_BYTES"] = str(_RESERVE_MIB * _MIB)
    try:
        with (
            server(PRETEND, _made(data / "data")) as (client, process),
            watched(client, process) as seen,
        ):
            return _fill_and_free(client, data / "foreign", seen)
    finally:
        del os.environ["STILLPATH_DISK_RESERVE_BYTES"]
        subprocess.run(["umount", "--lazy", str(data)], check=True)


def _fill_and_free(client: httpx2.Client, foreign: Path, seen: Seen) -> Line:
    accepted, refused = [], 0
    for number in range(50):
        content = f"nap 0.2 {number}\n".encode().ljust(_MIB, b";")
        with contextlib.suppress(httpx2.TransportError):
            answer = client.post("/v1/jobs?machine=ender3", content=content)
            refused += answer.status_code == 507
            if answer.status_code == 202:
                accepted.append(answer.headers["location"])
    with contextlib.suppress(OSError), foreign.open("wb", buffering=0) as file:
        while file.write(b"x" * 4096):
            pass
    time.sleep(5)
    deleted = client.delete(accepted[0]).status_code
    foreign.unlink()
    left, lost = set(accepted[1:]), 0

    def fetch_and_delete() -> bool:
        nonlocal lost
        for where in sorted(left):
            state = client.get(where).json()["state"]
            if state not in ("queued", "running"):
                lost += state != "done"
                client.delete(where)
                left.discard(where)
        return not left

    until(fetch_and_delete, 180)
    return Line(
        f"a disk of {_DISK_MIB} MB filled to the last byte, 50 uploads of 1 MB",
        f"{len(accepted)} accepted, {refused} refused (507), {lost} lost; DELETE {deleted} on the "
        "full disk; the rest done afterwards",
        lost == 0 and deleted == 204 and refused > 0,
        seen,
    )


def _clock(data: Path, _: argparse.Namespace) -> Line:
    code = _JUMPING.replace("SERVER", PRETEND[1])
    command = [sys.executable, str(_written(data / "jumping.py", code))]
    folder = _made(data / "data")
    gone = 0
    with server(command, folder) as (client, _process):
        jobs = [post(client, f"G1 X{number}".encode()) for number in range(3)]
        for job in jobs:
            finished(client, job)
        for days in (32, -1, 400):
            (folder / "offset").write_text(str(days * _DAY_S))
            time.sleep(65)  # the sweep looks once a minute
            gone += sum(client.get(job).status_code != 200 for job in jobs)
        state = finished(client, post(client, b"G1 X9"))["state"]
    return Line(
        "clock +32 days, -1 day, +400 days while the service runs, a sweep after each",
        f"{gone} of 3 results gone; a new job {state}",
        gone == 0 and state == "done",
    )


@dataclass
class _Used:
    """What worker processes took."""

    cpu_s: float = 0.0
    peak_bytes: int = 0
    before_s: dict[int, float] = field(default_factory=dict)


@contextlib.contextmanager
def _workers(process: subprocess.Popen[str]) -> Iterator[_Used]:
    """Watch the processes below the API: CPU time of all, memory of the largest that computes."""
    used, over = _Used(), threading.Event()
    api = psutil.Process(process.pid)

    def look(first: bool = False) -> None:
        spent = 0.0
        for child in api.children(recursive=True):
            with contextlib.suppress(psutil.Error):
                times = child.cpu_times()
                cpu_s = times.user + times.system
                if first:
                    used.before_s[child.pid] = cpu_s
                mine = cpu_s - used.before_s.get(child.pid, 0.0)
                spent += mine
                if mine > 0.05:
                    used.peak_bytes = max(used.peak_bytes, child.memory_info().rss)
        used.cpu_s = max(used.cpu_s, spent)

    def watch() -> None:
        while not over.wait(0.02):
            look()

    look(first=True)
    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield used
    finally:
        over.set()
        thread.join()
        look()


def _made(folder: Path) -> Path:
    folder.mkdir()
    return folder


def _written(file: Path, text: str) -> Path:
    file.write_text(text)
    return file


_CASES: dict[str, Callable[[Path, argparse.Namespace], Line]] = {
    "routes": _routes,
    "spectrum": _large_spectrum,
    "logs": _six_logs,
    "stalled": _stalled,
    "disk": _full_disk,
    "clock": _clock,
}


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name", nargs="*", choices=[[], *_CASES], help="by default all")
    parser.add_argument("--logs-mb", type=int, default=190)
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
