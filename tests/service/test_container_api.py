"""Binary and packed files over HTTP, through the real pipeline."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from stillpath.gcode.containers.opening import open_text
from stillpath.service.api import create_app
from stillpath.service.settings import Settings
from tests.gcode.container_files import binary, package
from tests.gcode.cutting import HEAD
from tests.gcode.prints import polygon
from tests.service.test_api import over, until

TEXT = (HEAD + "G1 X120 Y100 F6000\n" + "\n".join(polygon(6, 15)) + "\n").encode()


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    app = create_app(Settings(data_dir=tmp_path_factory.mktemp("data")))
    with TestClient(app, base_url="http://localhost") as opened:
        yield opened


def job_of(client: TestClient, content: bytes, **query: object) -> dict:
    chosen = {"machine": "ender3", **query}
    answer = client.post("/v1/jobs", params=chosen, content=content)
    assert answer.status_code == 202, answer.text
    return until(client, answer.headers["location"], over)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("content", "name", "made", "media"),
    [
        (binary(TEXT), "a.bgcode", "a.stillpath.bgcode", "application/gcode+binary"),
        (package({1: TEXT}), "a.gcode.3mf", "a.stillpath.gcode.3mf", "model/3mf"),
        (binary(TEXT), "", "upload.stillpath.gcode", "application/gcode+binary"),
    ],
)
def test_the_result_is_of_the_kind_that_came(
    client: TestClient, tmp_path: Path, content: bytes, name: str, made: str, media: str
):
    job = job_of(client, content, name=name)
    assert job["state"] == "done", job
    result = client.get(job["links"]["result"])
    assert result.headers["content-type"].split(";")[0] == media
    assert f'filename="{made}"' in result.headers["content-disposition"]
    path = tmp_path / made
    path.write_bytes(result.content)
    with open_text(path) as container:
        assert container.kind.value == media
        assert b"; Processed by stillpath " in container.text.read()


@pytest.mark.slow
def test_plates_and_damage(client: TestClient):
    several = package({1: TEXT, 2: TEXT})
    job = job_of(client, several, name="a.gcode.3mf")
    assert "say which one" in job["error"]["detail"]
    assert job_of(client, several, name="a.gcode.3mf", plate=2)["state"] == "done"
    assert client.post("/v1/jobs?machine=ender3&plate=0", content=several).status_code == 422
    damaged = bytearray(binary(TEXT))
    damaged[-1] ^= 1
    error = job_of(client, bytes(damaged), name="a.bgcode")["error"]
    assert error["status"] == 422
    assert "block 6 (at byte" in error["detail"]
