"""A stream that may break off: what it costs, and what the motors see when it does.

For each file, machine and firmware the written file is read back with its own limits. At some
hundred of its stream's lines the motion breaks off: the firmware brakes to a stand by its own
rules, and goes on from there. The table gives the largest change of a motor's speed within a ms
around all breaks, at some speed factors (M220), beside what the machine says its motors bear, and
the share of breaks at which it is more than a tenth above that (at M220 100 %), and the largest
of the file as sliced;
and the report's contour error of one model (a prediction), print time, segments a second and put
back pieces, for comparison with streams that ran under other limits.

`--corpus SECONDS` takes so much of every file of the corpus instead, and gives the worst of each
machine and firmware.
"""

from __future__ import annotations

import argparse
import math
import re
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from firmwares import machine_with, without_macros
from inputs import find_input, plain_copy, shared_folder
from numpy.typing import NDArray

from stillpath.gcode.errors import GcodeError
from stillpath.gcode.firmware.registry import adapter
from stillpath.gcode.interpreter import Interpreter
from stillpath.gcode.plan import plan_moves
from stillpath.gcode.sampler import sample_phases
from stillpath.gcode.types import Limits, Moves, rows_of
from stillpath.models.machine import Machine
from stillpath.models.store import load_machine
from stillpath.pipeline.compensate import compensate_file
from stillpath.pipeline.files import default_cache_dir
from stillpath.pipeline.options import Options

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from tests.e2e.round_trip import corpus_files, corpus_folder, made_to_fit, text_of
from tests.gcode.marlin_interrupts import stepped

FILES = ("cura_ender3_gear24", "klipper_excludeobj_multi")
MACHINES = ("ender3", "voron-v24-250")
FIRMWARES = ("klipper", "marlin", "reprapfirmware")
FOUR = ("ender3", "voron-v0", "voron-v24-250", "annex-k3")
FACTORS = (0.5, 1.0, 2.0)
_SAMPLE_S, _REACH = 5e-5, 20
_SAME_MM = 1e-4
_AROUND = 60
"""Moves that are looked at before and after a break."""


def velocity_step(
    moves: Moves, limits: list[Limits], machine: Machine, *, stop: bool = False
) -> float:
    """Largest change of a motor's speed within a ms when moves go from rest to rest, mm/s.

    Of an axis that bears more, the same share of what it bears. Marlin's by its steps. `stop`: in
    the second half alone, because the start is none of the print's.
    """
    if not len(moves):
        return 0.0
    if machine.firmware.kind == "marlin":
        t_s, place_mm = stepped(
            moves, limits, machine.firmware, corexy=machine.kinematics == "corexy"
        )
        sampled_s = np.arange(-_REACH, t_s[-1] / _SAMPLE_S + _REACH) * _SAMPLE_S
        place = np.stack([np.interp(sampled_s, t_s, row) for row in place_mm])
    else:
        place = planned(moves, limits, machine)
    velocity = np.diff(place, axis=1) / _SAMPLE_S
    change = velocity[:, _REACH:] - velocity[:, :-_REACH]
    if machine.kinematics == "corexy":
        change = np.stack([change[0] + change[1], change[0] - change[1]])
    least = machine.command.speed_step_mm_s
    for row, axis in zip(change, ("x", "y"), strict=True):
        row *= least / machine.command.of(axis).speed_step_mm_s
    if stop:
        change = change[:, change.shape[1] // 2 :]
    return float(np.max(np.abs(change), initial=0.0))


def planned(moves: Moves, limits: list[Limits], machine: Machine) -> NDArray[np.float64]:
    """X and Y of moves from rest to rest every `_SAMPLE_S`, mm, shape (2, n)."""
    phases = plan_moves(moves, limits, machine)
    if not len(phases):
        return np.zeros((2, 0))
    # RepRapFirmware holds moves back by some hundredths of a ms where they come too fast: late
    # steps, which this does not count.
    lasts_s = phases.lasts_s
    ends_s = phases.t_s[0] + np.cumsum(lasts_s)
    phases = replace(phases, t_s=ends_s - lasts_s)
    count = int((ends_s[-1] - ends_s[0] + lasts_s[0]) / _SAMPLE_S) + 2 * _REACH
    begin_s = float(phases.t_s[0]) - _REACH * _SAMPLE_S
    place, _ = sample_phases(phases, (begin_s, _SAMPLE_S, count))
    return place[:2]


def steps_at_breaks(
    written: Path, machine: Machine, breaks: int, *, sliced: bool = False
) -> NDArray[np.float64]:
    """Largest change of velocity around each break of a written file, shape (factors, breaks).

    `sliced`: of a file as sliced, at any of its lines.
    """
    firmware = adapter(machine)
    stream = firmware.stream_limits(firmware.initial_limits()).as_row()
    rng = np.random.default_rng(20261124)
    reader = Interpreter(machine)
    steps: list[list[float]] = []
    # Marlin's lines, and late pieces, have accelerations of X and Y of their own.
    mark = 1 if machine.firmware.kind == "klipper" else 3
    with written.open("rb") as file:
        blocks = [b for data in iter(lambda: file.read(1 << 20), b"") for b in reader.push(data)]
    blocks += reader.flush()
    ours = [
        np.flatnonzero(
            np.array([sliced or x.as_row()[mark] == stream[mark] for x in b.limits])[
                b.moves.limits_id
            ]
        )
        if len(b.moves)
        else np.zeros(0, int)
        for b in blocks
    ]
    total = max(sum(map(len, ours)), 1)
    for block, rows in zip(blocks, ours, strict=True):
        chosen = rows[rng.random(len(rows)) < breaks / total]
        # Homing and the like: after it the machine is elsewhere.
        apart = np.abs(block.moves.start_mm[1:, :3] - block.moves.end_mm[:-1, :3]) > _SAME_MM
        jumps = np.concatenate([[0], np.flatnonzero(apart.any(axis=1)) + 1, [len(block.moves)]])
        for k in chosen.tolist():
            behind = np.searchsorted(jumps, k, side="right")
            low, high = int(jumps[behind - 1]), int(jumps[behind])
            worst = [0.0] * len(FACTORS)
            for stop in (True, False):
                part = slice(max(k - _AROUND, low), k) if stop else slice(k, min(k + _AROUND, high))
                for i, factor in enumerate(FACTORS):
                    moves = rows_of(block.moves, part)
                    moves = replace(moves, speed_mm_s=factor * moves.speed_mm_s)
                    step = velocity_step(moves, list(block.limits), machine, stop=stop)
                    worst[i] = max(worst[i], step)
            steps.append(worst)
    return np.array(steps).reshape(-1, len(FACTORS)).T


def cut(data: bytes, seconds: float) -> bytes:
    """The beginning of a file that takes about so long, by lengths and F alone."""
    place, feed, passed, whole = {b"X": 0.0, b"Y": 0.0}, 1500.0, 0.0, []
    for line in data.splitlines(keepends=True):
        whole.append(line)
        if not re.match(rb"\s*G[0-3]\b", line):
            continue
        words = re.findall(rb"([XYF])(-?[\d.]+)", line.partition(b";")[0])
        before = dict(place)
        for letter, number in words:
            feed = float(number) or feed if letter == b"F" else feed
            if letter != b"F":
                place[letter] = float(number)
        passed += math.dist(before.values(), place.values()) * 60.0 / feed
        if passed > seconds:
            break
    return b"".join(whole)


def over_the_corpus(
    seconds: float, machines: list[str], firmwares: list[str], breaks: int, folder: Path
) -> None:
    """Print the worst of all files for each machine and firmware, and which file it was."""
    texts = {name: cut(text_of(corpus_folder() / name), seconds) for name in corpus_files()}
    head = " ".join(f"{f'{100 * factor:.0f} %':>6}" for factor in FACTORS)
    print(f"{'machine':15}{'firmware':15}{'bears':>6} {head}  files  worst file")
    source, target = folder / "in.gcode", folder / "out.gcode"
    for machine_name in machines:
        for firmware in firmwares:
            worst, count, which = [0.0] * len(FACTORS), 0, ""
            for name, text in texts.items():
                machine = load_machine(machine_name)
                if firmware != "klipper":
                    machine = machine_with(machine_name, firmware, 80.0)
                lines = text.splitlines(keepends=True)
                source.write_bytes(
                    b"".join(x for x in lines if not x.startswith(b"EXCLUDE_OBJECT_DEFINE"))
                )
                machine = made_to_fit(machine, text)
                try:
                    compensate_file(
                        source,
                        target,
                        machine,
                        Options(robust="off"),
                        cache_dir=default_cache_dir(),
                    )
                except GcodeError:
                    continue
                found = steps_at_breaks(target, machine, breaks).max(axis=1, initial=0.0)
                count += max(found) > 0.0
                which = name if max(found) > max(worst) else which
                worst = [max(pair) for pair in zip(worst, found, strict=True)]
            print(
                f"{machine_name:15}{firmware:15}{machine.command.speed_step_mm_s:6.0f} "
                + " ".join(f"{step:6.0f}" for step in worst)
                + f" {count:6d}  {Path(which).name.split('.gcode')[0]}",
                flush=True,
            )


def main() -> None:
    parser = argparse.ArgumentParser(description="What breaks of a stream ask of the motors.")
    parser.add_argument("files", nargs="*", default=list(FILES), help="paths, or corpus names")
    parser.add_argument("--machines", nargs="+", default=list(MACHINES))
    parser.add_argument("--firmwares", nargs="+", default=list(FIRMWARES))
    parser.add_argument("--accel-mm-s2", type=float, help="what the motors bear, of all machines")
    parser.add_argument("--breaks", type=int, default=300, help="lines of each file")
    parser.add_argument("--corpus", type=float, metavar="SECONDS", help="of every file")
    given = parser.parse_args()
    if given.corpus:
        machines = given.machines if given.machines != list(MACHINES) else list(FOUR)
        with tempfile.TemporaryDirectory(prefix="stillpath-breaks-") as folder:
            over_the_corpus(given.corpus, machines, given.firmwares, given.breaks, Path(folder))
        return
    head = " ".join(f"{f'{100 * factor:.0f} %':>6}" for factor in FACTORS)
    print(
        f"{'file':26}{'machine':15}{'firmware':15}{'bears':>6} {head}"
        "   above sliced  rms um  time s  seg/s back"
    )
    with tempfile.TemporaryDirectory(prefix="stillpath-breaks-") as folder:
        for name in given.files:
            source = plain_copy(find_input(name, shared_folder()), Path(folder))
            for machine_name in given.machines:
                for firmware in given.firmwares:
                    machine, sliced = load_machine(machine_name), source
                    if firmware != "klipper":
                        machine = machine_with(machine_name, firmware, 80.0)
                        (Path(folder) / firmware).mkdir(exist_ok=True)
                        sliced = without_macros(source, Path(folder) / firmware)
                    if given.accel_mm_s2:
                        change = {"accel_mm_s2": given.accel_mm_s2}
                        command = machine.command.model_copy(update=change)
                        machine = machine.model_copy(update={"command": command})
                    target = Path(folder) / "out.gcode"
                    options = Options(robust="off")
                    result = compensate_file(
                        sliced, target, machine, options, cache_dir=default_cache_dir()
                    )
                    steps = steps_at_breaks(target, machine, given.breaks)
                    bears = machine.command.speed_step_mm_s
                    above = np.mean(steps[1] > 1.1 * bears)
                    before = steps_at_breaks(sliced, machine, given.breaks, sliced=True)[1]
                    print(
                        f"{name[:25]:26}{machine_name:15}{firmware:15}"
                        f"{bears:6.0f} "
                        + " ".join(f"{step:6.0f}" for step in steps.max(axis=1, initial=0.0))
                        + f" {100 * above:5.1f} % {before.max(initial=0.0):6.0f}"
                        f" {result.channels[1].extruding.contour_rms_um:7.3f}"
                        f" {result.compensated_s:7.1f} {result.segments_per_s:6.0f}"
                        f" {len(result.put_back):4d}",
                        flush=True,
                    )


if __name__ == "__main__":
    main()
