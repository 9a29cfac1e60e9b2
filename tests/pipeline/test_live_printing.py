"""Two ways to print: the compensated file, and the file as sliced with the extra in Klipper."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from stillpath.compensation.base import DesignError
from stillpath.gcode.errors import GcodeError
from stillpath.models.firmware import Marlin
from stillpath.models.machine import Machine
from stillpath.models.store import load_machine
from stillpath.pipeline.compensate import compensate_file
from stillpath.pipeline.live_design import cached_live_design
from stillpath.pipeline.live_printing import simulate_live
from stillpath.pipeline.options import Options
from stillpath.pipeline.progress import Progress, StopWork
from stillpath.pipeline.result import Result
from tests.compensating import compensated

PENTAGON = b"G28\nG90\nM83\nG1 Z0.3 F600\nG1 X60 Y60 F9000\n" + b"".join(
    b"G1 X%.3f Y%.3f E2 F6000\n" % (100 + 40 * np.cos(1.2566 * k), 100 + 40 * np.sin(1.2566 * k))
    for k in range(40)
)
DRAWN = Path(__file__).parents[2] / "examples" / "hatch.gcode"
"""Of a pen: it extrudes nothing."""
BOTH = Options(compare_live=True)


@pytest.fixture(scope="module")
def machine() -> Machine:
    return load_machine("ender3")


@pytest.fixture(scope="module")
def pentagon(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("source") / "pentagon.gcode"
    path.write_bytes(PENTAGON)
    return path


@pytest.fixture(scope="module")
def live(machine: Machine, cache: Path, pentagon: Path) -> Result:
    return simulate_live(pentagon, machine, cache_dir=cache)


def test_the_report_of_a_file_has_the_figures_of_both_ways(
    machine: Machine, cache: Path, pentagon: Path, live: Result, tmp_path: Path
) -> None:
    plain, compared = tmp_path / "plain.gcode", tmp_path / "compared.gcode"
    alone = compensate_file(pentagon, plain, machine, Options(), cache_dir=cache)
    found = compensate_file(pentagon, compared, machine, BOTH, cache_dir=cache)
    assert plain.read_bytes() == compared.read_bytes()
    assert alone.ways == []
    assert found.channels == alone.channels
    assert found.settings == alone.settings
    file, way = found.ways
    after = next(channel for channel in found.channels if channel.name == "after")
    assert (file.name, way.name) == ("file", "live")
    assert file.contour_rms_um == after.extruding.contour_rms_um
    assert file.contour_range_um == after.contour_range_um
    assert file.file_bytes == compared.stat().st_size
    (alone_live,) = live.ways
    assert way.contour_rms_um == pytest.approx(alone_live.contour_rms_um, rel=1e-9)
    assert way.contour_max_um == pytest.approx(alone_live.contour_max_um, rel=1e-9)
    assert way.contour_range_um == pytest.approx(alone_live.contour_range_um, rel=1e-9)
    assert (way.time_s, way.file_bytes) == (alone_live.time_s, len(PENTAGON))
    assert way.needs
    assert way.lacks


def test_the_channels_of_a_live_report_have_ranges(live: Result) -> None:
    ours = next(channel for channel in live.channels if channel.name == "after")
    assert ours.label == "printed live"
    for channel in live.channels:
        assert channel.contour_range_um is not None
        low, high = channel.contour_range_um
        assert low <= channel.extruding.contour_rms_um <= high
    (way,) = live.ways
    assert way.contour_rms_um == ours.extruding.contour_rms_um
    assert way.contour_range_um == ours.contour_range_um


def test_method_live_leaves_the_file_as_it_is(
    machine: Machine, cache: Path, pentagon: Path, live: Result, tmp_path: Path
) -> None:
    target = tmp_path / "out.gcode"
    found = compensate_file(pentagon, target, machine, Options(method="live"), cache_dir=cache)
    assert target.read_bytes() == PENTAGON
    assert found.channels == live.channels
    assert found.ways == live.ways
    with pytest.raises(GcodeError, match=r"out\.bgcode must end like pentagon\.gcode"):
        compensate_file(pentagon, tmp_path / "out.bgcode", machine, Options(method="live"))
    assert [path.name for path in tmp_path.iterdir()] == ["out.gcode"]


@pytest.mark.parametrize("options", [Options(method="live"), BOTH])
def test_a_processed_file_is_refused_before_anything_is_predicted(
    machine: Machine, cache: Path, tmp_path: Path, options: Options
) -> None:
    source, target = tmp_path / "part.gcode", tmp_path / "out.gcode"
    source.write_bytes(PENTAGON)
    compensate_file(source, source, machine, Options(method="shaper:mzv"), cache_dir=cache)
    with pytest.raises(GcodeError, match="already processed by stillpath; print the original"):
        compensate_file(source, target, machine, options, cache_dir=cache)
    assert not target.exists()


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"firmware": Marlin()}, "runs marlin: only Klipper has print-time compensation"),
        ({"kinematics": "delta"}, "has delta kinematics: the extra of Klipper knows"),
    ],
)
def test_a_machine_that_cannot_print_live_says_why(
    machine: Machine,
    cache: Path,
    pentagon: Path,
    tmp_path: Path,
    change: dict[str, object],
    reason: str,
) -> None:
    other = machine.model_copy(update=change)
    if "firmware" in change:
        target = tmp_path / "out.gcode"
        found = compensate_file(pentagon, target, other, BOTH, cache_dir=cache)
        assert reason in found.not_live
        assert found.ways == []
    assert reason in str(other.live_refusal)
    with pytest.raises(DesignError, match=reason):
        simulate_live(pentagon, other, cache_dir=cache)


def test_a_file_that_sets_the_shaper_says_why(
    machine: Machine, cache: Path, tmp_path: Path
) -> None:
    line = b"SET_INPUT_SHAPER SHAPER_TYPE=mzv SHAPER_FREQ_X=40 SHAPER_FREQ_Y=40\n"
    found, _ = compensated(line + PENTAGON, tmp_path, cache, machine, compare_live=True)
    assert found.not_live.startswith("the file sets the firmware's shaper (mzv")
    assert found.ways == []


def test_a_file_may_switch_the_shaper_off(
    machine: Machine, cache: Path, live: Result, tmp_path: Path
) -> None:
    source = tmp_path / "part.gcode"
    source.write_bytes(b"SET_INPUT_SHAPER SHAPER_FREQ_X=0 SHAPER_FREQ_Y=0\n" + PENTAGON)
    found = simulate_live(source, machine, cache_dir=cache)
    assert found.channels == live.channels


def test_it_may_be_written_in_place_and_cancelled(
    machine: Machine, cache: Path, tmp_path: Path
) -> None:
    source = tmp_path / "part.gcode"
    source.write_bytes(PENTAGON)

    def cancel(progress: Progress) -> None:
        if progress.stage == "predicting the live print":
            assert progress.fraction == 0.0
            raise StopWork

    with pytest.raises(StopWork):
        compensate_file(source, source, machine, BOTH, cache_dir=cache, progress=cancel)
    assert source.read_bytes() == PENTAGON
    found = compensate_file(source, source, machine, BOTH, cache_dir=cache)
    assert [way.file_bytes for way in found.ways] == [source.stat().st_size, len(PENTAGON)]


def test_what_extrudes_nothing_is_judged_by_all_motion(machine: Machine, cache: Path) -> None:
    found = simulate_live(DRAWN, machine, cache_dir=cache)
    (way,) = found.ways
    ours = next(channel for channel in found.channels if channel.name == "after")
    assert way.contour_rms_um == ours.all_motion.contour_rms_um > 0.0
    assert way.contour_range_um is None


def test_the_filter_is_kept_and_made_again_if_damaged(
    machine: Machine, live: Result, cache: Path
) -> None:
    (path,) = cache.glob(f"live-{machine.revision}-*.json")
    kept = path.read_bytes()
    first = cached_live_design(machine, cache)
    document = json.loads(kept)
    document["taps"] = [[1.0], [1.0]]
    path.write_text(json.dumps(document))
    again = cached_live_design(machine, cache)
    assert path.read_bytes() == kept
    assert again.taps.tolist() == first.taps.tolist()
    assert again.ranges == first.ranges


@pytest.mark.slow
def test_dry_friction_is_in_what_a_filter_leaves(machine: Machine, cache: Path) -> None:
    """No filter makes up for it."""
    axes = {k: v.model_copy(update={"friction_mm": 0.03}) for k, v in machine.axes.items()}
    rubbing = machine.model_copy(update={"axes": axes})
    clean, rubbed = (cached_live_design(one, cache).ranges for one in (machine, rubbing))
    assert rubbed["live"].reference_um > clean["live"].reference_um + 10.0


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        ({"method": "none", "compare_live": True}, "method none writes none"),
        ({"method": "advise", "compare_live": True}, "method advise writes none"),
        ({"method": "live", "compare_live": True}, "method live writes none"),
        ({"method": "live", "where": "walls"}, "prints the file as sliced"),
        ({"method": "live", "budget_um": 5.0}, "prints the file as sliced"),
        ({"method": "advise", "where": "walls"}, "method advise .*where"),
        ({"budget_um": 5.0, "where": "walls"}, "budget_um"),
    ],
)
def test_what_makes_no_sense_together_is_refused(given: dict[str, object], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        Options.model_validate(given)
