"""Block diagrams against their definition in plain Python, scipy and python-control."""

from __future__ import annotations

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from stillpath.models.diagrams import Block, Diagram, Running
from stillpath.models.errors import ModelError

small = st.floats(-0.4, 0.4)


def twin(blocks: list[Block], inputs: dict[str, np.ndarray], watch: str) -> np.ndarray:
    """Direct form I, block by block, as the docstring of `Block` says it."""
    heard: list[list[float]] = [[] for _ in blocks]
    said: list[list[float]] = [[] for _ in blocks]
    signals = {b.output: 0.0 for b in blocks}
    out = []
    for k in range(len(next(iter(inputs.values())))):
        signals |= {name: float(x[k]) for name, x in inputs.items()}
        order = sorted(range(len(blocks)), key=lambda i: blocks[i].direct)
        for b in blocks:
            if b.zero_between and k % b.every != b.phase:
                signals[b.output] = 0.0
        for step in ("from memory", "at once", "hear"):
            for i in order:
                b = blocks[i]
                if k % b.every != b.phase:
                    continue
                if b.direct == (step == "at once") and step != "hear":
                    if b.direct:
                        heard[i].append(sum(g * signals[n] for n, g in b.inputs))
                    past = heard[i] if b.direct else [*heard[i], 0.0]
                    runs = len(said[i])
                    y = sum(
                        c * past[runs - b.delay - j]
                        for j, c in enumerate(b.num)
                        if runs - b.delay - j >= 0
                    )
                    y -= sum(a * said[i][-j] for j, a in enumerate(b.den) if 0 < j <= runs)
                    said[i].append(y / b.den[0])
                    y = said[i][-1]
                    if b.quantum:
                        y = b.quantum * np.floor(y / b.quantum + 0.5)
                    signals[b.output] = min(max(y, -b.limit), b.limit)
                elif step == "hear" and not b.direct:
                    heard[i].append(sum(g * signals[n] for n, g in b.inputs))
        out.append(signals[watch])
    return np.array(out)


def loop(a: float, b: float, delay: int, every: int, phase: int, zero: bool) -> list[Block]:
    """A plant, a sensor at another rate, two controllers that share an output."""
    controllers = [
        Block("c", (("s", 0.3),), (1.0, b), (1.0, a), delay=delay, every=every, phase=phase,
              zero_between=zero),
    ]  # fmt: skip
    if every > 1 and not zero:
        other = (phase + 1) % every
        controllers.append(Block("c", (("s", -0.2), ("r", 0.5)), every=every, phase=other))
    return [
        Block("y", (("u", 1.0), ("d", 1.0)), (0.0, 0.5, b), (2.0, 0.4, a)),
        Block("s", (("y", 1.0), ("n", 1.0)), every=2, quantum=0.125),
        *controllers,
        Block("u", (("r", 1.0), ("c", -1.0)), limit=0.9),
    ]


@given(
    small, small, st.integers(0, 3), st.integers(1, 3), st.integers(0, 2), st.booleans(),
    st.integers(0, 2**32 - 1), st.integers(0, 40),
)  # fmt: skip
@settings(max_examples=60)
def test_kernel_is_the_definition(
    a: float, b: float, delay: int, every: int, phase: int, zero: bool, seed: int, cut: int
) -> None:
    blocks = loop(a, b, delay, every, phase % every, zero)
    generator = np.random.default_rng(seed)
    inputs = {name: generator.normal(size=40) for name in ("r", "d", "n")}
    running = Running(Diagram(blocks))
    parts = [
        running.push({n: x[part] for n, x in inputs.items()}, ("y", "u"))
        for part in (slice(0, cut), slice(cut, 40))
    ]
    for signal in ("y", "u"):
        found = np.concatenate([part[signal] for part in parts])
        assert found == pytest.approx(twin(blocks, inputs, signal), abs=1e-12)


def test_filters_are_scipys() -> None:
    x = np.random.default_rng(0).normal(size=500)
    num, den = (0.3, -0.2, 0.5), (2.0, -0.3, 0.4, 0.1)
    made = Running(Diagram([Block("y", (("x", 1.5),), num, den, delay=7)]))
    expected = np.concatenate([np.zeros(7), lfilter(num, den, 1.5 * x)[:-7]])
    assert made.push({"x": x}, ("y",))["y"] == pytest.approx(expected, abs=1e-12)


def test_response_and_radius_are_python_controls() -> None:
    plant = control.tf([0.2, 0.1], [1, -1.2, 0.5], 0.01)
    controller = control.tf([0.8, -0.3], [1, -0.6], 0.01)
    closed = control.feedback(plant, controller)
    diagram = Diagram(
        [
            Block("y", (("u", 1.0),), (0.0, 0.2, 0.1), (1.0, -1.2, 0.5)),
            Block("v", (("y", 1.0),), (0.8, -0.3), (1.0, -0.6)),
            Block("u", (("r", 1.0), ("v", -1.0))),
        ]
    )
    f = np.array([0.5, 7.0, 33.0])
    expected = closed(np.exp(2j * np.pi * f * 0.01))
    assert diagram.response(f, 0.01, "r", "y") == pytest.approx(expected, abs=1e-12)
    assert diagram.spectral_radius() == pytest.approx(np.abs(closed.poles()).max(), abs=1e-9)


@pytest.mark.parametrize("every", [2, 5])
def test_radius_of_several_rates(every: int) -> None:
    # y' = .9 y + u, fed back through a sampler that holds for `every` ticks.
    gain = 0.1
    diagram = Diagram(
        [
            Block("y", (("u", 1.0),), (0.0, 1.0), (1.0, -0.9)),
            Block("u", (("y", -gain),), every=every),
        ]
    )
    per_period = 0.9**every - gain * sum(0.9**i for i in range(every))
    assert diagram.spectral_radius() == pytest.approx(abs(per_period) ** (1 / every), abs=1e-12)
    with pytest.raises(ModelError, match="several rates"):
        diagram.response([1.0], 0.01, "x", "y")


def test_delay_lines_count_as_states() -> None:
    # z^-4 fed back with gain .5: poles at .5^(1/4).
    diagram = Diagram([Block("y", (("y", 0.5), ("r", 1.0)), delay=4)])
    assert diagram.states == 4
    assert diagram.spectral_radius() == pytest.approx(0.5**0.25, abs=1e-12)


def test_replacement_keeps_or_clears_states() -> None:
    def blocks(pole: float) -> list[Block]:
        return [Block("y", (("x", 1.0),), (0.0, 1.0), (1.0, -pole))]

    for reset, expected in ((False, 0.5), (True, 0.0)):
        running = Running(Diagram(blocks(0.9)))
        running.push({"x": [1.0]}, ("y",))
        running.replace(blocks(0.5), reset=reset)
        after = running.push({"x": [0.0, 0.0]}, ("y",))["y"]
        assert after[1] == pytest.approx(expected)
    with pytest.raises(ModelError, match="does not fit"):
        running.replace([Block("y", (("x", 1.0),), (0.0, 1.0, 1.0))], reset=True)


@pytest.mark.parametrize(
    ("blocks", "message"),
    [
        ([], "needs blocks"),
        ([Block("a", (("b", 1.0),)), Block("b", (("a", 1.0),))], "algebraic loop"),
        ([Block("a", (("a", 1.0),))], "algebraic loop"),
        ([Block("a", ()), Block("a", ())], "two writers"),
        ([Block("a", (), den=(0.0, 1.0))], r"den\[0\]"),
        ([Block("a", (), every=2, phase=2)], "phase"),
    ],
)
def test_impossible_diagrams(blocks: list[Block], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        Diagram(blocks)


def test_unknown_signals_and_lengths() -> None:
    running = Running(Diagram([Block("y", (("x", 1.0),))]))
    with pytest.raises(ModelError, match="takes x"):
        running.push({"z": [1.0]}, ("y",))
    with pytest.raises(ModelError, match="no signal"):
        running.push({"x": [1.0]}, ("z",))


def test_multiplications_leave_out_ones() -> None:
    blocks = [
        Block("a", (("x", -1.0), ("y", 2.0)), (1.0, 0.5), (2.0, 0.4)),
        Block("b", (("a", 1.0),), (0.25, 0.5, 0.0), every=2),
    ]
    assert Diagram(blocks).multiplications == pytest.approx(3 + 2 / 2)
