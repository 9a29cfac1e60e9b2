"""`stillpath warm`."""

from __future__ import annotations

from pathlib import Path

import pytest

from stillpath.cli.main import run

HATCH = Path(__file__).parents[2] / "examples" / "hatch.gcode"


@pytest.mark.slow
def test_nothing_is_left_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = tmp_path / "part.gcode"
    source.write_bytes(HATCH.read_bytes())
    monkeypatch.chdir(tmp_path)
    assert run(["warm", str(source), "-m", "ender3"]) == 0
    assert list(tmp_path.iterdir()) == [source]
    assert source.read_bytes() == HATCH.read_bytes()


def test_a_file_that_is_not_there(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["warm", "nowhere.gcode", "-m", "ender3"]) == 2
    assert "nowhere.gcode does not exist" in capsys.readouterr().err
