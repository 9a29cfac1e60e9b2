"""The slicer's estimate in the metadata of binary files and packages."""

from __future__ import annotations

from pathlib import Path

import pytest

from stillpath.gcode.containers.opening import open_text, rewriting
from tests.gcode.container_files import binary, block, blocks, members, package

TEXT = b"G28\nG1 X1 Y1 F600\n"
OTHER = b"G28\nG1 X2 Y2 F600\n"
INFO = (
    b'<?xml version="1.0"?>\n<config>\n'
    b'  <plate>\n    <metadata key="index" value="1"/>\n'
    b'    <metadata key="prediction" value="100"/>\n  </plate>\n'
    b'  <plate>\n    <metadata key="index" value="2"/>\n'
    b'    <metadata key="prediction" value="1723"/>\n    <metadata key="weight" value="3.1"/>\n'
    b"  </plate>\n</config>\n"
)


def rewritten(folder: Path, name: str, content: bytes, delay_s: float, **options: int) -> bytes:
    source, target = folder / name, folder / f"out-{name}"
    source.write_bytes(content)
    with (
        open_text(source, **options) as container,
        rewriting(container, target, name=target) as text,
    ):
        text.write(OTHER)
        container.delay(delay_s)
    return target.read_bytes()


def test_binary_metadata(tmp_path: Path) -> None:
    content = binary(TEXT)
    made = list(blocks(rewritten(tmp_path, "a.bgcode", content, 54.0)))
    for old, new in zip(blocks(content), made, strict=True):
        if old[0] == 4:
            wanted = b"estimated printing time (normal mode)=2m 2s\n"
            assert new[3] == block(4, wanted, compression=1)
        elif old[0] != 1:
            assert new == old


@pytest.mark.parametrize("delay_s", [0.0, 0.3])
def test_a_time_that_stays_keeps_its_bytes(tmp_path: Path, delay_s: float) -> None:
    content = binary(TEXT)
    made = list(blocks(rewritten(tmp_path, "a.bgcode", content, delay_s)))
    assert [b for b in made if b[0] != 1] == [b for b in blocks(content) if b[0] != 1]


def test_plain_text_of_a_binary_file_tells_the_new_time(tmp_path: Path) -> None:
    (tmp_path / "a.bgcode").write_bytes(binary(TEXT))
    target = tmp_path / "a.gcode"
    with open_text(tmp_path / "a.bgcode") as container:
        assert container.facts().slicer == "PrusaSlicer"
        assert container.facts().estimate_s == 68.0
        with rewriting(container, target, name=target) as text:
            text.write(OTHER)
            container.delay(54.0)
    assert b"; estimated printing time (normal mode) = 2m 2s\n" in target.read_bytes()


def test_package_tells_it_of_its_plate(tmp_path: Path) -> None:
    content = package({1: TEXT, 2: TEXT}, more={"Metadata/slice_info.config": INFO})
    made = members(rewritten(tmp_path, "a.gcode.3mf", content, 7.4, plate=2))
    wanted = INFO.replace(b'"1723"', b'"1730"')
    assert made["Metadata/slice_info.config"] == wanted
    assert made["Metadata/plate_1.gcode"] == TEXT


@pytest.mark.parametrize("info", [b"", b"<plate></plate>", INFO.replace(b"prediction", b"else")])
def test_packages_that_tell_nothing(tmp_path: Path, info: bytes) -> None:
    content = package({2: TEXT}, more={"Metadata/slice_info.config": info})
    made = members(rewritten(tmp_path, "a.gcode.3mf", content, 7.4))
    assert made["Metadata/slice_info.config"] == info
