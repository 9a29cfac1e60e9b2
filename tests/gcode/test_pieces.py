"""Cutting a file: nothing is lost, and pieces are what may be compensated."""

from __future__ import annotations

import gzip
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stillpath.gcode.errors import GcodeError
from stillpath.gcode.firmware.jumps import jump_lines
from stillpath.gcode.firmware.registry import adapter
from stillpath.gcode.interpreter import Interpreter
from stillpath.gcode.pieces import Piece, VerbatimPart
from stillpath.gcode.plan import plan_moves
from stillpath.gcode.splitter import Splitter
from stillpath.gcode.types import EventKind
from stillpath.models.machine import AxisTravel, Machine
from stillpath.models.store import load_machine
from tests.fuzz.machines import machine_of
from tests.gcode.cutting import HEAD, cut, ender3_with, pieces_of
from tests.gcode.prints import made_up_print, polygon


@pytest.fixture(scope="module")
def machine() -> Machine:
    return load_machine("ender3")


def text_of(items: list[Piece | VerbatimPart]) -> bytes:
    return b"".join(item.text for item in items)


def check(items: list[Piece | VerbatimPart], data: bytes) -> None:
    assert text_of(items) == data
    offset = 0
    for item in items:
        assert item.text_offset == offset
        offset += len(item.text)
        moves, events = item.moves, item.events
        lines = len(np.unique(moves.line)) + len(events)
        assert lines == len(item.text.splitlines())
        if len(events):
            assert events.move_index.min() >= 0
            assert events.move_index.max() <= len(moves)
        if not isinstance(item, Piece):
            continue
        travel = moves.end_mm - moves.start_mm
        xy = np.any(travel[:, :2] != 0, axis=1)
        assert xy[0]
        assert xy[-1]
        assert np.all(moves.known[xy] & 3 == 3)
        assert len(item.phases) == len(moves)
        assert not np.any(events.kind >= EventKind.STOP)
        p = item.phases
        assert p.start_mm_s[0] == 0
        assert p.end_mm_s[-1] == 0
        assert (p.t_s + p.accel_s + p.cruise_s + p.decel_s)[-1] - p.t_s[0] <= 60 + 1e-6


@settings(max_examples=25)
@given(
    seed=st.integers(0, 10**6), wild=st.booleans(), chunk=st.sampled_from([1, 97, 4096, 1 << 17])
)
def test_nothing_is_lost(machine: Machine, seed: int, wild: bool, chunk: int) -> None:
    data = made_up_print(seed, chapters=1, wild=wild)
    items = cut(data, machine, chunk=chunk)
    check(items, data)
    whole = cut(data, machine)
    kinds = [[(type(i), i.text) for i in x if isinstance(i, Piece)] for x in (items, whole)]
    assert kinds[0] == kinds[1]


@pytest.mark.parametrize("ending", [b"\n", b"\r\n", b""])
def test_pieces_join_to_the_file_whatever_its_line_ends(machine: Machine, ending: bytes) -> None:
    text = (HEAD + "G1 X80 E1\nG1 X80 Y80 E1 ; last").encode().replace(b"\n", ending or b"\n")
    data = text + ending
    check(cut(data, machine), data)


def test_method_none(machine: Machine) -> None:
    data = made_up_print(4)
    items = cut(data, machine, compensate=False)
    assert text_of(items) == data
    assert not any(isinstance(item, Piece) for item in items)


def test_comments_of_a_single_object_end_nothing(machine: Machine) -> None:
    """Who excludes the only object cancels the print."""
    lines = "; printing object a\nG1 X70 E1\nG1 X80 E1\n; stop printing object a\nG1 Y60 E1\n"
    pieces = [i for i in cut((HEAD + 3 * lines).encode(), machine) if isinstance(i, Piece)]
    assert len(pieces) == 2  # the head's, and the object's


EXCLUDED = (
    "EXCLUDE_OBJECT_START NAME=a",
    "EXCLUDE_OBJECT_END NAME=a\nEXCLUDE_OBJECT_START NAME=b",
)
MARKS_OF_ALL = [
    ("; printing object a id:0 copy 0", "; printing object b id:0 copy 0"),
    (";MESH:a", ";MESH:b"),
    (";PRINTING: a", ";PRINTING: b"),
    ("; process a", "; process b"),
    ("@Object a id:0 copy 0", "@Object b id:0 copy 0"),  # OctoPrint's Cancel Objects
    ("M486 S0\n; printing object a", "M486 S-1\n; stop printing object a\nM486 S1"),
]


@pytest.mark.parametrize(
    ("firmware", "a", "b"),
    [
        ("klipper", *EXCLUDED),
        *((kind, *m) for kind in ("klipper", "marlin", "reprapfirmware") for m in MARKS_OF_ALL),
    ],
)
def test_object_marks(firmware: str, a: str, b: str) -> None:
    """A mark ends a piece, and the next one begins behind it; the same object's does not."""
    again = f"{a}\n" if a.startswith((";", "@")) else ""
    jump = "G1 X20 Y20 F9000\nG1 E1\n"
    drawn = f"G1 X40 Y20 E1\n{again}G1 X40 Y40 E1\n"
    text = HEAD + (f"{b}\n" if again else "")
    text += f"{a}\nG1 X70 E1\nG1 X80 E1\n{again}G1 Y60 E1\n"
    text += f"{b}\nG1 E-1\n{jump}{drawn.replace(a, b)}{a}\nG1 E-1\n{jump}{drawn}"
    items = cut(text.encode(), ender3_with(firmware))
    assert text_of(items) == text.encode()
    pieces = [item for item in items if isinstance(item, Piece)]
    assert [piece.text for piece in pieces[1:]] == [
        f"G1 X70 E1\nG1 X80 E1\n{again}G1 Y60 E1\n".encode(),
        (jump + drawn.replace(a, b)).encode(),
        (jump + drawn).encode(),
    ]
    assert [piece.after_mark for piece in pieces] == [False, True, True, True]


@pytest.mark.parametrize("jump", ["G1 X90.05", "G2 X95 Y95 I5 J0"])
def test_what_may_not_come_after_a_jump_stays(machine: Machine, jump: str) -> None:
    """An arc, and a move as short as what is written to catch a jump."""
    text = HEAD + f"G1 X90 Y90 E1\n{EXCLUDED[0]}\n{jump}\nG1 X20 E1\nG1 Y40 E1\n"
    items = cut(text.encode(), machine)
    pieces = [item for item in items if isinstance(item, Piece)]
    assert pieces[-1].text == b"G1 X20 E1\nG1 Y40 E1\n"
    assert not pieces[-1].after_mark


@pytest.mark.parametrize("toward", ["X100 Y80.5", "X79.5 Y60", "X80 Y60"])
@pytest.mark.parametrize(
    ("firmware", "kinematics", "steps_per_mm"),
    [
        ("marlin", "corexy", 80.0),
        ("reprapfirmware", "cartesian", 160.0),
        ("reprapfirmware", "corexy", 160.0),
    ],
)
def test_no_motor_steps_where_a_jump_is_caught(
    firmware: str, kinematics: str, steps_per_mm: float, toward: str
) -> None:
    """Wherever the head stands at three decimals: close to half a step of either motor, too."""
    machine = ender3_with(firmware).model_copy(update={"kinematics": kinematics})
    piece = [
        item
        for item in cut(f"{HEAD}{EXCLUDED[0]}\nG1 {toward}\nG1 X20 E1\n".encode(), machine)
        if isinstance(item, Piece)
    ][-1]
    axes = kinematics == "cartesian" or firmware == "marlin"
    motors = np.eye(2) if axes else np.array([[1.0, 1.0], [1.0, -1.0]])
    made = 0
    for x, y in np.random.default_rng(5).integers(50000, 90000, (500, 2)) / 1000:
        begin = np.array([[x, y, 0.2, 0.0]])
        moves = replace(piece.moves, start_mm=np.vstack([begin, piece.moves.start_mm[1:]]))
        lines = jump_lines(replace(piece, moves=moves), adapter(machine).stands, 0.0)
        words = [line.split()[1:3] for line in lines.decode().splitlines()]
        places = np.array([[float(word[1:]) for word in line] for line in words])
        np.testing.assert_allclose(places[1], (x, y), atol=1e-9)
        assert np.hypot(*(places[0] - places[1])) == pytest.approx(1e-3)
        assert len(set(map(tuple, np.rint(places @ motors * steps_per_mm).tolist()))) == 1
        made += abs(places[0] - (x, y))[0] > 0.0
    assert 0 < made < 500


@pytest.mark.parametrize(
    "barrier", ["G28", "SOME_MACRO", "T1", "PAUSE", "BED_MESH_CALIBRATE", "G4 P5", "M400"]
)
def test_no_piece_reaches_across_a_barrier(machine: Machine, barrier: str) -> None:
    text = HEAD + f"G1 X80 E1\n{barrier}\nG1 X20\nG1 Y20\nG1 X30\nG1 Y30\n"
    items = cut(text.encode(), machine)
    check(items, text.encode())
    for item in items:
        assert not (isinstance(item, Piece) and barrier.encode() in item.text)
    known = barrier in ("G28", "G4 P5", "M400")  # this machine says where it homes
    last = items[-1]
    assert isinstance(last, Piece)
    # After an unknown position X and Y must both be named before a move is ours.
    first_line = last.text.split(b"\n", 1)[0]
    assert first_line == (b"G1 X20" if known else b"G1 X30")


def test_positions_unknown_at_the_start(machine: Machine) -> None:
    data = b"G1 X20\nG1 Y20\nG1 X50\nG1 Y50\n"
    pieces = pieces_of(data, machine)
    assert [p.text for p in pieces] == [b"G1 X50\nG1 Y50\n"]


def test_long_runs_are_cut_at_rests(machine: Machine) -> None:
    lines = [*HEAD.splitlines(), "G1 X120 Y100 F6000"]
    for _ in range(40):
        lines += [*polygon(60, 20), "G1 E-0.8 F2100", "G1 E0.8 F2100"]
    data = ("\n".join(lines) + "\n").encode()
    items = cut(data, machine)
    check(items, data)
    long = [item for item in items if isinstance(item, Piece)][1:]
    assert len(long) > 1
    for piece in long[:-1]:
        assert len(piece.moves) > 10
        following = next(i for i in items if i.text_offset > piece.text_offset)
        assert following.text.startswith(b"G1 E")


def test_vase_is_forced_to_stop(machine: Machine) -> None:
    lines = [*HEAD.splitlines(), "G1 X120 Y100 F6000"]
    for _ in range(40):
        lines += polygon(60, 20)
    data = ("\n".join(lines) + "\n").encode()
    items = cut(data, machine)
    check(items, data)
    long = [item for item in items if isinstance(item, Piece)][1:]
    assert len(long) > 1
    # Cut in mid motion, but for that whole; each half is planned to stop (see `check`).
    assert b"".join(piece.text for piece in long) in data


@pytest.mark.parametrize(
    ("between", "kept"),
    [
        (b"G1 X60.001 E.0001\nG1 X60 E.0001\n" * 17_000, 32_768),
        (b"; nothing\n" * 70_000, 0),
        (b";" + b"-" * 9_000_000 + b"\n", 0),
    ],
    ids=["moves", "lines", "bytes"],
)
def test_what_a_piece_holds_is_bounded(machine: Machine, between: bytes, kept: int) -> None:
    data = HEAD.encode() + b"G1 X70\nG1 X60\n" + between + b"G1 X80\nG1 Y60\nG1 X85\n"
    items, whole = (cut(data, machine, chunk=chunk) for chunk in (1 << 18, 1 << 24))
    check(items, data)
    pieces, others = ([i for i in found if isinstance(i, Piece)] for found in (items, whole))
    assert [item.text for item in pieces] == [item.text for item in others]
    assert len(pieces) == 3  # one in the head
    assert len(pieces[1].moves) == max(kept, 2)
    assert pieces[1].text.startswith(b"G1 X70\n")


def test_states_around_items(machine: Machine) -> None:
    text = HEAD + "M204 S900\nG1 X80 F1800 E1\nG91\nG1 X2\nM204 S700\nG28\nG1 X9\n"
    items = cut(text.encode(), machine)
    for before, after in pairwise(items):
        assert before.modal_after == after.modal_before
    assert items[-1].limits_before.accel_mm_s2 == 700
    assert not items[-1].modal_after.absolute_xyz


@pytest.mark.shared
@pytest.mark.parametrize("folder", ["own", "third_party"])
def test_corpus_is_cut_whole(machine: Machine, shared_dir: Path, folder: str) -> None:
    firmware = machine.firmware.model_copy(
        update={
            "extruder": machine.firmware.extruder.model_copy(
                update={"max_extrude_cross_section_mm2": 1e3, "max_extrude_only_distance_mm": 1e4}
            )
        }
    )
    travel = {axis: AxisTravel(min_mm=-5000, max_mm=5000) for axis in ("x", "y", "z")}
    wide = machine.model_copy(update={"firmware": firmware, "travel": travel})
    skipped = ("hm_arcs", "hm_cnc", "hm_laser")  # what Klipper rejects
    for path in sorted((shared_dir / "corpus" / folder).glob("*.gz")):
        if path.name.startswith(skipped):
            continue
        data = b"".join(gzip.decompress(path.read_bytes()).splitlines(keepends=True)[:6000])
        check(cut(data, wide), data)


@pytest.mark.parametrize(
    ("off", "on"),
    [
        (";STILLPATH_OFF", "; STILLPATH_ON"),
        ("; stillpath off", "; stillpath on"),
        ("  ;  stillpath_off for this bridge", ";STILLPATH_ON; again"),
        (";\tSTILLPATH_OFF", "; \t stillpath_on"),
        (";\u00a0STILLPATH_OFF", ";\u2003STILLPATH_ON"),
    ],
)
def test_moves_between_off_and_on_stay_as_they_came(machine, off, on):
    lines = [f"G1 X{60 + 5 * (k % 2)} Y{50 + k} E.1 F6000" for k in range(12)]
    lines.insert(8, on)
    lines.insert(4, off)
    data = (HEAD + "\n".join(lines) + "\n").encode()
    for chunk in (7, 1 << 17):
        items = cut(data, machine, chunk=chunk)
        check(items, data)
        ours = b"".join(item.text for item in items if isinstance(item, Piece))
        changed = [k for k in range(12) if f"Y{50 + k} " in ours.decode()]
        assert changed == [0, 1, 2, 3, 8, 9, 10, 11]


def test_off_holds_until_the_end_and_through_homing(machine):
    data = HEAD + "; STILLPATH_OFF\nG28\nG1 X60 Y50 F6000\nG1 X70\nG1 Y60\n"
    assert [piece.text for piece in pieces_of(data, machine)] == pieces_of_head(machine)


@pytest.mark.parametrize("mark", ["", "; STILLPATH_ON\n"])
def test_behind_a_tuning_tower_moves_stay_as_they_came(machine, mark):
    """It sets limits or a shaper in the first printing move of a height, within a stream."""
    tower = "TUNING_TOWER COMMAND=SET_VELOCITY_LIMIT PARAMETER=ACCEL START=1500 FACTOR=100\n"
    data = HEAD + tower + "G1 X60 Y50 Z5 F6000\n" + mark + "G1 X70 E1\nG1 Y60 E1\n"
    assert [piece.text for piece in pieces_of(data, machine)] == pieces_of_head(machine)


@pytest.mark.parametrize(
    ("kind", "line"),
    [
        ("klipper", "G1 X70 A5 E.5"),
        ("marlin", "G1 X70 U5"),
        ("marlin", "G1 X70 S50"),
        ("marlin", "G2 X70 I5 J0 C1 E.5"),
        ("reprapfirmware", "G1 X70 U-5 E.5"),
        ("reprapfirmware", "G1 X70 E.2:.3"),
        ("reprapfirmware", "G1 U5"),
    ],
)
def test_moves_that_move_more_than_a_stream_can_stay_as_they_came(kind: str, line: str) -> None:
    machine = ender3_with(kind)
    data = f"{HEAD}G1 Y60 E.5 F3000\n{line}\nG1 Y70 E.5\n".encode()
    items = cut(data, machine)
    assert text_of(items) == data
    pieces = [item.text for item in items if isinstance(item, Piece)]
    assert not any(line.encode() in text for text in pieces)
    assert [text for text in pieces if b"Y" in text][-2:] == [
        b"G1 Y60 E.5 F3000\n",
        b"G1 Y70 E.5\n",
    ]


def pieces_of_head(machine: Machine) -> list[bytes]:
    return [piece.text for piece in pieces_of(HEAD, machine)]


@pytest.mark.parametrize(
    ("lines", "line"),
    [
        ("G1 X120 E1 F.5\n", 7),
        ("G1 X61 E1 F600\nSET_VELOCITY_LIMIT VELOCITY=1e-9 ACCEL=100\nG1 X62 E1\n", 9),
        ("SET_VELOCITY_LIMIT ACCEL=1e-9\nG1 X70 E.1\n", 8),
        ("G1 E50 F2\n", 7),
    ],
)
@pytest.mark.parametrize("compensate", [True, False])
def test_moves_that_hardly_end(
    machine: Machine, lines: str, line: int, *, compensate: bool
) -> None:
    """By the plan, not by F: the limits in force may be what is slow."""

    def plan() -> None:
        for item in cut((HEAD + lines).encode(), machine, compensate=compensate):
            plan_moves(item.moves, item.limits, machine)

    with pytest.raises(
        GcodeError, match=f"line {line}: the move takes .*more than 20 min; correct"
    ):
        plan()


def test_moves_that_last_leave_as_they_came(machine: Machine) -> None:
    """A move of two minutes under a low limit is a verbatim part; the pieces beside it stay."""
    slow = "SET_VELOCITY_LIMIT VELOCITY=.5\nG1 X60 Y110 E1\nSET_VELOCITY_LIMIT VELOCITY=300\n"
    text = HEAD + "G1 X90 E1 F6000\nG1 X60 E1\n" + slow + "G1 X90 E1\nG1 X60 E1\n"
    items = cut(text.encode(), machine)
    check(items, text.encode())
    pieces = [b"\n".join(x.text.splitlines()) for x in items if isinstance(x, Piece)]
    assert b"G1 X90 E1 F6000\nG1 X60 E1" in pieces
    assert b"G1 X90 E1\nG1 X60 E1" in pieces
    assert not any(b"Y110" in piece for piece in pieces)


def test_a_climb_from_a_height_that_nobody_knows_stays(machine: Machine) -> None:
    """Our lines would name its Z."""
    text = "G28 X Y\nG1 X60 Y50 F6000\nG1 X70 E1\nG91\nG1 X5 Z.2 E1\nG90\nG1 X80 E1\nG1 X60 E1\n"
    items = cut(text.encode(), machine)
    pieces = [x.text for x in items if isinstance(x, Piece)]
    assert any(b"X80" in piece for piece in pieces)
    assert not any(b"Z.2" in piece for piece in pieces)


@pytest.mark.parametrize(("fed", "ours"), [(9.0, True), (40.0, False), (-40.0, False)])
def test_a_wild_extruder_leaves_as_it_came(machine: Machine, fed: float, ours: bool) -> None:
    """Forty mm of filament on one of way: no print does that, and a stream would creep along."""
    firmware = machine.firmware.model_copy(
        update={
            "extruder": machine.firmware.extruder.model_copy(
                update={"max_extrude_cross_section_mm2": 1e9}
            )
        }
    )
    loose = machine.model_copy(update={"firmware": firmware})
    text = HEAD + f"G1 X80 E1 F6000\nG1 X81 E{fed}\nG1 X60 E1\n"
    pieces = [x.text for x in cut(text.encode(), loose) if isinstance(x, Piece)]
    assert any(b"X81" in piece for piece in pieces) is ours
    assert any(b"X80" in piece for piece in pieces)


@pytest.mark.parametrize("chunk", [1, 1 << 17])
@pytest.mark.parametrize(
    "text",
    [
        b"G1 X104 Y100 F3000\nG1 Y189 E3\nG1 X107 Z0 E1\n",
        b"G1 X104 Y100 F3000\nG10\nG1 Y189 E3\nG1 X107 Z0 E1\nG11\n",
        # In coordinates of the file's own the machine's Z is never known.
        b"G92 Z0\nPAUSE\nG1 X104 Y100 F3000\nG1 Y189 E3\nG1 X107 Z0 E1\n",
    ],
)
def test_a_line_that_finds_the_height_stays(machine: Machine, chunk: int, text: bytes) -> None:
    """Z is guessed at 0: after a macro that left it elsewhere this line moves it."""
    text += b"G1 X90 E1\nG1 Y100 E1\n"
    pieces = [x.text for x in cut(text, machine, chunk=chunk) if isinstance(x, Piece)]
    assert b"".join(pieces).count(b"E") == 3
    assert not any(b"Z0" in piece for piece in pieces)


@pytest.mark.parametrize(
    ("kind", "line"),
    [
        ("klipper", "SAVE_GCODE_STATE"),
        ("klipper", "M221 S95"),
        ("marlin", "G60 S1"),
        ("marlin", "M221 S95"),
        ("reprapfirmware", "G60 S1"),
        ("reprapfirmware", "M120"),
    ],
)
def test_lines_that_must_find_the_file_s_own_state(kind: str, line: str) -> None:
    machine = machine_of(kind)
    if kind == "marlin":
        firmware = machine.firmware.model_copy(update={"saved_positions": True})
        machine = machine.model_copy(update={"firmware": firmware})
    *_, first, second = pieces_of(HEAD + f"G1 X70\nG1 X80\n{line}\nG1 X90\n", machine)
    assert line.encode() not in first.text + second.text
    assert first.moves.end_mm[-1, 0] == second.moves.start_mm[0, 0] == 80.0


def test_comments_do_not_wait_for_the_next_move(machine: Machine) -> None:
    """They were held until the next move, and copied for every block of the file."""
    reader, splitter = Interpreter(machine), Splitter(machine)
    text = b"G28\nG1 X50 Y50 Z5 F6000\nG1 X60 Y50 E1\n" + 200_000 * b";\n"
    found = [item for block in reader.push(text) for item in splitter.push(block)]
    assert any(isinstance(item, Piece) for item in found)
    assert sum(len(item.text) for item in found) > len(text) / 2
