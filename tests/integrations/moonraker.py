"""Stand-ins for what Moonraker gives its components; and the real one, where it is installed.

`MOONRAKER_PYTHON` names a Python that has Moonraker; `tests/get-tools` makes one.

The contract is Moonraker 0.11's: server.py, confighelper.py, components/file_manager (metadata:
`run_gcode_processors`, `file_manager:metadata_processed`), klippy_apis.py.
"""

from __future__ import annotations

import asyncio
import inspect
import os
import re
import socket
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import httpx2
import pytest

from tests.loading import module_at
from tests.service.test_server import until

__all__ = [
    "COMPONENT",
    "NO_MOONRAKER",
    "Config",
    "RealMoonraker",
    "Server",
    "ServerError",
    "component_module",
]

COMPONENT = Path(__file__).resolve().parents[2] / "integrations" / "moonraker" / "stillpath.py"


def component_module() -> ModuleType:
    """Load the component's file, as Moonraker imports it from its own folder."""
    return module_at(COMPONENT, "moonraker_components_stillpath")


class ServerError(Exception):
    def __init__(self, message: str, status_code: int = 400) -> None:
        super().__init__(message)
        self.status_code = status_code


class Config:
    """A section of moonraker.conf."""

    error = ServerError

    def __init__(self, server: Server, options: dict[str, str]) -> None:
        self._server, self._options = server, options

    def get_server(self) -> Server:
        return self._server

    def get(self, name: str, *default: Any) -> Any:
        if name not in self._options and not default:
            raise ServerError(f"No option '{name}' found in section [stillpath]")
        return self._options.get(name, *default)

    def getboolean(self, name: str, default: bool) -> bool:
        return {"True": True, "False": False}[self._options.get(name, str(default))]

    def getfloat(self, name: str, default: float, above: float | None = None) -> float:
        value = float(self._options.get(name, default))
        assert above is None or value > above
        return value

    def load_template(self, name: str, default: str) -> Any:
        text = self._options.get(name, default)
        return type("Template", (), {"render": staticmethod(lambda: text)})


class Server:
    """Moonraker, as far as a component sees it.

    Attributes
    ----------
    print_stats : dict
        Of the printer; empty: Klipper is away.
    software : str
        Klipper's version.
    settings : dict
        Sections of printer.cfg.
    console : list of str
    started : list of str
        Prints that were asked for.
    """

    error = ServerError

    def __init__(self, folder: Path) -> None:
        self.data = folder / "printer_data"
        self.gcodes = self.data / "gcodes"
        self.gcodes.mkdir(parents=True, exist_ok=True)
        self.print_stats: dict[str, Any] = {"state": "standby", "filename": ""}
        self.software = "v0.13.0-300-g1"
        self.settings: dict[str, Any] = {"input_shaper": {"shaper_freq_x": 57.8}}
        self.console: list[str] = []
        self.changes: list[dict[str, Any]] = []
        self.started: list[str] = []
        self.endpoints: dict[str, Callable[..., Any]] = {}
        self.methods: dict[str, Callable[..., Any]] = {}
        self.directories: dict[str, str] = {}
        self.processors: dict[str, dict[str, Any]] = {}
        self._handlers: dict[str, Callable[..., Any]] = {}

    # What a component uses

    def get_app_args(self) -> dict[str, Any]:
        return {"data_path": str(self.data)}

    def lookup_component(self, name: str) -> Any:
        assert name in ("file_manager", "klippy_apis", "job_state")
        return self

    def register_event_handler(self, event: str, callback: Callable[..., Any]) -> None:
        self._handlers[event] = callback

    def register_notification(self, event: str) -> None:
        assert ":" in event

    def register_endpoint(self, place: str, kinds: list[str], callback: Callable[..., Any]) -> None:
        self.endpoints[f"{' '.join(kinds)} {place}"] = callback

    def register_remote_method(self, name: str, callback: Callable[..., Any]) -> None:
        self.methods[name] = callback

    def send_event(self, event: str, *given: Any) -> None:
        if event == "server:gcode_response":
            self.console.extend(given)
        elif event == "stillpath:changed":
            self.changes.extend(given)

    # The file manager and its metadata

    def get_metadata_storage(self) -> Any:
        storage = type("Storage", (), {})()
        storage.register_gcode_processor = self.processors.__setitem__
        storage.get = self._metadata
        return storage

    def register_directory(self, root: str, path: str) -> bool:
        self.directories[root] = path
        return Path(path).is_dir()

    def get_directory(self, root: str = "gcodes") -> str:
        assert root == "gcodes"
        return str(self.gcodes)

    def _metadata(self, file: str, default: Any = None) -> Any:
        path = self.gcodes / file
        return {"file_processors": self._finished(path)} if path.is_file() else default

    def _finished(self, path: Path) -> list[str]:
        """Names of the processors that recognise a file, or run on it, as Moonraker does."""
        head = path.read_bytes()[: 1 << 20].decode(errors="ignore")
        found = []
        for name, processor in self.processors.items():
            assert processor["timeout"] > 0
            assert processor["ident"]["location"] == "header"
            if re.search(processor["ident"]["regex"], head, re.MULTILINE):
                found.append(name)
            else:
                assert not processor.get("enabled", True), "it would hold the upload back"
        return found

    def upload(self, name: str, content: str, changed: bool = True) -> Path:
        """Bring a file, as a slicer does; its metadata are read, and then told of.

        One that is not `changed` lies there already: its metadata are read later, or again.
        """
        path = self.gcodes / name
        if changed:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(content)
        assert path.read_text() == content
        assert self._handlers["file_manager:metadata_processed"](name) is None
        return path

    # Klipper

    def get_last_stats(self) -> dict[str, Any]:
        return dict(self.print_stats)

    def print(self, file: str, state: str) -> None:
        """Let a print begin or end; it is told as Moonraker does."""
        before, self.print_stats = self.print_stats, {"state": state, "filename": file}
        self._handlers["job_state:state_changed"](state, before, dict(self.print_stats))

    async def query_objects(self, objects: dict[str, Any], default: Any) -> Any:
        if not self.print_stats:
            return default
        known = {"print_stats": self.print_stats, "configfile": {"settings": self.settings}}
        return {name: dict(known[name]) for name in objects}

    async def get_klippy_info(self, default: Any) -> Any:
        return {"software_version": self.software} if self.print_stats else default

    async def start_print(self, filename: str) -> str:
        if self.print_stats.get("state") == "error":
            raise ServerError("Must home axis first")
        self.started.append(filename)
        return "ok"

    async def call(self, place: str, **given: Any) -> Any:
        """Send a request to an endpoint."""
        request = type("Request", (), {})()
        request.get_str = lambda name: given[name]
        request.get_boolean = lambda name, default: given.get(name, default)
        return await self.endpoints[place](request)

    async def from_macro(self, name: str, **given: Any) -> None:
        """Call a remote method, as a macro does."""
        answer = self.methods[name](**given)
        if inspect.isawaitable(answer):
            await answer

    async def until(self, condition: Callable[[], Any], seconds: float = 120.0) -> Any:
        """Wait for a condition."""
        deadline = asyncio.get_running_loop().time() + seconds
        while not (found := condition()):
            assert asyncio.get_running_loop().time() < deadline, self.console
            await asyncio.sleep(0.02)
        return found


NO_MOONRAKER = "Moonraker not here"


def moonraker_python() -> Path:
    """Return the Python that has Moonraker; without one the test is skipped."""
    found = os.environ.get("MOONRAKER_PYTHON")
    if not found:
        pytest.skip(f"{NO_MOONRAKER}: MOONRAKER_PYTHON names a Python that has it")
    return Path(found)


class RealMoonraker:
    """Moonraker from PyPI with our component, as a process of its own.

    Parameters
    ----------
    folder : Path
        For its files; kept between starts.
    settings : dict
        Options of ``[stillpath]``.

    Attributes
    ----------
    klippy : Path
        Socket at which it looks for a Klipper.
    """

    def __init__(self, folder: Path, **settings: str) -> None:
        self._python = moonraker_python()
        self.data = folder / "printer_data"
        self.gcodes = self.data / "gcodes"
        self._short = tempfile.TemporaryDirectory()  # names of sockets are short
        self.klippy = Path(self._short.name) / "klippy"
        for name in ("config", "gcodes", "logs"):
            (self.data / name).mkdir(parents=True)
        with socket.create_server(("127.0.0.1", 0)) as free:
            port = free.getsockname()[1]
        self.url = f"http://127.0.0.1:{port}"
        own = "".join(f"{name}: {value}\n" for name, value in settings.items())
        (self.data / "config" / "moonraker.conf").write_text(
            f"[server]\nhost: 127.0.0.1\nport: {port}\n"
            f"klippy_uds_address: {self.klippy}\n"
            "[machine]\nprovider: none\nvalidate_service: False\nvalidate_config: False\n"
            "[authorization]\ntrusted_clients:\n  127.0.0.1\n"
            f"[stillpath]\n{own}"
        )

    @contextmanager
    def running(self) -> Iterator[httpx2.Client]:
        """Run it during the `with` block, and speak to it."""
        # Its folder of components is searched first; ours is another one behind it.
        start = (
            "import moonraker.components as c; "
            f"c.__path__.append({str(COMPONENT.parent)!r}); "
            "from moonraker.server import main; main()"
        )
        command = [str(self._python), "-c", start, "-d", str(self.data), "-n"]
        environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
        with (self.data / "logs" / "said").open("ab") as log:
            process = subprocess.Popen(command, stdout=log, stderr=log, env=environment)
        try:
            with httpx2.Client(base_url=self.url, timeout=180, trust_env=False) as client:
                until(lambda: process.poll() is not None or self._answers(client))
                assert process.poll() is None, (self.data / "logs" / "said").read_text()
                yield client
        finally:
            process.terminate()
            try:
                process.wait(timeout=60)
            except subprocess.TimeoutExpired:  # as it may while it reads metadata
                process.kill()
                process.wait()
                raise

    def close(self) -> None:
        """Delete what does not lie in the folder."""
        self._short.cleanup()

    @staticmethod
    def _answers(client: httpx2.Client) -> bool:
        try:
            return client.get("/server/info").status_code == 200
        except httpx2.TransportError:
            return False
