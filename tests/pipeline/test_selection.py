"""Only what shows is compensated: smaller files whose visible features print as well."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest

from stillpath.gcode.errors import GcodeError
from stillpath.models.machine import Machine
from stillpath.pipeline.compensate import compensate_file
from stillpath.pipeline.options import Options
from stillpath.pipeline.progress import Progress, ProgressCallback
from stillpath.pipeline.result import Result
from tests.gcode.cutting import ender3_with
from tests.gcode.plain_reader import Firmware, read
from tests.gcode.prints import small_arcs
from tests.gcode.states import differences, tagged

GEAR = Path(__file__).parents[2] / "examples" / "cura_ender3_gear24.gcode"
KINDS: tuple[Firmware, ...] = ("klipper", "marlin", "reprapfirmware")


@pytest.fixture(scope="module")
def gear(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two layers and a half of the gear: all its features, and no end."""
    lines = GEAR.read_bytes().splitlines(keepends=True)
    path = tmp_path_factory.mktemp("gear") / "gear.gcode"
    path.write_bytes(tagged(b"".join(lines[:3100])))
    return path


Written = Callable[[Firmware, str], tuple[Path, Result]]


@pytest.fixture(scope="module")
def written(gear: Path) -> Written:
    """Give the gear as it is written for a firmware and a choice of what shows, each made once."""

    @cache
    def make(kind: Firmware, where: str) -> tuple[Path, Result]:
        target = gear.parent / f"{kind}-{where}.gcode"
        return target, run(gear, target, ender3_with(kind), where=where)

    return make


def run(
    gear: Path,
    target: Path,
    machine: Machine,
    progress: ProgressCallback | None = None,
    **options: object,
) -> Result:
    chosen, cache = Options.model_validate(options), gear.parent / "cache"
    return compensate_file(gear, target, machine, chosen, cache_dir=cache, progress=progress)


def rms(result: Result, feature: str) -> dict[str, float]:
    return next(g.contour_rms_um for g in result.features if g.name == feature)


@pytest.mark.parametrize(
    "kind", [k if k == "klipper" else pytest.param(k, marks=pytest.mark.slow) for k in KINDS]
)
def test_outer_walls_alone(kind: Firmware, gear: Path, written: Written) -> None:
    _, all_of_it = written(kind, "all")
    target, walls = written(kind, "walls")
    text, made = gear.read_bytes(), target.read_bytes()
    assert walls.put_back == []

    # The printer is where the file leaves it, at every line that both have.
    assert differences(text, made, ender3_with(kind)) == []
    came, leaves = read(text, kind), read(made, kind)
    assert leaves.modes() == came.modes()
    assert leaves.position_mm == pytest.approx(came.position_mm, abs=1e-3)
    assert leaves.extruded_mm[0] == pytest.approx(came.extruded_mm[0], abs=1e-3)
    # Inner walls leave line by line as sliced.
    inner = text.split(b";TYPE:WALL-INNER\n")[3].split(b";TYPE:")[0]
    kept = [line for line in inner.splitlines() if b"E" in line and not line.startswith(b";@")]
    assert len(kept) > 10
    assert all(line in made for line in kept[1:-1])

    assert walls.written_bytes < 0.7 * all_of_it.written_bytes
    assert walls.left_out_extruding_s > 20.0
    assert walls.left_alone_s <= all_of_it.left_alone_s + 0.1
    assert walls.original_time_s == pytest.approx(all_of_it.original_time_s, rel=1e-6)
    assert walls.time_s <= 1.005 * all_of_it.time_s
    outer, sliced = rms(walls, "WALL-OUTER"), rms(walls, "WALL-INNER")
    # Marlin starts from a stand less exactly, and between parts there are more of them.
    more = 1.5 if kind == "marlin" else 1.1
    assert outer["after"] <= more * rms(all_of_it, "WALL-OUTER")["after"] + 0.1
    assert sliced["after"] == pytest.approx(sliced["before"], rel=0.05)
    assert any("where=walls" in note for note in walls.notes)
    # What counts, and its range, are those of the walls (the skirt and purge lines left out).
    selected = {c.name: c for c in walls.channels}["after"]
    assert selected.selected_rms_um == pytest.approx(outer["after"], rel=0.3)
    assert selected.contour_range_um is not None
    assert selected.contour_range_um[0] <= selected.selected_rms_um
    assert selected.contour_range_um[1] < selected.extruding.contour_rms_um * 4
    assert not any("shaper would serve" in warning for warning in walls.warnings)


def test_outer_walls_of_small_arcs(gear: Path, tmp_path: Path) -> None:
    # Of a Marlin's arc some segments feed nothing: less than a step of E.
    machine, source = ender3_with("marlin"), tmp_path / "arcs.gcode"
    source.write_bytes(tagged(small_arcs().encode()))
    target, options = tmp_path / "walls.gcode", Options(where="walls")
    result = compensate_file(source, target, machine, options, cache_dir=gear.parent / "cache")
    assert result.put_back == []
    assert differences(source.read_bytes(), target.read_bytes(), machine) == []
    outer = next(g.contour_rms_um for g in result.features if g.name == "WALL-OUTER")
    assert outer["after"] < 0.5 * outer["before"]


def test_the_firmwares_shaper_is_not_switched_between_walls(gear: Path, tmp_path: Path) -> None:
    document = ender3_with("klipper").model_dump(mode="json")
    document["firmware"]["shaper"] = {"freq_x_hz": 45.0, "freq_y_hz": 35.0}
    target = tmp_path / "out.gcode"
    run(gear, target, Machine.model_validate(document), where="walls")
    assert target.read_bytes().count(b"SET_INPUT_SHAPER") <= 6


@pytest.mark.parametrize("kind", [pytest.param("marlin", marks=pytest.mark.slow), "reprapfirmware"])
def test_what_is_left_out_has_the_firmwares_pressure_advance(
    kind: str, gear: Path, tmp_path: Path
) -> None:
    """Streams have it in their filament, and the firmware's off; infill is the slicer's."""
    document = ender3_with(kind).model_dump(mode="json") | {"pressure_advance_s": 0.05}
    if kind == "marlin":
        document["firmware"] |= {"linear_advance": True, "linear_advance_k_s": 0.05}
        document["firmware"]["shaper"] = {"freq_x_hz": 45.0, "freq_y_hz": 35.0}
    target = tmp_path / "out.gcode"
    result = run(gear, target, Machine.model_validate(document), where="walls")
    assert result.left_out_extruding_s > 20.0
    advance_s, of_stream, of_file = 0.05, set(), set()
    for line in target.read_bytes().splitlines():
        if (match := re.match(rb"(?:M572 S|M900 K)([\d.]+)", line)) is not None:
            advance_s = float(match[1])
        elif re.match(rb"G1 .*[XY].* E[.\d]", line):
            (of_file if b";#" in line else of_stream).add(advance_s)
    assert (of_stream, of_file) == ({0.0}, {0.05})


def test_a_file_that_must_not_be_large(gear: Path, written: Written, tmp_path: Path) -> None:
    machine, target = ender3_with("klipper"), tmp_path / "out.gcode"
    sizes = [written("klipper", where)[1].written_bytes for where in ("all", "visible", "walls")]
    assert sizes[0] > sizes[1] > sizes[2]
    for limit_mb, where, tolerance_um in (
        (10.0, "all", 2),
        (1e-6 * sizes[1] + 1e-3, "visible", 2),
        (1e-6 * (sizes[1] - 9), "visible", 8),  # surfaces shake before they are left out
    ):
        shown: list[Progress] = []
        found = run(gear, target, machine, shown.append, max_mb=limit_mb)
        # It goes on while the file is written again.
        fractions = [now.fraction for now in shown if now.stage != "done"]
        assert fractions == sorted(fractions)
        assert len(set(fractions)) > 0.5 * len(fractions)
        assert shown[-1].fraction == 1.0
        chosen = (
            f"max_mb={limit_mb:g}: written with where={where} and tolerance_um={tolerance_um:g}"
        )
        assert chosen in found.notes
        assert found.settings.get("where", "all") == where
        assert found.settings["tolerance_um"] == tolerance_um
        assert found.written_bytes == target.stat().st_size <= 1e6 * limit_mb
    target.write_bytes(b"precious")
    with pytest.raises(GcodeError, match=r"exceeds max_mb 0\.1"):
        run(gear, target, machine, max_mb=0.1)
    assert target.read_bytes() == b"precious"
    assert [p.name for p in tmp_path.iterdir()] == ["out.gcode"]


def test_a_file_that_stays_as_sliced_only_fits_or_not(gear: Path, tmp_path: Path) -> None:
    machine, target = ender3_with("klipper"), tmp_path / "out.gcode"
    found = run(gear, target, machine, method="none", max_mb=10)
    assert target.read_bytes() == gear.read_bytes()
    assert not any("max_mb" in note for note in found.notes)
    with pytest.raises(GcodeError, match=r"exceeds max_mb 0\.01, and method none") as refused:
        run(gear, target, machine, method="none", max_mb=0.01)
    assert "outer walls" not in str(refused.value)


@pytest.mark.parametrize(
    ("method", "chosen", "unused"),
    [
        ("none", {"tolerance_um": 5.0, "budget_um": 9.0, "basis": "dct"}, "basis, tolerance_um"),
        ("shaper:zv", {"robust": "off", "along": 0.5, "tolerance_um": 5.0}, "robust, along. "),
        ("advise", {"tolerance_um": 5.0, "budget_um": 90.0}, "tolerance_um. "),
        ("fbf", {"basis": "dct", "robust": "off", "along": 0.5, "tolerance_um": 5.0}, ""),
    ],
)
def test_what_has_no_effect_is_told(
    method: str, chosen: dict[str, object], unused: str, gear: Path, tmp_path: Path
) -> None:
    short = tmp_path / "short.gcode"
    short.write_bytes(b"G28\n" + b"G1 X60 Y60 F6000\nG1 X90 Y60 E1\nG1 X90 Y90 E2\n" * 4)
    found = compensate_file(
        short,
        tmp_path / "out.gcode",
        ender3_with("klipper"),
        Options.model_validate({"method": method, **chosen}),
        cache_dir=gear.parent / "cache",
    )
    told = [warning for warning in found.warnings if warning.startswith("Without effect: ")]
    assert len(told) == bool(unused)
    assert not unused or f"Without effect: {unused}" in told[0]
