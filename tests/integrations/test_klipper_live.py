"""The extra in Klipper's own host: steps, events, exports that are not what they should be."""

from __future__ import annotations

from collections.abc import Callable
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stillpath.applications.live.export import export_digest
from stillpath.models.machine import Machine
from stillpath.models.store import load_machine
from stillpath.pipeline.compensate import compensate_file
from stillpath.pipeline.options import Options
from tests.integrations.hostile_exports import HOSTILE
from tests.integrations.interrupted import MACROS, USERS, asked, homed, two_objects
from tests.integrations.klipper_host import NO_KLIPPER, PYTHON, Steps, printer_cfg, steps_of
from tests.integrations.live import (
    EVENTS,
    FILES,
    FINE,
    both,
    later,
    off_steps,
    predicted,
    print_begins,
    print_with,
    stands,
    with_event,
)

pytestmark = [pytest.mark.slow, pytest.mark.skipif(PYTHON is None, reason=NO_KLIPPER)]


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("ender3", "gear"),
        ("voron-v24-250", "curves"),
        ("voron-v0", "two objects"),  # the gear does not fit on its bed
        ("annex-k3", "gear"),
    ],
)
def test_steps_are_the_filtered_plan(
    name: str,
    file: str,
    klipper_live: Path,
    export: Callable[[str], dict[str, Any]],
    tmp_path: Path,
) -> None:
    machine, given = homed(load_machine(name)), export(name)
    prints = both(FILES[file](), machine, given, tmp_path, klipper_live)
    assert f"stillpath: on for {name}; limited 0.000 s" in prints.log

    corexy = machine.kinematics == "corexy"
    begin, shift_s = print_begins(prints.plain.time_s), later(prints)
    plan = prints.planned()[1]
    assert np.abs(predicted(plan, given) - plan).max() > 0.01
    # Motors that round to whole steps, here of .8 um, are within half a step, .29 rms; Klipper's
    # own are up to 1 off its plan (times of steps are whole clock ticks).
    off = off_steps(prints, given, corexy)
    assert np.sqrt(np.mean(off**2)) < 0.31
    assert np.abs(off[:, ::FINE]).max() < 1.1
    assert np.abs(off).max() < 1.6

    # Time and material: one shift for all of the print, of all other motors too.
    for ours, theirs in zip(prints.live.others_s, prints.plain.others_s, strict=True):
        assert len(ours) == len(theirs)
        after = theirs > begin
        assert np.abs(ours[after] - theirs[after] - shift_s).max() < 1e-4


@pytest.mark.parametrize(
    ("event", "name"), list(zip(EVENTS, cycle(("ender3", "voron-v24-250")), strict=False))
)
def test_no_step_is_lost_whatever_happens(
    name: str,
    event: str,
    klipper_live: Path,
    export: Callable[[str], dict[str, Any]],
    tmp_path: Path,
) -> None:
    machine = homed(load_machine(name))
    prints = both(with_event(event), machine, export(name), tmp_path, klipper_live)
    assert "stillpath: " + ("off" if event == "off" else "on") + " for" in prints.log
    assert "passing through" not in prints.log
    assert stands(prints.live) == stands(prints.plain)
    # Z and the extruder make as many steps as without it.
    live_s, plain_s = prints.live.others_s, prints.plain.others_s
    assert [len(times) for times in live_s] == [len(times) for times in plain_s]
    bears, plain, live = machine.command, asked(prints.plain, machine), asked(prints.live, machine)
    # What Klipper plans beyond the limits passes; nothing is added to it.
    assert live.step_mm_s <= max(bears.speed_step_mm_s, 1.05 * plain.step_mm_s)
    assert live.ramp_mm_s <= max(10e-3 * bears.accel_mm_s2, 1.05 * plain.ramp_mm_s)


def test_limits_bring_the_plan_back(
    klipper_live: Path, export: Callable[[str], dict[str, Any]], tmp_path: Path
) -> None:
    machine, given = homed(load_machine("ender3")), export("ender3")
    given["command"]["accel_mm_s2"] = 5200.0
    given["digest"] = export_digest(given)
    prints = both(two_objects(), machine, given, tmp_path, klipper_live)
    assert "limited 0.000 s" not in prints.log
    # At the samples of the filter: between them the prediction would decide anew what is too much.
    off = off_steps(prints, given, corexy=False)[:, ::FINE]
    assert np.sqrt(np.mean(off**2)) < 0.31
    assert np.abs(off).max() < 1.1


@pytest.mark.parametrize(
    ("name", "bears"),
    [
        ("ender3", {}),
        # Its streams have a limit of 14142 mm/s2, every way the same.
        ("voron-v24-250", {"motors": {"accel_mm_s2": 20_000.0}}),
    ],
)
def test_a_compensated_file_is_not_compensated_twice(
    name: str,
    bears: dict[str, Any],
    klipper_live: Path,
    export: Callable[[str], dict[str, Any]],
    tmp_path: Path,
) -> None:
    document = load_machine(name).model_dump()
    document["command"] |= bears
    machine = homed(Machine.model_validate(document))
    (tmp_path / "in.gcode").write_text(two_objects())
    made = tmp_path / "out.gcode"
    compensate_file(tmp_path / "in.gcode", made, machine, Options(robust="off"))
    more = f"[force_move]\nenable_force_move: True\n{USERS}\n{MACROS}"
    prints = both(made.read_text(), machine, export(name), tmp_path, klipper_live, more)
    # It stands aside for SET_INPUT_SHAPER, so that there the head stands a little longer.
    wanted = stands(prints.plain)
    assert [place for place in stands(prints.live) if place in wanted] == wanted
    # Step by step the same order of places, but for the few moves outside of the streams.
    for ours, theirs in zip(prints.live.place_mm, prints.plain.place_mm, strict=True):
        assert len(ours) == pytest.approx(len(theirs), rel=2e-3)
    assert "limited 0.000 s" not in prints.log


@pytest.mark.parametrize("what", ["truncated", "kinematics", "delta", "limits", "wild"])
def test_bad_exports_are_refused_and_klipper_prints(
    what: str, klipper_live: Path, export: Callable[[str], dict[str, Any]], tmp_path: Path
) -> None:
    machine = homed(load_machine("ender3"))
    change, reason = HOSTILE[what]
    text = "G28\nG90\nG1 X50 Y20 F9000\nSTILLPATH ENABLE=1\nG1 X20 Y60\nSTILLPATH_STATUS\n"
    bad = change(export("ender3"))
    (tmp_path / "export.json").write_text(bad)
    prints = _with_file(text, machine, tmp_path, klipper_live)
    log = (tmp_path / "klippy.log").read_text()
    assert "Klipper moves as without it" in log
    assert reason in log
    assert "stillpath: refused" in log
    home, end = stands(prints)[-2:] if len(stands(prints)) > 1 else ((0, 0), stands(prints)[-1])
    assert end != home


def _with_file(text: str, machine: Machine, place: Path, klipper_live: Path) -> Steps:
    config = printer_cfg(machine, "[stillpath]\nfile: export.json")
    return steps_of(text, config, place, klipper_live)


def test_a_missing_export_is_said(klipper_live: Path, tmp_path: Path) -> None:
    _with_file("G28\nSTILLPATH_STATUS\n", homed(load_machine("ender3")), tmp_path, klipper_live)
    assert "cannot read export.json" in (tmp_path / "klippy.log").read_text()


def test_an_emergency_stop_stays_one(
    klipper_live: Path, export: Callable[[str], dict[str, Any]], tmp_path: Path
) -> None:
    machine = homed(load_machine("ender3"))
    with pytest.raises(AssertionError):
        print_with("G28\nG1 X50 F9000\nM112\n", machine, export("ender3"), tmp_path, klipper_live)
    log = (tmp_path / "klippy.log").read_text()
    assert "Shutdown due to M112 command" in log
    assert "stillpath.py" not in log
