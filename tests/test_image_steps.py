"""The image's steps in a clean folder, and the service from what they made: no engine needed."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx2
import pytest

from tests.dockerfile import Image, build, context_of

ROOT = Path(__file__).parents[1]
KEY = "sp_" + "k" * 32

pytestmark = [pytest.mark.slow, pytest.mark.skipif(os.name != "posix", reason="an image of Linux")]


@pytest.fixture(scope="module")
def image() -> Iterator[Image]:
    root = Path(tempfile.mkdtemp(prefix="stillpath-image-"))  # short, for lines of #!
    try:
        if not _reaches_pypi():
            pytest.skip("NOT CHECKED: the image's steps need PyPI")
        yield build(ROOT / "Dockerfile", context_of(ROOT, root / "context"), root)
    finally:
        shutil.rmtree(root)


def _reaches_pypi() -> bool:
    command = ["python3", "-m", "pip", "download", "--quiet", "--no-deps", "--dest"]
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run([*command, folder, "editables==0.5"], capture_output=True)
    return done.returncode == 0


def plainly(command: list[str]) -> list[str]:
    """Without the rights of root, to whom no file is read-only; it may be root's own Python."""
    if os.geteuid() != 0:
        return command
    return ["setpriv", "--bounding-set=-all", "--inh-caps=-all", *command]


@contextmanager
def read_only(folder: Path) -> Iterator[None]:
    subprocess.run(["chmod", "-R", "a-w", str(folder)], check=True)
    try:
        yield
    finally:
        subprocess.run(["chmod", "-R", "u+w", str(folder)], check=True)


@contextmanager
def running(image: Image, port: int) -> Iterator[subprocess.Popen[str]]:
    """Run the image's command as a container does, without capabilities."""
    data = Path(image.environment["STILLPATH_DATA_DIR"])
    # What the host puts into any container, and nothing else.
    environment = image.environment | {"STILLPATH_FIRST_KEY": KEY, "HOME": str(data)}
    program, *arguments = [part.replace("8000", str(port)) for part in image.command]
    program = shutil.which(program, path=environment["PATH"]) or program
    with subprocess.Popen(
        plainly([program, *arguments]),
        env=environment,
        cwd=data,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


def until_ready(client: httpx2.Client, process: subprocess.Popen[str]) -> None:
    deadline = time.monotonic() + 300
    while process.poll() is None and time.monotonic() < deadline:
        try:
            if client.get("/readyz").status_code == 200:
                return
        except httpx2.TransportError:
            pass
        time.sleep(0.2)
    raise AssertionError("the service does not get ready")


def test_the_image_says_how_it_is_run(image: Image):
    assert image.user == "10001:10001"
    assert image.stop_signal == "SIGTERM"
    assert image.command[:2] == ["stillpath", "serve"]
    assert "readyz" in image.healthcheck[-1]


def test_it_serves_without_the_sources_and_writes_only_data(image: Image):
    port = free_port()
    installed = Path(image.environment["NUMBA_CACHE_DIR"]).parent
    before = {path: path.stat().st_mtime_ns for path in installed.rglob("*") if path.is_file()}
    kernels = [path for path in before if path.suffix == ".nbc"]
    assert len(kernels) > 20, "no kernels were made in advance"
    made_for = {path.parent.name.rsplit("_", 1)[0] for path in kernels}
    assert made_for >= {"klipper", "marlin", "reprapfirmware"}
    for folder in (image.root / "context", image.root / "done-build"):
        if folder.exists():
            folder.rename(folder.with_name(f"{folder.name}-gone"))
    headers = {"X-Api-Key": KEY}
    with (
        read_only(installed),
        running(image, port) as process,
        httpx2.Client(base_url=f"http://127.0.0.1:{port}", headers=headers, timeout=60) as client,
    ):
        until_ready(client, process)
        check = [part.replace("8000", str(port)) for part in image.healthcheck]
        python = shutil.which(check[0], path=image.environment["PATH"])
        assert python is not None
        assert python.startswith(str(installed))
        subprocess.run(plainly([python, *check[1:]]), env=image.environment, check=True)
        where = subprocess.run(
            [python, "-c", "import stillpath; print(stillpath.__file__)"],
            env=image.environment,
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=True,
        )
        assert where.stdout.startswith(str(installed))

        assert "<h1" in client.get("/help/safety").text
        assert client.get("/v1/jobs", headers={"X-Api-Key": "sp_" + "x" * 32}).status_code == 401
        text = (ROOT / "examples" / "ps_ender3_pauses_hept24f.gcode").read_bytes()
        answer = client.post("/v1/jobs", params={"machine": "ender3"}, content=text)
        assert answer.status_code == 202, answer.text
        deadline = time.monotonic() + 600
        while time.monotonic() < deadline:
            job = client.get(answer.headers["location"]).json()
            if job["state"] in ("done", "failed"):
                break
            time.sleep(0.5)
        assert job["state"] == "done", job
        assert b"; Processed by stillpath" in client.get(job["links"]["result"]).content
        assert client.get("/").status_code == 200

        process.send_signal(getattr(signal, image.stop_signal))
        process.wait(timeout=60)
        # uvicorn ends by the signal that it was sent, once all is put away.
        assert process.returncode in (0, -getattr(signal, image.stop_signal))
    after = {path: path.stat().st_mtime_ns for path in installed.rglob("*") if path.is_file()}
    assert after == before
