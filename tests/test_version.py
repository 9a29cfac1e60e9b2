"""What tells one state of the program from the next."""

from __future__ import annotations

from pathlib import Path

import pytest

from stillpath import version


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A checkout: a layer that computes, reached by a link, and one that does not."""
    layer = tmp_path / "gcode" / "firmware"
    layer.mkdir(parents=True)
    (layer / "marlin.py").write_text("STEPS = 16\n")
    folder = tmp_path / "src"
    (folder / "cli").mkdir(parents=True)
    (folder / "gcode").symlink_to(tmp_path / "gcode")
    monkeypatch.setattr(version, "__file__", str(folder / "version.py"))
    return folder


def test_a_build_is_the_code_that_computes(package: Path):
    build = version.build.__wrapped__  # as another process
    first = build()
    assert first.startswith(f"{version.__version__}+")
    (package / "cli" / "main.py").write_text("print('hello')\n")
    (package / "gcode" / "__pycache__").mkdir()
    (package / "gcode" / "__pycache__" / "marlin.pyc").write_bytes(b"1")
    assert build() == first
    (package / "gcode" / "firmware" / "marlin.py").write_text("STEPS = 17\n")
    assert build() != first
