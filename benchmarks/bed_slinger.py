"""A bed that grows heavier: a fixed model against one that follows the printed mass.

A bed slinger of moving mass .8 kg (35 Hz with the bed empty) prints a block of .5 kg; Y falls to
27.4 Hz. The print is made here: squares with zigzag infill and a ring, layer on layer, of a
filament ten times as dense as PLA, so that half a kilogram takes 13 minutes (17 m of filament, 43
mm high) instead of two hours. The mass grows ten times as fast as it would: the harder case.

The file is compensated with the model of the empty bed, and with the mass schedule. The judge reads
the written files back at 10 kHz and integrates m(t) y'' + c y' + k y = k u with position and speed
carried on, the mass taken anew every quarter of a second from the file's own filament. It shares no
code, grid or state with the schedule.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from readback import DT_S, WINDOW_S, Aligned, Motion, Own, Timed, forced_stops, read_motion
from scipy.linalg import expm

from stillpath.models.arrays import Array
from stillpath.models.machine import Machine
from stillpath.models.plants import Mode, ModesSpec, RelativeModesSpec
from stillpath.models.response_kernels import dense_response
from stillpath.models.schedule import AxisSchedule, MassSchedule
from stillpath.models.store import load_machine
from stillpath.pipeline.compensate import compensate_file
from stillpath.pipeline.files import default_cache_dir
from stillpath.pipeline.options import Options
from stillpath.simulation.measures import PathDistances, Tally

MOVING_KG, PRINT_KG = 0.8, 0.5
DENSITY_G_CM3 = 12.4
_WIDTH_MM, _HEIGHT_MM, _SPEED_MM_S, _ACCEL_MM_S2 = 0.6, 0.75, 120.0, 2000.0
_SIDE_MM, _CENTRE_MM, _PITCH_MM = 90.0, 110.0, 9.0
_BLOCK_S, _EVERY = 0.25, 20
_GOAL = 5.0


@dataclass(frozen=True, slots=True)
class Row:
    """Contour error [um] while printing: the first and last quarter of the filament, all of it."""

    method: str
    first_rms: float
    last_rms: float
    last_max: float
    all_rms: float
    predicted_rms: float
    cpu_s: float


def main() -> None:
    parser = argparse.ArgumentParser(description="Fixed against scheduled model on a bed slinger.")
    parser.add_argument("--kg", type=float, default=PRINT_KG, help="mass of the print")
    parser.add_argument("--moving-kg", type=float, default=MOVING_KG, help="mass of the bed")
    parser.add_argument("--method", default="fbf")
    parser.add_argument("--robust", default="off")
    parser.add_argument("--json", type=Path, help="write the rows here too")
    given = parser.parse_args()

    plain = damped_by_the_frame(load_machine("generic-bedslinger"))
    mass = MassSchedule(moving_mass_kg=given.moving_kg, filament_density_g_cm3=DENSITY_G_CM3)
    scheduled = plain.model_copy(update={"schedules": {"y": AxisSchedule(mass=mass)}})
    options = Options(method=given.method, robust=given.robust)
    rows = []
    with tempfile.TemporaryDirectory(prefix="stillpath-bed-") as folder:
        source, target = Path(folder, "block.gcode"), Path(folder, "out.gcode")
        layers = write_block(source, given.kg, plain)
        print(
            f"{given.kg:g} kg in {layers} layers of {_HEIGHT_MM:g} mm on a bed of "
            f"{given.moving_kg:g} kg; contour error in um"
        )
        print(
            f"{'model':<12}{'first 1/4':>10}{'last 1/4':>10}{'max':>8}{'all':>8}"
            f"{'report':>8}{'cpu s':>7}"
        )
        original = read_motion(source, plain)
        for name, machine in (("none", None), ("fixed", plain), ("scheduled", scheduled)):
            began = time.process_time()
            predicted, motions = math.nan, list[Timed](Own.sections(original))
            written = original
            if machine is not None:
                result = compensate_file(
                    source, target, machine, options, cache_dir=default_cache_dir()
                )
                assert not result.put_back, result.put_back[0].reason
                predicted = result.channels[1].extruding.contour_rms_um
                written = read_motion(target, plain)
                planned = read_motion(source, plain, forced_stops(original, written))
                motions = list(Aligned(planned, written).sections(planned, written))
            cpu_s = time.process_time() - began
            judge = Judge(plain, mass, given.kg)
            for motion in motions:
                judge.add(motion, written)
            rows.append(judge.row(name, predicted, cpu_s))
            print(
                "{method:<12}{first_rms:>10.3f}{last_rms:>10.3f}{last_max:>8.2f}{all_rms:>8.3f}"
                "{predicted_rms:>8.3f}{cpu_s:>7.1f}".format(**asdict(rows[-1]))
            )
    gain = rows[1].last_rms / rows[2].last_rms
    print(f"last quarter: the schedule is {gain:.1f} x better (goal {_GOAL:g} x)")
    if given.json:
        given.json.write_text(json.dumps([asdict(row) for row in rows]), encoding="utf-8")
    if not gain >= _GOAL:
        raise SystemExit(1)


def write_block(path: Path, kg: float, machine: Machine) -> int:
    """Write a print of this mass; return its number of layers."""
    diameter_mm = machine.firmware.hotend.filament_diameter_mm
    filament_mm2 = 0.25 * math.pi * diameter_mm**2
    section_mm2 = _WIDTH_MM * _HEIGHT_MM
    wanted_mm = kg / (1e-6 * DENSITY_G_CM3) / filament_mm2
    lines = ["G28", "G90", "M83", f"M204 S{_ACCEL_MM_S2:.0f}"]
    fed_mm, layer = 0.0, 0
    while fed_mm < wanted_mm:
        z_mm = _HEIGHT_MM * (layer + 1)
        for number, outline in enumerate(_layer(layer)):
            x, y = outline[0]
            lines += [
                "G1 E-0.8 F2100",
                f"G1 Z{z_mm + 0.4:.3f} F900",
                f"G1 X{x:.3f} Y{y:.3f} F12000",
                f"G1 Z{z_mm:.3f} F900",
                "G1 E0.8 F2100",
            ]
            if number == 0:
                lines.insert(len(lines) - 5, f";LAYER:{layer}")
            for (x0, y0), (x1, y1) in itertools.pairwise(outline):
                e_mm = math.hypot(x1 - x0, y1 - y0) * section_mm2 / filament_mm2
                fed_mm += e_mm
                lines.append(f"G1 X{x1:.3f} Y{y1:.3f} E{e_mm:.5f} F{60 * _SPEED_MM_S:.0f}")
        layer += 1
    path.write_text("\n".join([*lines, ""]), encoding="ascii")
    return layer


def _layer(number: int) -> list[Array]:
    """Outlines of a layer: two squares, zigzag between, and a ring."""

    def square(half: float) -> Array:
        corners = [(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)]
        return _CENTRE_MM + half * np.array(corners, float)

    half = 0.5 * _SIDE_MM
    x = np.arange(-half + 6, half - 5, _PITCH_MM)
    ends = np.where(np.arange(2 * len(x)) // 2 % 2 == 0, 1, -1) * (half - 6)
    zigzag = np.column_stack([np.repeat(x, 2), -ends * np.tile([1, -1], len(x))])
    if number % 2:
        zigzag = zigzag[:, ::-1]
    turn = np.linspace(0.0, 2 * np.pi, 73)
    ring = 15.0 * np.column_stack([np.cos(turn), np.sin(turn)])
    return [square(half), square(half - 3), _CENTRE_MM + zigzag, _CENTRE_MM + ring]


def damped_by_the_frame(machine: Machine) -> Machine:
    """Return the machine with the same modes and viscous guides, as the judge integrates them."""
    axes = {}
    for axis, plants in machine.axes.items():
        assert isinstance(plants.nominal, RelativeModesSpec)
        modes = tuple(Mode(f_hz=m.f_hz, zeta=m.zeta, gain=m.share) for m in plants.nominal.modes)
        axes[axis] = plants.model_copy(update={"nominal": ModesSpec(modes=modes)})
    return machine.model_copy(update={"axes": axes})


class TrueAxis:
    """m y'' + c y' + k (y - u) = 0 with a mass that changes; position and speed go on."""

    def __init__(self, f_hz: float, zeta: float, moving_kg: float) -> None:
        w = 2 * np.pi * f_hz
        self._k, self._c, self._m0 = moving_kg * w**2, 2 * zeta * w * moving_kg, moving_kg
        self._state: Array | None = None

    def push(self, u: Array, printed_kg: float) -> Array:
        """Return the positions that answer a command that is linear between samples."""
        m = self._m0 + printed_kg
        # States y - origin, y' and the held command with its slope (triangle hold).
        block = np.zeros((4, 4))
        block[0, 1] = 1.0
        block[1, :3] = -self._k / m, -self._c / m, self._k / m
        block[2, 3] = 1.0 / DT_S
        grown = expm(block * DT_S)
        phi, step, ramp = grown[:2, :2], grown[:2, 2], grown[:2, 3]
        if self._state is None:
            self._origin, self._state = float(u[0]), np.zeros(2)
        xi = self._state - ramp * (u[0] - self._origin)
        y = np.empty(len(u))
        b = step - ramp + phi @ ramp
        dense_response(phi, b, np.array([1.0, 0.0]), float(ramp[0]), self._origin, xi, u, y)
        # The state at the next sample, whose command is not known yet: the caller overlaps by one.
        self._state = self._last(phi, b, ramp, xi, float(u[-1]))
        return y

    def _last(self, phi: Array, b: Array, ramp: Array, xi: Array, u: float) -> Array:
        """Physical state at the last sample pushed."""
        drive = u - self._origin
        return np.asarray(np.linalg.solve(phi, xi - b * drive) + ramp * drive)


class Judge:
    """Contour error of the true machine, by quarters of the filament."""

    def __init__(self, machine: Machine, mass: MassSchedule, print_kg: float) -> None:
        self._machine, self._moving_kg, self._print_kg = machine, mass.moving_mass_kg, print_kg
        area_mm2 = 0.25 * math.pi * machine.firmware.hotend.filament_diameter_mm**2
        self._kg_per_mm = 1e-6 * DENSITY_G_CM3 * area_mm2
        self._quarters = [Tally() for _ in range(4)]

    def add(self, motion: Timed, written: Motion) -> None:
        axes = []
        for name, moving_kg in (("x", math.inf), ("y", self._moving_kg)):
            plant = self._machine.axes[name].nominal  # type: ignore[index]
            assert isinstance(plant, ModesSpec)
            assert len(plant.modes) == 1
            # Beside an endless mass a print weighs nothing.
            kg = 1e6 if math.isinf(moving_kg) else moving_kg
            axes.append(TrueAxis(plant.modes[0].f_hz, plant.modes[0].zeta, kg))
        filament = np.maximum.accumulate(written.phases.start_mm[:, 3])
        times = written.phases.t_s
        window, size, n = round(WINDOW_S / DT_S), round(_BLOCK_S / DT_S), motion.samples
        for k0 in range(0, n - 1, size):
            k1 = min(n, k0 + size + 1)
            start_s = motion._start_s + DT_S * k0  # type: ignore[attr-defined]
            printed_kg = self._kg_per_mm * float(np.interp(start_s, times, filament))
            u = motion.command(k0, k1)
            y = np.stack([a.push(row, printed_kg) for a, row in zip(axes, u, strict=True)])
            first, last = max(0, k0 - window), min(n, k1 + window)
            path, extruding = motion.path(first, last)
            at = np.flatnonzero(extruding[k0 - first : k1 - 1 - first : _EVERY]) * _EVERY
            error = PathDistances(path, DT_S, WINDOW_S).at(y[:, at], at + (k0 - first))
            quarter = min(3, int(4 * printed_kg / self._print_kg))
            self._quarters[quarter].add(error)

    def row(self, method: str, predicted_um: float, cpu_s: float) -> Row:
        every = math.sqrt(
            sum(t.rms**2 * t.count for t in self._quarters) / sum(t.count for t in self._quarters)
        )
        last = self._quarters[3]
        return Row(
            method,
            1e3 * self._quarters[0].rms,
            1e3 * last.rms,
            1e3 * last.max,
            1e3 * every,
            predicted_um,
            cpu_s,
        )


if __name__ == "__main__":
    main()
