"""Files of jobs over HTTP: ranges, entity tags, HEAD, layers."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from starlette.testclient import TestClient

from tests.service.api.serving import post
from tests.service.test_api import assert_problem, over, until

CONTENT = b"; compensated\n" + b"".join(b"G1 X%d\n" % n for n in range(500))


@pytest.fixture(scope="module")
def job(client: TestClient, data_dir: Path) -> str:
    """Path of a job that is done, with two layers."""
    where = post(client, CONTENT.removeprefix(b"; compensated\n")).headers["location"]
    done = until(client, where, over)
    assert done["state"] == "done", done
    (report,) = (data_dir / "jobs" / done["id"]).glob("*/report")
    layers = [{"n": 0, "offset": 0, "bytes": 8}, {"n": 1, "offset": 8, "bytes": 4}]
    index = {"version": 1, "channels": ["before"], "scale_um": 1.0, "bounds_mm": [0, 0, 1, 1]}
    (report / "layers.json").write_text(json.dumps(index | {"layers": layers}))
    (report / "layers.bin").write_bytes(b"01234567abcd")
    return where


def test_a_result_is_named_by_its_digest(client: TestClient, job: str):
    whole = client.get(f"{job}/result")
    assert whole.content == CONTENT
    tag = whole.headers["etag"]
    assert len(tag) == 66
    again = client.get(f"{job}/result", headers={"If-None-Match": f'"x", {tag}'})
    assert (again.status_code, again.content, again.headers["etag"]) == (304, b"", tag)
    head = client.head(f"{job}/result")
    assert (head.status_code, head.content) == (200, b"")
    assert head.headers["content-length"] == str(len(CONTENT))
    assert head.headers["accept-ranges"] == "bytes"


@settings(max_examples=60)
@given(first=st.integers(0, 9000), last=st.none() | st.integers(0, 9000))
def test_ranges_are_slices(client: TestClient, job: str, first: int, last: int | None):
    given_range = f"bytes={first}-{'' if last is None else last}"
    answer = client.get(f"{job}/result", headers={"Range": given_range})
    if last is not None and last < first:
        assert (answer.status_code, answer.content) == (200, CONTENT)
    elif first >= len(CONTENT):
        assert_problem(answer, 416, str(len(CONTENT)))
        assert answer.headers["content-range"] == f"bytes */{len(CONTENT)}"
    else:
        stop = len(CONTENT) if last is None else min(last + 1, len(CONTENT))
        assert (answer.status_code, answer.content) == (206, CONTENT[first:stop])
        assert answer.headers["content-range"] == f"bytes {first}-{stop - 1}/{len(CONTENT)}"


@pytest.mark.parametrize("odd", ["bytes=", "bytes=-", "lines=1-2", "bytes=1-2,5-6", "bytes=a-b"])
def test_odd_ranges_give_the_whole(client: TestClient, job: str, odd: str):
    answer = client.get(f"{job}/result", headers={"Range": odd})
    assert (answer.status_code, answer.content) == (200, CONTENT)


def test_the_last_bytes_and_if_range(client: TestClient, job: str):
    answer = client.get(f"{job}/result", headers={"Range": "bytes=-7"})
    assert (answer.status_code, answer.content) == (206, CONTENT[-7:])
    assert_problem(client.get(f"{job}/result", headers={"Range": "bytes=-0"}), 416)
    tag = answer.headers["etag"]
    for condition, status in ((tag, 206), ('"other"', 200)):
        headers = {"Range": "bytes=0-1", "If-Range": condition}
        assert client.get(f"{job}/result", headers=headers).status_code == status


def test_layers_are_served_in_ranges_with_tags(client: TestClient, job: str):
    index = client.get(f"{job}/layers")
    assert len(index.json()["layers"]) == 2
    tag = index.headers["etag"]
    assert client.get(f"{job}/layers", headers={"If-None-Match": tag}).status_code == 304
    tiles = [client.get(f"{job}/layers/{n}") for n in range(2)]
    assert [tile.content for tile in tiles] == [b"01234567", b"abcd"]
    assert tiles[0].headers["etag"] != tiles[1].headers["etag"]
    part = client.get(f"{job}/layers/1", headers={"Range": "bytes=1-2"})
    assert (part.content, part.headers["content-range"]) == (b"bc", "bytes 1-2/4")
    assert client.head(f"{job}/layers/1").headers["content-length"] == "4"
    assert_problem(client.get(f"{job}/layers/2"), 404, "2 layers")
    assert_problem(client.get(f"{job}/layers/-1"), 422)


def test_what_is_gone_is_told(client: TestClient, data_dir: Path):
    where = post(client, b"G1 X177").headers["location"]
    done = until(client, where, over)
    (result,) = (data_dir / "jobs" / done["id"]).glob("*/result/*")
    result.unlink()
    assert_problem(client.get(f"{where}/result"), 404, "no longer")
    assert_problem(client.get(f"{where}/layers"), 404, "layers.json")
    assert_problem(client.get(f"{where}/layers/0"), 404, "0 layers")


def test_what_is_damaged_is_told(client: TestClient, data_dir: Path):
    where = post(client, b"G1 X178").headers["location"]
    done = until(client, where, over)
    folder = next((data_dir / "jobs" / done["id"]).glob("1"))
    (result,) = (folder / "result").iterdir()
    result.write_bytes(result.read_bytes()[:5])
    assert_problem(client.get(f"{where}/result"), 404, "5 bytes instead of 21")
    result.write_bytes(b"x" * 21)
    assert_problem(client.get(f"{where}/result"), 404, "SHA-256", "delete the job")
    assert_problem(client.get(f"{where}/result", headers={"Range": "bytes=3-4"}), 404, "SHA-256")
    (folder / "report" / "layers.json").write_text('{"layers": [{"off')
    assert_problem(client.get(f"{where}/layers/0"), 404, "no list of layers")


def test_what_was_sound_is_looked_at_again_when_it_was_written_to(
    client: TestClient, data_dir: Path
):
    where = post(client, b"G1 X179").headers["location"]
    done = until(client, where, over)
    (result,) = (data_dir / "jobs" / done["id"]).glob("*/result/*")
    content = client.get(f"{where}/result").content
    result.write_bytes(content.swapcase())
    assert_problem(client.get(f"{where}/result"), 404, "SHA-256")
    result.write_bytes(content)
    assert client.get(f"{where}/result").content == content


def test_the_schema_of_the_report(client: TestClient):
    schema = client.get("/v1/schemas/report.json").json()
    assert "properties" in schema


def test_trajectories_ask_for_a_part(client: TestClient, job: str):
    for query in ("start_s=0&stop_s=601", "start_s=5&stop_s=5", "start_s=nan", "format=xls"):
        assert_problem(client.get(f"{job}/trajectories?{query}"), 422)
