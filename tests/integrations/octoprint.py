"""OctoPrint from PyPI, started as a process of its own with our plugin, and spoken to by its API.

`OCTOPRINT` names the program in an environment of its own; `tests/get-tools` makes one.
"""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import quote

import httpx2
import pytest

from tests.integrations.posting import ROOT

__all__ = ["NO_OCTOPRINT", "PLUGIN", "OctoPrint", "install", "octoprint_program", "until"]

NO_OCTOPRINT = "OctoPrint not here"
PLUGIN = ROOT / "integrations" / "octoprint"
_KEY = "a-key-for-tests-only-0123456789a"
# What looks into the network, or only takes time.
_LEFT_OUT = [
    *("achievements", "announcements", "backup", "discovery", "errortracking", "file_check"),
    *("firmware_check", "gcodeviewer", "health_check", "pi_support", "pluginmanager"),
    *("softwareupdate", "tracking", "upload_manager"),
]


def until(wanted: Callable[[], Any], seconds: float = 300.0) -> Any:
    """Wait for something and return it; OctoPrint is asked less often than our own server."""
    deadline = time.monotonic() + seconds
    while not (found := wanted()):
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.3)
    return found


def octoprint_program() -> Path:
    """Return the program, or skip the test."""
    found = os.environ.get("OCTOPRINT") or shutil.which("octoprint")
    if not found:
        pytest.skip(f"{NO_OCTOPRINT}: OCTOPRINT, or octoprint on the PATH")
    return Path(found)


def install(program: Path, folder: Path) -> Path:
    """Install our plugin beside the environment, as pip does from its folder, and return where."""
    copy, site = folder / "checkout", folder / "site"
    shutil.copytree(PLUGIN, copy, ignore=shutil.ignore_patterns("__pycache__", "*.egg-info"))
    words = [str(program.with_name("python")), "-m", "pip", "install", "--quiet", "--no-deps"]
    words += ["--no-build-isolation", "--no-index", "--disable-pip-version-check"]
    subprocess.run([*words, "--target", str(site), str(copy)], check=True, capture_output=True)
    return site


class OctoPrint:
    """One OctoPrint: its folder, and while it runs its API.

    Parameters
    ----------
    program, site : Path
        OctoPrint, and where our plugin is installed.
    base : Path
        Of its settings and files.
    """

    def __init__(self, program: Path, site: Path, base: Path) -> None:
        self._program, self._site, self._base = program, site, base
        self.uploads = base / "uploads"
        base.mkdir()
        config = {
            "api": {"key": _KEY},
            "server": {
                "firstRun": False,
                "onlineCheck": {"enabled": False},
                "pluginBlacklist": {"enabled": False},
            },
            # It costs more than all the rest: tests ask for it.
            "gcodeAnalysis": {"runAt": "never"},
            "plugins": {"_disabled": _LEFT_OUT, "virtual_printer": {"enabled": True}},
        }
        # JSON is YAML.
        (base / "config.yaml").write_text(json.dumps(config))

    @contextmanager
    def running(self) -> Iterator[OctoPrint]:
        """Start it, and end it as a service manager does."""
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        words = [self._program, "serve", "--iknowwhatimdoing", "--host", "127.0.0.1"]
        words += ["--port", str(port), "--basedir", self._base]
        log = self._base / "said.txt"
        with log.open("ab") as said:
            process = subprocess.Popen(
                list(map(str, words)),
                stdin=subprocess.DEVNULL,
                stdout=said,
                stderr=said,
                env={**os.environ, "PYTHONPATH": str(self._site)},
            )
        try:
            self.address = f"http://127.0.0.1:{port}"
            with httpx2.Client(
                base_url=self.address, headers={"X-Api-Key": _KEY}, timeout=120
            ) as self.client:
                until(lambda: self._answers(process, log))
                yield self
        finally:
            process.terminate()
            try:
                process.wait(60)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def set(self, **settings: Any) -> None:
        """Change settings of our plugin."""
        self._set(plugins={"stillpath": settings})

    def analyse(self, when: str) -> None:
        """Let OctoPrint analyse what comes from now on: always or never."""
        self._set(gcodeAnalysis={"runAt": when})

    def upload(self, name: str, text: bytes | str, folder: str = "") -> str:
        """Upload a file and return its path in the storage."""
        content = text.encode() if isinstance(text, str) else text
        answer = self.client.post(
            "/api/files/local", files={"file": (name, content)}, data={"path": folder}
        )
        assert answer.status_code == 201, answer.text
        return str(answer.json()["files"]["local"]["path"])

    def about(self, path: str) -> dict[str, Any]:
        """Return what OctoPrint knows of a file; empty: it is not there."""
        answer = self.client.get(f"/api/files/local/{quote(path)}")
        return answer.json() if answer.status_code == 200 else {}

    def entries(self) -> list[dict[str, Any]]:
        """Return our list, newest first."""
        answer = self.client.get("/api/plugin/stillpath")
        assert answer.status_code == 200, answer.text
        return answer.json()["entries"]

    def entry(self, path: str) -> dict[str, Any] | None:
        """Return the newest entry of a file."""
        return next((entry for entry in self.entries() if entry["path"] == path), None)

    def ask(self, command: str, **data: Any) -> httpx2.Response:
        """Send a command to our plugin."""
        return self.client.post("/api/plugin/stillpath", json={"command": command, **data})

    def ended(self, path: str) -> dict[str, Any]:
        """Return the newest entry of a file when it is over."""

        def over() -> dict[str, Any] | None:
            entry = self.entry(path)
            return entry if entry and entry["is_over"] else None

        return until(over)

    def working(self, path: str) -> dict[str, Any]:
        """Return the newest entry of a file when the server has its job."""

        def begun() -> dict[str, Any] | None:
            entry = self.entry(path)
            return entry if entry and entry["job"] else None

        return until(begun)

    def connect_printer(self) -> None:
        """Connect OctoPrint's own virtual printer."""
        if self.is_ready():
            return
        answer = self.client.post("/api/connection", json={"command": "connect", "port": "VIRTUAL"})
        assert answer.status_code == 204, answer.text
        until(self.is_ready)

    def is_ready(self) -> bool:
        """Return whether the printer waits for work."""
        answer = self.client.get("/api/printer?exclude=temperature,sd")
        return answer.status_code == 200 and answer.json()["state"]["flags"]["ready"]

    def job(self) -> dict[str, Any]:
        """Return what is printed."""
        return self.client.get("/api/job").json()

    def _set(self, **settings: Any) -> None:
        answer = self.client.post("/api/settings", json=settings)
        assert answer.status_code == 200, answer.text

    def _answers(self, process: subprocess.Popen[bytes], log: Path) -> bool:
        assert process.poll() is None, log.read_text(errors="replace")[-3000:]
        try:
            answer = self.client.get("/api/plugin/stillpath")
        except httpx2.TransportError:
            return False
        return answer.status_code == 200
