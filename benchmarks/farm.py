"""Two workers against one, for the same batch: are both busy, and what does it cost?

    python benchmarks/farm.py [FILE] [--copies 8] [--only here|service]

`here`: `stillpath batch --jobs N`. `service`: a server with N workers, through `--server`. Busy is
the share of all workers' time, from the first file's beginning to the last one's end, in which
they had a file; CPU counts every process. Exits with 1 if a limit is missed.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import forkserver
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PART = ROOT / "examples" / "ps_ender3_pauses_hept24f.gcode"
BUSY, EXTRA_CPU = 0.90, 1.10


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", nargs="?", type=Path, default=PART)
    parser.add_argument("--copies", type=int, default=8)
    parser.add_argument("--machine", default="ender3")
    parser.add_argument("--only", choices=["here", "service"])
    given = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory(prefix="stillpath-farm-") as folder:
        files = Path(folder) / "in"
        files.mkdir()
        for n in range(given.copies):
            shutil.copy(given.file, files / f"part{n:02}.gcode")
        # So that no run pays for kernels and shapers that another one finds ready.
        here(files, Path(folder) / "warm", given.machine, 1, limit=1)
        for name, run in (("here", here), ("service", service)):
            if given.only in (None, name):
                costs = {}
                for workers in (1, 2):
                    out = Path(folder) / f"{name}{workers}"
                    busy, costs[workers] = run(files, out, given.machine, workers)
                    text = f"{100 * busy:.1f} %"
                    rows.append((f"{name}, {workers} workers: busy", BUSY, busy, text))
                rows.append((f"{name}: CPU of one worker, s", None, costs[1], f"{costs[1]:.1f}"))
                ratio = costs[2] / costs[1]
                rows.append((f"{name}: CPU of two / one", EXTRA_CPU, ratio, f"{ratio:.3f}"))
    return table(rows)


def here(
    files: Path, output: Path, machine: str, workers: int, limit: int | None = None
) -> tuple[float, float]:
    from stillpath.cli.batch.batch import run_batch
    from stillpath.cli.batch.items import Group, items_of
    from stillpath.cli.batch.output import OutputFolder
    from stillpath.cli.batch.worker_pool import LocalBackend, worker_pool
    from stillpath.cli.own_machines import open_machines
    from stillpath.pipeline.options import Options

    options = Options()
    items = items_of([files], Group((machine,)), output=output)[:limit]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    began, busy_s = time.monotonic(), []
    with OutputFolder.opened(output) as kept:
        works = LocalBackend(open_machines(), options, workers)
        with worker_pool(works, kept, options, workers) as made:
            outcomes = run_batch(made, kept, items, tell=lambda o: busy_s.append(o.took_s))
            wall_s = time.monotonic() - began
    # Its time counts when it has ended; the next run begins with one of its own.
    forkserver._forkserver._stop()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    failed = [outcome.error for outcome in outcomes if outcome.state != "done"]
    assert not failed, failed
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return sum(busy_s) / (workers * wall_s), cpu_s


def service(files: Path, output: Path, machine: str, workers: int) -> tuple[float, float]:
    from stillpath.cli.batch.server import batch_name
    from stillpath.service.client import Client

    with server(output.with_suffix(".data"), workers) as (address, pid):
        command = ["batch", str(files), "-m", machine, "-o", str(output), "--server", address]
        subprocess.run(
            stillpath(*command), check=True, stdout=subprocess.DEVNULL, env=environment()
        )
        cpu_s = tree_cpu_s(pid)
        with Client(address) as client:
            jobs = list(client.jobs(batch=batch_name(output)))
    begun = [job.started_at.timestamp() for job in jobs if job.started_at]
    ended = [job.finished_at.timestamp() for job in jobs if job.finished_at]
    busy_s = sum(ended) - sum(begun)
    return busy_s / (workers * (max(ended) - min(begun))), cpu_s


@contextmanager
def server(data: Path, workers: int) -> Iterator[tuple[str, int]]:
    command = stillpath("serve", "--port", "0", "--data-dir", str(data), "--workers", str(workers))
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment()) as process:
        try:
            assert process.stdout is not None
            yield process.stdout.readline().removeprefix("stillpath: ").strip(), process.pid
        finally:
            process.terminate()


def stillpath(*arguments: str) -> list[str]:
    return [sys.executable, "-c", "from stillpath.cli.main import main; main()", *arguments]


def environment() -> dict[str, str]:
    return os.environ | {"PYTHONPATH": os.pathsep.join((str(ROOT / "src"), str(ROOT)))}


def tree_cpu_s(pid: int) -> float:
    """CPU of a process and of all below it, with those that have ended."""
    of: dict[int, tuple[int, int]] = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        of[int(path.parent.name)] = int(fields[1]), sum(map(int, fields[11:15]))
    tree = {pid}
    while more := {child for child, (parent, _) in of.items() if parent in tree} - tree:
        tree |= more
    return sum(of[process][1] for process in tree) / os.sysconf("SC_CLK_TCK")


def table(rows: list[tuple[str, float | None, float, str]]) -> int:
    width = max(len(name) for name, *_ in rows)
    missed = 0
    for name, limit, value, text in rows:
        verdict = ""
        if limit is not None:
            good = value >= limit if limit < 1 else value <= limit
            verdict = f"{'>=' if limit < 1 else '<='} {limit:.2f}  {'ok' if good else 'MISS'}"
            missed += not good
        print(f"{name:<{width}}  {text:>9}  {verdict}")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    sys.exit(main())
