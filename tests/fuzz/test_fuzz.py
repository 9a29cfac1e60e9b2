"""Slices of what `benchmarks/fuzz.py` and `hostile.py` do at length, and what they found."""

from __future__ import annotations

import gzip
import random
from pathlib import Path

import pytest

from stillpath.gcode.detection import detect
from stillpath.gcode.errors import GcodeError
from stillpath.gcode.firmware.registry import adapter
from stillpath.gcode.interpreter import Interpreter
from stillpath.gcode.slicers.facts import facts_in
from stillpath.pipeline.piece_compensator import PieceCompensator
from tests.fuzz.checks import read_through, through_the_pipeline, walk
from tests.fuzz.grammar import written
from tests.fuzz.hostile import HOSTILE, pieces
from tests.fuzz.layers import layered
from tests.fuzz.machines import KINDS, machine_of
from tests.fuzz.mutations import excerpts
from tests.gcode.states import tagged

EXAMPLES = sorted((Path(__file__).parents[2] / "examples").glob("*_*.gcode"))


def test_damage_is_the_seed_s() -> None:
    files = [path.read_bytes() for path in EXAMPLES]
    made = [list(excerpts(files, 30_000, random.Random(seed))) for seed in (1, 1, 2)]
    assert made[0] == made[1]
    assert made[0] != made[2]
    assert 30_000 <= sum(map(len, made[0])) < 100_000


def test_a_piece_reverted_for_an_error_of_ours_is_a_failure(
    tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def faulty(*_: object) -> None:
        raise IndexError("index 3 is out of bounds")

    monkeypatch.setattr(PieceCompensator, "compensate", faulty)
    square = b"G28\nM83\nG1 X50 Y50 F6000\nG1 X90 E1\nG1 Y90 E1\nG1 X50 E1\n"
    with pytest.raises(AssertionError, match="internal error"):
        walk(square, machine_of("klipper"), tmp_path, "shaper:mzv", cache)


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_files_are_read_and_planned_or_refused(kind: str) -> None:
    machine = machine_of(kind)
    files = [path.read_bytes() for path in EXAMPLES]
    for data in excerpts(files, 24_000, random.Random(KINDS.index(kind)), size=3000):
        read_through(data, machine)


def test_a_grammar_s_files_are_the_seed_s() -> None:
    made = [written(random.Random(seed), 50) for seed in (1, 1, 2)]
    assert made[0] == made[1]
    assert made[0] != made[2]
    assert made[0].count(b"\n") >= 50


@pytest.mark.parametrize("kind", KINDS)
def test_files_of_a_grammar_are_read_and_planned(kind: str) -> None:
    dice = random.Random(KINDS.index(kind))
    for _ in range(5):
        read_through(written(dice, 60), machine_of(kind))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", sorted(HOSTILE))
def test_hostile_files_are_read_or_refused(kind: str, name: str) -> None:
    reader = Interpreter(machine_of(kind))
    size = min(HOSTILE[name][1], 300)
    data = b"".join(pieces(name, size))
    read = b""
    try:
        for block in [*reader.push(data), *reader.flush()]:
            read += block.text
    except GcodeError as error:
        told = error
    else:
        assert read == data
        return
    assert told.line is not None
    assert len(str(told)) < 500


TOLD = """settings_without_end settings_of_nothing generators long_generator
    deep_settings wide_settings wide_limits"""


@pytest.mark.parametrize("name", TOLD.split())
def test_what_a_file_says_about_itself_is_found_in_passing(name: str) -> None:
    """Patterns that go back and forth need hours for these."""
    head = b"".join(pieces(name, 200_000))
    assert facts_in(head).estimate_s is None
    assert detect(head).certainty < 1.0


FOUND = {
    "an arc may begin with chords of Z alone": (
        "G28\nM83\nG1 X126 Y120\nG1 X125.518 Y120.144 E.06729\nG4 P1\nG3 X12 Z3 I1 K1\n"
        "G1 X124.983 Y119.953 E.08619\nG1 X124.525 Y121.057 E.02594\n"
    ),
    "an arc that only feeds needs the file's F": (
        "M83\nG1 X252.037 Y148.647 E.00484\nG3 X252.48 Y147.533 I8.433 J2.711 E.0386\n"
        "G3 X252.48 Y147.533 I8.433 J2.711 E.0386\nG1 X253.084 Y146.652 E.03435\n"
    ),
    "an arc of no length must not become a circle": (
        "N3910 G1 X0.3000 F20.\nN3960 G3 X0.0000 Y2.3000 I0. J-.05\nN3970 G1 Y2.0000\n"
        "N3980 G2 X0.0000 Y2.0000 I.1 J.1\nN4010 G0 X0.5000 Y2.0000\n"
    ),
    "G01 is G1": "G28\nM83\nG1 X50 Y50 F6000\nG1 X90 E1\nG01 E-.8\nG1 X60 Y60\nG01 E.8\nG1 X90\n",
    "an unknown Z is not named": (
        "G1 X110.304 Y111.102 E5.00986\nSET_GCODE_OFFSET Z_ADJUST=0.009174993 MOVE=1 MOVE_SPEED=5\n"
        "G1 X113.461 Y114.428 F9000\nG1 E5 F2400\n"
    ),
    "rests stand on the plan": (
        "G1 X36.788 Y62.785 E0.05436\nG1 X36.786 Y62.787 E0.00004\nG1 X36.786 Y62.787 E0.00003\n"
        "G1 X36.277 Y62.401 E0.02931\n"
    ),
    "the places of numbered lines": (
        "N1 G1 X2.0000 Y1.5000\nN2 G1 Z-.02 F5.\nN3 G0 X2.5000 Y1.5000\nN4 G1 Z-.02 F5.\n"
        "N5 G1 X2.8000 F20.\n"
    ),
    "G92 E counts where E is absolute later": (
        "G28\nM83\nG1 X10 Y5 F3000\nG92 E5\nM82\nG1 X40 Y40 E5.3\nM400\nG1 X45 Y40 E.1 F3000\n"
    ),
}

FLOW = (
    "G1 X158.284 Y148.156 F18000\nG1 X159.747 Y147.662\nM221 S90\nG1 X161.243 Y147.662 E0.04643\n"
    "G1 X160.917 Y149.687 F18000\nG1 F1208\nG1 E0.75000 F1800\n"
)
RETRACTION = (
    "M83\nG1 X138.259 Y118.237 E-.01404\nG1 X138.32 Y118.237 E-.01404\nG1 E-.92978 F2100\n"
    "G1 Z4.8 F720\nG1 X133.71 Y117.819 E.02766\n"
)
"""The second move has fewer than 6 steps: Marlin joins it with the retraction."""
SWALLOWED = (
    "G1 X141.741 Y142.018 E0.00346\nG1 X141.831 Y141.917 E0.00414\nG10 L2 P1 X5\n"
    "G1 X141.888 Y141.859 E0.00249\nSET_VELOCITY_LIMIT ACCEL=5\nG1 X142.577 Y141.394 E0.00382\n"
)
SMALL_LETTER = (
    "G1 X33.564 Y24.219 E-.10216\nG1 X33.239 Y23.894 E-.10913\nG1 Z1e263.913290592 F9000\n"
    "G1 X38.525 Y10.46\nG1 X35.574 Y4.357 E.01566\n"
)
"""Where small letters are no words, Z1e263 is Z1."""
THERE_AND_BACK = (
    "M83\nG1 X114.506 Y117.493 E.02432\nG1 X138.32 Y118.237 F10800\nG1 Z.3 F720\nG1 E1 F2100\n"
    "G1 X138.32 Y118.342 E.00369\nG1 F8640\nG1 X138.32 Y118.237 E-.01404\nG1 Z.5 F720\n"
    "G1 X129.322 Y118.166 F10800\n"
)
"""Nothing is left of X Y between two rests: the F between them stays between them."""
MINUS_ZERO = (
    "G1 X151.694 Y156.136 E0.07375 F3000\nG1 Z2.000000 F18000\nG1 X141.011 Y157.006\n"
    "G-0 Z1.600000\nG1 X137.602 Y157.403 E0.11812\n"
)
"""G-0 is G0, whose speed is the file's."""
NO_TURN = (
    "G91\nG0 X100.0 Y100 F30\nG0 X100.001 Y92 E-0.11247 F18000\nG1 X106 E0.19595\n"
    "G1 X87 Y100.61055 E-0.22675\nG1 X100.7 E0.13458 F600\nG2 X100 Y100.0 I-0.032 J-0.032 E.05\n"
)
"""An arc by an angle that rounds to a full turn, less a full turn."""
NO_STEPS = "M83\nG1 F4200 X103.493 Y97.659 E1959.16539\nG1 X103.484 Y97.658\n"
NO_TIME = (
    "M83\nG1 X120.613 Y120.554 E5.2601\nG1 X120.619 Y120.224 E5.27322\n"
    "G1 X119.971 Y118.323 E5.34247\nG1 E1.84247 F3600\nG2 X119.495 Y117.807 I-265.097 J244.069"
    " E1.50880\n"
    "G2 X120.720 Y118.024 I2.419 J-10.088 E0.91721\nG1 X119.466 Y122.251 E5.02687\n"
    "G1 X108.526 Y117.369 E5.0076\nG1 E1.5076 F3600\nG1 E.0076 F3600\nG1 F7200\n"
    "G1 X111.498 Y117.81 E1.40752\n"
)
AFTER_DUST = (
    "G1 X137.81 Y108.441 E.31343\nG1 X138.937 Y110.131 E.06728\nG0.006 X10 Y10 R-20\n"
    "G1 X138.937 Y110.131 E.06728\nG1\n"
)
"""The fourth line moves by a rounding error of E, from a place that nobody knows."""


@pytest.mark.parametrize(("kind", "seed"), [("klipper", 12), ("marlin", 40), ("marlin", 61)])
def test_layers_that_repeat_themselves(kind: str, seed: int, tmp_path: Path, cache: Path) -> None:
    """The last check took lines for earlier ones of the same text, and pieces were reverted."""
    data = layered(random.Random(seed))
    _, result = through_the_pipeline(data, machine_of(kind), tmp_path, "shaper:mzv", cache)
    assert not result.put_back


@pytest.mark.slow
def test_what_was_found_on_reprapfirmware(tmp_path: Path, cache: Path) -> None:
    data = tagged(AFTER_DUST.encode())
    through_the_pipeline(data, machine_of("reprapfirmware"), tmp_path, "shaper:mzv", cache)


@pytest.mark.slow
@pytest.mark.parametrize(
    "text",
    [
        NO_TIME,
        NO_STEPS,
        FLOW,
        RETRACTION,
        SWALLOWED,
        SMALL_LETTER,
        THERE_AND_BACK,
        MINUS_ZERO,
        NO_TURN,
    ],
)
def test_what_was_found_on_marlin(text: str, tmp_path: Path, cache: Path) -> None:
    data = tagged(text.encode())
    through_the_pipeline(data, machine_of("marlin"), tmp_path, "shaper:mzv", cache)


@pytest.mark.slow  # tunes the shaper of its machine
@pytest.mark.parametrize("name", FOUND)
@pytest.mark.parametrize("method", ["shaper:mzv", "fbf"])
def test_what_was_found_once(name: str, method: str, tmp_path: Path, cache: Path) -> None:
    through_the_pipeline(
        tagged(FOUND[name].encode()), machine_of("klipper"), tmp_path, method, cache
    )


@pytest.mark.shared
@pytest.mark.slow
def test_the_file_that_took_its_job_down(tmp_path: Path, cache: Path, shared_dir: Path) -> None:
    """A piece of moves that round to nothing: ValueError in the encoder, once."""
    data = tagged((shared_dir / "corpus" / "fuzz" / "crash_klipper_1.gcode").read_bytes())
    _, result = through_the_pipeline(data, machine_of("klipper"), tmp_path, "fbf", cache)
    # That one; in another a corner is at the edge of what may be printed (22 um).
    assert len(result.put_back) <= 2


@pytest.mark.shared
@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_damaged_files_through_the_pipeline(
    kind: str, tmp_path: Path, cache: Path, shared_dir: Path
) -> None:
    machine = machine_of(kind)
    found = sorted((shared_dir / "corpus").glob("*/*.gz"))
    files = [gzip.decompress(path.read_bytes()) for path in found]
    written = 0
    methods = ("shaper:mzv", "fbf", "none")
    if adapter(machine).refusal is not None:
        methods = ("none",) * 3
    for number, data in enumerate(excerpts(files, 36_000, random.Random(7), size=4000)):
        folder = tmp_path / f"{number}"
        folder.mkdir()
        written += walk(data, machine, folder, methods[number % 3], cache).written is not None
    assert written > 1
