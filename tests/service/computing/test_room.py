"""Computations in real processes: what ends them, and what is said then."""

from __future__ import annotations

import asyncio
import contextlib
import sys
import time
from pathlib import Path
from typing import Any

import psutil
import pytest

from service.computing.room import Broke, LimitReached, Refused, Room, RoomLimits

MIB = 1 << 20


async def asked(room: Room, task: str, owner: str = "ada", **given: Any) -> Any:
    name = f"tests.service.computing.pretended:{task}"
    return await room.compute(owner, name, given, remedy="Send less.")


def room(processes: int = 1, seconds: float = 60.0, mib: int = 64) -> Room:
    return Room(processes, RoomLimits(seconds, mib * MIB))


async def marked(mark: Path) -> psutil.Process:
    """Wait for the process that says where it is."""
    while not (mark.exists() and mark.read_text()):
        await asyncio.sleep(0.02)
    return psutil.Process(int(mark.read_text()))


def test_an_answer_and_what_is_refused() -> None:
    own = room()
    assert asyncio.run(asked(own, "echo", x=[1, "µ"])) == {"x": [1, "µ"]}
    with pytest.raises(Refused, match="7 bins, at least 16"):
        asyncio.run(asked(own, "refuse"))
    with pytest.raises(Broke) as caught:
        asyncio.run(asked(own, "break_down"))
    assert "secret" not in str(caught.value)


@pytest.mark.skipif(sys.platform != "linux", reason="the system limits no memory")
def test_memory_is_the_system_s_to_refuse() -> None:
    own = room(mib=64)
    assert asyncio.run(asked(own, "grow", mib=24)) == 24 * MIB
    said = r"more memory than 64 MiB \(STILLPATH_MAX_COMPUTING_BYTES\), the limit.*Send less"
    with pytest.raises(LimitReached, match=said):
        asyncio.run(asked(own, "grow", mib=400))
    with pytest.raises(LimitReached, match="its process ended"):
        asyncio.run(asked(own, "die"))


def test_time_is_up(tmp_path: Path) -> None:
    mark = tmp_path / "mark"
    said = r"stopped after 1 s \(STILLPATH_MAX_COMPUTING_S\), the limit\. Send less"
    with pytest.raises(LimitReached, match=said):
        asyncio.run(asked(room(seconds=1.0), "sleep", mark=str(mark), seconds=60))
    assert not psutil.pid_exists(int(mark.read_text()))


def test_an_asker_who_goes_away_ends_it_and_the_next_one_begins(tmp_path: Path) -> None:
    async def ask() -> float:
        own, mark = room(), tmp_path / "mark"
        first = asyncio.ensure_future(asked(own, "sleep", mark=str(mark), seconds=60))
        second = asyncio.ensure_future(asked(own, "echo", "ben"))
        process = await marked(mark)
        first.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await first
        assert not process.is_running()
        began = time.monotonic()
        await second
        return time.monotonic() - began

    assert asyncio.run(ask()) < 30


def test_a_long_one_holds_up_its_owner_only(tmp_path: Path) -> None:
    async def ask() -> None:
        own, mark = room(processes=2), tmp_path / "mark"
        long = asyncio.ensure_future(asked(own, "sleep", mark=str(mark), seconds=60))
        waits = asyncio.ensure_future(asked(own, "echo"))
        await marked(mark)
        await asked(own, "echo", "ben")
        assert not waits.done()
        own.close()
        for one in (long, waits):
            with pytest.raises(Broke):
                await one

    asyncio.run(ask())
