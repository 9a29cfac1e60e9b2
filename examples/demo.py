"""The whole service once through, for real: `./run demo`.

Starts the HTTP server on a free port of this computer, hands in a sliced file as any client
would, waits, fetches the compensated file and its report into `demo-output/`, prints what was
measured and what it cost, and stops the server. Only the standard library talks HTTP here, so that
this file also shows how little a client needs (`service.client` is ours).
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
import time
import urllib.parse
import urllib.request
from pathlib import Path
from typing import Any

from stillpath.cli.console import print_result
from stillpath.pipeline.result import Result

ROOT = Path(__file__).resolve().parent.parent
SOURCE = ROOT / "examples" / "cura_ender3_gear24.gcode"
OUTPUT = ROOT / "demo-output"
LOG = OUTPUT / "server.log"
MACHINE = "ender3"
START_TIMEOUT_S = 300.0
_NO_CURVES = {"bin_s": 1.0, "contour_rms_um": {}}


def main() -> int:
    """Run the demo and return its exit code."""
    before_s = _cpu_s()  # `./run` may have installed everything first, in this very process
    OUTPUT.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="stillpath-demo-") as data:
        command = [shutil.which("stillpath", path=str(Path(sys.executable).parent)) or "stillpath"]
        command += ["serve", "--port", "0", "--data-dir", data]
        with LOG.open("w") as log:
            server = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True)
        try:
            return _talk(server)
        except (OSError, RuntimeError) as error:
            print(f"demo: {error} (the server's log: {LOG})", file=sys.stderr)
            return 1
        finally:
            server.terminate()
            server.wait(timeout=60)
            if sys.platform != "win32":
                print(f"CPU        {_cpu_s() - before_s:.1f} s")


def _talk(server: subprocess.Popen[str]) -> int:
    assert server.stdout is not None
    base = server.stdout.readline().removeprefix("stillpath: ").strip().rstrip("/")
    if not base.startswith("http://"):
        raise RuntimeError("the server did not start")
    _wait_until_ready(base, server)
    print(f"server     {base}/ (the page), {base}/openapi.json (the API)")

    query = urllib.parse.urlencode({"machine": MACHINE, "name": SOURCE.name})
    print(f"POST       {base}/v1/jobs?{query}  ({SOURCE.stat().st_size / 1e6:.2f} MB)")
    with SOURCE.open("rb") as body:
        request = urllib.request.Request(f"{base}/v1/jobs?{query}", data=body, method="POST")
        request.add_header("Content-Length", str(SOURCE.stat().st_size))
        request.add_header("Content-Type", "text/x.gcode")
        with urllib.request.urlopen(request) as answer:
            where = base + answer.headers["Location"]
    job = _wait_until_over(where)
    if job["state"] != "done":
        raise RuntimeError(f"the job failed: {job['error']['detail']}")

    written = OUTPUT / f"{SOURCE.stem}.stillpath.gcode"
    for path, target in (
        ("result", written),
        ("report", OUTPUT / "report.html"),
        ("report.json", OUTPUT / "report.json"),
    ):
        with urllib.request.urlopen(f"{where}/{path}") as answer, target.open("wb") as file:
            shutil.copyfileobj(answer, file)
    print()
    figures = json.loads((OUTPUT / "report.json").read_bytes())
    print_result(Result.model_validate(figures | {"track": _NO_CURVES, "layer_views": []}))
    print(f"\ninput      {SOURCE}\noutput     {written}\nreport     {OUTPUT / 'report.html'}")
    return 0


def _cpu_s() -> float:
    """Return the CPU time of this process and of all that it started and that has ended."""
    if sys.platform == "win32":
        return 0.0
    import resource

    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(use.ru_utime + use.ru_stime for use in used)


def _wait_until_ready(base: str, server: subprocess.Popen[str]) -> None:
    deadline = time.monotonic() + START_TIMEOUT_S
    while time.monotonic() < deadline and server.poll() is None:
        try:
            with urllib.request.urlopen(f"{base}/readyz", timeout=5):
                return
        except OSError:
            time.sleep(0.1)
    raise RuntimeError("the server does not get ready")


def _wait_until_over(where: str) -> dict[str, Any]:
    print(f"GET        {where}")
    shown = ""
    while True:
        with urllib.request.urlopen(where) as answer:
            job: dict[str, Any] = json.load(answer)
        if job["stage"] != shown:
            shown = job["stage"]
            print(f"           {job['state']}: {shown}")
        if job["state"] in ("done", "failed", "cancelled"):
            return job
        time.sleep(0.2)


if __name__ == "__main__":
    sys.exit(main())
