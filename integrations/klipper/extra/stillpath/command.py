# Copyright (C) 2026  The Stillpath authors
# This file is free software under the GNU General Public License, version 3 or later (LICENSE).
"""From Klipper's plan of X and Y to the command of their motors, sample by sample."""

from __future__ import annotations

import math
from collections import deque
from operator import mul

FADE = 24
"""Samples in which the filter fades out before, and in after, what it may not do."""
MARGIN = 6
"""Samples from the end of a batch of steps to the last one that is asked for."""
BLOCK = 256
PAUSE = 500
"""Samples between two moves that pass, so few that the filter does not come back for them."""
STILL_MM = 1e-10


class Plan:
    """Klipper's plan of X and Y: phases of constant acceleration, sampled once, in order."""

    def __init__(self):
        self.phases = deque()
        self.here = (0.0, 0.0)

    def rest_at(self, x, y):
        self.phases.clear()
        self.here = (x, y)

    def add(self, *move):
        """Take a move as `trapq_append` does."""
        t, accel_t, cruise_t, decel_t, x, y, _z, rx, ry, _rz, start_v, cruise_v, accel = move
        if not rx and not ry:
            return
        for seconds, v, a in (
            (accel_t, start_v, accel),
            (cruise_t, cruise_v, 0.0),
            (decel_t, cruise_v, -accel),
        ):
            if seconds:
                half = 0.5 * a
                self.phases.append((t, t + seconds, x, y, rx, ry, v, half))
                way = (v + half * seconds) * seconds
                x, y, t = x + rx * way, y + ry * way, t + seconds

    def starts_s(self):
        """Return when the next phase begins."""
        return self.phases[0][0] if self.phases else math.inf

    def sample(self, first, count, sample_s, xs, ys):
        """Append so many samples; phases that are over are forgotten."""
        phases = self.phases
        x, y = self.here
        for k in range(first, first + count):
            t = k * sample_s
            while phases:
                begin, end, px, py, rx, ry, v, half = phases[0]
                if t < begin:
                    break
                if t < end:
                    into = t - begin
                    way = (v + half * into) * into
                    x, y = px + rx * way, py + ry * way
                    break
                into = end - begin
                way = (v + half * into) * into
                x, y = px + rx * way, py + ry * way
                phases.popleft()
            xs.append(x)
            ys.append(y)
        self.here = (x, y)


def _part(change, most):
    """Return the largest part of what is added to the plan's change that keeps a limit."""
    plan, more = change
    if abs(plan + more) <= most:
        return 1.0
    room = most - (plan if more > 0.0 else -plan)
    return max(0.0, room / abs(more)) if more else 0.0


class Filter:
    """The command of X and Y, sample by sample: plan + share * (filtered plan - plan).

    The share is 1, but for what command limits forbid: there, and FADE samples around, it is so
    small that they are kept. Sample k stands for the print time k * sample_s.
    """

    def __init__(self, export, bounds):
        self.plan = Plan()
        self.sample_s = export.sample_s
        self.taps = [taps[::-1] for taps in export.taps]
        self.reach = export.reach
        self.far = export.reach + 2 * FADE + 2
        self.preview_s = (self.far + MARGIN) * export.sample_s
        self.most_step = export.velocity_mm_s * export.sample_s
        self.most_turn = export.accel_mm_s2 * export.sample_s**2
        self.most_motor_step = export.motor_velocity_mm_s * export.sample_s
        self.most_motor_turn = export.motor_accel_mm_s2 * export.sample_s**2
        self.bounds = bounds
        self.passing = False
        self.blocked = deque()
        self.limited = 0
        ramp = list(range(1, FADE + 2)) + list(range(FADE, 0, -1))
        self.ramp = [r / float(sum(ramp)) for r in ramp]
        self.next = 0
        self.rest_at(0.0, 0.0)

    def rest_at(self, x, y):
        """Stand there."""
        self.plan.rest_at(x, y)
        self._stand(x, y)

    def _stand(self, x, y):
        """Start buffers anew: the plan stood at (x, y) for long."""
        self.base = self.next - self.far - 3 * FADE
        known = self.next + self.far + 1 - self.base
        self.x, self.y = [x] * known, [y] * known
        devs = known - self.reach
        self.dx, self.dy = [0.0] * devs, [0.0] * devs
        self.allowed = [1.0] * (devs - 1)
        self.changed = self.limit_at = -(1 << 62)
        self.out = [(x, y), (x, y)]

    def block(self, begin_s, end_s):
        """Let the plan pass between two times that lie ahead."""
        first, last = (math.floor(t / self.sample_s) for t in (begin_s, end_s))
        if self.blocked and first - self.blocked[-1][1] < PAUSE:
            self.blocked[-1][1] = last
        else:
            self.blocked.append([first, last])

    def late_move(self, t):
        """Forget samples at and after a time; return whether there were any."""
        keep = max(math.ceil(t / self.sample_s) - self.base, 2 * self.reach + 2)
        if keep >= len(self.x):
            return False
        for values, ahead in ((self.x, 0), (self.y, 0), (self.dx, 1), (self.dy, 1)):
            del values[keep - self.reach * ahead :]
        del self.allowed[keep - self.reach - 1 :]
        return True

    def push(self, until):
        """Return pieces up to an index: (index, u before, u, u after) of X and of Y, in order.

        Nothing is returned for samples in which the command stands.
        """
        pieces = []
        while self.next <= until:
            if self.next - self.far - 3 * FADE > self.changed:
                starts = self.plan.starts_s() / self.sample_s
                quiet = int(min(until + 1, starts - self.far - 2))
                if quiet > self.next:
                    self.next = quiet
                    self._stand(*self.plan.here)
                    continue
            count = min(BLOCK, until + 1 - self.next)
            self._extend(self.next + count + self.far - self.base)
            self._emit(count, pieces)
        return pieces

    def _extend(self, size):
        """Sample, filter and check so far."""
        x, y = self.x, self.y
        old = len(x)
        if size > old:
            self.plan.sample(self.base + old, size - old, self.sample_s, x, y)
            for i in range(size - 1, old - 1, -1):
                if x[i] != x[i - 1] or y[i] != y[i - 1]:
                    self.changed = self.base + i
                    break
        width, reach = 2 * self.reach + 1, self.reach
        for values, taps, devs in ((x, self.taps[0], self.dx), (y, self.taps[1], self.dy)):
            for i in range(len(devs), size - reach):
                near = values[i - reach : i - reach + width]
                devs.append(sum(map(mul, taps, near)) - values[i])
        allowed, blocked = self.allowed, self.blocked
        for i in range(len(allowed), size - reach - 1):
            while blocked and blocked[0][1] < self.base + i:
                blocked.popleft()
            passing = self.passing or (blocked and blocked[0][0] <= self.base + i)
            share = 0.0 if passing else self._share(i)
            if share < 1.0:
                self.limit_at = self.base + i
            allowed.append(share)

    def _share(self, i):
        """Return the largest share that keeps all limits at a sample."""
        share = 1.0
        steps, turns = [], []
        for values, devs, (least, most) in (
            (self.x, self.dx, self.bounds[0]),
            (self.y, self.dy, self.bounds[1]),
        ):
            d = devs[i]
            turn = (
                values[i - 1] - 2.0 * values[i] + values[i + 1],
                devs[i - 1] - 2.0 * d + devs[i + 1],
            )
            step = (values[i] - values[i - 1], d - devs[i - 1])
            share = min(share, _part(turn, self.most_turn), _part(step, self.most_step))
            turns.append(turn)
            steps.append(step)
            if not least <= values[i] + d <= most:
                room = (most - values[i]) if d > 0.0 else (values[i] - least)
                share = min(share, max(0.0, room / abs(d)) if d else 0.0)
        for both, most in ((turns, self.most_motor_turn), (steps, self.most_motor_step)):
            if most < math.inf:
                (x, more_x), (y, more_y) = both
                share = min(
                    share,
                    _part((x + y, more_x + more_y), most),
                    _part((x - y, more_x - more_y), most),
                )
        return share

    def _emit(self, count, pieces):
        base, x, y, dx, dy = self.base, self.x, self.y, self.dx, self.dy
        free = self.limit_at < self.next - 3 * FADE
        before, now = self.out
        for k in range(self.next, self.next + count):
            i = k + 1 - base
            share = 1.0 if free else self._faded(i)
            after = (x[i] + share * dx[i], y[i] + share * dy[i])
            if (
                abs(now[0] - before[0]) > STILL_MM
                or abs(now[1] - before[1]) > STILL_MM
                or abs(after[0] - now[0]) > STILL_MM
                or abs(after[1] - now[1]) > STILL_MM
            ):
                pieces.append((k, before, now, after))
            before, now = now, after
        self.out = [before, now]
        self.next += count
        drop = self.next - self.far - 3 * FADE - base
        if drop > BLOCK:
            for values in (x, y, dx, dy, self.allowed):
                del values[:drop]
            self.base += drop

    def _faded(self, i):
        """Return the mean over FADE samples around of the least share FADE samples around."""
        allowed = self.allowed
        least = [min(allowed[j - FADE : j + FADE + 1]) for j in range(i - FADE, i + FADE + 1)]
        share = sum(map(mul, self.ramp, least))
        if share < 1.0 - 1e-9:
            self.limited += 1
        return min(1.0, share)
