"""The output folder through kills at every step."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

import pytest

from stillpath.cli.batch.output import Figures, Outcome, OutputFolder
from stillpath.service.storage.base import sha256_of
from stillpath.service.storage.local import LocalStorage

TEXT = "; compensated\nG28\n"


class Killed(BaseException):
    """Stands for kill -9: nothing of ours runs any more on the way out."""


def done(output: OutputFolder, text: str = TEXT) -> Outcome:
    scratch = output.scratch("m/a.stillpath.gcode")
    scratch.result.write_text(text)
    scratch.report.mkdir()
    (scratch.report / "report.html").write_text("page of " + text)
    outcome = Outcome(
        state="done",
        source="a.gcode",
        machine="m",
        output="m/a.stillpath.gcode",
        report="reports/m/a.gcode",
        output_sha256=sha256_of(scratch.result),
        figures=Figures(after_um=1.0),
    )
    output.keep(scratch, outcome)
    return outcome


def test_what_somebody_changed_stays(tmp_path):
    with OutputFolder.opened(tmp_path) as output:
        outcome = done(output)
        done(output, "; other options\n")  # what we wrote ourselves may be replaced
        (tmp_path / outcome.output).write_text("edited by hand")
        with pytest.raises(FileExistsError, match="changed or not written by this command"):
            done(output)
    assert (tmp_path / outcome.output).read_text() == "edited by hand"


def test_a_noted_failure_does_not_disown_the_result(tmp_path):
    with OutputFolder.opened(tmp_path) as output:
        outcome = done(output)
        failed = Outcome(state="failed", source="a.gcode", machine="m", trouble="file")
        output.note(outcome.output, failed)
        assert output.recorded(outcome.output).state == "failed"
        done(output, "; the next one\n")
    assert (tmp_path / outcome.output).read_text() == "; the next one\n"


def test_one_at_a_time(tmp_path):
    with (
        OutputFolder.opened(tmp_path),
        pytest.raises(OSError, match="another batch or watch"),
        OutputFolder.opened(tmp_path),
    ):
        pass


def test_what_file_managers_leave_is_no_obstacle(tmp_path):
    with OutputFolder.opened(tmp_path) as output:
        done(output)
    (tmp_path / ".stillpath" / "work" / ".DS_Store").write_bytes(b"x")
    with OutputFolder.opened(tmp_path) as output:
        outcome = done(output, "; the next one\n")
    assert (tmp_path / outcome.output).read_text() == "; the next one\n"


def test_a_file_system_that_syncs_no_folders(tmp_path, monkeypatch):
    """As fsync(2) of VirtualBox's shared folders answers; of files it may not fail."""
    fsync = os.fsync

    def of_files(handle):
        if stat.S_ISDIR(os.fstat(handle).st_mode):
            raise OSError(errno.EINVAL, "Invalid argument")
        fsync(handle)

    monkeypatch.setattr(os, "fsync", of_files)
    with OutputFolder.opened(tmp_path) as output:
        assert output.is_there(done(output))
    storage = LocalStorage(tmp_path / "storage")
    upload = tmp_path / "upload"
    upload.write_text(TEXT)
    storage.put("jobs/a/source/a.gcode", upload)
    assert storage.stat("jobs/a/source/a.gcode").size_bytes == len(TEXT)


@pytest.fixture(name="other_disk")
def printers_shares(monkeypatch):
    """Results and reports lie on other disks than what is worked on: shares of printers, say."""
    replace = Path.replace

    def across(path, target):
        if ".stillpath" in path.parts and ".stillpath" not in Path(target).parts:
            raise OSError(errno.EXDEV, "Invalid cross-device link", str(path))
        return replace(path, target)

    monkeypatch.setattr(Path, "replace", across)


@pytest.mark.usefixtures("other_disk")
def test_a_share_that_is_away_keeps_nothing_else_from_starting(tmp_path, monkeypatch):
    def away(*_, **__):
        raise OSError(errno.EHOSTDOWN, "Host is down")

    with monkeypatch.context() as network, OutputFolder.opened(tmp_path) as output:
        network.setattr("stillpath.cli.batch.output.shutil.copyfile", away)
        with pytest.raises(OSError, match="Host is down"):
            done(output)
    with monkeypatch.context() as network:
        network.setattr("stillpath.cli.batch.output.shutil.copyfile", away)
        with OutputFolder.opened(tmp_path) as output:
            assert output.recorded("m/a.stillpath.gcode") is None
    with OutputFolder.opened(tmp_path) as output:
        assert output.is_there(output.recorded("m/a.stillpath.gcode"))


@pytest.mark.parametrize("apart", [False, True])
@pytest.mark.parametrize("step", range(12))
def test_killed_at_any_step(step, apart, tmp_path, monkeypatch, request):
    if apart:
        request.getfixturevalue("other_disk")
    left = step
    with OutputFolder.opened(tmp_path) as output:
        done(output, "; before\n")

    def count(act):
        def counted(*arguments, **named):
            nonlocal left
            if left == 0:
                raise Killed
            left -= 1
            return act(*arguments, **named)

        return counted

    was_killed = False
    with monkeypatch.context() as patched, OutputFolder.opened(tmp_path) as output:
        patched.setattr(Path, "replace", count(Path.replace))
        patched.setattr(os, "fsync", count(os.fsync))
        patched.setattr(os, "rmdir", count(os.rmdir))
        try:
            done(output)
        except Killed:
            was_killed = True
    assert was_killed or step > 8
    with OutputFolder.opened(tmp_path) as output:
        record = output.recorded("m/a.stillpath.gcode")
        assert output.is_there(record)
        text = (tmp_path / record.output).read_text()
        assert text in ("; before\n", TEXT)
        report = tmp_path / record.report / "report.html"
        assert report.read_text() == "page of " + text
        assert not list((tmp_path / ".stillpath/work").iterdir())
