"""A direct-drive table: disturbance observer with delay, PD, ZPETC and a zero-phase low-pass.

The measured plant is not printed: damping, the zero and pole near 800 Hz, the current loop and its
delay are unknown. `fitted_table` has four free numbers, chosen to meet the four printed margins of
the two observers with a current loop as fast as section II says, so these are no check; everything
else follows without them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from feedback_records import Row, checked, derived, rate, shown, stated
from scipy.signal import cont2discrete

from stillpath.compensation.feedback.disturbance_observer import (
    binomial_q,
    continuous_q,
    delay_limit_hz,
    design_disturbance_observer,
    observer_sensitivity,
)
from stillpath.compensation.feedback.pd import Margins, inertia_pd, loop_margins, margins
from stillpath.compensation.feedback.zero_phase import design_prefilter
from stillpath.compensation.inversion import invert
from stillpath.compensation.inverting import zero_phase_fir
from stillpath.models.arrays import Array
from stillpath.models.diagrams import Block, polynomial_response
from stillpath.models.disturbances import SensorSpec
from stillpath.models.loops import Loop, load_loop
from stillpath.models.plants import Mode, ModesSpec, continuous
from stillpath.simulation.closed_loop import ClosedLoop, Imperfections, simulate
from stillpath.simulation.response import response

LOOPS = load_loop("direct-drive-table").loops()
TABLE = LOOPS[0]
DT = TABLE.dt_s
F_HZ = np.linspace(1.0, 4999.0, 40_001)
ENCODER_MM = 0.5e-3
ACCEL_MM_S2_V = 500 / 10 / 7.5 * 1e3
CURRENT_HZ, CURRENT_ZETA = 1260.0, 0.817
RESONANCE_HZ, ZERO_RATIO, RESONANCE_ZETA = 800.0, 0.911, 0.05
EXTRA_DELAY = 1.39
STOPPED = 400


def rows() -> Iterator[Row]:
    yield from feedback()
    yield from delay_in_the_observer()
    yield from feedforward()
    yield from four_stages()
    yield from on_a_printer()
    yield from budget()


def feedback() -> Iterator[Row]:
    """Section III-C, figure 12."""
    kp, kv = inertia_pd(1.0, DT, 100.0, 0.85)
    yield shown("kp b0, kv b0", None, f"{kp:.6f}, {kv:.5f}", "poles at 100 Hz, damping 0.85")
    nominal = loop_margins(TABLE)
    note = "of some 28 readings of the text only this one gives both"
    yield checked("nominal phase margin", 40.0, nominal.phase_deg, 0.5, note, "deg")
    yield checked("nominal gain margin", 9.3, nominal.gain_db, 0.1, "", "dB")
    discrete, continuous = outer_margins(fitted_table())
    for name, got, phase, gain in (
        ("discrete", discrete, 35.0, 9.0),
        ("continuous", continuous, 11.0, 3.2),
    ):
        yield shown(f"margins with the {name} observer", f"{phase:g} deg, {gain:g} dB",
                    f"{got.phase_deg:.1f} deg, {got.gain_db:.1f} dB",
                    "4 numbers of the plant to these 4; not a check", "fitted")  # fmt: skip
    square = 1 - 2 * CURRENT_ZETA**2
    current_hz = CURRENT_HZ * math.sqrt(square + math.hypot(square, 1.0))
    yield stated("bandwidth of the fitted current loop", "up to 1/3 decade above 800 Hz",
                 f"{current_hz:.0f} Hz", 800 < current_hz < 800 * 10 ** (1 / 3))  # fmt: skip
    order = len(np.trim_zeros(np.asarray(TABLE.t0_den), "b")) - 1
    yield checked("order of A_CL", 6, order, 0)
    numerator = np.trim_zeros(np.convolve(TABLE.plant_num, TABLE.rate_den))
    yield checked("order of B_CL", 2, len(numerator) - 1, 0)


def delay_in_the_observer() -> Iterator[Row]:
    """Section III-A and B, figures 7 and 11; tau = 1 / (2 pi fc)."""
    with_delay = np.abs(observer_sensitivity(150.0, DT, 4, F_HZ))
    without = np.abs(1 - continuous_q(150.0, F_HZ))
    more = db(with_delay.max() / without.max())
    yield checked("peak of S_z over that of S", 1.7, more, 0.02, "", "dB")
    where = float(F_HZ[np.argmax(with_delay)])
    yield stated("frequency of that peak", "near 200 Hz", f"{where:.0f} Hz", 175 < where < 225)
    error = np.abs(np.exp(-2j * np.pi * F_HZ * 4e-4) - 1)
    for cutoff, said in ((50.0, "kept"), (150.0, "close, but kept"), (450.0, "violated")):
        worst = db(np.max(np.abs(continuous_q(cutoff, F_HZ)) * error))
        yield stated(f"abs(Q Delta) at {cutoff:g} Hz, without the delay in the model", said,
                     f"{worst:.1f} dB", (worst > 0) == (said == "violated"),
                     "0 dB is the limit")  # fmt: skip
    yield shown("largest cutoff without the delay in the model", None,
                f"{delay_limit_hz(4e-4):.0f} Hz")  # fmt: skip


def feedforward() -> Iterator[Row]:
    """Section IV, figures 16 and 17."""
    bare, filtered = design_prefilter(TABLE), design_prefilter(TABLE, cutoff_hz=500.0)
    yield stated("peak of ZPETC", "above 50 dB", f"{bare.peak.db:.1f} dB", bare.peak.db > 50)
    yield stated("frequency of that peak", "around 3 kHz", f"{bare.peak.f_hz:.0f} Hz",
                 2800 < bare.peak.f_hz < 3200)  # fmt: skip
    yield checked("preview, ZPETC", 5, bare.preview, 0)
    yield checked("preview, with FIR", 10, filtered.preview, 0)
    total = bare.response(F_HZ) * TABLE.tracking(F_HZ)
    gap = float(np.max(np.abs(total - np.cos(np.pi * F_HZ * DT) ** 2)))
    yield derived("G_Z G_CL against cos^2(w/2)", 0.0, gap, 1e-8, "(21) with one zero at -1")
    assert filtered.fir is not None
    half = filtered.fir[5:]
    ratio = half[0] / half[-1]
    yield stated("FIR, l = 5, 500 Hz: largest over smallest", "about 10", f"{ratio:.1f}",
                 9 < ratio < 11, " ".join(f"{x:.4f}" for x in half))  # fmt: skip
    gain = half[0] + 2 * np.cos(2 * np.pi * np.outer(F_HZ, np.arange(1, 6)) * DT) @ half[1:]
    yield shown("FIR, its own -3 dB", None, f"{F_HZ[gain < math.sqrt(0.5)][0]:.0f} Hz",
                "500 Hz is the corner of the single pole in it")  # fmt: skip


def four_stages() -> Iterator[Row]:
    """Section V, figures 19 to 23: 2 mm in 16 ms and back, on the fitted plant."""
    y_d, accel = there_and_back()
    yield stated("acceleration of 2 mm in 16 ms", "above 3 G", f"{accel / 9806.65:.3f} G",
                 accel > 3 * 9806.65)  # fmt: skip
    stages = {
        name: staged(name, y_d, ENCODER_MM) for name in ("PD", "+ observer", "+ ZPETC", "+ FIR")
    }
    why = "the drive's transients of 125-150 Hz after it are not printed"
    for name, paper, tolerance, note in (
        ("PD", 600, 30, "class; read off a figure"),
        ("+ observer", 600, 30, "class; read off a figure"),
        ("+ ZPETC", 30, 0, why),
        ("+ FIR", 10, 0, why),
    ):
        got = stages[name]
        quantity = f"peak error, {name}"
        if tolerance:
            yield checked(quantity, paper, got.peak_um, tolerance, note, "µm")
        else:
            yield shown(quantity, f"{paper} µm", f"{got.peak_um:.2f} µm", note, "not reproduced")
    yield shown("steady error, PD", "2 µm", f"{stages['PD'].steady_um:.2f} µm",
                "friction is not printed; with 0.12 V the table stops anywhere within 0.12 V / kp "
                "= 2.1 µm", "not reproduced")  # fmt: skip
    left_um = stages["+ observer"].steady_um
    yield stated("steady error, + observer", "eliminated", f"{left_um:.2f} µm", left_um < 0.5,
                 "the encoder's step is 0.5 µm")  # fmt: skip
    for name, said in (("+ ZPETC", "chatter"), ("+ FIR", "largely eliminated")):
        got, smooth = stages[name], staged(name, y_d, 0.0)
        holds = (got.step_v > 2 * smooth.step_v) == (said == "chatter")
        yield stated(f"rms thrust step, {name}", said, f"{got.step_v:.2f} V", holds,
                     f"without the encoder's steps {smooth.step_v:.2f} V")  # fmt: skip
    yield shown("peak thrust, + ZPETC", "clips at 10 V", f"{stages['+ ZPETC'].thrust_v:.1f} V",
                why, "not reproduced")  # fmt: skip
    least = stages["+ FIR"].thrust_v
    yield stated("peak thrust, + FIR", "reduced", f"{least:.1f} V",
                 least < 0.8 * stages["+ ZPETC"].thrust_v)  # fmt: skip


def on_a_printer() -> Iterator[Row]:
    """ZPETC and FIR as a command prefilter: 20 mm at 100 mm/s and 3 m/s^2, 45 Hz, damping .05."""
    dt = 1e-3
    nominal = continuous(ModesSpec(modes=(Mode(f_hz=45.0, zeta=0.05),)))
    inverse = invert("zpetc", nominal.discretise(dt))
    path = trapezoid(20.0, 100.0, 3000.0, dt)
    fir = zero_phase_fir(100.0, dt, 5)
    commands = {"plan": path, "ZPETC": inverse.apply(path), "+ FIR": inverse.apply(path, fir)}
    tries = (
        ("plan", 1.0), ("ZPETC", 1.0), ("ZPETC", 1.03), ("ZPETC", 0.95),
        ("+ FIR", 1.0), ("+ FIR", 1.03), ("+ FIR", 0.95),
    )  # fmt: skip
    for name, scale in tries:
        plant = continuous(ModesSpec(modes=(Mode(f_hz=45.0 * scale, zeta=0.05),)))
        y = response([plant.discretise(dt)], commands[name][None])[0]
        error = 1e3 * np.abs(y - path)
        yield shown(f"printer axis, plant {scale - 1:+.0%}, {name}: peak (residual)", None,
                    f"{error.max():.1f} ({error[STOPPED:].max():.1f}) µm")  # fmt: skip
    for name, command in commands.items():
        peak = np.abs(np.diff(command, 2)).max() / dt**2 / 1e3
        yield shown(f"printer axis, peak acceleration, {name}", None, f"{peak:.1f} m/s2")


def trapezoid(length: float, speed: float, accel: float, dt: float) -> Array:
    """Rest, a move with a trapezoid of speed, rest; it ends at the sample `STOPPED`."""
    ramp, cruise = speed / accel, length / speed - speed / accel
    t = np.arange(900) * dt - (STOPPED * dt - 2 * ramp - cruise)
    corners = [0.0, ramp, ramp + cruise, 2 * ramp + cruise]
    v = np.interp(t, corners, [0.0, speed, speed, 0.0], left=0.0, right=0.0)
    x = np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1]))]) * dt
    return x * length / x[-1]


def budget() -> Iterator[Row]:
    made = design_disturbance_observer(LOOPS, 150.0)
    prefilter = design_prefilter(TABLE, cutoff_hz=500.0)
    command = prefilter.inversion.command
    sections = 0 if command.sections is None else len(command.sections)
    taps = len(np.convolve(command.taps, prefilter.fir))
    yield shown("multiplications a sample, observer / prefilter", None,
                f"{made.multiplications:.0f} / {taps + 5 * sections}",
                f"min 1/abs(T) {made.prediction.min_inverse_t.db:.1f} dB, max abs(1 - PQ) "
                f"{made.prediction.max_add_on.db:.1f} dB, largest abs(z) of all plants "
                f"{max(made.spectral_radii):.4f}")  # fmt: skip
    drive = np.zeros(1_000_000)
    loop = ClosedLoop(TABLE, made.blocks)
    yield shown("simulation of the loop with observer", None,
                rate(lambda: loop.push({"r": drive}), len(drive)))  # fmt: skip


@dataclass(frozen=True, slots=True)
class Stage:
    peak_um: float
    steady_um: float
    step_v: float
    thrust_v: float


def staged(name: str, y_d: Array, quantum_mm: float) -> Stage:
    """One of the four stages, designed for the nominal plant, on the fitted one."""
    r = np.round(y_d / quantum_mm) * quantum_mm if quantum_mm else y_d
    true = fitted_table()
    blocks: tuple[Block, ...] = ()
    if name != "PD":
        blocks = design_disturbance_observer((true,), 150.0, nominal=TABLE).blocks
    command = r
    if name in ("+ ZPETC", "+ FIR"):
        cutoff = 500.0 if name == "+ FIR" else None
        command = design_prefilter(TABLE, cutoff_hz=cutoff).apply(r)
    real = Imperfections(input_limit=10.0, friction=0.12, friction_speed=1e-5)
    got = simulate(
        true,
        blocks,
        {"r": command},
        ("y", "u"),
        sensor=SensorSpec(quantum=quantum_mm),
        imperfections=real,
    )
    error, moving = 1e3 * np.abs(y_d - got["y"]), slice(100, 260)
    return Stage(
        float(error.max()),
        # Between the moves, and after them.
        float(max(error[580], error[-1])),
        float(np.sqrt(np.mean(np.diff(got["u"])[moving] ** 2))),
        float(np.abs(got["u"]).max()),
    )


def there_and_back() -> tuple[Array, float]:
    t, took = np.arange(1200) * DT, 0.016
    accel = 8.0 / took**2

    def out(t: Array) -> Array:
        x = np.clip(t, 0, took)
        return np.where(x < took / 2, 0.5 * accel * x**2, 2.0 - 0.5 * accel * (took - x) ** 2)

    return out(t - 0.01) - out(t - 0.06), accel


def fitted_table() -> Loop:
    """The table with a current loop, a resonance and more delay in place of three samples."""
    pole, zero = 2 * math.pi * RESONANCE_HZ, 2 * math.pi * RESONANCE_HZ * ZERO_RATIO
    current = 2 * math.pi * CURRENT_HZ
    num = np.array([1 / zero**2, 2 * RESONANCE_ZETA / zero, 1.0]) * ACCEL_MM_S2_V
    den = np.convolve(
        np.convolve([1.0, 0.0, 0.0], [1 / pole**2, 2 * RESONANCE_ZETA / pole, 1.0]),
        [1 / current**2, 2 * CURRENT_ZETA / current, 1.0],
    )
    top, bottom, _ = cont2discrete((num, den), DT, "zoh")
    whole = replace(
        TABLE, plant_num=tuple(np.ravel(top).tolist()), plant_den=tuple(bottom.tolist())
    )
    return whole.varied(1.0, EXTRA_DELAY)


def outer_margins(true: Loop) -> tuple[Margins, Margins]:
    """Of PD on the observed plant, cut at the observer's command: discrete, and continuous."""
    z = true.z(F_HZ)
    p, control = true.plant(F_HZ), TABLE.t0(F_HZ) / TABLE.s0(F_HZ) / TABLE.plant(F_HZ)
    q = polynomial_response(*binomial_q(150.0, DT), z)
    late = z**-4 * q
    discrete = control * p / (1 - late + p * late / TABLE.plant(F_HZ))
    # The paper's figure 6 by the bilinear transform: an inertia without delay.
    s = 2 / DT * (z - 1) / (z + 1)
    continuous = control * p / (1 - q + p * q * s**2 / ACCEL_MM_S2_V)
    return margins(F_HZ, discrete), margins(F_HZ, continuous)


def db(value: float) -> float:
    return 20 * math.log10(value)
