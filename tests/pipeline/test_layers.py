"""Layers of a whole print: what the tiles say, against numbers computed another way."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal

from stillpath.gcode.errors import GcodeError
from stillpath.gcode.firmware.encoding import as_moves
from stillpath.gcode.types import Moves, rows_of
from stillpath.models.machine import Machine
from stillpath.models.plants import PlantSetSpec
from stillpath.models.store import load_machine
from stillpath.pipeline.compensate import compensate_file
from stillpath.pipeline.measuring import _layer_kernels as kernels
from stillpath.pipeline.measuring import layers as layers_module
from stillpath.pipeline.measuring.layers import UNKNOWN, LayerRecorder, LayerTile
from stillpath.pipeline.options import Options
from stillpath.pipeline.simulate import plan_file, simulate_file
from tests.gcode.cutting import HEAD
from tests.gcode.prints import polygon
from tests.pipeline.tiles import read_tiles

EXAMPLE = Path(__file__).parents[2] / "examples" / "ps_ender3_pauses_hept24f.gcode"
SMALL = (
    HEAD
    + "G1 X5 Y5 F6000\nG1 X60 E4\n;LAYER_CHANGE\n;Z:0.2\nG1 Z0.2\nG1 X120 Y100 F6000\n"
    + ";TYPE:External perimeter\n"
    + "\n".join(polygon(6, 15))
    + "\n;LAYER_CHANGE\n;Z:0.4\nG1 Z0.4\n;TYPE:Solid infill\nG1 X30 Y30\nG1 X90 Y30 E9 F3000\n"
    + "G28 X Y\nG1 X40 Y40 F6000\nG1 X80 Y40 E9 F3000\n"
)


def with_modes(f_hz: tuple[float, float], zeta: float) -> Machine:
    machine = load_machine("ender3")
    axes = {
        axis: PlantSetSpec.model_validate(
            {"nominal": {"kind": "modes", "modes": [{"f_hz": f, "zeta": zeta}]}}
        )
        for axis, f in zip(("x", "y"), f_hz, strict=True)
    }
    return Machine.model_validate(machine.model_dump() | {"axes": axes})


def distance(path: np.ndarray, point: np.ndarray) -> float:
    """Distance from a point to a polyline (2, n), plainly."""
    a, b = path[:, :-1], path[:, 1:]
    d = b - a
    size = np.maximum(np.sum(d * d, axis=0), 1e-30)
    along = np.clip(np.sum((point[:, None] - a) * d, axis=0) / size, 0.0, 1.0)
    return float(np.min(np.linalg.norm(a + along * d - point[:, None], axis=0)))


def test_a_corner_against_a_simulation_of_its_own(tmp_path: Path, cache: Path) -> None:
    """A mass on a spring at a corner: the differential equation by scipy, distances plainly."""
    machine = with_modes((32.0, 27.0), 0.06)
    source = tmp_path / "in.gcode"
    source.write_text(HEAD + "G1 X60 Y60 F6000\nG1 X100 Y60 E3 F4800\nG1 X100 Y95 E3\n")
    simulate_file(source, machine, cache_dir=cache, layers=tmp_path / "report")
    _, tiles = read_tiles(tmp_path / "report")

    plan_file(source, tmp_path / "plan.npz", machine)
    with np.load(tmp_path / "plan.npz") as planned:
        path = np.stack([planned["x"], planned["y"]])
    t = 1e-3 * np.arange(path.shape[1])
    answers = []
    for row, f_hz in zip(path, (32.0, 27.0), strict=True):
        w = 2 * np.pi * f_hz
        system = signal.StateSpace([[0, 1], [-(w**2), -2 * 0.06 * w]], [[0], [w**2]], [[1, 0]], [0])
        answers.append(signal.lsim(system, row - row[0], t)[1] + row[0])
    y = np.stack(answers)
    span = np.arange(path.shape[1])
    error = np.array([distance(path[:, max(k - 80, 0) : k + 81], y[:, k]) for k in span])

    (tile,) = [tile for tile in tiles if tile.on.any()]
    second = np.flatnonzero(tile.line == tile.line[tile.on > 0][-1])
    assert len(second) > 12  # the ringing along the edge is not one number
    ends = np.array([tile.x, tile.y], dtype=float)
    measured = np.abs(path[0] - 100.0) < 1e-3
    seen = 0
    for k in second:
        stretch = measured & (path[1] > ends[1, k - 1] + 1e-4) & (path[1] < ends[1, k] + 1e-4)
        if stretch.any() and ends[1, k] < 94.0:
            seen += 1
            found_um = 0.1 * tile.error["before"][k]
            assert found_um == pytest.approx(1e3 * error[stretch].max(), abs=0.1)
    moving = (np.abs(path[0] - 100.0) < 1e-3) & (path[1] < 94.0)
    inside = second[ends[1, second] < 94.0]
    largest = 0.1 * tile.error["before"][inside].max()
    assert largest == pytest.approx(1e3 * error[moving].max(), rel=0.02)
    assert largest > 20.0


def test_every_layer_every_corner(tmp_path: Path, cache: Path) -> None:
    source = tmp_path / "in.gcode"
    source.write_text(SMALL)
    machine = load_machine("ender3")
    result = compensate_file(
        source,
        tmp_path / "out.gcode",
        machine,
        Options(),
        cache_dir=cache,
        layers=tmp_path / "report",
    )
    index, tiles = read_tiles(tmp_path / "report")
    assert index["version"] == 1
    assert index["channels"] == [c.name for c in result.channels] == ["before", "after", "shaper"]
    assert [t.entry["n"] for t in tiles] == [-1, 0, 1]
    assert [t.entry["z_mm"] for t in tiles][1:] == [0.2, 0.4]
    assert [index["features"][k] for k in sorted(set(np.concatenate([t.feature for t in tiles])))
            if k < 255] == ["outer wall (External perimeter)", "solid infill"]  # fmt: skip
    # Figures of a layer are those of the report.
    named = {group.name: group for group in result.layers}
    for tile in tiles:
        group = named[tile.entry["name"]]
        assert tile.entry["seconds"] == pytest.approx(group.seconds, abs=2e-3)
        for name in index["channels"]:
            rms, largest = group.contour_rms_um[name], group.contour_max_um[name]
            assert tile.entry["rms_um"][name] == pytest.approx(rms, abs=0.006)
            # The report's counts what rings after the ends of lines too.
            printed = tile.entry["max_um"][name]
            assert printed <= largest + 0.006
            drawn = tile.error[name][(tile.on > 0) & (tile.error[name] < UNKNOWN)]
            assert 0.1 * drawn.max() >= printed - 0.06
    # Every corner of the file stands there, under its line, with travel and extrusion.
    lines = SMALL.split("\n")
    for tile in tiles:
        assert tile.on[0] == 0
        assert all(column[0] == UNKNOWN for column in tile.error.values())
        for k in range(1, len(tile.line)):
            assert lines[int(tile.line[k]) - 1].startswith(("G1 X", "G28"))
    (last,) = tiles[-1:]
    end = np.flatnonzero(last.line == len(lines) - 1)[-1]
    assert (last.x[end], last.y[end], last.on[end]) == (80.0, 40.0, 1)
    # After homing nobody knows how the nozzle came there.
    lifted = np.flatnonzero(last.error["before"] == UNKNOWN)
    assert len(lifted) == 2
    assert last.on[lifted[1]] == 0
    assert index["bounds_mm"][0] >= 30.0


def test_sliders_top_is_a_round_number(tmp_path: Path, cache: Path) -> None:
    source = tmp_path / "in.gcode"
    source.write_text(SMALL)
    simulate_file(source, load_machine("ender3"), cache_dir=cache, layers=tmp_path)
    index, tiles = read_tiles(tmp_path)
    assert index["channels"] == ["before", "shaper"]
    values = 0.1 * np.concatenate([t.error["before"][t.on > 0] for t in tiles])
    assert np.mean(values > index["scale_um"]) <= 0.01
    assert index["scale_um"] / 10 ** np.floor(np.log10(index["scale_um"])) in (
        pytest.approx(f) for f in (1, 1.5, 2, 3, 4, 5, 6, 8)
    )


def test_same_bytes_and_no_other_file(tmp_path: Path, cache: Path) -> None:
    machine, source = load_machine("ender3"), tmp_path / "in.gcode"
    source.write_text(SMALL)
    found, written = [], []
    for name in ("one", "two"):
        target = tmp_path / f"{name}.gcode"
        compensate_file(source, target, machine, Options(), cache_dir=cache, layers=tmp_path / name)
        assert sorted(p.name for p in (tmp_path / name).iterdir()) == ["layers.bin", "layers.json"]
        written.append(hashlib.sha256(target.read_bytes()).hexdigest())
        found.append([p.read_bytes() for p in sorted((tmp_path / name).iterdir())])
    plain = tmp_path / "plain.gcode"
    compensate_file(source, plain, machine, Options(), cache_dir=cache)
    assert hashlib.sha256(plain.read_bytes()).hexdigest() == written[0] == written[1]
    assert found[0] == found[1]


def test_a_failure_leaves_nothing(tmp_path: Path, cache: Path) -> None:
    source = tmp_path / "in.gcode"
    source.write_text(SMALL * 30 + "G1 X9000 F6000\n")
    with pytest.raises(GcodeError):
        compensate_file(
            source,
            tmp_path / "out.gcode",
            load_machine("ender3"),
            Options(),
            cache_dir=cache,
            layers=tmp_path / "report",
        )
    assert [p for p in tmp_path.rglob("*") if p.is_file()] == [source]


def test_a_file_without_marks_has_a_tile_for_each_height(tmp_path: Path, cache: Path) -> None:
    source = tmp_path / "in.gcode"
    text = HEAD
    for k in range(4):
        text += f"G1 Z{0.2 * (k + 1):.1f} F600\nG1 X30 Y30 F6000\nG1 X60 Y30 E2\nG1 X60 Y60 E2\n"
    source.write_text(text)
    simulate_file(source, load_machine("ender3"), cache_dir=cache, layers=tmp_path)
    _, tiles = read_tiles(tmp_path)
    assert {t.entry["n"] for t in tiles} == {-1}
    assert [t.entry["z_mm"] for t in tiles if t.on.any()] == pytest.approx([0.2, 0.4, 0.6, 0.8])


def test_points_cost_no_more_than_the_text(tmp_path: Path, cache: Path, monkeypatch) -> None:
    """Without what small files are granted, a file's points fit into the bytes of its moves."""
    monkeypatch.setattr(layers_module, "_GRANTED", 0)
    simulate_file(EXAMPLE, load_machine("ender3"), cache_dir=cache, layers=tmp_path)
    assert (tmp_path / "layers.bin").stat().st_size <= EXAMPLE.stat().st_size


def test_arcs_need_few_points(tmp_path: Path, cache: Path) -> None:
    source = tmp_path / "in.gcode"
    source.write_text(HEAD + "G1 X60 Y60 F6000\nG2 X60 Y60 I20 J0 E9 F3000\n")
    simulate_file(source, load_machine("ender3"), cache_dir=cache, layers=tmp_path)
    _, tiles = read_tiles(tmp_path)
    (tile,) = [t for t in tiles if t.on.any()]
    on = np.flatnonzero(tile.on)
    # Chords between points stay this close to the circle.
    middle = 0.5 * np.array([tile.x[on] + tile.x[on - 1], tile.y[on] + tile.y[on - 1]], float)
    assert np.max(np.abs(np.hypot(middle[0] - 80.0, middle[1] - 60.0) - 20.0)) < 0.05


# ---- the kernel by itself -----------------------------------------------------------------


def made_moves(rng: np.random.Generator, count: int) -> Moves:
    """Edges of a random path with layers that change now and then, and some that stand."""
    corner = np.cumsum(rng.normal(0, 3, (count + 1, 2)), axis=0)
    stands = rng.random(count) < 0.15
    for k in np.flatnonzero(stands):
        corner[k + 1] = corner[k]
    e = np.concatenate([[0], np.cumsum(np.where(rng.random(count) < 0.7, 0.3, 0.0))])
    z = np.full(count + 1, 0.2)
    position = np.column_stack([corner, z, e])
    line = np.arange(10, 10 + count)
    moves = as_moves(position[:-1], position[1:], np.ones(count), line.astype(np.int32))
    return replace(
        moves,
        line=line,
        byte_start=20 * line,
        byte_end=20 * line + rng.integers(15, 40, count),
        layer=np.cumsum(rng.random(count) < 0.1).astype(np.int32),
        feature=rng.integers(-1, 4, count).astype(np.int32),
    )


def made_samples(
    rng: np.random.Generator, moves: Moves
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    row = np.repeat(np.arange(len(moves)), rng.integers(0, 6, len(moves)))
    share = np.concatenate([np.sort(rng.random(n)) for n in np.bincount(row, minlength=len(moves))])
    along = moves.start_mm[row] + share[:, None] * (moves.end_mm - moves.start_mm)[row]
    extruding = moves.end_mm[row, 3] > moves.start_mm[row, 3]
    error = np.abs(rng.normal(0, 0.03, (2, len(row))))
    return along[:, :2].T.copy(), along[:, 2].copy(), extruding, row, error


def recorded(
    moves: Moves, samples: tuple[np.ndarray, ...], cuts: list[int], parts: list[int]
) -> list[LayerTile]:
    """Feed samples in blocks; moves in tables that begin anew at `parts`."""
    tiles: list[LayerTile] = []
    recorder = LayerRecorder(2, 6e-3, [tiles.append])
    xy, z, extruding, row, error = samples
    edges = [0, *parts, len(moves)]
    for first, last in pairwise(edges):
        table = rows_of(moves, slice(first, last))
        mine = np.flatnonzero((row >= first) & (row < last))
        if len(mine) == 0:
            continue
        inner = [c for c in cuts if mine[0] < c <= mine[-1]]
        for a, b in pairwise([int(mine[0]), *inner, int(mine[-1]) + 1]):
            recorder.add(
                xy[:, a:b], z[a:b], extruding[a:b], row[a:b] - first, table, first, error[:, a:b]
            )
    recorder.finish()
    return tiles


def same(one: list[LayerTile], other: list[LayerTile]) -> bool:
    return len(one) == len(other) and all(
        a.layer == b.layer
        and a.seconds == b.seconds
        and all(
            np.array_equal(getattr(a, n), getattr(b, n))
            for n in ("x_mm", "y_mm", "line", "error", "feature", "on", "rms_um", "max_um")
        )
        for a, b in zip(one, other, strict=True)
    )


@settings(max_examples=60)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(2, 60))
def test_tiles_hold_what_was_measured(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    moves = made_moves(rng, count)
    samples = made_samples(rng, moves)
    _, _, extruding, row, error = samples
    if len(row) == 0:
        return
    tiles = recorded(moves, samples, [], [])
    cuts = sorted(set(rng.integers(0, len(row), 5).tolist()))
    assert same(tiles, recorded(moves, samples, cuts, []))

    # Corners: of every move with a way, from the first that was seen, in order.
    points = [
        (float(x), float(y))
        for tile in tiles
        for x, y in zip(tile.x_mm[1:], tile.y_mm[1:], strict=True)
    ]
    place = 0
    for k in range(int(row[0]), count):
        if np.any(moves.end_mm[k, :2] != moves.start_mm[k, :2]):
            corner = tuple(float(v) for v in moves.end_mm[k, :2].astype(np.float32))
            place = points.index(corner, place) + 1
    # Largest errors: line by line, no sample is lost and none is invented.
    units = np.floor(1e4 * error + 0.5)
    way = np.any(moves.end_mm[:, :2] != moves.start_mm[:, :2], axis=1)
    for k in np.unique(row[way[row]]):
        stretch = [t.error[:, t.line == moves.line[k]] for t in tiles]
        found = np.concatenate(stretch, axis=1)
        found = found[:, found[0] != UNKNOWN]
        if k == 0 or way[k - 1]:
            assert np.all(found.max(axis=1) == units[:, row == k].max(axis=1))
        else:  # what was measured standing in front of it counts here
            assert np.all(found.max(axis=1) >= units[:, row == k].max(axis=1))
    # Layers: sums over their own samples.
    for tile in tiles:
        own = (moves.layer[row] == tile.layer) & extruding
        assert tile.seconds == pytest.approx(6e-3 * np.count_nonzero(own))
        if own.any():
            assert tile.rms_um == pytest.approx(1e3 * np.sqrt(np.mean(error[:, own] ** 2, axis=1)))
            assert tile.max_um == pytest.approx(1e3 * error[:, own].max(axis=1))


@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_compiled_loop_agrees_with_plain_python(seed: int) -> None:
    """The compiled loop and the same lines run by Python."""
    rng = np.random.default_rng(seed)
    moves = made_moves(rng, 30)
    samples = made_samples(rng, moves)
    if len(samples[3]) == 0:
        return
    parts = sorted(set(rng.integers(1, 29, 2).tolist()))
    compiled = recorded(moves, samples, [], parts)
    with pytest.MonkeyPatch.context() as patch:
        plain = kernels.follow.py_func  # type: ignore[attr-defined]
        patch.setitem(plain.__globals__, "_add", kernels._add.py_func)  # type: ignore[attr-defined]
        patch.setattr(kernels, "follow", plain)
        assert same(compiled, recorded(moves, samples, [], parts))


def test_a_layer_of_many_points_is_several_tiles(monkeypatch) -> None:
    rng = np.random.default_rng(3)
    moves = replace(made_moves(rng, 200), layer=np.zeros(200, np.int32))
    samples = made_samples(rng, moves)
    (whole,) = recorded(moves, samples, [], [])
    monkeypatch.setattr(layers_module, "TILE_POINTS", 32)
    parts = recorded(moves, samples, [], [])
    assert len(parts) > 5
    assert max(map(len, parts)) <= 32
    for name in ("x_mm", "y_mm", "line", "on"):
        joined = np.concatenate([getattr(t, name)[min(k, 1) :] for k, t in enumerate(parts)])
        assert np.array_equal(joined, getattr(whole, name))
    for one, other in pairwise(parts):
        assert (one.x_mm[-1], one.y_mm[-1]) == (other.x_mm[0], other.y_mm[0])
