"""Secrets do not reach the logs: of single events, and of a real service."""

from __future__ import annotations

import json
import os
import subprocess
import time
from pathlib import Path

import httpx2
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stillpath.service.security.masking import mask, mask_secrets
from tests.service.test_server import REAL

ROOT = Path(__file__).resolve().parents[3]
KEY = "sp_" + "Ab0_-9" * 6
SECRETS = st.from_regex(r"[A-Za-z0-9_-]{32,60}", fullmatch=True)


@pytest.mark.parametrize(
    "text",
    [
        *("key {}", "X-Api-Key: {}", "'x-api-key': '{}'", "(b'x-api-key', b'{}')"),
        *("Authorization: Bearer {}", "{{'authorization': 'Bearer {}'}}"),
        *("(b'authorization', b'Bearer {}')", "Authorization: Basic {}"),
        *("GET /v1/jobs?api_key={}&x=1", "https://h/x?a=1&token={}"),
        *("https://h/x?webhook_secret={}#y", "postgresql+psycopg://user:{}@host/db"),
        "cannot reach http://{}@host:80/",
    ],
)
@settings(max_examples=25)
@given(secret=SECRETS)
def test_a_secret_in_a_text_is_masked(text: str, secret: str):
    shown = "sp_" + secret if text == "key {}" else secret
    assert secret not in mask(text.format(shown))


@given(secret=SECRETS)
def test_a_secret_in_an_event_is_masked_wherever_it_is(secret: str):
    event = {
        "event": f"called with sp_{secret}",
        "webhook_secret": secret,
        "headers": {"X-Api-Key": secret, "Authorization": f"Bearer {secret}"},
        "list": [f"https://u:{secret}@h/", (f"sp_{secret}".encode(),)],
        "exception": f"ValueError: sp_{secret}",
        "error": ValueError(f"sp_{secret}"),
        "object": type("Odd", (), {"__repr__": lambda _: f"<sp_{secret}>"})(),
    }
    assert secret not in str(mask_secrets(None, "info", event))


@given(st.text(alphabet="abcXYZ 0123456789.:/-\n", max_size=60))
def test_plain_text_stays(text: str):
    assert mask(text) == text


def test_events_keep_what_is_no_secret():
    event = {"event": "audit", "key_id": "ab12", "n": 3, "at": 1.5, "ok": True, "none": None}
    assert mask_secrets(None, "info", dict(event)) == event


@pytest.mark.slow
def test_a_real_services_logs_hold_no_secret(tmp_path: Path):
    first, secret, password = "sp_" + "F1rst-" * 6, "wEbhOOk" * 5, "pa55" * 8
    printers = tmp_path / "printers.toml"
    printers.write_text(
        "[printer.m]\nkind = 'moonraker'\nurl = 'http://127.0.0.1:1'\n"
        f"api_key = '{password}'\nmachine = 'ender3'\n"
    )
    environment = os.environ | {
        "STILLPATH_KEYS": "true",
        "STILLPATH_FIRST_KEY": first,
        "STILLPATH_WEBHOOK_SECRET": secret,
        "STILLPATH_WEBHOOK_TARGETS": '["127.0.0.1:1"]',
        "STILLPATH_PRINTERS": str(printers),
    }
    with (tmp_path / "log").open("wb") as log:
        process = subprocess.Popen(
            [*REAL, str(tmp_path / "data")],
            cwd=ROOT,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=log,
        )
        assert process.stdout is not None
        try:
            url = process.stdout.readline().decode().split()[-1]
            made = _use(url, first, secret)
            printed = _ended(process)
        finally:
            process.kill()
            process.wait()
            process.stdout.close()
    logged = (tmp_path / "log").read_text()
    assert [json.loads(line) for line in logged.splitlines() if line.startswith("{")]
    assert '"action": "key.create"' in logged
    for hidden in (first, made, secret, password, "s3cret-token", "Basic-s3cret"):
        assert hidden not in logged
        assert hidden not in printed


def _use(url: str, first: str, secret: str) -> str:
    """Call the service in all sorts of ways with secrets; return a key it made."""
    with httpx2.Client(base_url=url, timeout=120, trust_env=False) as client:
        mine = {"Authorization": f"Bearer {first}"}
        wish = {"name": "k", "owner": "ada", "scopes": ["read", "submit"]}
        deadline = time.monotonic() + 120
        while True:
            try:
                made = client.post("/v1/keys", json=wish, headers=mine).json()["key"]
                break
            except httpx2.ConnectError:
                assert time.monotonic() < deadline
                time.sleep(0.1)
        for headers in ({"X-Api-Key": made + "x"}, {"Authorization": "Basic Basic-s3cret"}, {}):
            for path in ("/v1/jobs?token=s3cret-token", "/v1/keys?api_key=s3cret-token", "/nope"):
                assert client.get(path, headers=headers).status_code in (401, 404, 422)
        webhook = "http://127.0.0.1:1/?token=s3cret-token"
        answer = client.post(
            "/v1/jobs",
            params={"machine": "ender3", "webhook": webhook, "printer": "m", "method": "none"},
            content=b"G28\nG1 X10 Y10 F6000\nG1 X60 Y10 E2\n",
            headers={"X-Api-Key": made},
        )
        assert answer.status_code == 202, answer.text
        where = answer.headers["location"]
        while client.get(where, headers=mine).json()["state"] in ("queued", "running"):
            assert time.monotonic() < deadline
            time.sleep(0.1)
        time.sleep(3)  # for first attempts of the deliveries
        shown = client.get(where, headers=mine).text
        assert secret not in shown
        return made


def _ended(process: subprocess.Popen[bytes]) -> str:
    process.terminate()
    assert process.stdout is not None
    printed = process.stdout.read().decode()
    process.wait(60)
    return printed
