"""A Klipper that Moonraker can connect to: its Unix socket, and objects as they are told.

JSON documents that end with 0x03, as Klipper's docs/API_Server.md has them (2026-08).
"""

from __future__ import annotations

import contextlib
import json
import socketserver
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

__all__ = ["klippy"]

_ENDPOINTS = (
    "info",
    "list_endpoints",
    "objects/list",
    "objects/query",
    "objects/subscribe",
    "gcode/script",
    "gcode/subscribe_output",
    "register_remote_method",
)
_INFO = {
    "state": "ready",
    "state_message": "Printer is ready",
    "software_version": "v0.13.0-300-g1",
    "hostname": "printer",
    "klipper_path": "/home/pi/klipper",
    "python_path": "/home/pi/klippy-env/bin/python",
    "config_file": "/home/pi/printer.cfg",
    "log_file": "/home/pi/klippy.log",
}


@contextmanager
def klippy(place: Path, status: dict[str, Any]) -> Iterator[list[str]]:
    """Serve at a path during the `with` block; gives the scripts that were sent.

    Parameters
    ----------
    place : Path
        Short: of a socket.
    status : dict
        Objects of the printer, read anew for each request.
    """
    scripts: list[str] = []

    def answer(method: str, given: dict[str, Any]) -> Any:
        if method == "info":
            return _INFO
        if method == "list_endpoints":
            return {"endpoints": list(_ENDPOINTS)}
        if method == "objects/list":
            return {"objects": list(status)}
        if method in ("objects/query", "objects/subscribe"):
            found = {
                name: {k: v for k, v in status[name].items() if wanted is None or k in wanted}
                for name, wanted in given["objects"].items()
                if name in status
            }
            return {"eventtime": 1.0, "status": found}
        if method == "gcode/script":
            scripts.append(given["script"])
        return {}

    class Handler(socketserver.StreamRequestHandler):
        def handle(self) -> None:
            text = b""
            with contextlib.suppress(OSError):
                while chunk := self.request.recv(1 << 16):
                    *whole, text = (text + chunk).split(b"\x03")
                    for request in map(json.loads, whole):
                        result = answer(request["method"], request.get("params", {}))
                        told = {"id": request.get("id"), "result": result}
                        self.request.sendall(json.dumps(told).encode() + b"\x03")

    class Server(socketserver.ThreadingUnixStreamServer):
        daemon_threads = True

        def handle_error(self, *_: object) -> None:
            pass

    with Server(str(place), Handler) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.05,))
        thread.start()
        try:
            yield scripts
        finally:
            server.shutdown()
            thread.join()
