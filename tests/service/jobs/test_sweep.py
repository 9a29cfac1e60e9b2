"""What the sweep deletes, and above all what it does not."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from service.jobs.state import Cancelled
from service.jobs.sweep import forget_expired, sweep_files, sweep_incoming
from tests.service.database.examples import finished
from tests.service.jobs.site import Site


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    site = Site(tmp_path / "data")
    yield site
    site.close()


def put(site: Site, key: str) -> None:
    file = site.data_dir / "x"
    file.write_text("x")
    site.storage.put(key, file)


def keys(site: Site) -> set[str]:
    return {stat.key for stat in site.storage.list("jobs/")}


def test_attempts_that_do_not_count_go(site: Site):
    ids = [site.submit("G1") for _ in range(4)]
    for job_id in ids:
        for attempt in (1, 2):
            put(site, f"jobs/{job_id}/{attempt}/result/a")
    done, running, _, cancelled = ids
    job = site.store.claim(done, 1.0, "w")
    site.store.apply(done, finished(job))
    site.store.claim(running, 1.0, "w")
    site.store.apply(cancelled, Cancelled(1.0))
    sweep_files(site.store, site.storage, before=time.time() - 3600)
    kept = {f"jobs/{job_id}/source/part.gcode" for job_id in ids}
    assert keys(site) == kept | {f"jobs/{done}/1/result/a", f"jobs/{running}/1/result/a"}


def test_files_without_a_row_go_when_they_are_old(site: Site):
    put(site, "jobs/nobody/source/a")
    sweep_files(site.store, site.storage, before=time.time() - 3600)
    assert keys(site)
    sweep_files(site.store, site.storage, before=time.time() + 1)
    assert not keys(site)


def test_results_of_the_first_version_stay(site: Site):
    job_id = site.submit("G1")
    job = site.store.claim(job_id, 1.0, "w")
    event = finished(job)
    site.store.apply(job_id, replace(event, output=f"jobs/{job_id}"))
    put(site, f"jobs/{job_id}/result/a")
    before = keys(site)
    sweep_files(site.store, site.storage, before=time.time() + 1)
    assert keys(site) == before


def test_old_jobs_are_forgotten_with_their_files(site: Site):
    old, young = site.submit("G1"), site.submit("G1")
    site.store.apply(old, Cancelled(time.time() - 2 * 86400))
    site.store.apply(young, Cancelled(time.time()))
    assert forget_expired(site.store, site.storage, keep_days=1.0) == 1
    assert site.store.get(old) is None
    assert keys(site) == {f"jobs/{young}/source/part.gcode"}


def test_uploads_that_were_broken_off_go(site: Site):
    folder = site.data_dir / "incoming"
    folder.mkdir()
    for name, age_s in (("old", 7200), ("young", 0)):
        (folder / name).write_text("x")
        os.utime(folder / name, (time.time() - age_s,) * 2)
    sweep_incoming([folder, site.data_dir / "none"], before=time.time() - 3600)
    assert [file.name for file in folder.iterdir()] == ["young"]
