"""Every file of the corpus there and back: its lines, its filament, its places, its modes.

What is added up, a reader adds up that shares nothing with the interpreter
(`tests.gcode.plain_reader`). `benchmarks/corpus.py` does the same with whole files.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from stillpath.gcode.errors import GcodeError
from stillpath.pipeline.compensate import compensate_file
from stillpath.pipeline.options import Options
from tests.e2e.round_trip import corpus_files, excerpt, flaws, made_to_fit, text_of
from tests.fuzz.machines import KINDS, machine_of
from tests.gcode.plain_reader import is_motion, read
from tests.gcode.states import differences

FIRMWARES = [k for k in KINDS if k not in ("prusa", "bambu")]
_LONG = "RepRapFirmware aborts the print at more than 255"
_CIRCLE = "mm off its circle"
REFUSED = {
    ("hm_arcs_planes_marlin", "klipper"): "Klipper's arcs do not take R; slice with I and J",
    ("hm_cnc_inches_g20_numbered", "klipper"): "Klipper has no G20",
    ("hm_laser_grbl", "klipper"): "Klipper's arcs do not take R",
    # It has no G5, and after it the tool is somewhere else.
    ("hm_arcs_planes_marlin", "reprapfirmware"): _CIRCLE,
    # Words without their G are nothing to it outside of its CNC mode.
    ("hm_cnc_inches_g20_numbered", "reprapfirmware"): _CIRCLE,
    ("hm_dialect_torture", "reprapfirmware"): "not a number",
    # Klipper's polygons of objects.
    ("klipper_excludeobj_multi", "reprapfirmware"): _LONG,
    ("real_bambustudio1", "reprapfirmware"): _LONG,
    ("real_orcaslicer2", "reprapfirmware"): _LONG,
}
"""What cannot be done, and what is said then."""
PAIRS = [
    (name, kind)
    for k, name in enumerate(corpus_files())
    for kind in FIRMWARES
    if kind in ("klipper", FIRMWARES[1 + k % 2]) or (Path(name).name.split(".")[0], kind) in REFUSED
]
"""Every file for Klipper and for one of the others, and what is refused."""


def test_the_plain_reader() -> None:
    found = read(
        b"G28\nG1 X5 Y5 E2 F600\nG92 E0\nG1 E1 X-3\nM83\ng1x7e.5 ; X99\nT1\nN7 G1 Z2 E1*33\n"
        b"G91\nG1 X1 E1\nM117 X50\nG92 X0\nG90\nG1 X-1\nM221 S50\nG1 E1\nG2 X3 Y4 I1 E1\n"
    )
    assert dict(found.extruded_mm) == pytest.approx({0: 3.5, 1: 3.0})
    assert found.position_mm == pytest.approx([11.0, 4.0, 2.0])
    assert found.low_mm == [-3.0, 4.0, 2.0]
    assert found.high_mm == [11.0, 5.0, 2.0]
    assert found.modes() == (True, False, 100.0, 50.0, 1)
    assert read(b"M83\nG90\nG1 E1\nG1 E3\n", "marlin").extruded_mm[0] == 3.0
    assert read(b"M83\nG90\nG1 E1\nG1 E3\n").extruded_mm[0] == 4.0
    motion = (b"G1 X1", b"g0y1", b"N1 G02 I1", b"G1 E.1")
    assert [is_motion(x) for x in (*motion, b"G1 F1", b"G10", b"G92 X1", b"")] == [True] * 4 + [
        False
    ] * 4


@pytest.mark.shared
@pytest.mark.slow
@pytest.mark.parametrize(("name", "kind"), PAIRS)
def test_round_trip(name: str, kind: str, tmp_path: Path, cache: Path, shared_dir: Path) -> None:
    # Klipper's files are the longest: what is read and split is the same for all firmwares.
    text = text_of(shared_dir / "corpus" / name)
    data = excerpt(text, head=2500 if kind == "klipper" else 800)
    machine = made_to_fit(machine_of(kind), data)
    source, target = tmp_path / "in.gcode", tmp_path / "out.gcode"
    source.write_bytes(data)
    reason = REFUSED.get((Path(name).name.split(".")[0], kind))
    for method in ("none", "fbf"):
        try:
            compensate_file(source, target, machine, Options(method=method), cache_dir=cache)
        except GcodeError as error:
            refused = error
        else:
            assert reason is None
            if method == "none":
                assert target.read_bytes() == data
            else:
                assert flaws(data, target.read_bytes(), machine) == []
                if kind == "klipper":
                    assert differences(data, target.read_bytes(), machine) == []
            continue
        assert source.read_bytes() == data
        assert [p.name for p in tmp_path.iterdir()] == ["in.gcode"]
        assert reason is not None, refused
        assert reason in str(refused)
        assert refused.line is not None
