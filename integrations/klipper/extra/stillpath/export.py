# Copyright (C) 2026  The Stillpath authors
# This file is free software under the GNU General Public License, version 3 or later (LICENSE).
"""The file that `stillpath klipper export` wrote, checked before anything is made of it."""

from __future__ import annotations

import hashlib
import json
import math
from pathlib import Path

SCHEMA = "stillpath-klipper/1"
MOST_BYTES, MOST_TAPS, MOST_PREVIEW_S, MOST_GAIN = 200_000, 401, 0.2, 50.0


class Refused(Exception):
    """Why the motors follow Klipper's own plan."""


class Export:
    """What `stillpath klipper export` wrote, checked from the first byte to the last."""

    def __init__(self, content):
        self.machine = str(content["machine"])
        self.kinematics = str(content["kinematics"])
        self.sample_s = _number(content, "sample_s", 2e-4, 4e-3)
        limits, command = content["limits"], content["command"]
        self.max_velocity = _number(limits, "max_velocity_mm_s", 1.0, 1e4)
        self.max_accel = _number(limits, "max_accel_mm_s2", 1.0, 1e6)
        self.velocity_mm_s = _number(command, "velocity_mm_s", 1.0, 1e4)
        self.accel_mm_s2 = _number(command, "accel_mm_s2", 1.0, 1e6)
        # Of x + y and of x - y, where a CoreXY states them.
        motors = {"velocity_mm_s": math.inf, "accel_mm_s2": math.inf, **command.get("motors", {})}
        self.motor_velocity_mm_s = _number(motors, "velocity_mm_s", 1.0, math.inf)
        self.motor_accel_mm_s2 = _number(motors, "accel_mm_s2", 1.0, math.inf)
        self.taps = [_taps(content["axes"][axis]["taps"], axis, self.sample_s) for axis in "xy"]
        if len(self.taps[0]) != len(self.taps[1]):
            raise Refused("x and y have different numbers of taps")
        self.reach = len(self.taps[0]) // 2
        self.digest = content["digest"]


def read_export(path):
    """Return the export in a file, or say what is wrong with it."""
    try:
        with Path(path).expanduser().open("rb") as file:
            data = file.read(MOST_BYTES + 1)
    except OSError as error:
        raise Refused("cannot read %s: %s" % (path, error.strerror)) from None
    if len(data) > MOST_BYTES:
        raise Refused("%s is larger than any export" % (path,))
    try:
        content = json.loads(data.decode("utf-8"), parse_constant=_no_constant)
        if not isinstance(content, dict) or content.get("schema") != SCHEMA:
            raise Refused("%s is not an export for this version (%s)" % (path, SCHEMA))
        if content.get("digest") != digest(content):
            raise Refused("%s was changed after it was exported: its digest differs" % (path,))
        return Export(content)
    except Refused:
        raise
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError, RuntimeError) as error:
        raise Refused(
            "%s is not a whole export: %s" % (path, error or type(error).__name__)
        ) from None


def digest(content):
    """Return the SHA-256 of an export without its digest, as canonical JSON."""
    rest = {name: value for name, value in content.items() if name != "digest"}
    text = json.dumps(rest, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode("utf-8")).hexdigest()


def _no_constant(text):
    raise Refused("the export holds %s" % (text,))


def _number(content, name, least, most):
    value = content[name]
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise Refused("%s is not a number" % (name,))
    if not least <= value <= most:
        raise Refused("%s is %s, not from %s to %s" % (name, value, least, most))
    return float(value)


def _taps(given, axis, sample_s):
    if not isinstance(given, list) or not 3 <= len(given) <= MOST_TAPS or not len(given) % 2:
        raise Refused("axis %s needs an odd number of taps, up to %d" % (axis, MOST_TAPS))
    taps = [_number({"tap": tap}, "tap", -MOST_GAIN, MOST_GAIN) for tap in given]
    reach = len(taps) // 2
    if reach * sample_s > MOST_PREVIEW_S:
        raise Refused("the taps of axis %s look further ahead than %s s" % (axis, MOST_PREVIEW_S))
    if abs(math.fsum(taps) - 1.0) > 1e-9:
        raise Refused("the taps of axis %s move what stands: they do not sum to 1" % (axis,))
    if abs(math.fsum((i - reach) * tap for i, tap in enumerate(taps))) > 1e-6:
        raise Refused("the taps of axis %s shift slow motion in time" % (axis,))
    if math.fsum(map(abs, taps)) > MOST_GAIN:
        raise Refused("the taps of axis %s amplify more than %s times" % (axis, MOST_GAIN))
    return taps
