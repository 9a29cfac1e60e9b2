"""The real server, with a pretended pipeline and something odd before it: `odd_server.py DATA_DIR`.

What is odd is told by the beginning of the path: /key wants the key "secret", with /short results
break off, with /login a page comes instead of them, with /lost a part of the upload gets lost,
/moved is somewhere else, /full takes no uploads, /busy takes each only the second time, /damaged
has damaged results, /unreported no reports, and /cut breaks each result off after a third of it.
All other paths are those of the real server.
"""

import json
import sys
from pathlib import Path

ODDITIES = (
    *("key", "short", "login", "lost", "moved", "full", "busy", "damaged", "unreported", "cut"),
)
KEYS = set()
"""Of uploads that came to /busy."""


def odd(app):
    async def application(scope, receive, send):
        oddity, _, path = scope.get("path", "")[1:].partition("/")
        if oddity not in ODDITIES:
            await app(scope, receive, send)
            return
        given = dict(scope["headers"]).get(b"authorization")
        headers = [pair for pair in scope["headers"] if pair[0] != b"authorization"]  # its own key
        scope = {**scope, "path": f"/{path}", "headers": headers}
        if oddity == "key" and given != b"Bearer secret":
            await answer(send, 401, {"detail": "This key is unknown here."})
        elif oddity == "moved":
            await answer(send, 308, {}, (b"location", b"http://elsewhere.invalid/"))
        elif oddity == "full" and path == "v1/jobs":
            await answer(send, 429, {"detail": "'ada' has 1000 unfinished jobs."})
        elif oddity == "busy" and path == "v1/jobs" and is_new(dict(headers)[b"idempotency-key"]):
            await answer(send, 408, {"detail": "Too slow."}, (b"retry-after", b"1"))
        elif oddity == "damaged" and path.endswith("/result"):
            document = {"title": "The file is damaged", "detail": "The result is damaged."}
            await answer(send, 404, document)
        elif oddity == "unreported" and "/report" in path:
            await answer(send, 404, {"title": "The file is gone", "detail": "The report is gone."})
        elif oddity == "login" and path.endswith("/result"):
            await answer(send, 200, {}, (b"content-type", b"text/html"))
        else:
            await app(scope, receive, Changed(send, scope["path"], oddity))

    return application


def is_new(key):
    known = key in KEYS
    KEYS.add(key)
    return not known


class Changed:
    def __init__(self, send, path, oddity):
        self._send, self._path, self._oddity = send, path, oddity
        self._start = None
        self._third = 0

    async def __call__(self, message):
        if self._oddity == "lost" and self._path == "/v1/jobs":
            if message["type"] == "http.response.start":
                self._start = message
                return
            body = json.loads(message["body"])
            body["source_bytes"] -= 1
            data = json.dumps(body).encode()
            self._start["headers"] = [(b"content-length", str(len(data)).encode())]
            await self._send(self._start)
            message = {**message, "body": data}
        if self._oddity == "short" and self._path.endswith("/result"):
            if message["type"] == "http.response.body" and message.get("body"):
                message = {**message, "body": message["body"][:-3], "more_body": False}
            elif message["type"] == "http.response.body":
                return
        if self._oddity == "cut" and self._path.endswith("/result"):
            if message["type"] == "http.response.start":
                headers = dict(message["headers"])
                whole = headers.get(b"content-range", headers[b"content-length"]).split(b"/")[-1]
                self._third = -(-int(whole) // 3)
            elif message.get("body"):
                message = {**message, "body": message["body"][: self._third], "more_body": False}
            else:
                return
        await self._send(message)


async def answer(send, status, document, *headers):
    data = json.dumps(document).encode()
    length = (b"content-length", str(len(data)).encode())
    await send({"type": "http.response.start", "status": status, "headers": [length, *headers]})
    await send({"type": "http.response.body", "body": data})


if __name__ == "__main__":
    from unittest import mock

    from stillpath.service import server
    from stillpath.service.api import create_app
    from stillpath.service.settings import Settings
    from tests.service.runners import load_little, pretend

    load_little()

    def application(settings: Settings, **more):
        return odd(create_app(settings, **more))

    with mock.patch.object(server, "create_app", application):
        server.serve_forever(Settings(data_dir=Path(sys.argv[1])), "127.0.0.1", 0, runner=pretend)
