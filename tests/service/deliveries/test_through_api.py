"""From an upload to the printer and the webhook, and what the API says of it."""

from __future__ import annotations

import json
import time
from pathlib import Path

from starlette.testclient import TestClient

from stillpath.models.store import load_machine
from stillpath.service.api import create_app
from stillpath.service.deliveries.webhooks import verify
from stillpath.service.settings import Settings
from tests.service.deliveries.listeners import Listener, moonraker, until, uploads
from tests.service.deliveries.places import SECRET
from tests.service.deliveries.recorded_printer import status_of
from tests.service.runners import pretend


def test_a_slicers_upload_reaches_the_printer(tmp_path: Path):
    printers = tmp_path / "printers.toml"
    status = status_of(load_machine("ender3"))
    with Listener() as listener, moonraker(key="k1", status=status) as server:
        printers.write_text(
            f"[printer.voron]\nkind = 'moonraker'\nurl = '{server.url}'\napi_key = 'k1'\n"
            "machine = 'ender3'\nmethod = 'none'\nstart = true\n"
        )
        settings = Settings(
            data_dir=tmp_path / "data",
            printers=printers,
            webhook_secret=SECRET,
            webhook_targets=[f"127.0.0.1:{listener.port}"],
        )
        app = create_app(settings, runner=pretend)
        with TestClient(app, base_url="http://localhost") as client:
            shown = client.get("/v1/printers")
            assert [printer["name"] for printer in shown.json()] == ["voron"]
            assert "k1" not in shown.text
            assert server.url not in shown.text
            assert client.get("/printers/voron/api/version").status_code == 200
            answer = client.post(
                "/printers/voron/api/files/local",
                files={"file": ("gear.gcode", b"G1 X1\n")},
                data={"print": "true"},
            )
            assert answer.status_code == 201, answer.text
            where = answer.json()["job"]
            told = client.post(
                "/v1/jobs",
                params={"machine": "ender3", "webhook": f"{listener.url}/hook?token=1"},
                content=b"G1 X2\n",
            )
            assert told.status_code == 202, told.text
            other = told.headers["location"]
            for place in (where, other):
                until(lambda p=place: _states(client, p) == ["done"], seconds=300)
            assert "token=1" not in str(client.get(other).json()["deliveries"])
            for query in ("webhook=http://169.254.169.254/", "printer=nobody"):
                refused = client.post(f"/v1/jobs?machine=ender3&{query}", content=b"G1 X3\n")
                assert refused.status_code == 422
    [seen] = uploads(server)
    assert seen.parts()["file"] == ("gear.stillpath.gcode", b"; compensated\nG1 X1\n")
    assert seen.parts()["print"][1] == b"true"
    [hook] = listener.seen
    verify(SECRET, hook.headers["stillpath-signature"], hook.body, now=time.time())
    assert f"/v1/jobs/{json.loads(hook.body)['job']['id']}" == other


def _states(client: TestClient, place: str) -> list[str]:
    return [delivery["state"] for delivery in client.get(place).json()["deliveries"]]
