"""What the sweep deletes, and above all what it does not."""

from __future__ import annotations

import errno
import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from stillpath.service.jobs.state import Cancelled
from stillpath.service.jobs.sweep import Sweep, sweep_files
from tests.service.database.examples import finished
from tests.service.jobs.site import Site


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
    sweep_files(site.store, site.storage, is_old=lambda _: False)
    kept = {f"jobs/{job_id}/source/part.gcode" for job_id in ids}
    assert keys(site) == kept | {f"jobs/{done}/1/result/a", f"jobs/{running}/1/result/a"}


def test_files_without_a_row_go_when_they_are_old(site: Site):
    put(site, "jobs/nobody/source/a")
    sweep_files(site.store, site.storage, is_old=lambda _: False)
    assert keys(site)
    sweep_files(site.store, site.storage, is_old=lambda _: True)
    assert not keys(site)


def test_results_of_the_first_version_stay(site: Site):
    job_id = site.submit("G1")
    job = site.store.claim(job_id, 1.0, "w")
    event = finished(job)
    site.store.apply(job_id, replace(event, output=f"jobs/{job_id}"))
    put(site, f"jobs/{job_id}/result/a")
    before = keys(site)
    sweep_files(site.store, site.storage, is_old=lambda _: True)
    assert keys(site) == before


class Clock:
    """Counts seconds as the test says."""

    def __init__(self) -> None:
        self.now_s = 5000.0

    def __call__(self) -> float:
        return self.now_s

    def sweep(self, sweep: Sweep, hours: float) -> None:
        """Sweep every minute, as the service does, for so long; not that often, to be quick."""
        for _ in range(10):
            self.now_s += 360.0 * hours
            sweep.run()


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def sweep(site: Site, clock: Clock) -> Sweep:
    settings = site.settings.model_copy(update={"keep_days": 1.0})
    return Sweep(settings, site.store, site.storage, clock=clock)


def test_old_jobs_are_forgotten_with_their_files(site: Site, sweep: Sweep, clock: Clock):
    old, young = site.submit("G1"), site.submit("G1")
    site.store.apply(old, Cancelled(time.time()))
    sweep.run()
    clock.sweep(sweep, 23)
    site.store.apply(young, Cancelled(time.time()))
    assert site.store.get(old) is not None
    clock.sweep(sweep, 2)
    assert site.store.get(old) is None
    assert keys(site) == {f"jobs/{young}/source/part.gcode"}


@pytest.mark.parametrize("refused", ["unlink", "rmdir"])
def test_an_upload_that_cannot_be_deleted_keeps_no_old_job(
    site: Site, sweep: Sweep, clock: Clock, monkeypatch: pytest.MonkeyPatch, refused: str
):
    """It belongs to somebody else, or another program has it open (Windows)."""
    old = site.submit("G1")
    site.store.apply(old, Cancelled(time.time()))
    folder = site.data_dir / "incoming"
    (folder / "measurements-1").mkdir(parents=True)
    (folder / "upload").write_text("x")
    sweep.run()
    original = getattr(os, refused)

    def fails(path: Any, **more: Any) -> None:
        if "incoming" in str(path) or path in ("measurements-1", "upload"):
            raise PermissionError(errno.EPERM, "Operation not permitted", str(path))
        original(path, **more)

    monkeypatch.setattr(os, refused, fails)
    clock.sweep(sweep, 26)
    assert site.store.get(old) is None
    assert len(list(folder.iterdir())) == 1


@pytest.mark.parametrize("days", [32, -1, 400])
def test_a_clock_that_jumps_deletes_nothing(
    site: Site, sweep: Sweep, clock: Clock, monkeypatch: pytest.MonkeyPatch, days: int
):
    done, waiting = site.submit("G1"), site.submit("G1")
    site.store.apply(done, Cancelled(time.time()))
    put(site, "jobs/nobody/source/a")
    (site.data_dir / "incoming").mkdir()
    (site.data_dir / "incoming" / "upload").write_text("x")
    before = keys(site)
    sweep.run()
    real = time.time
    monkeypatch.setattr(time, "time", lambda: real() + days * 86400)
    clock.sweep(sweep, 0.5)
    again = Sweep(sweep._settings, site.store, site.storage, clock=clock)  # as after a start
    clock.now_s -= 4000
    again.run()
    assert keys(site) == before
    assert (site.data_dir / "incoming" / "upload").exists()
    assert site.store.get(done) is not None
    assert site.store.get(waiting) is not None
    clock.sweep(again, 25)
    assert site.store.get(done) is None
    assert site.store.get(waiting) is not None


def test_time_that_somebody_else_counts_is_not_counted_twice(
    site: Site, sweep: Sweep, clock: Clock
):
    job_id = site.submit("G1")
    site.store.apply(job_id, Cancelled(time.time()))
    sweep.run()
    for _ in range(10):
        sweep.pause()
        clock.now_s += 86400.0
        sweep.run()
    assert site.store.get(job_id) is not None


def test_files_that_are_seen_without_a_row_for_long_go(site: Site, sweep: Sweep, clock: Clock):
    put(site, "jobs/nobody/source/a")
    folder = site.data_dir / "incoming"
    (folder / "measurements-1").mkdir(parents=True)
    for name in ("broken-off", "grows"):
        (folder / name).write_text("x")
    sweep.run()
    clock.sweep(sweep, 0.9)
    assert keys(site)
    clock.sweep(sweep, 0.2)
    assert not keys(site)
    (folder / "grows").write_text("xx")
    clock.sweep(sweep, 23)
    assert [file.name for file in folder.iterdir()] == ["grows"]


def test_two_services_in_one_storage_delete_nothing_of_each_other(tmp_path: Path, clock: Clock):
    """Each with a database of its own: neither knows the jobs of the other."""
    storage_url = (tmp_path / "nas").as_uri()
    sites = [Site(tmp_path / name, storage_url=storage_url) for name in ("a", "b")]
    sweeps = [Sweep(site.settings, site.store, site.storage, clock=clock) for site in sites]
    jobs = [site.submit("G1") for site in sites]
    put(sites[0], "jobs/nobody/source/a")
    for _ in range(2):
        for sweep in sweeps:
            sweep.run()
        clock.now_s += 2 * 3600.0
    kept = {f"jobs/{job_id}/source/part.gcode" for job_id in jobs}
    assert keys(sites[0]) == {*kept, "jobs/nobody/source/a"}
    [other] = [
        stat.key
        for stat in sites[1].storage.list("databases/")
        if not stat.key.endswith(sites[0].store.identity())
    ]
    assert sites[1].store.forget(jobs[1])  # and its service is gone, with its mark
    (tmp_path / "nas" / other).unlink()
    clock.sweep(sweeps[0], 2.1)
    assert keys(sites[0]) == {f"jobs/{jobs[0]}/source/part.gcode"}
    for site in sites:
        site.close()
