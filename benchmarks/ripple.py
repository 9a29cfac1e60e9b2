"""Ripple on a printer axis: what a table over position cuts, beside repetitive control in time.

One axis, 45 Hz, damping .05, commands at 1 kHz and linear between samples (simulated at 8 kHz);
ripple of 2 mm pitch, 20, 8 and 4 um. Prints situation | reference | ours. The reference is
section 5 of the notes on feedback and repetitive control; nobody measured a machine.

    python benchmarks/ripple.py [--seeds 3] [--no-file]
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.signal import lfilter

from stillpath.compensation.base import DesignError
from stillpath.compensation.feedback.repetitive import InternalModel
from stillpath.compensation.ripple import PassThrough, RippleCompensator
from stillpath.models.arrays import Array
from stillpath.models.identification.ripple import PassLog, WaveBasis, learn_ripple, update_ripple
from stillpath.models.machine import CommandLimits, Machine
from stillpath.models.plants import Mode, ModesSpec, PlantSetSpec, continuous
from stillpath.models.ripple import (
    AxisRipple,
    RippleHarmonic,
    RippleSide,
    RippleSource,
    RippleTable,
)
from stillpath.models.store import load_machine
from stillpath.pipeline.compensate import compensate_file
from stillpath.pipeline.options import Options
from stillpath.simulation.response import response

Row = tuple[str, str, str]

DT, FINER, PITCH = 1e-3, 8, 2.0
NOTHING = RippleTable(np.zeros(0), np.zeros(0, complex))
NO_RESTS = np.zeros((0, 2), np.int64)
INNER = slice(500, -500)
MOTIONS = ("steady 80 mm/s", "ramp 30-110 mm/s", "stop and go")


def ripple(side: RippleSide, shift_deg: float = 0.0) -> AxisRipple:
    """The axis's ripple; `shift_deg` of the pitch beside where it is."""
    waves = ((1, 20.0, 10.0), (2, 8.0, 40.0), (3, 4.0, -70.0))
    harmonics = tuple(
        RippleHarmonic(number=h, amplitude_um=a, phase_deg=p + h * shift_deg) for h, a, p in waves
    )
    source = RippleSource(name="belt", pitch_mm=PITCH, enters=side, harmonics=harmonics)
    return AxisRipple(sources=(source,))


def spec(f_scale: float = 1.0, zeta: float = 0.05) -> ModesSpec:
    return ModesSpec(modes=(Mode(f_hz=45.0 * f_scale, zeta=zeta),))


def printer(known: AxisRipple) -> Machine:
    plants = PlantSetSpec(nominal=spec())
    # Room enough: what an acceleration limit costs is shown by itself.
    update = {
        "axes": {"x": plants, "y": plants},
        "command": CommandLimits(accel_mm_s2=200_000.0),
        "ripple": {"x": known},
    }
    return load_machine("ender3").model_copy(update=update)


def drive(motion: str, seconds: float = 6.0, speed: float = 80.0) -> Array:
    t = np.arange(0, seconds, DT)
    if motion == "stop and go":
        v = 60 * np.sin(2 * np.pi * t / 1.5) ** 2
    elif motion.startswith("ramp"):
        v = np.interp(t, [0.2, seconds - 0.2], [30.0, 110.0])
    else:
        v = np.full(len(t), speed)
    return np.cumsum(v * np.clip(np.minimum(t / 0.1, (seconds - t) / 0.1), 0, 1)) * DT


def moved(u: Array, table: RippleTable, side: RippleSide, path: Array, true: ModesSpec) -> Array:
    """Position at the samples; every path's own axis."""
    n = len(u)
    fine = np.interp(np.arange((n - 1) * FINER + 1) / FINER, np.arange(n), u)
    entering = fine + table.deviation_mm(fine) if side == "input" else fine
    plant = continuous(true).discretise(DT / FINER)
    y = response([plant], entering[None])[0][::FINER]
    return y if side == "input" else y + table.deviation_mm(path)


def cut(u: Array, path: Array, side: RippleSide, true: ModesSpec) -> float:
    """Share of the ripple at the tool (rms) that is gone, start and end left out."""
    table = ripple(side).table(side)
    clean = moved(path, NOTHING, side, path, true)[INNER]
    before = moved(path, table, side, path, true)[INNER] - clean
    after = moved(u, table, side, path, true)[INNER] - clean
    return float(1 - np.sqrt(np.mean(after**2) / np.mean(before**2)))


def undo(path: Array, known: AxisRipple) -> Array:
    both = np.stack([path, np.zeros_like(path)])
    made = RippleCompensator(PassThrough(), printer(known), DT)
    return made.compensate(both, np.ones(len(path), bool), NO_RESTS)[0]


def learnt(
    path: Array, side: RippleSide, true: ModesSpec, passes: int, noise_mm: float, seed: int
) -> AxisRipple:
    """A table learnt over passes with the nominal plant, every pass with the one before at work."""
    rng, plant = np.random.default_rng(seed), continuous(spec()).discretise(DT)
    known, u = None, path
    for _ in range(passes):
        y = moved(u, ripple(side).table(side), side, path, true)
        log = PassLog(
            path, DT * np.arange(len(y)), y + noise_mm * rng.standard_normal(len(y)), homed=True
        )
        fit = learn_ripple([log], (WaveBasis("belt", PITCH, enters=side),), plant).ripple
        known = fit if known is None else update_ripple(known, fit, gain=0.8, remaining=True)
        u = undo(path, known)
    assert known is not None
    return known


def in_time(path: Array, period: int, alpha: float, pairs: int) -> float:
    """Cut of repetitive control with a fixed period, G inverted exactly: y = (1 - L) d."""
    d = ripple("output").table("output").deviation_mm(path)
    model = InternalModel(period, alpha, pairs)
    share = alpha**period
    num = np.zeros(period + model.lead + 1)
    num[0] = 1.0
    num[period] -= share
    num[period - model.lead :] -= (1 - share) * model.taps
    left = lfilter(num, np.concatenate([[1.0], np.zeros(period - 1), [-share]]), d)
    inner = slice(3000, -500)
    return float(1 - np.sqrt(np.mean(left[inner] ** 2) / np.mean(d[inner] ** 2)))


def percent(*values: float) -> str:
    return " / ".join(f"{100 * v:.1f}" for v in values) + " %"


def input_side(seeds: int) -> Iterator[Row]:
    paths = [drive(motion) for motion in MOTIONS]
    known = [cut(undo(p, ripple("input")), p, "input", spec()) for p in paths]
    yield "input side, known table: " + ", ".join(MOTIONS), ">= 99 (99.8)", percent(*known)
    speeds = (10.0, 30.0, 60.0, 90.0, 120.0, 180.0)
    steady = [drive("steady", speed=v) for v in speeds]
    cuts = [cut(undo(p, ripple("input")), p, "input", spec()) for p in steady]
    yield "  steady 10, 30, 60, 90, 120, 180 mm/s", ">= 99", percent(*cuts)
    for scale in (1.05, 0.95):
        mean = [
            np.mean(
                [
                    cut(
                        undo(p, learnt(p, "input", spec(scale), 9, 0.01, s)),
                        p,
                        "input",
                        spec(scale),
                    )
                    for s in range(seeds)
                ]
            )
            for p in paths
        ]
        name = f"  learnt, plant {scale - 1:+.0%}, 10 um noise, 9 passes"
        yield name, ">= 95 (96-98)", percent(*map(float, mean))
    shifted = [cut(undo(p, ripple("input", 10.0)), p, "input", spec()) for p in paths]
    yield "  table 10 degrees of the pitch aside", "80-82", percent(*shifted)


def steady_speed() -> Iterator[Row]:
    path = drive("steady", speed=73.0)
    yield (
        "output side, 73 mm/s (36.5 Hz, N = 27.397): N = 27, a = .999",
        "2",
        percent(in_time(path, 27, 0.999, 1)),
    )
    yield "  wide-band, a = .8", "88", percent(in_time(path, 27, 0.8, 1))
    for name, said, true in (
        ("exact", "100", spec()),
        ("+3 %", "90", spec(1.03)),
        ("-5 %", "76", spec(0.95)),
        ("zeta .1", "80", spec(zeta=0.1)),
    ):
        one = cut(undo(path, ripple("output")), path, "output", true)
        yield f"  -G^-1 d, plant {name}", said, percent(one)


def varying_speed(seeds: int) -> Iterator[Row]:
    paths = [drive(motion) for motion in MOTIONS]
    fixed = [in_time(p, round(PITCH / (70e-3)), 0.999, 1) for p in paths[1:]]
    yield "varying speed (ramp, stop and go): fixed-period RC", "-1 .. 0", percent(*fixed)
    known = [cut(undo(p, ripple("output")), p, "output", spec()) for p in paths[1:]]
    yield "  table over position, output side", ">= 97 (99.3-99.5)", percent(*known)
    noisy = [
        float(
            np.mean(
                [
                    cut(undo(p, learnt(p, "output", spec(), 3, 0.01, s)), p, "output", spec())
                    for s in range(seeds)
                ]
            )
        )
        for p in paths[1:]
    ]
    yield "  learnt over 3 passes, 10 um noise", "97-98", percent(*noisy)
    off = [
        cut(undo(p, learnt(p, "output", spec(1.03), 6, 0.0, 0)), p, "output", spec(1.03))
        for p in paths
    ]
    yield "  learnt, plant +3 % (steady 80 first)", "99 / 77-82", percent(*off)


def limits() -> Iterator[Row]:
    path = drive("steady", speed=20.0)
    cuts = [
        cut(undo(path, ripple("output", d)), path, "output", spec())
        for d in (5.0, 15.0, 30.0, 60.0)
    ]
    yield "phase 5 / 15 / 30 / 60 degrees aside", "89 / 67 / 35 / -17", percent(*cuts)
    for quantum_um, said in ((12.5, "77-85"), (3.1, "92-96")):
        step = 1e-3 * quantum_um
        values = [
            cut(step * np.round(undo(p, ripple("input")) / step), p, "input", spec())
            for p in map(drive, MOTIONS)
        ]
        yield f"command in steps of {quantum_um} um, input side", said, percent(*values)
    loose = ripple("input").model_copy(update={"homing_repeatability_mm": 0.4})
    try:
        undo(path, loose)
        said = "designed"
    except DesignError as error:
        said = f"refused: {error}"
    yield "homing repeats within 0.4 mm", "refuse", said


def slow_sensor(seeds: int) -> Iterator[Row]:
    table = ripple("output").table("output")
    basis = (WaveBasis("belt", PITCH, enters="output"),)
    plant = continuous(spec()).discretise(DT)
    for rate, offset, said in (
        (100, 9.5, "2.8"),
        (100, 0.25, "3.9"),
        (100, 0.02, "13"),
        (30, 4.0, "5"),
    ):
        errors, distance = [], math.nan
        for seed in range(max(seeds, 5)):
            speed = PITCH * (rate + offset) / 3
            path = drive("steady", 5.0, speed)
            y = moved(path, table, "output", path, spec())
            at = np.arange(0, 4.99, 1 / rate)
            noise = 0.005 * np.random.default_rng(seed).standard_normal(len(at))
            log = PassLog(path, at, np.interp(at, DT * np.arange(len(y)), y) + noise, homed=True)
            try:
                made = learn_ripple([log], basis, plant)
            except ValueError as error:
                yield f"sensor {rate} Hz, {offset:g} Hz from folding", said, f"refused: {error}"
                break
            distance = made.observability[0].distance_hz or math.nan
            gap = made.ripple.table("output").coefficient_mm - table.coefficient_mm
            errors.append(np.linalg.norm(gap) / np.linalg.norm(table.coefficient_mm))
        else:
            name = f"sensor {rate} Hz, 5 s, 5 um noise, {distance:.3g} Hz from folding: error"
            yield name, f"{said} %", percent(float(np.median(errors)))


def through_a_file() -> Iterator[Row]:
    """Error at the tool while extruding, of the file as written and read back, at 1 um."""
    plants = PlantSetSpec(nominal=spec())
    clean = load_machine("ender3").model_copy(update={"axes": {"x": plants, "y": plants}})
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder, "in.gcode"), Path(folder, "out.gcode")
        source.write_text(print_file())
        for side, said in (("input", ">= 90"), ("output", "")):
            machine = clean.model_copy(update={"ripple": {"x": ripple(side)}})
            rms = {}
            for method in ("fbf", "fbf+ripple"):
                options = Options(method=method, tolerance_um=1.0)
                made = compensate_file(
                    source, target, machine, options, cache_dir=Path(folder, "cache")
                )
                rms[method] = next(
                    c.extruding.tracking_rms_um for c in made.channels if c.name == "after"
                )
            gone = 1 - rms["fbf+ripple"] / rms["fbf"]
            yield (
                f"through a G-code file, {side} side, fbf / fbf+ripple",
                said,
                f"{rms['fbf']:.2f} / {rms['fbf+ripple']:.2f} um rms: {percent(gone)}",
            )


def print_file() -> str:
    """Slanted lines of 120 mm at 30 to 110 mm/s."""
    lines = ["G28", "G90", "M83", "G1 Z5 F600", "G1 X40 Y30 F6000", "G4 P10", "G1 X40 Y40 F6000"]
    for k, speed in enumerate((30, 50, 70, 90, 110, 100, 80, 60, 40)):
        lines.append(f"G1 X{160 if k % 2 == 0 else 40} Y{43 + 3 * k} E4 F{60 * speed}")
    return "\n".join([*lines, "G1 E-1 F2100", ""])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--no-file", action="store_true", help="leave the print file out")
    chosen = parser.parse_args()
    rows = [
        *input_side(chosen.seeds),
        *steady_speed(),
        *varying_speed(chosen.seeds),
        *limits(),
        *slow_sensor(chosen.seeds),
    ]
    rows += [] if chosen.no_file else through_a_file()
    for name, said, ours in rows:
        print(f"{name:72s} | {said:20s} | {ours}")


if __name__ == "__main__":
    main()
