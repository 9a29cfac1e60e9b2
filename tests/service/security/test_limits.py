"""Requests per minute, and uploads at once."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stillpath.service.api.limits import CallerLimits, name_of
from stillpath.service.api.problems import Problem
from stillpath.service.security.callers import Caller, Scope


def caller(key_id: str | None = None, remote: str | None = "203.0.113.7") -> Caller:
    return Caller("ada", frozenset(Scope), key_id=key_id, remote=remote)


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def is_granted(limits: CallerLimits, who: str) -> bool:
    try:
        limits.take(who)
    except Problem as problem:
        return problem.document["status"] != 429 or int(problem.headers["Retry-After"]) < 1
    return True


@given(
    per_minute=st.integers(1, 600), pauses_s=st.lists(st.floats(0, 30), min_size=1, max_size=300)
)
def test_never_more_than_a_bucket_and_its_filling(per_minute: int, pauses_s: list[float]):
    clock = Clock()
    limits = CallerLimits(per_minute, clock=clock)
    granted = 0
    for pause_s in pauses_s:
        clock.now += pause_s
        granted += is_granted(limits, "a")
        assert granted <= per_minute * (1 + clock.now / 60) + 1e-6


def test_a_patient_caller_is_always_served():
    clock = Clock()
    limits = CallerLimits(60, clock=clock)
    while is_granted(limits, "a"):
        pass
    for _ in range(100):
        clock.now += 1.001
        assert is_granted(limits, "a")


def test_waiting_as_long_as_told_is_enough():
    clock = Clock()
    limits = CallerLimits(7, clock=clock)
    while True:
        try:
            limits.take("a")
        except Problem as problem:
            clock.now += int(problem.headers["Retry-After"])
            break
    assert is_granted(limits, "a")


def test_callers_do_not_disturb_each_other():
    limits = CallerLimits(3, clock=Clock())
    for who in ("a", "b"):
        assert [is_granted(limits, who) for _ in range(4)] == [True, True, True, False]


def test_who_is_counted_together():
    assert name_of(caller("k1")) == name_of(caller("k1", "198.51.100.1"))
    assert name_of(caller("k1")) != name_of(caller("k2"))
    assert name_of(caller()) != name_of(caller(remote="203.0.113.8"))
    # One computer has the whole network.
    assert name_of(caller(remote="2001:db8::1")) == name_of(caller(remote="2001:db8::ffff"))
    assert name_of(caller(remote="2001:db8::1")) != name_of(caller(remote="2001:db8:1::1"))
    assert name_of(caller(remote="::ffff:203.0.113.7")) == name_of(caller())
    assert name_of(caller(remote=None)) == "unknown"


def test_memory_does_not_grow_with_the_number_of_addresses():
    limits = CallerLimits(3, clock=Clock())
    for n in range(30_000):
        limits.take(f"address {n}")
    assert len(limits._buckets) <= 10_000


def test_places_for_uploads_are_given_back():
    limits = CallerLimits(100, uploads=2)
    for _ in range(3):
        with limits.uploading(caller("k")), limits.uploading(caller("k")):
            with pytest.raises(Problem) as caught, limits.uploading(caller("k")):
                pass
            assert caught.value.document["status"] == 429
            with limits.uploading(caller("other")):
                pass
        with pytest.raises(ZeroDivisionError), limits.uploading(caller("k")):
            raise ZeroDivisionError
