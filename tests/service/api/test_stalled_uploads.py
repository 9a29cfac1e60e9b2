"""Senders who fall silent: they lose their places, and nobody else does."""

from __future__ import annotations

import asyncio
import socket
import time
from pathlib import Path
from typing import Any

import pytest
from starlette.exceptions import HTTPException
from starlette.types import Message

from stillpath.service.api.body_timeout import LEAST_BYTES, BodyTimeout
from stillpath.service.api.limits import CallerLimits
from stillpath.service.api.problems import Problem
from tests.service.security.test_limits import caller
from tests.service.test_server import PRETEND, finished, server, until


class Sender:
    """Sends chunks after pauses, then falls silent."""

    def __init__(self, *chunks: tuple[float, int], more: bool = True) -> None:
        self._chunks = list(chunks)
        self._more = more

    async def receive(self) -> Message:
        if not self._chunks:
            await asyncio.sleep(60)
        pause_s, size = self._chunks.pop(0)
        await asyncio.sleep(pause_s)
        more = self._more or bool(self._chunks)
        return {"type": "http.request", "body": b"x" * size, "more_body": more}


async def whole(body: BodyTimeout) -> int:
    size = 0
    while True:
        message = await body.receive()
        size += len(message["body"])
        if not message["more_body"]:
            return size


def test_silence_ends_a_body() -> None:
    async def ask() -> None:
        body = BodyTimeout(Sender((0, LEAST_BYTES)).receive, quiet_s=0.1)
        with pytest.raises(
            HTTPException, match=r"Fewer than 1024 bytes of the body came within 0\.1 s"
        ) as caught:
            await whole(body)
        assert caught.value.status_code == 408

    asyncio.run(ask())


def test_a_byte_now_and_then_is_silence_too() -> None:
    async def ask() -> None:
        with pytest.raises(HTTPException):
            await whole(BodyTimeout(Sender(*[(0.05, 1)] * 40).receive, quiet_s=0.2))

    asyncio.run(ask())


def test_slow_but_steady_is_fine() -> None:
    async def ask() -> None:
        slow = Sender(*[(0.05, LEAST_BYTES)] * 8, more=False)
        assert await whole(BodyTimeout(slow.receive, quiet_s=0.3)) == 8 * LEAST_BYTES

    asyncio.run(ask())


def test_what_the_service_takes_itself_is_not_the_sender_s() -> None:
    async def ask() -> None:
        body = BodyTimeout(Sender(*[(0, 10)] * 8, more=False).receive, quiet_s=0.1)
        for _ in range(8):
            await body.receive()
            await asyncio.sleep(0.05)  # the disk is slow

    asyncio.run(ask())


def test_who_has_been_silent_for_long_yields_his_place(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stillpath.service.api.body_timeout._YIELDS_AFTER_S", 0.1)

    async def ask() -> None:
        limits, ended = CallerLimits(100, uploads=2), []

        async def upload(*chunks: tuple[float, int], more: bool = True) -> None:
            body = BodyTimeout(Sender(*chunks, more=more).receive, quiet_s=5)
            try:
                with limits.uploading(caller("k"), body):
                    await whole(body)
            except HTTPException as error:
                ended.append(error.detail)

        silent = asyncio.ensure_future(upload((0, 10)))
        lively = asyncio.ensure_future(upload(*[(0.02, LEAST_BYTES)] * 20, more=False))
        await asyncio.sleep(0.02)
        with pytest.raises(Problem):  # nobody has been silent for long
            await upload((0, 1), more=False)
        await asyncio.sleep(0.15)
        await upload((0, 1), more=False)
        await silent
        assert len(ended) == 1
        assert "its slot was given to another one" in ended[0]
        await lively

    asyncio.run(ask())


def stalled(port: int, path: str, kind: str = "text/plain") -> socket.socket:
    opened = socket.create_connection(("127.0.0.1", port), timeout=90)
    head = f"POST {path} HTTP/1.1\r\nHost: localhost\r\nContent-Type: {kind}\r\n"
    opened.sendall(f"{head}Content-Length: 1000000\r\n\r\nG1 X10".encode())
    return opened


def answer(opened: socket.socket) -> str:
    with opened, opened.makefile("rb") as file:
        return file.read().decode()


@pytest.mark.slow
def test_many_stalled_uploads_do_not_lock_a_good_one_out(tmp_path: Path) -> None:
    with server(PRETEND, tmp_path) as (client, _):
        port, began = client.base_url.port, time.monotonic()
        senders = [stalled(port, "/v1/jobs?machine=ender3") for _ in range(64)]
        senders.append(stalled(port, "/v1/machines/galvo-40khz/controllers", "application/json"))

        def good() -> Any:
            found = client.post("/v1/jobs?machine=ender3", content=b"G1 X1")
            return found if found.status_code == 202 else None

        assert finished(client, until(good, 20).headers["location"])["state"] == "done"
        answers = [answer(opened) for opened in senders]
        assert time.monotonic() - began < 120  # each has 20 s at most, on a busy computer more
        statuses = [text.split(" ")[1] for text in answers]
        assert set(statuses) == {"408", "429"}
        assert statuses[-1] == "408"
        assert statuses.count("408") in (32, 33)  # of 32 places, and the document
        assert not list((tmp_path / "incoming").iterdir())
        for _ in range(32):
            assert client.post("/v1/jobs?machine=ender3", content=b"G1 X1").status_code == 200
