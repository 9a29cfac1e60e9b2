"""What speaks against printing a machine's files on a printer, as the printer describes itself."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from pydantic import BaseModel, ConfigDict

from stillpath.applications.machines.checks import differences
from stillpath.compensation.defaults import DEFAULT_METHOD
from stillpath.gcode.firmware.klipper.versions import ignores_shaper_frequencies
from stillpath.models.errors import ModelError
from stillpath.models.firmware import Klipper
from stillpath.models.machine import Machine
from stillpath.service.deliveries.moonraker import PrinterState

__all__ = ["Finding", "changes", "findings", "relevant"]

_WRAPPED = ("PAUSE", "RESUME", "CANCEL_PRINT")
_OURS = "Stillpath:"
"""Beginning of the descriptions of our macros (integrations/klipper)."""
# Limits that no command can raise: a file planned with higher ones runs late.
_FIXED = frozenset(
    {
        "max_z_velocity",
        "max_z_accel",
        "max_extrude_only_velocity",
        "max_extrude_only_accel",
        "max_extrude_cross_section",
    }
)
_RELATIVE = 1e-6
_WITHOUT_STREAM = ("none", "advise", "live")
# What changes the motion or the vibration, of sections that hold more than that.
_STEPPER = frozenset(
    {
        "rotation_distance",
        "gear_ratio",
        "microsteps",
        "full_steps_per_rotation",
        "position_min",
        "position_max",
    }
)
_DRIVER_OF_XY = re.compile(r"tmc\S+ stepper_[xy](?P<further>\d*)")
_DRIVER = frozenset({"run_current", "interpolate", "stealthchop_threshold"})
_EXTRUDER = _STEPPER | {
    "nozzle_diameter",
    "filament_diameter",
    "pressure_advance",
    "pressure_advance_smooth_time",
    "instantaneous_corner_velocity",
    "max_extrude_only_velocity",
    "max_extrude_only_accel",
    "max_extrude_cross_section",
}
_WHOLE = frozenset({"printer", "input_shaper", "firmware_retraction", "gcode_arcs"})


class Finding(BaseModel):
    """One thing that speaks against printing now.

    Attributes
    ----------
    place : str
        Section and option, command, or limit.
    machine, printer
        What the machine's document says (or what was remembered), and what the printer has.
    unsafe : bool
        Whether a print is not started because of it.
    text : str
        One line: place, both values, remedy.
    """

    model_config = ConfigDict(frozen=True)

    place: str
    machine: Any = None
    printer: Any = None
    unsafe: bool = False
    text: str


def findings(
    machine: Machine, asked: PrinterState, *, method: str = DEFAULT_METHOD
) -> list[Finding]:
    """Return findings against printing a machine's file on a printer, unsafe ones first."""
    firmware = machine.firmware
    if not isinstance(firmware, Klipper):
        text = (
            f"it runs Klipper, the machine {machine.name} runs {firmware.kind}, and so do files "
            "made for it; name a Klipper machine in the file of printers"
        )
        return [Finding(place="firmware", machine=firmware.kind, unsafe=True, text=text)]
    streams = method not in _WITHOUT_STREAM
    found = [
        *_differences(machine, asked),
        *_in_force(machine, asked),
        *(_commands(machine, asked) if streams else ()),
        *(_wrappers(asked) if streams else ()),
        *(_kept_shaper(asked, streams=streams) if method != "none" else ()),
        *(_no_shaper(asked) if method == "advise" else ()),
    ]
    return sorted(found, key=lambda finding: not finding.unsafe)


def relevant(asked: PrinterState) -> dict[str, dict[str, Any]]:
    """Return of a configuration what changes motion or vibration, by section and option."""
    found: dict[str, dict[str, Any]] = {}
    for section, options in sorted(asked.settings.items()):
        words = section.split()
        if section in _WHOLE:
            kept = set(options)
        elif words[0].startswith("stepper_"):
            kept = set(_STEPPER)
        elif _DRIVER_OF_XY.fullmatch(section):
            kept = set(_DRIVER)
        elif words[0] == "extruder":
            kept = set(_EXTRUDER)
        else:
            continue
        found[section] = {name: options[name] for name in sorted(kept & set(options))}
    return found


def changes(
    known: Mapping[str, Mapping[str, Any]], day: str, printer: str, asked: PrinterState
) -> Iterator[Finding]:
    """Yield what has changed in a printer's configuration.

    Parameters
    ----------
    known : mapping
        What `relevant` returned for it on `day`.
    printer : str
        Its name.
    """
    now = relevant(asked)
    for section in sorted({*known, *now}):
        driver = _DRIVER_OF_XY.fullmatch(section)
        if driver and driver["further"] and section not in known:
            continue  # until 2026-11-28 drivers of second motors were not remembered
        before, after = known.get(section, {}), now.get(section, {})
        for option in sorted({*before, *after}):
            was, is_now = before.get(option), after.get(option)
            # As JSON gives it back: tuples are lists there.
            if _plain(was) != _plain(is_now):
                text = (
                    f"[{section}] {option} has changed since {day}, from {_word(was)} to "
                    f"{_word(is_now)}; if it changes the motion, measure the machine again, else "
                    f"accept it (`stillpath printers accept {printer}`)"
                )
                place = f"[{section}] {option}"
                yield Finding(place=place, machine=was, printer=is_now, text=text)


def _differences(machine: Machine, asked: PrinterState) -> Iterator[Finding]:
    """Compare the configuration with the document, option by option."""
    try:
        found = differences(machine, asked.config())
    except ModelError as error:
        yield Finding(place="printer.cfg", text=f"cannot be compared with the machine: {error}")
        return
    for entry in found:
        place = f"[{entry.section}] {entry.option}".rstrip()
        unsafe, why = False, ""
        if entry.option == "kinematics":
            unsafe, why = True, "; a file for other kinematics must not be printed"
        elif entry.option in _FIXED and _less(entry.printer, entry.machine):
            unsafe, why = True, "; no command raises this limit, so that the file would be late"
        yield Finding(
            place=place,
            machine=entry.machine,
            printer=entry.printer,
            unsafe=unsafe,
            text=entry.text + why,
        )


def _in_force(machine: Machine, asked: PrinterState) -> Iterator[Finding]:
    """Compare what is in force with the configuration, unless a print may have changed it."""
    if asked.prints:
        return
    for name, value in asked.limits.items():
        configured = asked.settings["printer"].get(name)
        if isinstance(configured, int | float) and not _close(value, float(configured)):
            raised = name == "max_accel" and value > configured
            told = f"{name} in force is {value:g}, printer.cfg says {configured:g}"
            if raised:
                told += "; the first moves of a print would be made with it"
            yield Finding(
                place=name,
                machine=configured,
                printer=value,
                unsafe=raised,
                text=f"{told}; send STILLPATH_RESTORE or restart Klipper",
            )
    advance, stated = asked.pressure_advance_s, machine.pressure_advance_s
    configured = asked.settings.get("extruder", {}).get("pressure_advance", 0.0)
    if advance is not None and not _close(advance, stated) and not _close(advance, configured):
        text = (
            f"pressure_advance in force is {advance:g}, printer.cfg says {configured:g}, the "
            f"machine {stated:g}; set it in the file (SET_PRESSURE_ADVANCE), or restart Klipper"
        )
        yield Finding(place="pressure_advance", machine=stated, printer=advance, text=text)


def _commands(machine: Machine, asked: PrinterState) -> Iterator[Finding]:
    """Find macros that stand in the way of what a stream sets."""
    from stillpath.gcode.firmware.registry import adapter  # heavy

    own = {section.lower() for section in asked.sections}
    limits = adapter(machine).stream_limits(adapter(machine).initial_limits())
    needed = float(getattr(limits, "accel_mm_s2", 0.0))
    configured = asked.settings["printer"].get("max_accel", 0.0)
    if "gcode_macro set_velocity_limit" in own and configured < needed:
        text = (
            f"[gcode_macro SET_VELOCITY_LIMIT] stands before Klipper's own command, and max_accel "
            f"is {configured:g} where a compensated file needs {needed:g}: nobody knows whether "
            "the macro lets it be raised; take it out, or start the print at the printer"
        )
        yield Finding(place="SET_VELOCITY_LIMIT", machine=needed, unsafe=True, text=text)
    if "gcode_macro set_input_shaper" in own:
        text = (
            "[gcode_macro SET_INPUT_SHAPER] stands before Klipper's own command: unless it passes "
            "on SHAPER_FREQ_X=0 SHAPER_FREQ_Y=0, the shaper works on top of the compensation; take "
            "it out"
        )
        yield Finding(place="SET_INPUT_SHAPER", text=text)


def _wrappers(asked: PrinterState) -> Iterator[Finding]:
    """Find commands that would run under a stream's limits."""
    missing = list(_unwrapped(asked))
    if not missing:
        return
    files = "stillpath.cfg"
    if "M600" in missing:
        files = "stillpath-m600.cfg" if missing == ["M600"] else f"{files} and stillpath-m600.cfg"
    names = ", ".join(missing)
    text = (
        f"{names} would move under a compensated stretch's limits: include {files} after your own "
        "macros in printer.cfg, then send STILLPATH_CHECK"
    )
    yield Finding(place=names, text=text)


def _kept_shaper(asked: PrinterState, *, streams: bool) -> Iterator[Finding]:
    """Find a Klipper that does not switch its shaper off, nor set its frequency."""
    shaper = asked.settings.get("input_shaper")
    if shaper is None or not ignores_shaper_frequencies(asked.software):
        return
    if streams and not any(shaper.get(f"shaper_freq_{axis}") for axis in "xy"):
        return
    does = (
        "it stays on in compensated stretches, on top of the compensation"
        if streams
        else "frequencies that a file sets have no effect"
    )
    text = (
        f"Klipper {asked.software} keeps the frequencies of its shaper whatever SET_INPUT_SHAPER "
        f"says, as all do from 2026-04-27 to 2026-05-04: {does}; update Klipper, or take the "
        "frequencies out of [input_shaper]"
    )
    yield Finding(place="SET_INPUT_SHAPER", printer=asked.software, unsafe=streams, text=text)


def _no_shaper(asked: PrinterState) -> Iterator[Finding]:
    """Find that the shaper cannot be set."""
    if "input_shaper" not in asked.settings:
        text = (
            "printer.cfg has no section [input_shaper], without which Klipper does not know "
            "SET_INPUT_SHAPER: an advised shaper has no effect, but its accelerations have; add "
            "the section, it may be empty"
        )
        yield Finding(place="[input_shaper]", text=text)


def _unwrapped(asked: PrinterState) -> Iterable[str]:
    if asked.commands is None:
        # Of macros of one name the last one counts. Those of stillpath.cfg have a tab in between.
        titles = [" ".join(name.split()) for name in asked.sections]
        last = {title.upper(): title for title in titles}
        return [
            name
            for name in _WRAPPED
            if last.get(f"GCODE_MACRO {name}") != f"gcode_macro {name.title()}"
        ]
    known = asked.commands
    looked_for = (*_WRAPPED, "M600") if "M600" in known else _WRAPPED
    return [name for name in looked_for if not known.get(name, "").startswith(_OURS)]


def _plain(value: Any) -> Any:
    return json.loads(json.dumps(value))


def _word(value: Any) -> str:
    return "nothing" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


def _less(value: Any, limit: Any) -> bool:
    both = isinstance(value, int | float) and isinstance(limit, int | float)
    return both and value < limit and not _close(value, limit)


def _close(a: float, b: float) -> bool:
    return abs(a - b) <= _RELATIVE * max(abs(a), abs(b))
