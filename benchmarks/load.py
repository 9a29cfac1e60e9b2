"""What the service bears: uploads while workers are busy, one huge upload, many watchers.

    python benchmarks/load.py [--uploads 200] [--megabytes 5] [--clients 20] [--watchers 1000]
        [--huge-megabytes 1024] [--only uploads|huge|watchers] [--workers 2]

Starts a server on loopback for each part, with SQLite and a folder. Of a POST the time counts from
the last kB of its body to the answer; that is sent when the server has read all before it (Linux
tells). The measure is to write a file of the same size and fsync it, on the same disk: half of
these by as many threads as there are clients, the others beside the uploads. Prints quantity, limit
and what it is; exits with 1 if a limit is missed.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import hashlib
import os
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import urlsplit

ROOT = Path(__file__).resolve().parents[1]
PART = ROOT / "examples" / "cura_ender3_gear24.gcode"
POST_LIMIT, RSS_LIMIT_MB = 5.0, 200.0
MB = 1 << 20
_LAST_BYTES, _LOOK_S = 1024, 0.05


@dataclass
class Table:
    rows: list[tuple[str, str, str]] = field(default_factory=list)
    missed: int = 0

    def add(self, name: str, value: float, unit: str, limit: float | None = None) -> None:
        verdict = ""
        if limit is not None:
            good = value <= limit
            self.missed += not good
            verdict = "" if good else "MISS"
        self.rows.append(
            (name, "" if limit is None else f"<= {limit:g}", f"{value:.3g} {unit} {verdict}")
        )

    def check(self, name: str, good: bool) -> None:
        self.missed += not good
        self.rows.append((name, "all", "all" if good else "MISS"))

    def show(self) -> int:
        width = max(len(name) for name, *_ in self.rows)
        print(f"{'quantity':<{width}}  {'limit':>8}  ours")
        for name, limit, value in self.rows:
            print(f"{name:<{width}}  {limit:>8}  {value}")
        return 1 if self.missed else 0


@dataclass
class Server:
    address: str
    pid: int

    @property
    def place(self) -> tuple[str, int]:
        parts = urlsplit(self.address)
        return parts.hostname or "127.0.0.1", parts.port or 80

    def status_mb(self, name: str) -> float:
        for line in Path(f"/proc/{self.pid}/status").read_text().splitlines():
            if line.startswith(f"{name}:"):
                return int(line.split()[1]) / 1024
        raise KeyError(name)

    def forget_peak(self) -> None:
        Path(f"/proc/{self.pid}/clear_refs").write_text("5")

    def cpu_s(self) -> float:
        fields = Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--uploads", type=int, default=200)
    parser.add_argument("--megabytes", type=int, default=5)
    parser.add_argument("--clients", type=int, default=20)
    parser.add_argument("--watchers", type=int, default=1000)
    parser.add_argument("--huge-megabytes", type=int, default=1024)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--only", choices=["uploads", "huge", "watchers"])
    given = parser.parse_args()
    table = Table()
    parts: dict[str, Callable[[Server, Path], None]] = {
        "watchers": lambda running, _: asyncio.run(watchers(running, table, given.watchers)),
        "huge": lambda running, _: huge(running, table, given.huge_megabytes * MB),
        "uploads": lambda running, folder: uploads(running, table, given, folder),
    }
    for name, part in parts.items():
        if given.only in (None, name):
            # A server of its own: memory that one part left behind is not another's.
            with (
                tempfile.TemporaryDirectory(prefix="stillpath-load-") as folder,
                server(Path(folder) / "data", given.workers) as running,
            ):
                part(running, Path(folder))
    return table.show()


@contextlib.contextmanager
def server(data: Path, workers: int) -> Iterator[Server]:
    command = [sys.executable, "-c", "from stillpath.cli.main import main; main()", "serve"]
    command += ["--port", "0", "--data-dir", str(data), "--workers", str(workers)]
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join((str(ROOT / "src"), str(ROOT))),
        "STILLPATH_REQUESTS_PER_MINUTE": "1000000",
        "STILLPATH_MAX_JOBS_PER_OWNER": "1000000",
        "STILLPATH_MAX_UPLOAD_BYTES": str(64 << 30),
    }
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as process:
        try:
            assert process.stdout is not None
            address = process.stdout.readline().removeprefix("stillpath: ").strip().rstrip("/")
            wait_until_ready(address)
            yield Server(address, process.pid)
        finally:
            process.terminate()


def wait_until_ready(address: str) -> None:
    import httpx2

    deadline = time.monotonic() + 300
    while time.monotonic() < deadline:
        with contextlib.suppress(httpx2.TransportError):
            if httpx2.get(f"{address}/readyz").status_code == 200:
                return
        time.sleep(0.2)
    raise SystemExit("the server does not get ready")


def uploads(running: Server, table: Table, given: argparse.Namespace, folder: Path) -> None:
    """Hand in many different files at once, while the workers have all they can do."""
    from stillpath.service.client import Client

    size = given.megabytes * MB
    text = (PART.read_bytes() * (size // PART.stat().st_size + 1))[: size - 64]
    with Client(running.address) as client:
        for n in range(4 * given.workers):
            client.submit(PART, machine="ender3", fresh=True, name=f"busy{n}.gcode")
        while not any(job.state.value == "running" for job in client.jobs()):
            time.sleep(0.2)
    fsyncs: list[float] = []
    done = threading.Event()

    def disk() -> None:
        while not done.is_set():
            fsyncs.append(fsync_s(folder / "beside", text))

    def before(n: int) -> None:
        fsyncs.append(fsync_s(folder / f"before{n}", text))

    def post(n: int) -> tuple[float, str, str]:
        body = b"; %d\n" % n + text
        seconds, job_id = posted_s(running.place, f"load{n}.gcode", body)
        return seconds, job_id, hashlib.sha256(body).hexdigest()

    with ThreadPoolExecutor(given.clients) as pool:
        list(pool.map(before, range(given.uploads // 2)))
        beside = threading.Thread(target=disk)
        beside.start()
        cpu_s = running.cpu_s()
        posted = list(pool.map(post, range(given.uploads)))
        cpu_s = running.cpu_s() - cpu_s
        done.set()
        beside.join()
    with Client(running.address) as client:
        right = all(client.job(job_id).source_sha256 == digest for _, job_id, digest in posted)
    seconds = sorted(second for second, *_ in posted)
    disk_s = sorted(fsyncs)
    table.check(f"{given.uploads} uploads of {given.megabytes} MB accepted and whole", right)
    table.add("POST after its body, median", 1e3 * statistics.median(seconds), "ms")
    table.add("POST after its body, p99", 1e3 * p99(seconds), "ms")
    table.add(f"fsync of {given.megabytes} MB, median", 1e3 * statistics.median(disk_s), "ms")
    table.add(f"fsync of {given.megabytes} MB, p99", 1e3 * p99(disk_s), "ms")
    table.add("POST p99 / fsync p99", p99(seconds) / p99(disk_s), "", POST_LIMIT)
    table.add("POST p99 / fsync median", p99(seconds) / statistics.median(disk_s), "")
    table.add("API: CPU for each upload", 1e3 * cpu_s / given.uploads, "ms")
    table.add("API after uploads, peak", running.status_mb("VmHWM"), "MB", RSS_LIMIT_MB)


def posted_s(place: tuple[str, int], name: str, body: bytes) -> tuple[float, str]:
    """Send a POST by hand, and return the seconds from its last byte to the answer, and the job."""
    import json

    head = (
        f"POST /v1/jobs?machine=ender3&name={name} HTTP/1.1\r\nHost: {place[0]}:{place[1]}\r\n"
        f"Content-Length: {len(body)}\r\nContent-Type: text/x.gcode\r\nConnection: close\r\n\r\n"
    )
    with socket.create_connection(place, timeout=600) as connection:
        connection.sendall(head.encode() + body[:-_LAST_BYTES])
        wait_until_read(connection)  # what lies in the system's buffers is the body's own time
        began = time.monotonic()
        connection.sendall(body[-_LAST_BYTES:])
        answer = b""
        while chunk := connection.recv(1 << 16):
            answer += chunk
        seconds = time.monotonic() - began
    status = answer.split(b" ", 2)[1]
    assert status == b"202", answer[:400]
    return seconds, json.loads(answer.partition(b"\r\n\r\n")[2])["id"]


def wait_until_read(connection: socket.socket) -> None:
    """Wait until the other side, on this computer, has read all that was sent.

    By Linux's table of connections: `local remote state sent:received`, in hexadecimal.
    """
    here, there = connection.getsockname()[1], connection.getpeername()[1]
    ends = {(here, there), (there, here)}
    while True:
        waiting = 0
        for line in Path("/proc/net/tcp").read_text().splitlines()[1:]:
            _, local, remote, _, queues, *_ = line.split()
            if tuple(int(end.rpartition(":")[2], 16) for end in (local, remote)) in ends:
                waiting += sum(int(size, 16) for size in queues.split(":"))
        if not waiting:
            return
        time.sleep(_LOOK_S)


def fsync_s(path: Path, data: bytes) -> float:
    began = time.monotonic()
    with path.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    seconds = time.monotonic() - began
    path.unlink()
    return seconds


def huge(running: Server, table: Table, size: int) -> None:
    """Hand in one file that no memory should hold."""
    running.forget_peak()
    line = b"; filling of a very long file, forty bytes\n"
    block = line * (MB // len(line))
    count = size // len(block)
    host, port = running.place
    head = (
        f"POST /v1/jobs?machine=ender3&name=huge.gcode HTTP/1.1\r\nHost: {host}:{port}\r\n"
        f"Content-Length: {count * len(block)}\r\nConnection: close\r\n\r\n"
    )
    with socket.create_connection(running.place, timeout=1800) as connection:
        connection.sendall(head.encode())
        for _ in range(count):
            connection.sendall(block)
        answer = connection.recv(1 << 16)
    table.check(f"upload of {size >> 20} MB accepted", answer.split(b" ", 2)[1] == b"202")
    name = f"API while taking in {size >> 20} MB, peak"
    table.add(name, running.status_mb("VmHWM"), "MB", RSS_LIMIT_MB)


async def watchers(running: Server, table: Table, count: int) -> None:
    """Watch one job by many streams, and count the events that come."""
    from stillpath.service.client import Client

    with Client(running.address) as client:
        job_id = client.submit(PART, machine="ender3", fresh=True, name="watched.gcode").id
    before_mb, before_s, began = running.status_mb("VmRSS"), running.cpu_s(), time.monotonic()
    host, port = running.place
    request = f"GET /v1/jobs/{job_id}/events HTTP/1.1\r\nHost: {host}:{port}\r\n\r\n".encode()
    events = [0] * count
    peak_mb = before_mb

    async def watch(n: int) -> None:
        reader, writer = await asyncio.open_connection(host, port)
        try:
            writer.write(request)
            status = await reader.readline()
            assert b" 200 " in status, status
            while line := await reader.readline():
                events[n] += line.startswith(b"event: job")
                if b'"state":"done"' in line.replace(b" ", b""):
                    return
        finally:
            writer.close()
            with contextlib.suppress(OSError):
                await writer.wait_closed()

    async def measure() -> None:
        nonlocal peak_mb
        while True:
            peak_mb = max(peak_mb, running.status_mb("VmRSS"))
            await asyncio.sleep(0.5)

    measuring = asyncio.create_task(measure())
    await asyncio.gather(*(watch(n) for n in range(count)))
    measuring.cancel()
    wall_s, cpu_s = time.monotonic() - began, running.cpu_s() - before_s
    table.check(f"{count} watchers saw the end", min(events) >= 1)
    table.add("events to each watcher", statistics.mean(events), "")
    table.add("API: CPU for each watcher and second", 1e6 * cpu_s / count / wall_s, "us")
    table.add("API: CPU for each event", 1e6 * cpu_s / max(sum(events), 1), "us")
    table.add("API: memory for each watcher", 1024 * (peak_mb - before_mb) / count, "kB")


def p99(values: list[float]) -> float:
    return sorted(values)[min(int(0.99 * len(values)), len(values) - 1)]


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    sys.exit(main())
