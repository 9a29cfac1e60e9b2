"""The closed chain: draw a printer, measure it, identify it, compensate, print, judge.

The printers are made of bodies, belts and dry friction (`simulation/printers`); what is identified
has another form, and sees a printer only through an accelerometer that is turned, hisses and reads
up to 15 % wrong. A file is compensated with default options, the written file is planned by the
firmware's rules, and the printer executes it at 10 kHz. Beside it: nothing; the shaper that
Klipper's rules recommend from the same table; and the shaper tuned by brute force on the printer's
own linear part, which nobody has. Contour error while extruding.

    python benchmarks/closed_chain.py --printers 30 --from spectra

With `--from ring` a ring test is written for resonances that were typed in, and its log identified,
as on a printer whose firmware has no resonance test.

Between measurement and print the printer may change: `--load-kg` lies on the bed of a bed slinger,
`--belts` scales the stiffness of all belts. `--friction` scales dry friction from the start: it is
drawn for light guides, .02 to .3 N, and wheels or a heavy bed rub with 1 to 3 N.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field, replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from firmwares import machine_with, without_macros
from inputs import find_input, one_thread_each, plain_copy, shared_folder
from readback import DT_S, WINDOW_S, Aligned, Motion, Own, Shaped, Timed, forced_stops, read_motion
from ringing import identified_from_stops
from scipy.signal import ss2zpk

from stillpath.applications.machines.envelope import derived_envelope
from stillpath.models.arrays import Array
from stillpath.models.errors import ModelError
from stillpath.models.friction import DryFriction, usual_guides
from stillpath.models.identification.identify import Measured, identify
from stillpath.models.identification.readers import ReadSettings, read_content
from stillpath.models.identification.shaper_choice import choose_shaper_of
from stillpath.models.identification.types import AccelerationLog, Spectrum
from stillpath.models.machine import Machine
from stillpath.models.plants import PlantSetSpec, ZpkSpec, plant_set
from stillpath.models.shaper_pulses import shaper_pulses
from stillpath.models.store import load_machine
from stillpath.models.typed_in import typed_in
from stillpath.pipeline.compensate import compensate_file
from stillpath.pipeline.measuring.reference_shaper import tune_shaper
from stillpath.pipeline.options import Options
from stillpath.simulation.measures import PathDistances
from stillpath.simulation.printers.bodies import Bodies
from stillpath.simulation.printers.drawing import KINDS, draw
from stillpath.simulation.printers.machines import Printer
from stillpath.simulation.printers.resonance_test import NEW_TEST, OLD_TEST, drawn_sensor, run_test
from stillpath.simulation.response import response

FILES = ("ps_voron_klipper_ringing", "klipper_excludeobj_multi")
BASES = {"bed slinger": "generic-bedslinger", "corexy": "generic-corexy"}
_EVERY = 20
_TUNE_S = 40.0
_GOALS = {"spectra": (0.6, 1.05), "raw": (0.45, 1.0), "typed": (1.0, 1.05), "ring": (0.6, 1.05)}
_TYPED_ZETA = 0.07
OTHERS = ("marlin", "reprapfirmware")
_STEPS_PER_MM, _MIN_STEPS = 80.0, 6
_NOTHING = 0.8


@dataclass(frozen=True, slots=True)
class Task:
    """A printer, how it is measured, and what it prints."""

    kind: str
    seed: int
    source: str
    files: tuple[Path, ...]
    seconds: float
    oracle: bool
    max_accel_mm_s2: float | None = None
    firmware: str = "klipper"
    load_kg: float = 0.0
    belts: float = 1.0
    friction: float = 1.0
    options: Options = field(default_factory=Options)
    ring_accel_mm_s2: float | None = None


@dataclass(frozen=True, slots=True)
class Row:
    """Contour rms (and largest) while extruding, in um; the predicted range of ours."""

    printer: str
    file: str
    none_um: float
    recommended_um: float
    oracle_um: float
    ours_um: float
    ours_max_um: float
    recommended_max_um: float
    predicted_um: tuple[float, float]
    shaper: str
    note: str = ""

    @property
    def to_shaper(self) -> float:
        """Ours over the recommended shaper's."""
        return self.ours_um / self.recommended_um

    @property
    def to_none(self) -> float:
        """Ours over none."""
        return self.ours_um / self.none_um

    @property
    def foreseen(self) -> bool:
        """Whether ours lies in the predicted range."""
        low, high = self.predicted_um
        return low <= self.ours_um <= high


@dataclass(slots=True)
class Errors:
    """Errors of a motion, in mm."""

    values: list[Array] = field(default_factory=list)

    @property
    def rms_um(self) -> float:
        """Root mean square."""
        every = np.concatenate(self.values)
        return float(1e3 * np.sqrt(np.mean(every**2)))

    @property
    def max_um(self) -> float:
        """Largest."""
        return float(1e3 * np.concatenate(self.values).max())


def main() -> int:
    given = parsed()
    shared = shared_folder(given.shared)
    one_thread_each()
    rows: list[Row] = []
    head = f"{'printer':16}{'file':20}{'none':>7}{'recom.':>8}{'oracle':>8}{'ours':>7}{'max':>6}"
    print(f"{head}{'/recom.':>8}{'/none':>7}{'predicted':>14}  recommended", flush=True)
    with tempfile.TemporaryDirectory(prefix="stillpath-chain-") as folder:
        files = tuple(plain_copy(find_input(name, shared), Path(folder)) for name in given.files)
        if given.firmware != "klipper":
            plain = Path(folder, "plain")
            plain.mkdir()
            files = tuple(without_macros(file, plain) for file in files)
        tasks = [
            Task(
                kind,
                seed,
                given.source,
                files,
                given.seconds,
                given.oracle,
                given.max_accel_mm_s2,
                given.firmware,
                given.load_kg,
                given.belts,
                given.friction,
                Options(tolerance_um=given.tolerance_um),
                given.ring_accel_mm_s2,
            )
            for seed in range(given.first, given.first + given.printers)
            for kind in KINDS
        ]
        with ProcessPoolExecutor(given.jobs, mp_context=get_context("spawn")) as pool:
            for done in as_completed([pool.submit(judged, task) for task in tasks]):
                found = done.result()
                rows += found
                for row in found:
                    print_row(row)
    return summary(rows, given.source)


def parsed() -> argparse.Namespace:
    """Return the options of the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("files", nargs="*", default=list(FILES), help="paths, or corpus names")
    parser.add_argument("--printers", type=int, default=30, help="of each kind")
    parser.add_argument("--first", type=int, default=0, help="seed of the first one")
    parser.add_argument("--from", dest="source", choices=list(_GOALS), default="spectra")
    parser.add_argument("--seconds", type=float, default=90.0, help="of each print to judge")
    parser.add_argument(
        "--max-accel-mm-s2",
        type=float,
        help="of the configuration, from which motors' limits follow (default: the built-in ones)",
    )
    parser.add_argument(
        "--ring-accel-mm-s2", type=float, help="of ring tests (default: the configuration's)"
    )
    parser.add_argument("--firmware", choices=("klipper", *OTHERS), default="klipper")
    parser.add_argument("--load-kg", type=float, default=0.0, help="on the bed, after measuring")
    parser.add_argument("--belts", type=float, default=1.0, help="stiffness after, over before")
    parser.add_argument("--friction", type=float, default=1.0, help="of all guides, times as drawn")
    parser.add_argument("--tolerance-um", type=float, default=Options().tolerance_um)
    parser.add_argument("--oracle", action="store_true", help="tune shapers on the truth as well")
    parser.add_argument("--shared", type=Path, help="default: $STILLPATH_SHARED or ../shared")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    return parser.parse_args()


def print_row(r: Row) -> None:
    low, high = r.predicted_um
    print(
        f"{r.printer:16}{r.file[:19]:20}{r.none_um:7.1f}{r.recommended_um:8.2f}{r.oracle_um:8.2f}"
        f"{r.ours_um:7.2f}{r.ours_max_um:6.0f}{r.to_shaper:8.2f}{r.to_none:7.2f}"
        f"{low:7.2f}-{high:<6.2f} {'' if r.foreseen else '!'} {r.shaper} {r.note}",
        flush=True,
    )


def summary(rows: Sequence[Row], source: str) -> int:
    """Print the distribution and what was to be reached."""
    ratio = np.sort([row.to_shaper for row in rows])
    share = 100.0 * np.array([row.to_shaper > 1.0 for row in rows]).mean()
    decile = float(np.mean(ratio[-max(1, len(ratio) // 10) :]))
    quartiles = np.quantile(ratio, [0.1, 0.25, 0.5, 0.75, 0.9])
    print(f"\nratio to the recommended shaper, deciles and quartiles: {quartiles.round(2)}")
    print(f"worst decile {decile:.2f} on average; worse than the shaper: {share:.0f} % of prints")
    mean_goal, worst_goal = _GOALS[source]
    foreseen = float(np.mean([row.foreseen for row in rows]))
    missed = 0
    for what, value, limit in (
        ("geometric mean to the shaper", math.exp(float(np.mean(np.log(ratio)))), mean_goal),
        ("worst to the shaper", float(ratio[-1]), worst_goal),
        ("worst to nothing", max(row.to_none for row in rows), _NOTHING),
        ("share outside the predicted range", 1.0 - foreseen, 0.1),
    ):
        missed += value > limit
        print(f"{'PASS' if value <= limit else 'MISS'} {what} {value:.3f} <= {limit:g}")
    return 1 if missed else 0


def judged(task: Task) -> list[Row]:
    """Measure, identify and print on one printer."""
    printer = rubbing(draw(task.kind, task.seed), task.friction)
    rng = np.random.default_rng([KINDS.index(task.kind), task.seed, 1])
    base = load_machine(BASES[task.kind])
    if task.firmware != "klipper":
        base = machine_with(BASES[task.kind], task.firmware, _STEPS_PER_MM, min_steps=_MIN_STEPS)
    base = limited(base, task.max_accel_mm_s2)
    machine, shapers, note = identified(printer, base, task, rng)
    printer = changed(printer, task.load_kg, task.belts)
    rows = []
    for file in task.files:
        own = read_motion(file, base)
        sections = Own.sections(own)
        none = errors_of(sections, printer, task.seconds)
        recommended = errors_of(through(own, shapers), printer, task.seconds)
        oracle = np.nan
        if task.oracle:
            oracle = errors_of(
                through(own, tuned(printer, base, sections)), printer, task.seconds
            ).rms_um
        ours, predicted = recommended, (0.0, np.inf)
        if machine is not None:
            ours, predicted = compensated(file, own, machine, printer, task)
        rows.append(
            Row(
                printer.name,
                file.stem,
                none.rms_um,
                recommended.rms_um,
                oracle,
                ours.rms_um,
                ours.max_um,
                recommended.max_um,
                predicted,
                " / ".join(f"{name} {f_hz:.1f}" for name, f_hz in shapers),
                note,
            )
        )
    return rows


def rubbing(printer: Printer, times: float) -> Printer:
    """Return the printer with guides that rub so many times as much."""
    bodies = printer.bodies
    frictions = tuple(replace(one, force_n=times * one.force_n) for one in bodies.frictions)
    return replace(printer, bodies=replace(bodies, frictions=frictions))


def changed(printer: Printer, load_kg: float, belts: float) -> Printer:
    """Return the printer with a load on its bed, if that moves, and all belts as stiff as said."""
    bodies = printer.bodies
    masses = {
        name: mass_kg + load_kg * (name == "bed") for name, mass_kg in bodies.masses_kg.items()
    }
    elements = tuple(
        # A belt is what lies between a rotor and something else.
        replace(one, k_n_m=belts * one.k_n_m)
        if len(one.along) > 1 and any(name.startswith("rotor") for name in one.along)
        else one
        for one in bodies.elements
    )
    return replace(printer, bodies=replace(bodies, masses_kg=masses, elements=elements))


def limited(base: Machine, max_accel_mm_s2: float | None) -> Machine:
    """Return the machine that a configuration with such an acceleration leads to."""
    if max_accel_mm_s2 is None:
        return base
    firmware = base.firmware.driven_at(max_accel_mm_s2)
    machine = base.model_copy(update={"firmware": firmware})
    return machine.model_copy(update={"command": derived_envelope(machine)})


def identified(
    printer: Printer, base: Machine, task: Task, rng: np.random.Generator
) -> tuple[Machine | None, list[tuple[str, float]], str]:
    """Return the machine that the measurement leads to, and the shapers of X and Y.

    Where resonances are typed in, they are those of ZV shapers that Klipper tunes; so are those
    that a ring test begins with. A machine that is refused prints with the shaper.
    """
    source = task.source
    sensor = drawn_sensor(rng)
    test = OLD_TEST if rng.random() < 0.5 else NEW_TEST
    settings = ReadSettings(
        accel_per_hz_mm_s=test.accel_per_hz_mm_s,
        f_start_hz=test.f_start_hz,
        f_end_hz=test.f_end_hz,
        hz_per_s=test.hz_per_s,
        sweeping_accel_mm_s2=test.sweeping_accel_mm_s2,
        guides=usual_guides(base.kinematics),
    )
    measured, shapers = [], []
    typed: dict[str, PlantSetSpec] = {}
    for axis in ("x", "y"):
        for run in range(3 if source == "raw" else 1):
            record = run_test(printer, axis, sensor, rng, test, rests=source != "raw")
            name = f"resonances_{axis}_{run}.csv"
            (table,) = read_content(record.resonances(), name, settings=settings)
            assert isinstance(table, Spectrum)
            if run == 0:
                best, every = choose_shaper_of(table)
                if source in ("typed", "ring"):
                    zv = next(one for one in every if one.name == "zv")
                    typed[axis] = typed_in(zv.f_hz, _TYPED_ZETA)
                    best = zv if source == "typed" else best
                shapers.append((best.name, best.f_hz))
            log = AccelerationLog(record.time_s, record.accel_mm_s2, axis, f"raw_{axis}_{run}.csv")
            measured.append(Measured(log if source == "raw" else table))
    machine = base.model_copy(update={"axes": typed or base.axes, "name": printer.name})
    if source == "typed":
        return machine, shapers, ""
    try:
        if source == "ring":
            with tempfile.TemporaryDirectory(prefix="stillpath-ring-") as folder:
                made = identified_from_stops(
                    printer, machine, sensor, rng, Path(folder), task.ring_accel_mm_s2
                )
            return made, shapers, ""
        found = identify(measured, settings)
    except ModelError as error:
        return None, shapers, f"refused: {error}"
    axes = {axis: one.plants for axis, one in found.items()}
    return base.model_copy(update={"axes": axes, "name": printer.name}), shapers, ""


def errors_of(sections: Sequence[Timed], printer: Printer, seconds: float) -> Errors:
    """Let the printer execute sections, up to so many seconds in all."""
    errors, left = Errors(), round(seconds / DT_S)
    for section in sections:
        n = min(section.samples, left)
        left -= n
        if n < 2 * round(WINDOW_S / DT_S):
            continue
        path, extruding = section.path(0, n)
        at = np.flatnonzero(extruding[::_EVERY]) * _EVERY
        if len(at) == 0:
            continue
        y = printer.prints(section.command(0, n), DT_S)
        errors.values.append(PathDistances(path, DT_S, WINDOW_S).at(y[:, at], at))
    return errors


def compensated(
    file: Path, own: Motion, machine: Machine, printer: Printer, task: Task
) -> tuple[Errors, tuple[float, float]]:
    """Errors of the written file on the printer, and the range that its report predicts."""
    with tempfile.TemporaryDirectory(prefix="stillpath-chain-") as folder:
        target = Path(folder) / "out.gcode"
        result = compensate_file(file, target, machine, task.options, cache_dir=Path(folder))
        written = read_motion(target, machine)
    original = read_motion(file, machine, forced_stops(own, written))
    parts = Aligned(original, written).sections(original, written)
    (after,) = (channel for channel in result.channels if channel.name == "after")
    low_um, high_um = after.contour_range_um or 2 * (after.extruding.contour_rms_um,)
    # The report is about the whole file, the printer prints its beginning; friction is the same.
    part = nominal_um(parts, machine, task.seconds) / after.extruding.contour_rms_um
    rubbed_um = math.sqrt((after.contour_rubbing_um or high_um) ** 2 - high_um**2)
    unsure_um = after.contour_friction_um or 0.0
    plants_um = part * math.sqrt(high_um**2 - unsure_um**2)
    high_um = math.hypot(plants_um, unsure_um, rubbed_um)
    return errors_of(parts, printer, task.seconds), (part * low_um, high_um)


def nominal_um(parts: Sequence[Timed], machine: Machine, seconds: float) -> float:
    """Contour rms of the plants in the middle, over as much as the printer prints."""
    step = 4
    pair = [plant_set(machine.axes[axis], step * DT_S).nominal for axis in ("x", "y")]
    errors, left = Errors(), round(seconds / DT_S)
    for part in parts:
        n = min(part.samples, left)
        left -= n
        if n < 2 * round(WINDOW_S / DT_S):
            continue
        path, extruding = part.path(0, n)
        path, extruding = path[:, ::step].copy(), extruding[::step]
        at = np.flatnonzero(extruding[::10]) * 10
        friction = DryFriction(machine.friction_mm, step * DT_S)
        received = friction.received_mm(part.command(0, n)[:, ::step])
        answer = response(pair, received)
        errors.values.append(PathDistances(path, step * DT_S, WINDOW_S).at(answer[:, at], at))
    return errors.rms_um


def through(motion: Motion, shapers: Sequence[tuple[str, float]]) -> list[Shaped]:
    """Return the sections of a file, driven through a shaper of its own for each axis."""
    return Shaped.through(motion, [shaper_pulses(name, f_hz, 0.1) for name, f_hz in shapers])


def tuned(printer: Printer, base: Machine, sections: Sequence[Timed]) -> list[tuple[str, float]]:
    """Return the best shaper on the printer's linear part, axis by axis of one type."""
    axes = {
        axis: PlantSetSpec(nominal=linear_part(printer, number))
        for number, axis in enumerate(("x", "y"))
    }
    longest = max(sections, key=lambda s: s.samples)
    path, extruding = longest.path(0, min(longest.samples, round(_TUNE_S / DT_S)))
    machine = base.model_copy(update={"axes": axes})
    best = tune_shaper(machine, path[:, ::10].copy(), 10 * DT_S, extruding[::10].copy())
    return [(best.type, best.fx_hz), (best.type, best.fy_hz)]


def linear_part(printer: Printer, number: int) -> ZpkSpec:
    """Return nozzle over command of one axis, without friction and without the other axis."""
    bodies: Bodies = printer.bodies
    m, d, k, by_command, by_rate = bodies.matrices()
    n = len(m)
    inverse = np.linalg.inv(m)
    a = np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ k, -inverse @ d]])
    # The rate of the command enters through damping: shift it into the state.
    b = np.concatenate([inverse @ by_rate, inverse @ (by_command - d @ inverse @ by_rate)])
    c = np.concatenate([printer.nozzle[number], np.zeros(n)])
    zeros, poles, _ = ss2zpk(a, b[:, [number]], c[None], np.zeros((1, 1)))
    kept_z, kept_p = cancelled(zeros, poles)
    return ZpkSpec(
        zeros=tuple((float(z.real), float(z.imag)) for z in kept_z),
        poles=tuple((float(p.real), float(p.imag)) for p in kept_p),
    )


def cancelled(zeros: Array, poles: Array) -> tuple[list[complex], list[complex]]:
    """Leave out what cancels: modes of the other axis."""
    left_z, left_p = list(zeros), []
    for pole in poles:
        near = min(left_z, key=lambda z: abs(z - pole), default=None)
        if near is not None and abs(near - pole) < 1e-6 * abs(pole):
            left_z.remove(near)
        else:
            left_p.append(pole)
    return [z for z in left_z if abs(z) < 1e6], left_p


if __name__ == "__main__":
    sys.exit(main())
