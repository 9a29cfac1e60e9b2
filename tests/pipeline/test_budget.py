"""A budget of contour error: as quick as it allows, within it, and told as it is."""

from __future__ import annotations

from pathlib import Path

import pytest

from stillpath.cli.console import budget_line
from stillpath.models.store import load_machine
from stillpath.pipeline import piece_compensator
from stillpath.pipeline.options import Options, stamp
from tests.compensating import compensated
from tests.gcode.cutting import HEAD
from tests.gcode.prints import polygon
from tests.pipeline.test_compensate import check_file


@pytest.fixture(scope="module")
def sliced() -> bytes:
    """Three layers of two features with slow accelerations."""
    lines = [HEAD, "M204 S500\n"]
    for layer in range(3):
        lines += [f";LAYER_CHANGE\n;Z:{0.2 * (layer + 1):.1f}\n", f"G1 Z{0.2 * (layer + 1):.1f}\n"]
        for name, sides, size in (("External perimeter", 8, 12), ("Internal infill", 4, 8)):
            lines += [f";TYPE:{name}\n", "G1 X120 Y100 F6000\n", "G92 E0\n"]
            lines += [line + "\n" for line in polygon(sides, size)]
    return "".join(lines).encode()


@pytest.mark.slow
def test_it_is_quicker_and_keeps_the_budget(tmp_path: Path, cache: Path, sliced: bytes) -> None:
    plain, _ = compensated(sliced, tmp_path, cache)
    assert plain.budget is None
    assert "budget_um" not in plain.settings
    result, written = compensated(sliced, tmp_path, cache, budget_um=25)
    found = result.budget
    assert found is not None
    assert result.settings["budget_um"] == 25
    assert result.put_back == []
    assert result.time_s < 0.9 * plain.time_s
    assert found.saved_share == pytest.approx(1.0 - result.time_s / result.original_time_s)
    for one in found.classes:
        # What is extruded right after a travel may have two budgets.
        assert one.contour_rms_um <= (2 if one.name == "travel" else 1.1) * 25
    quicker = {one.name: one.acceleration_factor for one in found.classes}
    stays = "all that stays as sliced"
    assert set(quicker) == {"External perimeter", "Internal infill", "travel", stays}
    assert quicker[stays] == 1.0
    assert all(factor >= 1.0 for factor in quicker.values())
    assert max(quicker.values()) > 2.0
    check_file(sliced, written, load_machine("ender3"))
    # What the file did before is told at its own speeds.
    for name in ("before", "shaper"):
        figures = [
            next(c.extruding.contour_rms_um for c in one.channels if c.name == name)
            for one in (plain, result)
        ]
        assert figures[1] == pytest.approx(figures[0], rel=0.05, abs=0.2)
    assert "budget 25 µm" in budget_line(found)
    again, same = compensated(sliced, tmp_path, cache, budget_um=25)
    assert same == written
    assert again.budget == found


@pytest.mark.slow
def test_a_small_budget_changes_no_speed(tmp_path: Path, cache: Path, sliced: bytes) -> None:
    plain, _ = compensated(sliced, tmp_path, cache)
    result, _ = compensated(sliced, tmp_path, cache, budget_um=0.5)
    assert result.budget is not None
    raised = [one for one in result.budget.classes if one.acceleration_factor > 1.0]
    over = [one for one in result.budget.classes if one.contour_rms_um > 0.5]
    assert len([w for w in result.warnings if "above the budget" in w]) == len(over)
    assert not raised
    assert result.time_s == pytest.approx(plain.time_s, rel=2e-3)


def test_shapers_have_budgets_too(tmp_path: Path, cache: Path, sliced: bytes) -> None:
    result, written = compensated(sliced, tmp_path, cache, method="shaper:zv", budget_um=40)
    assert result.budget is not None
    assert result.budget.saved_share > 0.05
    assert result.time_s < result.original_time_s
    assert all(one.contour_rms_um <= 2 * 40 for one in result.budget.classes)
    check_file(sliced, written, load_machine("ender3"))


@pytest.mark.slow
def test_what_no_command_follows_is_slower(
    tmp_path: Path, cache: Path, sliced: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    # An inverse asks for more acceleration than the machine allows where the plan is quickest, and
    # corners are not rounded for it here.
    monkeypatch.setattr(piece_compensator, "_ROUNDING_S", ())
    result, _ = compensated(sliced, tmp_path, cache, method="zpetc", budget_um=40)
    assert result.put_back == []
    assert any("slower than the budget allows" in warning for warning in result.warnings)
    assert result.time_s < result.original_time_s


def test_without_a_method_it_is_not_used(tmp_path: Path, cache: Path, sliced: bytes) -> None:
    result, written = compensated(sliced, tmp_path, cache, method="none", budget_um=10)
    assert written == sliced
    assert result.budget is None
    assert any("Without effect: budget_um" in warning for warning in result.warnings)


def test_options_of_later_versions_change_no_digest() -> None:
    assert not {"budget_um", "where", "max_mb", "compare_live"} & Options().model_dump().keys()
    assert "budget_um" not in Options().model_dump_json()
    assert Options(where="walls").model_dump()["where"] == "walls"
    machine = load_machine("ender3")
    assert stamp(machine, Options(compare_live=True)) == stamp(machine, Options())
    assert Options.model_validate(Options(budget_um=3).model_dump()).budget_um == 3
    for bad in (0.4, 1001, float("nan")):
        with pytest.raises(ValueError, match="budget_um"):
            Options(budget_um=bad)
