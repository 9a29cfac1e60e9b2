"""A server that does not take an upload the first time: it breaks off, or the server is busy."""

from __future__ import annotations

import http.server
import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["BODY", "TAKES_S", "breaking_server"]

BODY = b"G1 X10 Y10\n" * 1_000_000
"""More than fits into the buffers of a connection."""
TAKES_S = 0.8
"""How long the upload comes before it breaks off."""


@contextmanager
def breaking_server(
    job: dict[str, object], *, busy: bool = False
) -> Iterator[tuple[str, list[str]]]:
    """Give its address, and the keys of the uploads that came; answer the second with a job.

    The first breaks off; `busy`: it comes, and is answered 503.
    """
    keys: list[str] = []

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            keys.append(self.headers["Idempotency-Key"])
            left = int(self.headers["Content-Length"])
            for _ in range(10 if len(keys) == 1 else 0):
                left -= len(self.rfile.read(1 << 16))
                time.sleep(TAKES_S / 10)
            if len(keys) == 1 and not busy:
                return  # what has come and was not read makes it a reset
            self.rfile.read(left)
            text = json.dumps(job | {"source_bytes": len(BODY)}).encode()
            self.send_response(503 if len(keys) == 1 else 202)
            self.send_header("Content-Length", str(len(text)))
            self.end_headers()
            self.wfile.write(text)

        def do_GET(self) -> None:
            self.send_response(200)
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.05,))
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}", keys
        finally:
            server.shutdown()
            thread.join()
