"""Whose turn it is."""

from __future__ import annotations

import asyncio

import pytest

from service.computing.turns import TooMany, Turns, Waited


async def served(turns: Turns, owners: str) -> str:
    """Return in which order owners who come at once are served."""
    order: list[str] = []

    async def one(owner: str) -> None:
        async with turns.turn(owner):
            order.append(owner)
            await asyncio.sleep(0.001)

    await asyncio.gather(*(one(owner) for owner in owners))
    return "".join(order)


def test_owners_take_turns() -> None:
    assert asyncio.run(served(Turns(1), "aaaabbc")) == "abcabaa"


def test_one_owner_leaves_a_place_to_others() -> None:
    async def ask() -> None:
        turns = Turns(2)
        async with turns.turn("a"):
            second = asyncio.ensure_future(served(turns, "a"))
            await asyncio.sleep(0.01)
            assert not second.done()
            assert await served(turns, "b") == "b"
            assert not second.done()
        assert await second == "a"

    asyncio.run(ask())


def test_nobody_waits_without_end() -> None:
    async def ask() -> None:
        turns = Turns(1, waiting=2, waiting_of_one=1, patience_s=0.05)
        async with turns.turn("a"):
            waiting = [asyncio.ensure_future(served(turns, owner)) for owner in "ab"]
            await asyncio.sleep(0)
            with pytest.raises(TooMany, match="1 of yours wait already"):
                await served(turns, "a")
            with pytest.raises(TooMany, match="2 wait already"):
                await served(turns, "c")
            for one in waiting:
                with pytest.raises(Waited, match=r"within 0\.05 s"):
                    await one
        assert await served(turns, "a") == "a"

    asyncio.run(ask())


def test_who_goes_away_leaves_the_line() -> None:
    async def ask() -> None:
        turns = Turns(1)
        async with turns.turn("a"):
            waiting = asyncio.ensure_future(served(turns, "b"))
            await asyncio.sleep(0)
            waiting.cancel()
            await asyncio.gather(waiting, return_exceptions=True)
        assert await served(turns, "cb") == "cb"

    asyncio.run(ask())


def test_who_goes_away_as_his_turn_comes_keeps_no_place() -> None:
    async def ask() -> None:
        turns = Turns(1)
        held = turns.turn("a")
        await held.__aenter__()
        waiting = [asyncio.ensure_future(served(turns, owner)) for owner in "bc"]
        await asyncio.sleep(0)
        waiting[0].cancel()
        await held.__aexit__(None, None, None)  # before the cancelled one has heard of it
        assert await asyncio.wait_for(waiting[1], 5) == "c"
        assert await asyncio.wait_for(served(turns, "d"), 5) == "d"

    asyncio.run(ask())


def test_who_goes_away_with_his_place_gives_it_back() -> None:
    async def ask() -> None:
        turns = Turns(1)
        held = turns.turn("a")
        await held.__aenter__()
        waiting = asyncio.ensure_future(served(turns, "b"))
        await asyncio.sleep(0)
        await held.__aexit__(None, None, None)
        waiting.cancel()  # it has the place, and has not heard of that
        assert await asyncio.wait_for(served(turns, "c"), 5) == "c"

    asyncio.run(ask())
