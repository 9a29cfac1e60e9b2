"""Little HTTP servers that are sent to: anybody, a Moonraker and an OctoPrint.

The latter two accept and answer what the programs' documentation says: Moonraker's
docs/external_api/file_manager.md (`POST /server/files/upload`) and printer.md (`GET /printer/info`,
`GET /printer/objects/query`), OctoPrint's docs/api/files.rst (`POST /api/files/local`).
"""

from __future__ import annotations

import hashlib
import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass
from email import message_from_bytes
from email.policy import HTTP
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

__all__ = ["Listener", "Seen", "moonraker", "octoprint", "until", "uploads"]


@dataclass(frozen=True)
class Seen:
    """A request that arrived."""

    method: str
    path: str
    headers: dict[str, str]
    body: bytes

    def parts(self) -> dict[str, tuple[str | None, bytes]]:
        """Return the parts of a form by name: file name and content."""
        head = f"Content-Type: {self.headers['content-type']}\r\n\r\n".encode()
        message = message_from_bytes(head + self.body, policy=HTTP)
        return {
            str(part.get_param("name", header="content-disposition")): (
                part.get_filename(),
                part.get_payload(decode=True),
            )
            for part in message.iter_parts()
        }


Answer = tuple[int, dict[str, str], bytes]


class Listener:
    """A server on a free port of this computer, while the `with` block lasts.

    Parameters
    ----------
    answer : callable
        From a request to status, headers and body.
    port : int
        0: any free one.
    """

    def __init__(self, answer: Callable[[Seen], Answer] | None = None, *, port: int = 0) -> None:
        self.seen: list[Seen] = []
        self._answer = answer or (lambda _: (204, {}, b""))
        listener = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_GET(self) -> None:
                length = int(self.headers.get("content-length", 0))
                headers = {name.lower(): value for name, value in self.headers.items()}
                seen = Seen(self.command, self.path, headers, self.rfile.read(length))
                listener.seen.append(seen)
                status, answered, body = listener._answer(seen)
                self.send_response(status)
                for name, value in answered.items():
                    self.send_header(name, value)
                self.send_header("Content-Length", str(len(body)))
                self.send_header("Connection", "close")
                self.end_headers()
                self.wfile.write(body)
                self.close_connection = True

            do_POST = do_GET

            def log_message(self, *_: object) -> None:
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", port), Handler)
        self._server.daemon_threads = True
        self._server.handle_error = lambda *_: None  # whoever was killed says no goodbye
        self.port = self._server.server_address[1]
        self.url = f"http://127.0.0.1:{self.port}"
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.05,))

    def __enter__(self) -> Listener:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()


@contextmanager
def moonraker(
    *,
    key: str | None = None,
    can_print: bool = True,
    status: dict[str, Any] | None = None,
    state: str = "ready",
    software: str = "v0.13.0-300-g1",
) -> Iterator[Listener]:
    """Serve as Moonraker does.

    Parameters
    ----------
    key : str, optional
        That callers must show.
    can_print : bool
        Whether a print begins when it is asked for.
    status : dict, optional
        Objects of the printer, read anew for each request; by default none is there.
    state : str
        Of Klipper; ``away``: it is not connected.
    software : str
        Klipper's version.
    """

    def answer(seen: Seen) -> Answer:
        if key is not None and seen.headers.get("x-api-key") != key:
            return _told(401, {"error": {"code": 401, "message": "Unauthorized"}})
        place, _, query = seen.path.partition("?")
        if place == "/server/info":
            return _told(200, {"result": {"klippy_connected": state != "away"}})
        if status is not None and seen.method == "GET" and place.startswith("/printer/"):
            if state == "away":
                return _told(503, {"error": {"code": 503, "message": "Klippy Host not connected"}})
            if place == "/printer/info":
                said = {"state": state, "state_message": f"Printer is {state}"}
                return _told(200, {"result": said | {"software_version": software}})
            if place == "/printer/objects/query":
                found = _queried(status, query)
                return _told(200, {"result": {"eventtime": 578243.5, "status": found}})
        if (seen.method, seen.path) != ("POST", "/server/files/upload"):
            return _told(404, {"error": {"code": 404, "message": "Not Found"}})
        parts = seen.parts()
        name, content = parts["file"]
        given = parts.get("checksum", (None, b""))[1].decode()
        if given and given != hashlib.sha256(content).hexdigest():
            return _told(422, {"error": {"code": 422, "message": "File checksum mismatch"}})
        prints = parts.get("print", (None, b"false"))[1] == b"true"
        item = {"path": name, "root": "gcodes", "size": len(content), "permissions": "rw"}
        told = {
            "item": item,
            "print_started": prints and can_print,
            "print_queued": False,
            "action": "create_file",
        }
        return _told(201, told)

    with Listener(answer) as listener:
        yield listener


def uploads(server: Listener) -> list[Seen]:
    """Return the requests that brought something."""
    return [seen for seen in server.seen if seen.method == "POST"]


@contextmanager
def octoprint(*, key: str, can_print: bool = True) -> Iterator[Listener]:
    """Serve as OctoPrint does."""

    def answer(seen: Seen) -> Answer:
        if seen.headers.get("x-api-key") != key:
            return _told(403, {"error": "You don't have the permission to access this"})
        if seen.path.endswith("/api/version"):
            return _told(200, {"api": "0.1", "server": "1.11.3", "text": "OctoPrint 1.11.3"})
        if (seen.method, seen.path) != ("POST", "/octo/api/files/local"):
            return _told(404, {"error": "Not found"})
        parts = seen.parts()
        name, _ = parts["file"]
        files = {"local": {"name": name, "path": name, "origin": "local"}}
        prints = can_print and parts["print"][1] == b"true"
        return _told(201, {"done": True, "files": files, "effectivePrint": prints})

    with Listener(answer) as listener:
        yield listener


def until(condition: Callable[[], object], seconds: float = 60.0) -> None:
    """Wait for a condition."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.02)


def _queried(status: dict[str, Any], query: str) -> dict[str, Any]:
    """Return of the objects what is asked for; what is not there is left out."""
    found = {}
    for part in query.split("&"):
        name, _, wanted = part.partition("=")
        if name in status:
            fields = wanted.split(",") if wanted else list(status[name])
            found[name] = {each: status[name][each] for each in fields if each in status[name]}
    return deepcopy(found)


def _told(status: int, document: object) -> Answer:
    return status, {"Content-Type": "application/json"}, json.dumps(document).encode()
