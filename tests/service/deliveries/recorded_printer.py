"""What Klipper says of a printer that is as a machine document says, in Moonraker's words."""

from __future__ import annotations

from typing import Any

from stillpath.models.firmware import Klipper
from stillpath.models.machine import Machine

__all__ = ["status_of"]

# Descriptions as of integrations/klipper and of Klipper's own commands.
_COMMANDS = {
    "PAUSE": "Stillpath: pause, limits and shaper restored first",
    "RESUME": "Stillpath: resume, the move back at printer.cfg's limits",
    "CANCEL_PRINT": "Stillpath: cancel, limits and shaper restored first",
    "SET_VELOCITY_LIMIT": "Set printer velocity limits",
    "SET_INPUT_SHAPER": "Set cartesian parameters for input shaper",
}


def status_of(machine: Machine) -> dict[str, Any]:
    """Return the objects of a printer; change them, and the printer is another one."""
    firmware = machine.firmware
    assert isinstance(firmware, Klipper)
    planner, extruder = firmware.planner, firmware.extruder
    settings: dict[str, dict[str, Any]] = {
        "printer": {
            "kinematics": machine.kinematics,
            "max_velocity": planner.max_velocity_mm_s,
            "max_accel": planner.max_accel_mm_s2,
            "square_corner_velocity": planner.square_corner_velocity_mm_s,
            "minimum_cruise_ratio": planner.minimum_cruise_ratio,
            "max_z_velocity": planner.max_z_velocity_mm_s,
            "max_z_accel": planner.max_z_accel_mm_s2,
        },
        "extruder": {
            "nozzle_diameter": extruder.nozzle_diameter_mm,
            "filament_diameter": extruder.filament_diameter_mm,
            "max_extrude_only_velocity": extruder.max_extrude_only_velocity_mm_s,
            "max_extrude_only_accel": extruder.max_extrude_only_accel_mm_s2,
            "max_extrude_only_distance": extruder.max_extrude_only_distance_mm,
            "max_extrude_cross_section": extruder.max_extrude_cross_section_mm2
            or 4.0 * extruder.nozzle_diameter_mm**2,
            "instantaneous_corner_velocity": extruder.instantaneous_corner_velocity_mm_s,
            "pressure_advance": machine.pressure_advance_s,
            "rotation_distance": 33.5,
        },
        "tmc2209 stepper_x": {"run_current": 0.58, "uart_pin": "PC11", "interpolate": True},
        **{
            f"stepper_{axis}": {
                "rotation_distance": 40.0,
                "position_min": travel.min_mm,
                "position_max": travel.max_mm,
                "gear_ratio": [],
                "endstop_pin": "^PC0",
            }
            for axis, travel in machine.travel.items()
        },
    }
    if firmware.shaper is not None:
        shaper = firmware.shaper
        settings["input_shaper"] = {
            "shaper_type_x": shaper.type_x,
            "shaper_freq_x": shaper.freq_x_hz,
            "damping_ratio_x": shaper.damping_x,
            "shaper_type_y": shaper.type_y,
            "shaper_freq_y": shaper.freq_y_hz,
            "damping_ratio_y": shaper.damping_y,
        }
    if firmware.retraction is not None:
        retraction = firmware.retraction
        settings["firmware_retraction"] = {
            "retract_length": retraction.retract_length_mm,
            "retract_speed": retraction.retract_speed_mm_s,
            "unretract_extra_length": retraction.unretract_extra_length_mm,
            "unretract_speed": retraction.unretract_speed_mm_s,
        }
    if firmware.arcs:
        settings["gcode_arcs"] = {"resolution": firmware.arc_resolution_mm}
    macros = ("gcode_macro PAUSE", "gcode_macro\tPause", "gcode_macro Resume")
    return {
        "configfile": {
            "settings": settings,
            "config": {**{n: {} for n in settings}, **{n: {} for n in macros}},
        },
        "toolhead": {
            name: settings["printer"][name]
            for name in (
                "max_velocity",
                "max_accel",
                "square_corner_velocity",
                "minimum_cruise_ratio",
            )
        },
        "gcode": {"commands": {name: {"help": text} for name, text in _COMMANDS.items()}},
        "extruder": {"pressure_advance": machine.pressure_advance_s},
        "print_stats": {"state": "standby"},
    }
