"""The extra in Klipper's own host: steps, events, exports that are not what they should be."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stillpath.applications.live.export import export_digest, write_export
from stillpath.compensation.live_filter import LiveFilter
from stillpath.models.machine import Machine
from stillpath.models.store import load_machine
from stillpath.pipeline.compensate import compensate_file
from stillpath.pipeline.options import Options
from tests.integrations.interrupted import MACROS, USERS, asked, homed, two_objects
from tests.integrations.klipper_host import (
    NO_KLIPPER,
    PYTHON,
    Steps,
    klipper_with_extra,
    printer_cfg,
    steps_of,
)
from tests.integrations.live import EVENTS, Pair, both, print_with, shifted, stands

pytestmark = [pytest.mark.slow, pytest.mark.skipif(PYTHON is None, reason=NO_KLIPPER)]

GEAR = Path(__file__).resolve().parents[2] / "examples" / "cura_ender3_gear24.gcode"
MACHINES = ("ender3", "voron-v24-250", "voron-v0", "annex-k3")
_FINE, _FAR_MM = 4, 1e4
_HOMED_S = 2.5


@pytest.fixture(scope="module")
def klipper(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return klipper_with_extra(tmp_path_factory.mktemp("klipper"))


@pytest.fixture(scope="module")
def export(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], dict[str, Any]]:
    """The export of a built-in machine, designed once."""
    folder, made = tmp_path_factory.mktemp("exports"), {}

    def of(name: str) -> dict[str, Any]:
        if name not in made:
            made[name] = write_export(load_machine(name), folder / f"{name}.json")
        return copy.deepcopy(made[name])

    return of


def curves() -> str:
    """Circles as slicers write them, at several speeds, and short zigzags."""
    lines = ["G28", "G90", "M83", "G1 Z.3 F900"]
    for radius, feed in ((3, 3000), (12, 9000), (25, 15000)):
        for k in range(73):
            a = 2 * np.pi * k / 72
            x, y = 60 + radius * np.cos(a), 60 + radius * np.sin(a)
            lines.append(f"G1 X{x:.3f} Y{y:.3f} E.03 F{feed}")
        lines += ["G1 E-.8 F2100", "G1 Z.6", "G1 X40 Y40 F18000", "G1 Z.3", "G1 E.8"]
        lines += [f"G1 X{40 + 0.4 * k:.1f} Y{40 + 4 * (k % 2)} E.1 F{feed}" for k in range(40)]
    return "\n".join(lines) + "\n"


FILES: dict[str, Callable[[], str]] = {
    "two objects": two_objects,
    "curves": curves,
    "gear": lambda: GEAR.read_text().partition(";LAYER:1")[0],
}


@pytest.mark.parametrize("file", FILES)
@pytest.mark.parametrize("name", MACHINES)
def test_steps_are_the_filtered_plan(
    name: str,
    file: str,
    klipper: Path,
    export: Callable[[str], dict[str, Any]],
    tmp_path: Path,
) -> None:
    if name == "voron-v0" and file == "gear":
        pytest.skip("does not fit on its bed")
    machine, given = homed(load_machine(name)), export(name)
    prints = both(FILES[file](), machine, given, tmp_path, klipper)
    assert f"stillpath: on for {name}; limited 0.000 s" in prints.log

    corexy = machine.kinematics == "corexy"
    plan, found = (s.sampled(1e-3 / _FINE, corexy) for s in (prints.plain, prints.live))
    begin = _print_begins(prints.plain.time_s)
    first = (round(begin * 1e3) - 500) * _FINE
    plan = plan[:, first:]
    wanted = _predicted(plan, given)
    shift_s = _later(prints)
    off_mm = shifted(found[:, first:], shift_s * 1e3 * _FINE, plan.shape[1]) - wanted
    assert np.abs(wanted - plan).max() > 0.01
    # A step of most printers is 12.5 um; ours are .8 um, so that no step hides anything.
    assert np.sqrt(np.mean(off_mm**2)) < 0.3 * 5e-3
    assert np.abs(off_mm).max() < 5e-3

    # Time and material: one shift for all of the print, of all other motors too.
    for ours, theirs in zip(prints.live.others_s, prints.plain.others_s, strict=True):
        assert len(ours) == len(theirs)
        after = theirs > begin
        assert np.abs(ours[after] - theirs[after] - shift_s).max() < 1e-4


@pytest.mark.parametrize("event", EVENTS)
@pytest.mark.parametrize("name", ["ender3", "voron-v24-250"])
def test_no_step_is_lost_whatever_happens(
    name: str,
    event: str,
    klipper: Path,
    export: Callable[[str], dict[str, Any]],
    tmp_path: Path,
) -> None:
    machine = homed(load_machine(name))
    prints = both(_with_event(event), machine, export(name), tmp_path, klipper)
    assert "stillpath: " + ("off" if event == "off" else "on") + " for" in prints.log
    assert "passing through" not in prints.log
    assert stands(prints.live) == stands(prints.plain)
    bears, plain, live = machine.command, asked(prints.plain, machine), asked(prints.live, machine)
    # What Klipper plans beyond the limits passes; nothing is added to it.
    assert live.step_mm_s <= max(bears.speed_step_mm_s, 1.05 * plain.step_mm_s)
    assert live.ramp_mm_s <= max(10e-3 * bears.accel_mm_s2, 1.05 * plain.ramp_mm_s)


def test_limits_bring_the_plan_back(
    klipper: Path, export: Callable[[str], dict[str, Any]], tmp_path: Path
) -> None:
    machine, given = homed(load_machine("ender3")), export("ender3")
    given["command"]["accel_mm_s2"] = 5200.0
    given["digest"] = export_digest(given)
    prints = both(two_objects(), machine, given, tmp_path, klipper)
    assert "limited 0.000 s" not in prints.log
    first = (round(_print_begins(prints.plain.time_s) * 1e3) - 500) * _FINE
    plan, found = (s.sampled(1e-3 / _FINE)[:, first:] for s in (prints.plain, prints.live))
    off_mm = shifted(found, _later(prints) * 1e3 * _FINE, plan.shape[1]) - _predicted(plan, given)
    # The prediction takes the plan from steps, whose edges look like acceleration at the limit.
    assert np.sqrt(np.mean(off_mm**2)) < 3e-3
    assert np.abs(off_mm).max() < 20e-3


def test_a_compensated_file_is_not_compensated_twice(
    klipper: Path, export: Callable[[str], dict[str, Any]], tmp_path: Path
) -> None:
    machine = homed(load_machine("ender3"))
    (tmp_path / "in.gcode").write_text(two_objects())
    made = tmp_path / "out.gcode"
    compensate_file(tmp_path / "in.gcode", made, machine, Options(robust="off"))
    more = f"[force_move]\nenable_force_move: True\n{USERS}\n{MACROS}"
    prints = both(made.read_text(), machine, export("ender3"), tmp_path, klipper, more)
    # It stands aside for SET_INPUT_SHAPER, so that there the head stands a little longer.
    wanted = stands(prints.plain)
    assert [place for place in stands(prints.live) if place in wanted] == wanted
    # Step by step the same order of places, but for the few moves outside of the streams.
    for ours, theirs in zip(prints.live.place_mm, prints.plain.place_mm, strict=True):
        assert len(ours) == pytest.approx(len(theirs), rel=2e-3)
    assert "limited 0.000 s" not in prints.log


def _unsigned(change: Callable[[dict[str, Any]], None]) -> Callable[[dict[str, Any]], str]:
    """Change an export and leave its digest as it was."""

    def made(given: dict[str, Any]) -> str:
        change(given)
        return json.dumps(given)

    return made


def _signed(change: Callable[[dict[str, Any]], None]) -> Callable[[dict[str, Any]], str]:
    """Change an export and sign it anew."""

    def made(given: dict[str, Any]) -> str:
        change(given)
        given["digest"] = export_digest(given)
        return json.dumps(given)

    return made


def _taps(change: Callable[[list[float]], Any]) -> Callable[[dict[str, Any]], None]:
    return lambda given: change(given["axes"]["x"]["taps"])


HOSTILE: dict[str, tuple[Callable[[dict[str, Any]], str], str]] = {
    "truncated": (lambda g: json.dumps(g)[:-200], "is not a whole export"),
    "empty": (lambda g: "", "is not a whole export"),
    "a list": (lambda g: "[1]", "is no export for this version"),
    "nested": (lambda g: "[" * 90_000, "is not a whole export"),
    "too large": (lambda g: json.dumps(g) + " " * 300_000, "larger than any export"),
    "changed": (_unsigned(_taps(lambda t: t.__setitem__(3, 0.2))), "its digest differs"),
    "foreign": (_signed(lambda g: g.update(schema="serval/1")), "is no export for this version"),
    "kinematics": (_signed(lambda g: g.update(kinematics="corexy")), "the export is for corexy"),
    "delta": (_signed(lambda g: g.update(kinematics="delta")), "the export is for delta"),
    "limits": (
        _signed(lambda g: g["limits"].update(max_accel_mm_s2=50_000.0)),
        "max_accel is 5000 in printer.cfg and 50000 in the export",
    ),
    "NaN": (
        lambda g: json.dumps(g).replace('"taps": [', '"taps": [NaN, ', 1),
        "the export holds NaN",
    ),
    "infinite": (
        lambda g: json.dumps(g).replace('"taps": [', '"taps": [1e999, ', 1),
        "not JSON compliant",
    ),
    "moves": (_signed(_taps(lambda t: t.__setitem__(80, t[80] + 0.01))), "do not sum to 1"),
    "late": (_signed(_taps(lambda t: t.reverse() or t.insert(0, t.pop()))), "in time"),
    "words": (_signed(_taps(lambda t: t.__setitem__(0, "1"))), "tap is no number"),
    "no taps": (_signed(lambda g: g["axes"].pop("y")), "is not a whole export"),
    "wild": (
        _signed(_taps(lambda t: (t.__setitem__(0, t[0] + 49), t.__setitem__(160, t[160] - 49)))),
        "",
    ),
}


@pytest.mark.parametrize("what", HOSTILE)
def test_bad_exports_are_refused_and_klipper_prints(
    what: str,
    klipper: Path,
    export: Callable[[str], dict[str, Any]],
    tmp_path: Path,
) -> None:
    machine = homed(load_machine("ender3"))
    change, reason = HOSTILE[what]
    text = "G28\nG90\nG1 X50 Y20 F9000\nSTILLPATH ENABLE=1\nG1 X20 Y60\nSTILLPATH_STATUS\n"
    bad = change(export("ender3"))
    (tmp_path / "export.json").write_text(bad)
    prints = _with_file(text, machine, tmp_path, klipper)
    log = (tmp_path / "klippy.log").read_text()
    assert "Klipper moves as without it" in log
    assert reason in log
    assert "stillpath: refused" in log
    home, end = stands(prints)[-2:] if len(stands(prints)) > 1 else ((0, 0), stands(prints)[-1])
    assert end != home


def _with_file(text: str, machine: Machine, place: Path, klipper: Path) -> Steps:
    config = printer_cfg(machine, "[stillpath]\nfile: export.json")
    return steps_of(text, config, place, klipper)


def test_a_missing_export_is_said(klipper: Path, tmp_path: Path) -> None:
    _with_file("G28\nSTILLPATH_STATUS\n", homed(load_machine("ender3")), tmp_path, klipper)
    assert "cannot read export.json" in (tmp_path / "klippy.log").read_text()


def test_an_emergency_stop_stays_one(
    klipper: Path, export: Callable[[str], dict[str, Any]], tmp_path: Path
) -> None:
    machine = homed(load_machine("ender3"))
    with pytest.raises(AssertionError):
        print_with("G28\nG1 X50 F9000\nM112\n", machine, export("ender3"), tmp_path, klipper)
    log = (tmp_path / "klippy.log").read_text()
    assert "Shutdown due to M112 command" in log
    assert "stillpath.py" not in log


def _with_event(event: str) -> str:
    """Two objects, with an event in fast lines and a stand behind the next one."""
    lines = two_objects().split("\n")
    fast = [k for k, line in enumerate(lines) if line.startswith("G1 X") and "F9000" in line]
    script = EVENTS[event].split("\n")
    if event == "CANCEL_PRINT":
        return "\n".join([*lines[: fast[12] + 1], *script, ""])
    for k in reversed(fast[3::9]):
        lines[k + 1 : k + 2] = [*script, lines[k + 1], "G4 P1500"]
    return "\n".join(lines)


def _print_begins(times: list[Any]) -> float:
    """When X or Y moves after the homing of Z, the only long stand."""
    t = np.sort(np.concatenate(times))
    return float(t[np.flatnonzero(np.diff(t) > _HOMED_S)[-1] + 1])


def _later(prints: Pair) -> float:
    """By how much later the extruder makes its last step, which no filter touches."""
    return float(prints.live.others_s[1][-1] - prints.plain.others_s[1][-1])


def _predicted(plan: np.ndarray, given: dict[str, Any]) -> np.ndarray:
    """Filter a plan whose samples are `_FINE` to one of the filter."""
    taps = np.array([given["axes"][axis]["taps"] for axis in ("x", "y")])
    command = given["command"]
    far = np.array([[-_FAR_MM, _FAR_MM]] * 2)
    live = LiveFilter(taps, 1e-3, command["velocity_mm_s"], command["accel_mm_s2"], far)
    out = np.empty_like(plan)
    for phase in range(_FINE):
        rows = np.pad(plan[:, phase::_FINE], ((0, 0), (live.margin, live.margin)), mode="edge")
        out[:, phase::_FINE] = live.command(rows)
    return out
