"""From a file of a pass to a machine that knows its ripple."""

from __future__ import annotations

import numpy as np
import pytest

from stillpath.models.errors import ModelError
from stillpath.models.identification.ripple import WaveBasis
from stillpath.models.identification.ripple_passes import learn_machine_ripple, read_pass
from stillpath.models.machine import Machine
from stillpath.models.plants import Mode, ModesSpec, PlantSetSpec, continuous
from stillpath.models.response_kernels import dense_response
from stillpath.models.ripple import (
    AxisRipple,
    MachineRipple,
    RippleAxis,
    RippleHarmonic,
    RippleSide,
    RippleSource,
)
from stillpath.models.store import load_machine
from stillpath.simulation.response import response

DT, FINER = 1e-3, 8
MODE = Mode(f_hz=45.0, zeta=0.05)


def machine(name: str = "ender3", mode: Mode = MODE) -> Machine:
    plants = PlantSetSpec(nominal=ModesSpec(modes=(mode,)))
    return load_machine(name).model_copy(update={"axes": {"x": plants, "y": plants}})


def log(
    comment: str = "# homed\n",
    share: float = 1.0,
    mode: Mode = MODE,
    speed: float = 80.0,
    number: int = 1,
) -> str:
    """A pass over a ripple of 20 um and 2 mm (its harmonic `number`), the sensor at 1 kHz."""
    fine = DT / FINER
    t = np.arange(0, 4, fine)
    s = 40 + np.cumsum(speed * np.clip(np.minimum(t / 0.1, (4 - t) / 0.1), 0, 1)) * fine
    u = s + share * 0.02 * np.sin(number * np.pi * s + 0.7)
    plant = continuous(ModesSpec(modes=(mode,))).discretise(fine)
    y = np.empty(len(u))
    dense_response(plant.a, plant.b, plant.c, plant.d, float(u[0]), np.zeros(2), u, y)
    table = np.stack([t, s, y], axis=1)[::FINER]
    rows = "\n".join(f"{a:.4f},{b:.6f},{c:.6f}" for a, b, c in table)
    return f"{comment}time_s,position_mm,measured_mm\n{rows}\n"


BASIS = (WaveBasis("belt", 2.0, (1, 2)),)


def test_a_file_becomes_ripple_of_the_machine() -> None:
    made, learning = learn_machine_ripple(machine(), "x", [read_pass(log(), "pass.csv")], BASIS)
    first, second = made.ripple["x"].sources[0].harmonics
    assert first.amplitude_um == pytest.approx(20.0, rel=0.01)
    assert first.phase_deg == pytest.approx(np.degrees(0.7), abs=0.5)
    assert second.amplitude_um < 0.2
    assert learning.explained > 0.9
    assert made.revision != machine().revision


def test_a_later_pass_updates_it() -> None:
    known, _ = learn_machine_ripple(machine(), "x", [read_pass(log(), "a.csv")], BASIS)
    later = [read_pass(log(share=0.5), "b.csv")]
    made, _ = learn_machine_ripple(known, "x", later, BASIS, gain=0.5)
    assert made.ripple["x"].sources[0].harmonics[0].amplitude_um == pytest.approx(15.0, rel=0.01)
    made, _ = learn_machine_ripple(known, "x", later, BASIS, gain=1.0, remaining=True)
    assert made.ripple["x"].sources[0].harmonics[0].amplitude_um == pytest.approx(30.0, rel=0.01)


def test_fast_waves_are_not_flattened() -> None:
    """180 Hz: lines between samples 1 ms apart would take a tenth off."""
    stiff = Mode(f_hz=150.0, zeta=0.3)
    text = log(mode=stiff, speed=90.0, number=4)
    basis = (WaveBasis("belt", 2.0, (4,)),)
    made, _ = learn_machine_ripple(machine(mode=stiff), "x", [read_pass(text, "a")], basis)
    (only,) = made.ripple["x"].sources[0].harmonics
    assert only.amplitude_um == pytest.approx(20.0, rel=0.02)
    assert only.phase_deg == pytest.approx(np.degrees(0.7), abs=1.0)


@pytest.mark.parametrize(("motor", "sign"), [("a", 1.0), ("b", -1.0)])
def test_a_motor_of_corexy_is_learnt_along_a_diagonal(motor: RippleAxis, sign: float) -> None:
    """X and Y vibrate differently; the machine's own ripple is what moved the log."""
    modes = (Mode(f_hz=45.0, zeta=0.05), Mode(f_hz=70.0, zeta=0.1))
    axes = {
        name: PlantSetSpec(nominal=ModesSpec(modes=(m,)))
        for name, m in zip("xy", modes, strict=True)
    }
    corexy = load_machine("generic-corexy").model_copy(update={"axes": axes})
    harmonic = RippleHarmonic(number=1, amplitude_um=20.0, phase_deg=40.0)
    source = RippleSource(name="belt", pitch_mm=2.0, harmonics=(harmonic,))
    true = MachineRipple("corexy", {motor: AxisRipple(sources=(source,))})
    fine = DT / FINER
    t = np.arange(0, 4, fine)
    x = 60 + np.cumsum(40 * np.clip(np.minimum(t / 0.1, (4 - t) / 0.1), 0, 1)) * fine
    received = true.received_mm(np.stack([x, sign * x]))
    plants = [continuous(axes[name].nominal).discretise(fine) for name in "xy"]
    moved = response(plants, received)
    rows = np.stack([t, 2 * x, moved[0] + sign * moved[1]], axis=1)[::FINER]
    text = "\n".join(f"{a:.4f},{b:.6f},{c:.6f}" for a, b, c in rows)
    log = read_pass(f"# homed\ntime_s,position_mm,measured_mm\n{text}\n", "diagonal.csv")
    made, _ = learn_machine_ripple(corexy, motor, [log], BASIS)
    first, second = made.ripple[motor].sources[0].harmonics
    assert first.amplitude_um == pytest.approx(20.0, rel=0.01)
    assert first.phase_deg == pytest.approx(40.0, abs=0.5)
    assert second.amplitude_um < 0.2


@pytest.mark.parametrize(
    ("name", "axis", "side", "words"),
    [
        ("generic-corexy", "x", "input", "belongs to a or b; two motors"),
        ("generic-corexy", "a", "output", "belongs to x or y"),
        ("ender3", "a", "input", "belongs to x or y"),
    ],
)
def test_where_ripple_cannot_enter(
    name: str, axis: RippleAxis, side: RippleSide, words: str
) -> None:
    basis = (WaveBasis("belt", 2.0, (1,), side),)
    with pytest.raises(ModelError, match=words):
        learn_machine_ripple(machine(name), axis, [read_pass(log(), "a")], basis)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("time_s,position_mm\n0,1\n1,2\n", "measured_mm nor accel_mm_s2"),
        ("time_s,position_mm,measured_mm\n0,1,1\n1,2,2\n", "2 rows"),
        (
            "time_s,position_mm,measured_mm\n" + "".join(f"{k % 10},{k},{k}\n" for k in range(20)),
            "line 12: time_s does not rise",
        ),
        *(
            (
                "time_s,position_mm,measured_mm\n" + "".join(f"{s * k},1,1\n" for k in range(20)),
                rf"lasts {19 * s:g} s and its rows are {s} s apart; .* must be in seconds",
            )
            for s in (1, 200)
        ),
        ("time_s,position_mm,measured_mm\n" + "0,1,x\n" * 20, "line 2.*measured_mm"),
        ("time_s,place_mm,measured_mm\n0,1,1\n1,1,1\n", "position_mm"),
    ],
)
def test_names_what_is_wrong_with_a_file(text: str, words: str) -> None:
    with pytest.raises(ModelError, match=words):
        read_pass(text, "pass.csv")
