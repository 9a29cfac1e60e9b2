"""The approximate inverses on the whole road: a file, or a reason."""

from __future__ import annotations

from pathlib import Path

import pytest

from compensation.base import INVERSIONS, DesignError
from models.store import load_machine
from service.pipeline.options import Options
from service.pipeline.road import compensate_file
from tests.gcode.cutting import HEAD
from tests.gcode.prints import polygon
from tests.gcode.states import differences, tagged

SMALL = (HEAD + "G1 X120 Y100 F6000\n" + "\n".join(polygon(6, 15)) + "\nG1 E-1 F2100\n").encode()


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.mark.parametrize("method", INVERSIONS)
def test_every_method_writes_a_better_file(tmp_path: Path, cache: Path, method: str) -> None:
    machine, data = load_machine("ender3"), tagged(SMALL)
    source, target = tmp_path / "in.gcode", tmp_path / "out.gcode"
    source.write_bytes(data)
    result = compensate_file(source, target, machine, Options(method=method), cache_dir=cache)
    assert result.put_back == []
    before, after = (
        next(c.extruding for c in result.channels if c.name == name) for name in ("before", "after")
    )
    assert after.contour_rms_um < 0.9 * before.contour_rms_um
    assert differences(data, target.read_bytes(), machine) == []


def test_a_machine_beyond_the_method_gets_the_reason_and_no_file(
    tmp_path: Path, cache: Path
) -> None:
    source, target = tmp_path / "in.gcode", tmp_path / "out.gcode"
    source.write_bytes(SMALL)
    with pytest.raises(DesignError, match=r"axis x: ebzpetc: .* use ts or fbf"):
        compensate_file(
            source,
            target,
            load_machine("taz6-x"),
            Options(method="ebzpetc"),
            cache_dir=cache,
        )
    assert not target.exists()
