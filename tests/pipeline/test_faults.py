"""Pieces that cannot be compensated stay as sliced, and the rest of the file is printed."""

from __future__ import annotations

from pathlib import Path

import pytest

from stillpath.models.store import load_machine
from stillpath.pipeline.compensate import compensate_file
from stillpath.pipeline.options import Options
from stillpath.pipeline.piece_compensator import PieceCompensator
from stillpath.pipeline.progress import Progress
from tests.compensating import compensated
from tests.pipeline.test_compensate import check_file

HEAD = "G28\nM83\nG90\nG1 X50 Y50 Z0.2 F6000\n"
SQUARE = "G1 X90 E1 F3000\nG1 Y90 E1\nG1 X50 E1\nG1 Y50 E1\n"
TINY = "G1 X50.0001 Y50.0001 E.00001\nG1 X50.0002 E.00001\nG1 X50 Y50 E.00001\n"
STOP = "M400\nG4 P10\n"


def test_a_fault_of_ours_costs_one_piece(
    tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, calls = PieceCompensator.compensate, []

    def faulty(self: PieceCompensator, *given: object) -> object:
        calls.append(given)
        if len(calls) == 2:
            raise IndexError("index 3 is out of bounds")
        return whole(self, *given)  # type: ignore[arg-type]

    monkeypatch.setattr(PieceCompensator, "compensate", faulty)
    data = (HEAD + 3 * (SQUARE + STOP)).encode()
    result, written = compensated(data, tmp_path, cache)
    (fault,) = result.put_back
    assert "internal error (IndexError: index 3 is out of bounds)" in fault.reason
    assert fault.reason.startswith(f"line {fault.line_first}:")
    assert len(calls) > 2
    check_file(data, written, load_machine("ender3"))


@pytest.mark.parametrize(
    "options",
    [Options(), Options(method="advise"), Options(method="live"), Options(compare_live=True)],
)
@pytest.mark.parametrize("name", ["in.gcode", "out.gcode"])
def test_a_file_that_is_replaced_meanwhile_stays(
    options: Options, name: str, tmp_path: Path, cache: Path
) -> None:
    """And so does the report that was there, with its layers."""
    source, report = tmp_path / "in.gcode", tmp_path / "report"
    source.write_text(HEAD + 3 * (SQUARE + STOP))
    report.mkdir()
    for layers in ("layers.json", "layers.bin"):
        (report / layers).write_text("of an earlier file")

    def replace(_: Progress) -> None:
        again = tmp_path / "again.gcode"
        if source.read_text() != "; sliced again\n":
            again.write_text("; sliced again\n")
            again.replace(source)

    with pytest.raises(OSError, match=r"another program changed .* run it again") as caught:
        compensate_file(
            *(source, tmp_path / name, load_machine("ender3"), options),
            cache_dir=cache,
            progress=replace,
            layers=report,
        )
    assert caught.value.filename == str(source)
    assert source.read_text() == "; sliced again\n"
    assert [path.name for path in tmp_path.iterdir() if path.is_file()] == ["in.gcode"]
    assert {path.read_text() for path in report.iterdir()} == {"of an earlier file"}


@pytest.mark.parametrize("name", ["ender3", "generic-corexy"])
def test_moves_below_the_grid_of_a_file(name: str, tmp_path: Path, cache: Path) -> None:
    data = (HEAD + SQUARE + STOP + TINY + STOP + SQUARE).encode()
    result, written = compensated(data, tmp_path, cache, name)
    assert all("internal error" not in piece.reason for piece in result.put_back)
    check_file(data, written, load_machine(name))


def test_a_report_that_has_no_place_leaves_the_file(tmp_path: Path, cache: Path) -> None:
    source, report = tmp_path / "part.gcode", tmp_path / "report"
    source.write_text(HEAD + SQUARE)

    def in_the_way(_: Progress) -> None:
        (report / "layers.json").mkdir(parents=True, exist_ok=True)

    with pytest.raises(OSError, match="layers"):
        compensate_file(
            source,
            source,
            load_machine("ender3"),
            Options(),
            cache_dir=cache,
            progress=in_the_way,
            layers=report,
        )
    assert source.read_text() == HEAD + SQUARE
