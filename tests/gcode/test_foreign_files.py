"""Files of another kind are named as what they are, whatever their names."""

from __future__ import annotations

from pathlib import Path

import pytest

from stillpath.gcode.containers.opening import open_text
from stillpath.gcode.errors import GcodeError


@pytest.mark.parametrize(
    ("head", "word"),
    [
        (b"\x89PNG\r\n\x1a\n", "PNG"),
        (b"\xff\xd8\xff\xe0", "JPEG"),
        (b"solid cube\n facet normal 0 0 1\n", "STL"),
        (b"a cube".ljust(80) + b"\1\0\0\0".ljust(48), "STL"),
        (b"\x1f\x8b\x08\x00", "gzip"),
        (b'{\r\n  "name": "mine"}\n', "JSON"),
        (b'[\n {"t_s": 0.0}\n]\n', "JSON"),
        (b"[1, 2]", "JSON"),
        (b"xgcode 1.0\n\0\0\0\0\0:\0\0\0\xb08\0\0BM", "FlashForge"),
    ],
)
def test_it_says_what_the_file_is(tmp_path: Path, head: bytes, word: str) -> None:
    path = tmp_path / "part.gcode"
    path.write_bytes(head + b"G1 X1\n")
    with pytest.raises(GcodeError, match=f"{word}.*slicer"), open_text(path):
        pass


def test_an_empty_file_is_called_so(tmp_path: Path) -> None:
    path = tmp_path / "part.gcode"
    path.touch()
    with pytest.raises(GcodeError, match=r"the file is empty.*slicer"), open_text(path):
        pass


@pytest.mark.parametrize(
    "text", [b"\n", b"%\nG28\n", b";solid\nG28\n", b"G28", b"<x\n", b"{if x}\n", b"[start]\n"]
)
def test_gcode_is_not_taken_for_it(tmp_path: Path, text: bytes) -> None:
    path = tmp_path / "part.gcode"
    path.write_bytes(text)
    with open_text(path) as container:
        assert container.text.read() == text
