"""Webhooks: signed, repeated until they arrive, and never sent elsewhere."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stillpath.service.deliveries import sender
from stillpath.service.deliveries.rows import claim, settle
from stillpath.service.deliveries.webhooks import SignatureRefused, sign, verify
from tests.service.deliveries.listeners import Listener, Seen, until
from tests.service.deliveries.places import SECRET, Place, open_place

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture
def place(tmp_path: Path) -> Iterator[Place]:
    with open_place(tmp_path / "data", webhook_targets=["127.0.0.1:1"]) as opened:
        yield opened


def listed(tmp_path: Path, *listeners: Listener, **settings):
    targets = [f"127.0.0.1:{listener.port}" for listener in listeners]
    return open_place(tmp_path / "data", webhook_targets=targets, **settings)


def check(seen: Seen) -> dict:
    verify(SECRET, seen.headers["stillpath-signature"], seen.body, now=time.time())
    return json.loads(seen.body)


def test_who_asked_is_told_that_a_job_is_over(tmp_path: Path):
    with Listener() as listener, listed(tmp_path, listener) as place:
        done = place.finish(tmp_path, webhook=f"{listener.url}/hook?room=7")
        failed = place.fail(webhook=f"{listener.url}/hook")
        with place.sending():
            assert place.settled(done).state == place.settled(failed).state == "done"
        told = {check(seen)["job"]["id"]: (seen, check(seen)) for seen in listener.seen}
    seen, document = told[done.id]
    assert (seen.method, seen.path) == ("POST", "/hook?room=7")
    assert seen.headers["host"] == f"127.0.0.1:{listener.port}"
    assert document["event"] == seen.headers["stillpath-event"] == "job.done"
    assert document["job"]["result_sha256"] == done.result_sha256
    assert document["job"]["links"]["result"] == f"/v1/jobs/{done.id}/result"
    assert told[failed.id][1]["job"]["error"]["detail"] == "line 7 is too large"
    assert "result" not in told[failed.id][1]["job"]["links"]


def test_the_same_body_is_sent_again_with_the_same_delivery(tmp_path: Path):
    answers = iter([503, 500, 429, 200])
    with (
        Listener(lambda _: (next(answers), {}, b"busy")) as listener,
        listed(tmp_path, listener) as place,
    ):
        job = place.fail(webhook=listener.url)
        with place.sending():
            delivery = place.settled(job)
    assert (delivery.state, delivery.attempts) == ("done", 4)
    assert len({seen.body for seen in listener.seen}) == 1
    assert {seen.headers["stillpath-delivery"] for seen in listener.seen} == {
        f"{job.id}-{delivery.id}"
    }
    for seen in listener.seen:
        check(seen)


def test_it_is_given_up_in_the_end_and_says_why(tmp_path: Path):
    with (
        Listener(lambda _: (503, {}, b"come back tomorrow")) as listener,
        listed(tmp_path, listener) as place,
    ):
        job = place.fail(webhook=listener.url)
        with place.sending(attempts=3):
            delivery = place.settled(job)
    assert (delivery.state, len(listener.seen)) == ("failed", 3)
    assert "503: come back tomorrow; given up after 3 attempts" in (delivery.error or "")


@pytest.mark.parametrize(
    "database", ["sqlite", pytest.param("postgresql", marks=pytest.mark.postgresql)]
)
def test_what_no_database_takes_is_kept_without(
    database: str, request: pytest.FixtureRequest, tmp_path: Path
):
    """A receiver's text of which the outcome could not be written was sent to for ever."""
    url = None if database == "sqlite" else request.getfixturevalue("postgres_url")
    with (
        Listener(lambda _: (410, {}, b"gone\0for good")) as listener,
        listed(tmp_path, listener, database_url=url) as place,
    ):
        job = place.fail(webhook=listener.url)
        with place.sending():
            delivery = place.settled(job)
        assert (delivery.state, len(listener.seen)) == ("failed", 1)
        assert delivery.error == "answered with status 410: gone?for good"
        half = place.fail(webhook=listener.url)
        found = claim(place.engine, now=time.time(), until=time.time() + 60)
        assert found is not None
        assert settle(place.engine, found[0], "failed", next_at=0.0, error="half \ud83d")
        assert place.delivery(half).error == "half ?"


def test_a_redirect_is_not_followed(tmp_path: Path):
    with Listener() as other:
        for status, where in [
            (302, "http://169.254.169.254/latest/meta-data/"),
            (307, other.url),
            (308, "/elsewhere"),
        ]:
            with (
                Listener(lambda _, s=status, w=where: (s, {"Location": w}, b"")) as listener,
                listed(tmp_path / str(status), listener, other) as place,
            ):
                job = place.fail(webhook=listener.url)
                with place.sending():
                    delivery = place.settled(job)
                assert delivery.state == "failed"
                assert "redirects are not followed" in (delivery.error or "")
                assert len(listener.seen) == 1
        assert other.seen == []


def test_what_is_no_longer_listed_is_not_sent(tmp_path: Path):
    with Listener() as listener:
        with listed(tmp_path, listener) as place:
            job = place.fail(webhook=listener.url)
        elsewhere = open_place(tmp_path / "data", webhook_targets=["elsewhere.example"])
        with elsewhere as place, place.sending():
            delivery = place.settled(job)
    assert (delivery.state, listener.seen) == ("failed", [])
    assert "WEBHOOK_TARGETS" in (delivery.error or "")


def test_a_listed_host_that_leads_to_this_computer_is_not_sent_to(tmp_path: Path):
    # It does not look like this computer, and connects to it.
    with Listener() as listener:
        target = f"http://0.0.0.0:{listener.port}"
        with open_place(tmp_path / "data", webhook_targets=[target]) as place:
            job = place.fail(webhook=target)
            with place.sending():
                delivery = place.settled(job)
    assert (delivery.state, listener.seen) == ("failed", [])
    assert "nothing is sent to" in (delivery.error or "")


def test_the_environments_proxy_is_not_asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    with Listener() as proxy, Listener() as listener, listed(tmp_path, listener) as place:
        for name in ("http_proxy", "HTTP_PROXY", "all_proxy"):
            monkeypatch.setenv(name, proxy.url)
        job = place.fail(webhook=listener.url)
        with place.sending():
            assert place.settled(job).state == "done"
        assert (len(listener.seen), proxy.seen) == (1, [])


def test_two_senders_send_each_once(tmp_path: Path):
    with Listener() as listener, listed(tmp_path, listener) as place:
        jobs = [place.fail(webhook=listener.url) for _ in range(20)]
        with place.sending(), place.sending():
            for job in jobs:
                assert place.settled(job).state == "done"
        assert len(listener.seen) == 20
        assert {check(seen)["job"]["id"] for seen in listener.seen} == {job.id for job in jobs}


@pytest.mark.slow
def test_a_sender_killed_in_between_is_followed_by_another(tmp_path: Path):
    """The receiver got it and the sender never heard so: it is sent once more, not lost."""
    holding = [True]

    def answer(_: Seen):
        while holding[0]:
            time.sleep(0.02)
        return 200, {}, b""

    with Listener(answer) as listener, listed(tmp_path, listener) as place:
        job = place.fail(webhook=listener.url)
        settings = place.settings.model_dump_json(exclude={"webhook_secret"}, exclude_defaults=True)
        given = json.dumps(json.loads(settings) | {"webhook_secret": SECRET})
        process = subprocess.Popen(
            [sys.executable, "-m", "tests.service.deliveries.sender_process", given, "1"], cwd=ROOT
        )
        try:
            until(lambda: listener.seen)
            assert place.delivery(job).state == "sending"
        finally:
            process.kill()
            process.wait()
        holding[0] = False
        with place.sending():
            delivery = place.settled(job)
    assert (delivery.state, delivery.attempts) == ("done", 2)
    assert [check(seen)["job"]["id"] for seen in listener.seen] == [job.id] * 2


class SetClock:
    """Stands for `time` in a module: a clock that can be set."""

    def __init__(self, back_s: float = 0.0) -> None:
        self.back_s = back_s
        self.monotonic = time.monotonic

    def time(self) -> float:
        return time.time() - self.back_s


def test_nothing_waits_because_the_clock_was_set_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """In between, before the service started, and behind that of the worker who noted it."""
    clock = SetClock()
    monkeypatch.setattr(sender, "time", clock)
    answers = iter([503])
    with (
        Listener(lambda _: (next(answers, 200), {}, b"")) as listener,
        listed(tmp_path, listener) as place,
    ):
        in_between = place.fail(webhook=listener.url)
        with place.sending(first_wait_s=1.0):
            until(lambda: place.delivery(in_between).error)
            clock.back_s = 3600.0
            assert place.settled(in_between).state == "done"
            of_worker = place.fail(webhook=listener.url)
            assert place.settled(of_worker).state == "done"
        answers = iter([503])
        before = place.fail(webhook=listener.url)
        with place.sending(first_wait_s=1.0):
            until(lambda: place.delivery(before).error)
        left = place.fail(webhook=listener.url)
        now = clock.time()
        claim(place.engine, now=now, until=now + 60.0)  # a sender that was killed
        clock.back_s = 7200.0
        with place.sending(first_wait_s=1.0, claim_s=1.0):
            assert place.settled(before).state == place.settled(left).state == "done"


def test_a_claim_holds_although_the_clock_is_set_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    clock = SetClock()
    monkeypatch.setattr(sender, "time", clock)

    def answer(_: Seen):
        clock.back_s = 3600.0
        time.sleep(2.5)
        return 200, {}, b""

    with Listener(answer) as listener, listed(tmp_path, listener) as place:
        job = place.fail(webhook=listener.url)
        # Long enough that a busy computer renews it in time, and shorter than the answer takes.
        with place.sending(claim_s=1.5), place.sending(claim_s=1.5):
            assert place.settled(job).state == "done"
        assert len(listener.seen) == 1


def test_the_row_of_a_deleted_job_is_not_taken_for_the_next_one(place: Place):
    first = place.fail(webhook="http://127.0.0.1:1/")
    claimed, _ = claim(place.engine, now=time.time(), until=time.time() + 60)
    place.store.forget(first.id)
    second = place.fail(webhook="http://127.0.0.1:1/")
    assert place.delivery(second).id == claimed.id  # SQLite gives it again
    claim(place.engine, now=time.time(), until=time.time() + 60)
    assert not settle(place.engine, claimed, "done", next_at=0.0)
    assert place.delivery(second).state == "sending"


@given(st.binary(max_size=200), st.integers(0, 10**10))
def test_a_signature_is_of_secret_time_and_body(body: bytes, at: int):
    header = sign(SECRET, at, body)
    verify(SECRET, header, body, now=at)
    for secret, sent, text in [
        ("another", header, body),
        (SECRET, header, body + b" "),
        (SECRET, header.replace(f"t={at}", f"t={at + 1}"), body),
        (SECRET, header[:-1], body),
        (SECRET, "v1=" + header.partition("v1=")[2], body),
        (SECRET, "", body),
    ]:
        with pytest.raises(SignatureRefused):
            verify(secret, sent, text, now=at)


def test_a_replayed_webhook_is_refused():
    header = sign(SECRET, 1_000_000, b"{}")
    verify(SECRET, header, b"{}", now=1_000_299)
    with pytest.raises(SignatureRefused, match="replay"):
        verify(SECRET, header, b"{}", now=1_000_301)
    fresh = header.replace("t=1000000", "t=1000300")
    with pytest.raises(SignatureRefused, match="does not match"):
        verify(SECRET, fresh, b"{}", now=1_000_301)
