"""One request: an answer that never ends is no answer."""

from __future__ import annotations

import socket
import threading

import pytest

from stillpath.service.deliveries import http_requests
from stillpath.service.deliveries.targets import read_url


@pytest.fixture(params=["body", "headers"])
def dripping(request):
    """A server whose body, or headers, come one byte at a time, for ever."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        over = threading.Event()

        def serve() -> None:
            connection, _ = server.accept()
            with connection:
                connection.recv(65536)
                whole = request.param == "body"
                end = b"\r\n\r\n" if whole else b"\r\nX-Long: "
                connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 4000" + end)
                while not over.wait(0.02):
                    try:
                        connection.sendall(b"x")
                    except OSError:
                        return

        thread = threading.Thread(target=serve)
        thread.start()
        yield server.getsockname()[1]
        over.set()
        thread.join()


def test_a_reply_in_drops_is_given_up(dripping):
    target = read_url(f"http://127.0.0.1:{dripping}/")
    with pytest.raises(http_requests.Unanswered, match=r"not whole after 3 s"):
        http_requests.get(target, headers={}, longest_bytes=4000, loopback=True, timeout_s=1.0)
