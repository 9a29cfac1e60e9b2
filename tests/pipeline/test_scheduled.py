"""The pipeline along a schedule: what lies on the bed, the written file, figures and notes."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from stillpath.gcode.interpreter import Interpreter
from stillpath.gcode.types import Moves
from stillpath.models.machine import Machine
from stillpath.models.plants import FirSpec, PlantSetSpec
from stillpath.models.provenance import Provenance
from stillpath.models.schedule import AxisSchedule, GridNode, GridSchedule, MassSchedule
from stillpath.models.store import load_machine
from stillpath.pipeline.band import NOTABLE_UM, BandContent
from stillpath.pipeline.operating_point import Operation
from stillpath.pipeline.simulate import simulate_file
from tests.checkout import PYTHONPATH
from tests.compensating import compensated

ROOT = Path(__file__).resolve().parents[2]
KG_PER_MM = 1e-6 * 1.24 * 0.25 * math.pi * 1.75**2

HEAD = "G28\nG90\nM83\nM204 S1500\n"


def bedslinger(moving_kg: float | None = 0.8, density: float = 1.24) -> Machine:
    machine = load_machine("generic-bedslinger")
    # Nobody says that its plants were typed in: they are designed for.
    axes = {a: p.model_copy(update={"provenance": None}) for a, p in machine.axes.items()}
    machine = machine.model_copy(update={"axes": axes})
    if moving_kg is None:
        return machine
    mass = MassSchedule(moving_mass_kg=moving_kg, filament_density_g_cm3=density)
    return machine.model_copy(update={"schedules": {"y": AxisSchedule(mass=mass)}})


def block(layers: int = 6) -> str:
    """Squares upon squares, a retraction and a hop between them; 40 mm of filament each."""
    lines = [HEAD]
    for k in range(layers):
        z = 0.2 * (k + 1)
        lines += [f";LAYER:{k}", "G1 E-0.8 F2100", f"G1 Z{z + 0.4:.2f} F900"]
        lines += ["G1 X60 Y60 F9000", f"G1 Z{z:.2f} F900", "G1 E0.8 F2100"]
        lines += [
            f"G1 X{x} Y{y} E10 F5400" for x, y in ((160, 60), (160, 160), (60, 160), (60, 60))
        ]
        lines += ["M400"]
    return "\n".join([*lines, ""])


def moves_of(text: str, machine: Machine) -> list[Moves]:
    reader = Interpreter(machine)
    return [b.moves for b in [*reader.push(text.encode()), *reader.flush()] if len(b.moves)]


@pytest.mark.parametrize(
    ("text", "laid_mm"),
    [
        ("G1 X50 E10 F3000\nG1 E-2 F1800\nG1 X60\nG1 E2 F1800\nG1 X70 E5", 15.0),
        # What was pulled back while moving (wipe) comes back while moving.
        ("G1 X50 E10 F3000\nG1 X48 E-1\nG1 X50 E3", 12.0),
        # An unretraction with extra, and a purge where the nozzle stands, do not lie on the bed.
        ("G1 E30 F300\nG1 X50 E10 F3000\nG1 E-1 F1800\nG1 E1.5 F1800\nG1 X60 E1", 11.0),
        ("M82\nG92 E0\nG1 X50 E10 F3000\nG92 E0\nG1 X60 E10", 20.0),
        ("G10\nG11\nG1 X50 E10 F3000\nM221 S150\nG1 X60 E10", 25.0),
        # Changes of filament: loaded again by the firmware, or by the file where the nozzle stands.
        ("G1 X50 E10 F3000\nG1 E-80 F1800\nM600\nG1 X60 E5\nG1 X20 E5", 20.0),
        ("G1 X50 E10 F3000\nG1 E-80 F1800\nT1\nG1 E81 F1800\nG1 X60 E5\nG1 X20 E5", 20.0),
        ("G1 X50 E10 F3000\nG1 E-15 F1800\nG1 E-65\nT0\nG1 X60 E5\nG1 E-2\nG1 X9 E4", 17.0),
    ],
)
def test_what_lies_on_the_bed(text: str, laid_mm: float) -> None:
    machine = bedslinger()
    operation = Operation(machine)
    for moves in moves_of(f"{HEAD}G1 X20 Y20 Z0.2 F3000\n{text}\n", machine):
        operation.passed(moves)
    assert operation.printed_kg == pytest.approx(laid_mm * KG_PER_MM, rel=1e-6)


def test_an_axis_without_a_resonance_beside_one_that_grows_heavier() -> None:
    machine = bedslinger()
    rigid = PlantSetSpec(nominal=FirSpec(taps=(1.0,), dt_s=1e-3))
    machine = machine.model_copy(update={"axes": {**machine.axes, "x": rigid}})
    operation = Operation(machine)
    operation.at(moves_of("G28\nG1 X50 Y9 F3000\n", machine)[0])
    (note,) = operation.notes()
    assert note.startswith("The plant of axis y follows the mass on the bed")


def test_a_heavy_print_is_told_where_nothing_follows_it() -> None:
    corexy = load_machine("generic-corexy")
    for machine, filament_mm, told in (
        (bedslinger(None), 60_000.0, True),
        (bedslinger(None), 40_000.0, False),
        (bedslinger(100.0), 60_000.0, False),
        (corexy, 60_000.0, False),
    ):
        operation = Operation(machine)
        lines = "".join(f"G1 X{50 + k % 2} E{filament_mm / 100:g}\n" for k in range(100))
        for moves in moves_of(f"{HEAD}G1 X20 Y20 Z0.2 F3000\n{lines}", machine):
            operation.passed(moves)
        heavy = [note for note in operation.notes() if "weighs" in note]
        assert bool(heavy) == told
        if told:
            assert f"{1e3 * filament_mm * KG_PER_MM:.0f} g" in heavy[0]
            assert operation.at(moves).mass_kg == 0.0


def test_where_a_piece_is() -> None:
    machine = bedslinger()
    (moves,) = moves_of(f"{HEAD}G1 X20 Y20 Z9 F3000\nG1 Z0.3\nG1 X50 E10\nG1 X70 E10\n", machine)
    operation = Operation(machine)
    point = operation.at(moves)
    assert (point.x_mm, point.y_mm, point.z_mm) == (20.0, 20.0, 0.3)
    # At half of its own filament.
    assert point.mass_kg == pytest.approx(10 * KG_PER_MM)
    operation.passed(moves)
    assert operation.printed_kg == pytest.approx(20 * KG_PER_MM)
    assert Operation(bedslinger(None)).at(moves).mass_kg == 0.0
    # Moves that shall stay as they are lie somewhere, too.
    kept = moves_of(f"{HEAD}; STILLPATH_OFF\nG1 X20 Y20 Z9 F3000\nG1 X50 E10\n", machine)
    assert Operation(machine).at(kept[0]).z_mm == 9.0


def test_one_operating_point_writes_the_same_bytes(tmp_path: Path, cache: Path) -> None:
    plain, expected = compensated(block(), tmp_path, cache, bedslinger(None))
    result, written = compensated(block(), tmp_path, cache, bedslinger(1e5))
    # Only the stamps name the machine's revision.
    stamp, lines = b"; Processed by stillpath", [x.splitlines() for x in (written, expected)]
    ours, theirs = ([x for x in each if stamp not in x] for each in lines)
    assert ours == theirs
    assert lines[0][0] != lines[1][0]
    figures, wanted = (one.channels[1].extruding.model_dump() for one in (result, plain))
    assert figures == pytest.approx(wanted, rel=1e-8)
    assert plain.notes == []


def test_follows_the_print(tmp_path: Path, cache: Path) -> None:
    """A light bed: 40 g of print beside 50 g of bed, on the way up."""
    machine = bedslinger(0.05, density=12.4)
    result, written = compensated(block(16), tmp_path, cache, machine)
    assert result.put_back == []
    (note,) = result.notes
    printed_kg = 16 * 40 * 10 * KG_PER_MM
    assert f"{printed_kg:.3f} kg at the end" in note
    lowest_hz = 35.0 / math.sqrt(1 + (printed_kg - 20 * 10 * KG_PER_MM) / 0.05)
    assert f"{lowest_hz:.1f}"[:3] in note
    before, after = (c.extruding.contour_rms_um for c in result.channels[:2])
    assert after < 0.15 * before
    # The same file made for the bed as it was.
    _, fixed = compensated(block(16), tmp_path, cache, bedslinger(None))
    assert fixed.splitlines()[1:] != written.splitlines()[1:]
    again, same = compensated(block(16), tmp_path, cache, machine)
    assert same == written
    assert again.channels == result.channels


def test_prediction_follows_too(tmp_path: Path, cache: Path) -> None:
    source = tmp_path / "in.gcode"
    source.write_text(block(16))
    heavy = bedslinger(0.05, density=12.4)
    result, plain = (simulate_file(source, m, cache_dir=cache) for m in (heavy, bedslinger(None)))
    assert "kg at the end" in result.notes[0]
    both = zip(result.layers, plain.layers, strict=True)
    gains = [a.contour_rms_um["before"] / b.contour_rms_um["before"] for a, b in both]
    # A lower resonance vibrates more; the prediction moves in blocks of the file.
    assert gains[-1] > 1.2


def test_plants_follow_the_height(tmp_path: Path, cache: Path) -> None:
    spec = load_machine("generic-bedslinger").axes["x"].nominal
    nodes = tuple(GridNode(z_mm=z, plant=spec.scaled(f, 1.0)) for z, f in ((0, 1.0), (2, 0.8)))
    machine = bedslinger(None).model_copy(
        update={"schedules": {"x": AxisSchedule(grid=GridSchedule(nodes=nodes))}}
    )
    result, _ = compensated(block(10), tmp_path, cache, machine)
    assert "position in z: its lowest resonance was between 36.0 and 45.0 Hz." in result.notes[0]
    assert result.channels[1].extruding.contour_rms_um < 1.5


def banded(high_hz: float | None, trust_hz: float | None = None) -> Machine:
    machine = bedslinger(None)
    update: dict[str, object] = {"band_hz": high_hz and (5.0, high_hz)}
    if trust_hz is not None:
        update["provenance"] = Provenance(kind="spectrum", trust_below_hz=trust_hz)
    axes = {**machine.axes, "y": machine.axes["y"].model_copy(update=update)}
    return machine.model_copy(update={"axes": axes})


def test_content_of_a_sine() -> None:
    content = BandContent(banded(60.0), 1e-3)
    t = 1e-3 * np.arange(20_000)
    path = np.stack([50.0 * t, 0.02 * np.sin(2 * np.pi * 80.0 * t)])
    for part in np.array_split(np.arange(20_000), 37):
        content.add(path[:, part], np.ones(len(part), bool))
    assert content.beyond_um(60.0)[1] == pytest.approx(20.0 / math.sqrt(2), rel=0.02)
    assert content.beyond_um(60.0)[0] < 1e-3
    assert content.beyond_um(90.0)[1] < 0.1
    (warning,) = content.warnings()
    assert "Axis y: 14.1 µm rms of the planned motion lie above 60 Hz" in warning
    assert NOTABLE_UM > 0.5


def test_band_is_warned_of(tmp_path: Path, cache: Path) -> None:
    narrow, _ = compensated(block(3), tmp_path, cache, banded(25.0))
    assert any("Axis y" in w and "above 25 Hz" in w for w in narrow.warnings)
    phase, _ = compensated(block(3), tmp_path, cache, banded(None, 20.0))
    assert any("above 20 Hz, where its model cannot be trusted" in w
               for w in phase.warnings)  # fmt: skip
    wide, _ = compensated(block(3), tmp_path, cache, banded(130.0))
    assert not any("planned motion" in w for w in wide.warnings)


@pytest.mark.slow
def test_bed_that_grows_heavier(tmp_path: Path) -> None:
    """The benchmark, on a bed and a print of a quarter of the mass."""
    report = tmp_path / "rows.json"
    script = ROOT / "benchmarks" / "bed_slinger.py"
    chosen = ["--kg", "0.125", "--moving-kg", "0.2", "--json", str(report)]
    environment = os.environ | {"PYTHONPATH": PYTHONPATH, "XDG_CACHE_HOME": str(tmp_path)}
    subprocess.run([sys.executable, str(script), *chosen], check=True, env=environment)
    none, fixed, scheduled = json.loads(report.read_text())
    assert none["last_rms"] > fixed["last_rms"] > 5 * scheduled["last_rms"]
    assert scheduled["predicted_rms"] == pytest.approx(scheduled["all_rms"], rel=0.15)
