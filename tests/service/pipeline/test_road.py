"""The whole road: a file in, a compensated and verified file out, with figures that hold."""

from __future__ import annotations

import gzip
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from compensation.base import DesignError
from compensation.registry import INVERSIONS
from gcode.errors import GcodeError
from gcode.interpreter import Interpreter
from models.machine import AxisTravel, Machine
from models.plants import plant_set
from models.reference_motion import reference_motion
from models.store import load_machine
from service.pipeline.measure import STRIDE, Measurement, MotionSamples
from service.pipeline.options import Options
from service.pipeline.progress import Cancelled, Progress
from service.pipeline.result import ErrorFigures, Result
from service.pipeline.road import compensate_file, plan_file
from service.pipeline.yardstick import BestShaper
from simulation.measures import contour_error
from simulation.response import response
from tests.gcode.cutting import HEAD
from tests.gcode.prints import polygon
from tests.gcode.states import differences, states, tagged

EXAMPLE = Path(__file__).parents[3] / "examples" / "ps_ender3_pauses_hept24f.gcode"
SMALL = (HEAD + "G1 X120 Y100 F6000\n" + "\n".join(polygon(6, 15)) + "\nG1 E-1 F2100\n").encode()


@pytest.fixture(scope="session")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


def wide(machine: Machine) -> Machine:
    """The machine with room for files of other printers."""
    travel = {axis: AxisTravel(min_mm=-5000, max_mm=5000) for axis in ("x", "y", "z")}
    return machine.model_copy(update={"travel": travel})


def extruding(result: Result, channel: str) -> ErrorFigures:
    return next(c.extruding for c in result.channels if c.name == channel)


def compensate(
    data: bytes, folder: Path, cache: Path, machine: str | Machine = "ender3", **options: object
) -> tuple[Result, bytes]:
    source, target = folder / "in.gcode", folder / "out.gcode"
    source.write_bytes(data)
    made = load_machine(machine) if isinstance(machine, str) else machine
    result = compensate_file(source, target, made, Options(**options), cache_dir=cache)
    assert source.read_bytes() == data
    assert sorted(p.name for p in folder.iterdir()) == ["in.gcode", "out.gcode"]
    return result, target.read_bytes()


def check_file(original: bytes, written: bytes, machine: Machine) -> None:
    """Lines, states, filament and travel of a written file."""
    assert differences(original, written, machine) == []
    ends = []
    for data in (original, written):
        reader = Interpreter(machine)
        for block in [*reader.push(data), *reader.flush()]:
            for k, axis in enumerate(("x", "y", "z")):
                known = (block.moves.known >> k & 1).astype(bool)
                travel = machine.travel[axis]
                assert np.all(block.moves.end_mm[known, k] >= travel.min_mm)
                assert np.all(block.moves.end_mm[known, k] <= travel.max_mm)
        ends.append(reader.position_mm)
    assert abs(ends[1][3] - ends[0][3]) < 1e-4


@pytest.mark.parametrize("name", ["ender3", "generic-corexy"])
def test_example(tmp_path: Path, cache: Path, name: str) -> None:
    data = tagged(b"".join(EXAMPLE.read_bytes().splitlines(keepends=True)[:1200]))
    result, written = compensate(data, tmp_path, cache, name)
    machine = load_machine(name)
    before, after = extruding(result, "before"), extruding(result, "after")
    assert after.contour_rms_um <= before.contour_rms_um / 4
    assert after.tracking_rms_um <= before.tracking_rms_um / 4
    assert result.put_back == []
    assert result.pieces > 3
    assert result.time_s <= 1.005 * result.original_time_s
    assert result.written_bytes == len(written)
    check_file(data, written, machine)
    first, *_, last = written.splitlines()
    assert first == last
    assert first.startswith(b"; Processed by stillpath ")


def test_stamped_file_is_refused(tmp_path: Path, cache: Path) -> None:
    _, written = compensate(SMALL, tmp_path, cache)
    again = tmp_path / "again"
    again.mkdir()
    (again / "in.gcode").write_bytes(written)
    with pytest.raises(GcodeError, match="line 1: this file was already processed by stillpath"):
        compensate(written, again, cache)
    with pytest.raises(GcodeError, match="already processed"):
        compensate(written, again, cache, method="none")
    assert [p.name for p in again.iterdir()] == ["in.gcode"]
    plan_file(again / "in.gcode", again / "motion.npz", load_machine("ender3"))
    with np.load(again / "motion.npz") as motion:
        assert motion["t"][0] == 0
        assert len(motion["x"]) > 1000


def test_method_none_returns_the_bytes(tmp_path: Path, cache: Path) -> None:
    for data in (SMALL, SMALL.rstrip(), SMALL.replace(b"\n", b"\r\n")):
        result, written = compensate(data, tmp_path, cache, method="none")
        assert written == data
        assert result.put_back == []


@pytest.mark.parametrize(
    "options",
    [{"method": "shaper:mzv"}, *({"method": name} for name in INVERSIONS), {"basis": "bspline"}],
)
def test_other_methods(tmp_path: Path, cache: Path, options: dict[str, str]) -> None:
    data = tagged(SMALL)
    result, written = compensate(data, tmp_path, cache, **options)
    assert result.put_back == []
    before, after = extruding(result, "before"), extruding(result, "after")
    assert after.contour_rms_um < 0.9 * before.contour_rms_um
    check_file(data, written, load_machine("ender3"))


@pytest.mark.slow
@pytest.mark.parametrize("method", ["zpetc", "npz-ignore", "shaper:mzv"])
def test_other_methods_stand_on_the_plan_in_rests(tmp_path: Path, cache: Path, method: str) -> None:
    # Motions end and begin between samples: with the command beside the plan's own rest, the
    # filament of a whole move would fall on a hundredth of a micrometre.
    result, written = compensate(EXAMPLE.read_bytes(), tmp_path, cache, method=method)
    assert result.put_back == []
    check_file(EXAMPLE.read_bytes(), written, load_machine("ender3"))


@pytest.mark.slow  # tunes the shaper of one more machine
def test_a_machine_beyond_the_method_gets_the_reason_and_no_file(
    tmp_path: Path, cache: Path
) -> None:
    with pytest.raises(DesignError, match=r"axis x: ebzpetc: .* use ts or fbf"):
        compensate(SMALL, tmp_path, cache, "taz6-x", method="ebzpetc")
    assert [p.name for p in tmp_path.iterdir()] == ["in.gcode"]


def test_same_bytes(tmp_path: Path, cache: Path) -> None:
    written = [compensate(SMALL, tmp_path, cache)[1] for _ in range(2)]
    assert written[0] == written[1]


def test_in_place(tmp_path: Path, cache: Path) -> None:
    _, expected = compensate(SMALL, tmp_path, cache)
    path = tmp_path / "in.gcode"
    compensate_file(path, path, load_machine("ender3"), Options(), cache_dir=cache)
    # The name of the file is no part of it.
    assert path.read_bytes() == expected


BAD = {
    "empty": (b"", None),
    "no moves": (b"; hello\nM104 S200\n", None),
    "unknown commands only": (b"FOO\nBAR X=1\n", None),
    "junk": (np.random.default_rng(3).bytes(5000), 0),
    "nan": (HEAD.encode() + b"G1 Xnan Y3\n", 7),
    "infinite": (HEAD.encode() + b"G1 X1e999 Y3\n", 7),
    "outside": (HEAD.encode() + b"G1 X90 Y3\nG1 X311\n", 8),
    "late": (SMALL * 20 + b"G1 X5000\n", 20 * SMALL.count(b"\n") + 1),
}


@pytest.mark.parametrize("name", BAD)
@pytest.mark.parametrize("method", ["fbf", "none"])
def test_bad_files(tmp_path: Path, cache: Path, name: str, method: str) -> None:
    data, line = BAD[name]
    source = tmp_path / "in.gcode"
    source.write_bytes(data)
    with pytest.raises(GcodeError) as caught:
        compensate_file(
            source, tmp_path / "out.gcode", load_machine("ender3"), Options(method=method),
            cache_dir=cache,
        )  # fmt: skip
    if line is None:
        assert "no moves" in str(caught.value)
    elif line:
        assert caught.value.line == line
    assert [p.name for p in tmp_path.iterdir()] == ["in.gcode"]
    assert source.read_bytes() == data


def test_cancelled(tmp_path: Path, cache: Path) -> None:
    source, target = tmp_path / "in.gcode", tmp_path / "out.gcode"
    source.write_bytes(SMALL)
    target.write_bytes(b"kept")
    calls: list[Progress] = []

    def stop(progress: Progress) -> None:
        calls.append(progress)
        if progress.stage == "compensating":
            raise Cancelled

    machine = load_machine("ender3")
    with pytest.raises(Cancelled):
        compensate_file(source, target, machine, Options(), cache_dir=cache, progress=stop)
    assert len(calls) >= 2
    assert target.read_bytes() == b"kept"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["in.gcode", "out.gcode"]


def test_progress_runs_to_the_end(tmp_path: Path, cache: Path) -> None:
    source = tmp_path / "in.gcode"
    source.write_bytes(SMALL * 3)
    seen: list[Progress] = []
    compensate_file(source, tmp_path / "o.gcode", load_machine("ender3"), Options(),
                    cache_dir=cache, progress=seen.append)  # fmt: skip
    fractions = [p.fraction for p in seen]
    assert fractions == sorted(fractions)
    assert (fractions[0], fractions[-1]) == (0.0, 1.0)
    assert seen[-1].print_seconds > 1


def test_tallies_are_the_whole_array_s() -> None:
    """The measurement, fed in uneven blocks, against one computation over everything."""
    machine = load_machine("ender3")
    path, feeds = reference_motion()
    path, feeds = path[:, :6000], feeds[:6000]
    n = path.shape[1]
    command = path + 0.02 * np.sin(np.arange(n) / 30.0)
    command[:, 0] = path[:, 0]
    measurement = Measurement(
        machine, 1e-3, BestShaper("mzv", 40.0, 40.0, 0.1, 0.0, 0.0), compensated=True
    )
    rng = np.random.default_rng(4)
    cuts = np.unique(np.concatenate([[0, n], rng.integers(0, n, 17)]))
    layer = (np.arange(n) // 2500).astype(np.int32)
    for a, b in pairwise(cuts.tolist()):
        part = slice(a, b)
        samples = MotionSamples(
            path_mm=path[:, part],
            executed_mm=command[:, part],
            z_mm=np.zeros(b - a),
            extruding=feeds[part],
            line=np.arange(a, b),
            layer=layer[part],
            feature=np.zeros(b - a, np.int32),
        )
        measurement.add(samples)
    measurement.finish()
    plants = [plant_set(machine.axes[a], 1e-3).nominal for a in ("x", "y")]
    channels = {c.name: c for c in measurement.channels()}
    for name, u in (("before", path), ("after", command)):
        y = response(plants, u)
        contour = 1e3 * contour_error(path, y, 1e-3, stride=STRIDE)
        tracking = 1e3 * np.hypot(*(y - path))
        some, figures = feeds[::STRIDE], channels[name].extruding
        assert figures.contour_rms_um == pytest.approx(rms(contour[some]), rel=1e-6)
        assert figures.contour_max_um == pytest.approx(contour[some].max(), rel=1e-6)
        assert figures.tracking_rms_um == pytest.approx(rms(tracking[feeds]), rel=1e-6)
        everything = channels[name].all_motion
        assert everything.contour_rms_um == pytest.approx(rms(contour), rel=1e-6)
        for k, group in enumerate(measurement.layers()):
            mine = contour[(layer[::STRIDE] == k) & some]
            assert group.contour_rms_um[name] == pytest.approx(rms(mine), rel=1e-6)
        bins = measurement.track().contour_rms_um[name]
        assert len(bins) == -(-n // 1000)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def corpus(shared_dir: Path, name: str, lines: int | None = None) -> bytes:
    data = gzip.decompress((shared_dir / "corpus" / name).read_bytes())
    return tagged(b"".join(data.splitlines(keepends=True)[:lines]))


def permissive(machine: Machine) -> Machine:
    """Without the cross-section check, which refuses the purge line of Prusa's profiles."""
    extruder = machine.firmware.extruder.model_copy(update={"max_extrude_cross_section_mm2": 10.0})
    firmware = machine.firmware.model_copy(update={"extruder": extruder})
    return wide(machine).model_copy(update={"firmware": firmware})


@pytest.mark.shared
@pytest.mark.parametrize(
    ("name", "machine", "lines"),
    [
        ("own/klipper_excludeobj_multi", "voron-v0", None),
        ("own/cura_ender3_gear24", "ender3", 12000),
        ("own/ps_mk3s_gyroid_medium", "ender3", 3000),
        ("own/ps_mk3s_vase", "ender3", 2000),
    ],
)
def test_real_prints(
    tmp_path: Path, cache: Path, shared_dir: Path, name: str, machine: str, lines: int | None
) -> None:
    data = corpus(shared_dir, f"{name}.gcode.gz", lines)
    used = permissive(load_machine(machine))
    result, written = compensate(data, tmp_path, cache, used)
    assert result.put_back_extruding_share <= 0.01
    assert result.time_s <= 1.005 * result.original_time_s
    before, after = extruding(result, "before"), extruding(result, "after")
    assert after.contour_rms_um <= max(0.1 * before.contour_rms_um, 1.5)
    check_file(data, written, used)
    if "excludeobj" in name:
        assert result.put_back == []
        check_marks(data, written, used)


def check_marks(original: bytes, written: bytes, machine: Machine) -> None:
    """The first travel behind every object mark is the slicer's, at the slicer's limits."""
    old, new = (states(d, machine) for d in (original, written))
    travels = []
    for lines in (old, new):
        found, marked = [], False
        for state in lines:
            marked = marked or state.text.startswith((b"EXCLUDE_OBJECT_START", b"EXCLUDE_OBJECT_E"))
            if marked and state.kind < 0 and state.moves_xy:
                found.append(state)
                marked = False
        travels.append(found)
    assert len(travels[0]) > 50
    for a, b in zip(*travels, strict=True):
        assert a.text == b.text
        assert a.limits == b.limits
        assert a.speed_mm_s == pytest.approx(b.speed_mm_s)
        assert not b.stream


def all_files(folder: str) -> list[str]:
    beside = Path(__file__).parents[4] / "shared" / "corpus" / folder
    return [f"{folder}/{p.name}" for p in sorted(beside.glob("*.gz"))] if beside.is_dir() else []


@pytest.mark.shared
@pytest.mark.slow
@pytest.mark.parametrize("name", [*all_files("own"), *all_files("third_party")])
def test_every_file(tmp_path: Path, cache: Path, shared_dir: Path, name: str) -> None:
    """Each ends as a good file or as an error that names a line; nothing else happens."""
    data = corpus(shared_dir, name, 8000)
    used = permissive(load_machine("ender3"))
    try:
        _, written = compensate(data, tmp_path, cache, used)
    except GcodeError as error:
        refused = error
    else:
        check_file(data, written, used)
        return
    assert refused.line is not None or "no moves" in str(refused)
    assert [p.name for p in tmp_path.iterdir()] == ["in.gcode"]
