"""What one computer does, on several: PostgreSQL, S3, Dask's scheduler and workers.

With the real pipeline and real processes; only S3 and the network are pretended.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import httpx2
import pytest

from stillpath.models.store import load_machine as machine
from stillpath.pipeline.compensate import compensate_file
from stillpath.pipeline.options import Options
from stillpath.service.client import Client, ClientError
from tests.service.database.postgres import PostgresServer
from tests.service.jobs.site import Site, until
from tests.service.storage.s3_server import BUCKET, CREDENTIALS, free_port, s3_server

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(os.name != "posix", reason="ends processes by signals"),
]

QUICK = Options(method="shaper:zv")


def square(layers: int, side_mm: float = 30.0) -> str:
    """Return a small print; another side makes another file."""
    lines = ["M82", "G28", "G92 E0", "M204 S3000", "G1 F9000"]
    filament_mm = 0.0
    for layer in range(layers):
        lines += [f";LAYER:{layer}", f"G0 X100 Y100 Z{0.2 * (layer + 1):.1f}"]
        for x, y in ((1, 0), (1, 1), (0, 1), (0, 0)):
            filament_mm += 0.03 * side_mm
            lines.append(f"G1 X{100 + x * side_mm} Y{100 + y * side_mm} E{filament_mm:.3f}")
    return "\n".join(lines) + "\n"


@pytest.fixture(scope="module")
def site(
    postgres_server: PostgresServer, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Site]:
    """A service, complete with processes; `environment["ADDRESS"]` says where."""
    folder = tmp_path_factory.mktemp("setup")
    with ExitStack() as stack:
        site = scaled(folder / "data", postgres_server, stack)
        serving = stack.enter_context(site.command("serve", "--port", "0"))
        site.environment["ADDRESS"] = serving.said.removeprefix("stillpath: ").strip("/ ")
        yield site


def scaled(folder: Path, postgres: PostgresServer, stack: ExitStack) -> Site:
    """Start database, storage, scheduler and two workers."""
    patch = stack.enter_context(pytest.MonkeyPatch.context())
    for name, value in CREDENTIALS.items():
        patch.setenv(name, value)
    s3, url, port = stack.enter_context(s3_server()), postgres.new_database(), free_port()
    stack.callback(postgres.drop_database, url)
    site = Site(
        folder,
        keys="false",
        database_url=url,
        storage_url=f"s3://{BUCKET}/farm?endpoint={s3}",
        scheduler=f"tcp://127.0.0.1:{port}",
    )
    stack.callback(site.close)
    stack.enter_context(site.command("scheduler", "--port", str(port)))
    stack.enter_context(site.command("worker", "--workers", "2", data_dir=folder / "w"))
    return site


@pytest.fixture
def client(site: Site) -> Iterator[Client]:
    with Client(site.environment["ADDRESS"]) as client:
        yield client


@pytest.fixture
def http(site: Site) -> Iterator[httpx2.Client]:
    with httpx2.Client(base_url=site.environment["ADDRESS"], timeout=120.0) as http:
        yield http


@pytest.fixture(scope="module")
def part(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("part") / "square.gcode"
    file.write_text(square(3))
    return file


@pytest.fixture(scope="module")
def done(site: Site, part: Path) -> str:
    """Id of a job that is done."""
    with Client(site.environment["ADDRESS"]) as client:
        return client.result_of(client.submit(part, machine="ender3", options=QUICK)).id


def test_the_result_is_that_of_the_command_line(
    client: Client, done: str, part: Path, tmp_path: Path
):
    compensate_file(part, tmp_path / "here.gcode", machine("ender3"), QUICK)
    fetched = client.fetch(done, tmp_path / "there.gcode").read_bytes()
    assert fetched == (tmp_path / "here.gcode").read_bytes()
    assert client.job(done).source_sha256 == hashlib.sha256(part.read_bytes()).hexdigest()


def test_report_and_layers(http: httpx2.Client, done: str):
    assert http.get(f"/v1/jobs/{done}/report.json").json()["machine"] == "ender3"
    assert b"<svg" in http.get(f"/v1/jobs/{done}/report").content
    layers = http.get(f"/v1/jobs/{done}/layers").json()["layers"]
    assert len(layers) == 3
    last = http.get(f"/v1/jobs/{done}/layers/{layers[-1]['n']}")
    assert (last.status_code, len(last.content)) == (200, layers[-1]["bytes"])


def test_ranges_and_tags(http: httpx2.Client, done: str):
    whole = http.get(f"/v1/jobs/{done}/result")
    middle = http.get(f"/v1/jobs/{done}/result", headers={"Range": "bytes=100-299"})
    assert (middle.status_code, middle.content) == (206, whole.content[100:300])
    again = http.get(f"/v1/jobs/{done}/result", headers={"If-None-Match": whole.headers["etag"]})
    assert again.status_code == 304


def test_events_end_with_the_job(http: httpx2.Client, done: str):
    with http.stream("GET", f"/v1/jobs/{done}/events") as answer:
        text = "".join(answer.iter_text())
    assert '"state":"done"' in text.replace(" ", "")


def test_the_same_again_is_the_same_job(client: Client, done: str, part: Path):
    assert client.submit(part, machine="ender3", options=QUICK).id == done


def test_an_idempotency_key_leads_to_one_job(http: httpx2.Client):
    def post(content: str) -> httpx2.Response:
        where = "/v1/jobs?machine=ender3&method=none&fresh=true"
        return http.post(where, content=content, headers={"Idempotency-Key": "one"})

    first, second, other = post(square(1)), post(square(1)), post(square(2))
    assert (first.status_code, second.status_code, other.status_code) == (202, 200, 422)
    assert first.json()["id"] == second.json()["id"]


def test_a_batch_is_listed_page_by_page(client: Client, http: httpx2.Client, tmp_path: Path):
    made = []
    for n in range(5):
        file = tmp_path / f"{n}.gcode"
        file.write_text(square(1, 20.0 + n))
        made.append(client.submit(file, machine="ender3", options=QUICK, batch="plate").id)
    assert all(client.wait(job_id).state.value == "done" for job_id in made)
    seen: list[str] = []
    query = {"batch": "plate", "limit": "2"}
    while True:
        page = http.get("/v1/jobs", params=query).json()
        seen += [job["id"] for job in page["jobs"]]
        if page["next"] is None:
            break
        query["cursor"] = page["next"]
    assert seen == made[::-1]


def test_why_a_file_cannot_be_done(client: Client, tmp_path: Path):
    (tmp_path / "bad.gcode").write_text("G28\nG1 X1e400\n")
    with pytest.raises(ClientError, match="line 2") as caught:
        client.result_of(client.submit(tmp_path / "bad.gcode", machine="ender3"))
    assert caught.value.is_refused


def test_a_cancelled_and_a_deleted_job_leave_nothing(client: Client, site: Site, tmp_path: Path):
    (tmp_path / "long.gcode").write_text(square(4000))
    job_id = client.submit(tmp_path / "long.gcode", machine="ender3").id
    until(lambda: client.job(job_id).state.value == "running")
    assert client.cancel(job_id).state.value == "cancelled"
    until(
        lambda: (
            [s.key for s in site.storage.list(f"jobs/{job_id}/") if "/source/" not in s.key]
            in ([], [f"jobs/{job_id}/machine.json"])
        )
    )
    client.delete(job_id)
    assert not list(site.storage.list(f"jobs/{job_id}/"))
    with pytest.raises(ClientError, match="no job"):
        client.job(job_id)


def test_machines_have_revisions(http: httpx2.Client, part: Path):
    document = http.get("/v1/machines/ender3").json() | {"name": "mine", "title": "Mine"}
    made = http.put("/v1/machines/mine", json=document)
    assert made.status_code == 201, made.text
    stale = {"If-Match": '"another"'}
    assert http.put("/v1/machines/mine", json=document, headers=stale).status_code == 412
    job = http.post("/v1/jobs?machine=mine&method=none", content=part.read_bytes()).json()
    assert job["machine"] == "mine"
    http.post(f"/v1/jobs/{job['id']}/cancel")  # its own reference shaper would have to be tuned
