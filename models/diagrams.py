"""Block diagrams of sampled loops: one description to simulate, to analyse and to load.

A diagram is a list of blocks that read and write signals by name. A block is a causal filter;
it may run at every k-th tick only (several rates in one diagram), and may round or clip its output.
A machine's loop, a sensor, friction and every feedback design are such lists, so the stability
check, the simulation and the loaded controller use the same description.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stillpath.models.arrays import Array, Complex
from stillpath.models.errors import ModelError

__all__ = ["Block", "Diagram", "Running", "polynomial_response"]

Coefficients = tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Block:
    """output = shaped(num(z)/den(z) z^-delay * sum(gain * signal)).

    Attributes
    ----------
    output : str
        Signal it writes. Blocks of one `every` and different `phase` may share an output.
    inputs : tuple of (str, float)
        Signals it reads, with gains.
    num, den : tuple of float
        In rising powers of z^-1, one power is one run of the block; den[0] is not 0.
    delay : int
        Whole runs of delay in front, at no cost per sample.
    every, phase : int
        The block runs at ticks n with n mod every = phase.
    zero_between : bool
        Write 0 at the other ticks instead of holding (zero insertion).
    quantum, limit : float
        Output rounded to multiples of `quantum` (0: not), then clipped to +-`limit`; the filter
        continues with the unrounded value. Friction is a clipped multiple of a velocity.
    """

    output: str
    inputs: tuple[tuple[str, float], ...]
    num: Coefficients = (1.0,)
    den: Coefficients = (1.0,)
    delay: int = 0
    every: int = 1
    phase: int = 0
    zero_between: bool = False
    quantum: float = 0.0
    limit: float = math.inf

    @property
    def order(self) -> int:
        """States of the filter, without the delay line."""
        return max(len(self.num), len(self.den)) - 1

    @property
    def direct(self) -> bool:
        """Whether the output needs the input of the same tick."""
        return self.delay == 0 and self.num[0] != 0.0

    @property
    def multiplications(self) -> float:
        """Multiplications per tick, those by 0, 1 and -1 left out, spread over all ticks."""
        factors = (
            *self.num,
            *(a / self.den[0] for a in self.den[1:]),
            *(g for _, g in self.inputs),
        )
        return sum(abs(c) not in (0.0, 1.0) for c in factors) / self.every

    def response(self, z: Complex) -> Complex:
        """Return num/den z^-delay at the points z; `every` must be 1."""
        return polynomial_response(self.num, self.den, z) * z**-self.delay


class Diagram:
    """Blocks in an order in which they can be computed.

    Parameters
    ----------
    blocks : iterable of Block
        In any order.

    Raises
    ------
    ModelError
        On two writers of one signal, an algebraic loop, or a filter with den[0] = 0.
    """

    def __init__(self, blocks: Iterable[Block]) -> None:
        listed = tuple(blocks)
        _check(listed)
        self.blocks = _ordered(listed)
        names = dict.fromkeys(b.output for b in self.blocks)
        read = dict.fromkeys(name for b in self.blocks for name, _ in b.inputs)
        self.sources: tuple[str, ...] = tuple(name for name in read if name not in names)
        """Signals read but not written: they come from outside."""
        self.signals: tuple[str, ...] = (*names, *self.sources)
        self.period = math.lcm(*(b.every for b in self.blocks))

    @property
    def states(self) -> int:
        """Number of states carried from tick to tick, without held outputs."""
        return sum(b.order + b.delay for b in self.blocks)

    @property
    def multiplications(self) -> float:
        """Multiplications per tick, on average over a period."""
        return sum(b.multiplications for b in self.blocks)

    def spectral_radius(self) -> float:
        """Return the largest eigenvalue modulus over one tick, rounding and limits left out.

        Below 1: every signal decays, the internal ones too. With several rates it is the root
        of the largest eigenvalue over a period.
        """
        linear = Running(Diagram(replace(b, quantum=0.0, limit=math.inf) for b in self.blocks))
        columns = [linear.unit_response(i) for i in range(linear.size)]
        if not columns:
            return 0.0
        radius = float(np.abs(np.linalg.eigvals(np.array(columns).T)).max())
        return float(radius ** (1.0 / self.period))

    def response(self, f_hz: ArrayLike, dt_s: float, source: str, target: str) -> Complex:
        """Return the frequency response from an outer signal to any signal.

        Rounding and limits are left out.

        Raises
        ------
        ModelError
            If the diagram has several rates: one input tone then causes many output tones.
        """
        if self.period > 1:
            raise ModelError("a diagram of several rates has no frequency response")
        z = np.exp(2j * np.pi * np.atleast_1d(np.asarray(f_hz, float)) * dt_s)
        place = {name: i for i, name in enumerate(self.signals)}
        system = np.broadcast_to(np.eye(len(place), dtype=complex), (len(z), *[len(place)] * 2))
        system = system.copy()
        for block in self.blocks:
            through = block.response(z)
            for name, gain in block.inputs:
                system[:, place[block.output], place[name]] -= gain * through
        drive = np.zeros((len(z), len(place), 1), complex)
        drive[:, place[source], 0] = 1.0
        return np.asarray(np.linalg.solve(system, drive)[:, place[target], 0], complex)


class _Row(NamedTuple):
    """Where a block's numbers lie in the arrays of the kernel, and how it runs.

    The order is that of the columns which `diagram_kernels` reads.

    Attributes
    ----------
    output : int
        Signal that it writes.
    first_wire, end_of_wires : int
        Its inputs among all wires and gains.
    coefficients : int
        First of its order + 1 numbers in numerators and denominators.
    states, delay_line : int
        First of its `order` states, and of its `delay` places, among all states.
    """

    output: int
    first_wire: int
    end_of_wires: int
    coefficients: int
    order: int
    states: int
    delay: int
    delay_line: int
    every: int
    phase: int
    zero_between: bool
    direct: bool


class Running:
    """A running diagram with its states; `push` continues where the last call ended.

    Attributes
    ----------
    tick : int
        Ticks since the start.
    """

    def __init__(self, diagram: Diagram) -> None:
        self.diagram = diagram
        self._place = {name: i for i, name in enumerate(diagram.signals)}
        self._compile()
        self.tick = 0
        self._state = np.zeros(self._states)
        self._cursor = np.zeros(len(diagram.blocks), np.int64)
        self._signals = np.zeros(len(diagram.signals))

    def push(self, inputs: Mapping[str, ArrayLike], watch: Sequence[str]) -> dict[str, Array]:
        """Return the signals `watch` for a stretch of the outer signals, all of one length.

        Outer signals that are not given are 0.

        Raises
        ------
        ModelError
            On an unknown signal, or inputs of different lengths.
        """
        columns = {name: np.atleast_1d(np.asarray(x, float)) for name, x in inputs.items()}
        lengths = {len(x) for x in columns.values()}
        unknown = [name for name in columns if name not in self.diagram.sources]
        if unknown or len(lengths) != 1:
            raise ModelError(
                f"inputs {sorted(columns)} of lengths {sorted(lengths)}: the diagram takes "
                f"{', '.join(self.diagram.sources)}, all of one length"
            )
        missing = [name for name in watch if name not in self._place]
        if missing:
            raise ModelError(
                f"no signal is called {missing[0]!r}; there are {', '.join(self._place)}"
            )
        records = np.empty((len(watch), lengths.pop()))
        self._advance(
            np.array([self._place[name] for name in columns], np.int64),
            np.ascontiguousarray(np.array(list(columns.values()))),
            np.array([self._place[name] for name in watch], np.int64),
            records,
        )
        return dict(zip(watch, records, strict=True))

    def replace(self, blocks: Iterable[Block], *, reset: bool) -> None:
        """Put new coefficients in place of those of the blocks that write the same signals.

        Parameters
        ----------
        blocks : iterable of Block
            Same outputs, wires, orders and delays as before.
        reset : bool
            Set the states of these blocks to 0. Otherwise a filter keeps the states of its former
            coefficients, which is right only for small changes.

        Raises
        ------
        ModelError
            If a block does not fit the one it replaces.
        """
        for new in blocks:
            at = [i for i, b in enumerate(self.diagram.blocks) if b.output == new.output]
            if len(at) != 1 or _frame(self.diagram.blocks[at[0]]) != _frame(new):
                raise ModelError(f"block {new.output!r} does not fit what it should replace")
            row = self._rows[at[0]]
            its = slice(row.coefficients, row.coefficients + row.order + 1)
            self._num[its] = _padded(new.num, row.order) / new.den[0]
            self._den[its] = _padded(new.den, row.order) / new.den[0]
            self._gains[row.first_wire : row.end_of_wires] = [gain for _, gain in new.inputs]
            if reset:
                self._state[row.states : row.states + row.order] = 0.0
                self._state[row.delay_line : row.delay_line + row.delay] = 0.0

    @property
    def size(self) -> int:
        """States, and the outputs that are held over ticks."""
        return self._states + len(self._held)

    def unit_response(self, index: int) -> Array:
        """Return all states one period after state `index` was 1, with no input."""
        self._state[:] = 0.0
        self._signals[:] = 0.0
        self._cursor[:] = 0
        self.tick = 0
        if index < self._states:
            self._state[index] = 1.0
        else:
            self._signals[self._held[index - self._states]] = 1.0
        nothing = np.zeros(0, np.int64)
        ticks = self.diagram.period
        self._advance(nothing, np.zeros((0, ticks)), nothing, np.zeros((0, ticks)))
        after = self._state.copy()
        for row, turn in zip(self._rows, self._cursor, strict=True):
            line = slice(row.delay_line, row.delay_line + row.delay)
            after[line] = np.roll(after[line], -turn)
        return np.concatenate([after, self._signals[self._held]])

    def _advance(
        self,
        sources: NDArray[np.int64],
        inputs: Array,
        watched: NDArray[np.int64],
        records: Array,
    ) -> None:
        # With numba, slow to import; the API describes loops without running them.
        from stillpath.models.diagram_kernels import advance

        advance(
            self._layout, self._wires, self._gains, self._num, self._den, self._shape,
            self._state, self._cursor, self._signals, self.tick,
            sources, inputs, watched, records,
        )  # fmt: skip
        self.tick += inputs.shape[1]

    def _compile(self) -> None:
        """Write the blocks as the arrays of the kernel."""
        blocks = self.diagram.blocks
        wires = [(self._place[name], gain) for b in blocks for name, gain in b.inputs]
        self._wires = np.array([w for w, _ in wires], np.int64)
        self._gains = np.array([g for _, g in wires])
        self._num = np.concatenate([_padded(b.num, b.order) / b.den[0] for b in blocks])
        self._den = np.concatenate([_padded(b.den, b.order) / b.den[0] for b in blocks])
        self._shape = np.array([[b.quantum, b.limit] for b in blocks])
        wire = coefficient = state = 0
        line = sum(b.order for b in blocks)
        self._rows: list[_Row] = []
        for b in blocks:
            row = _Row(
                output=self._place[b.output],
                first_wire=wire,
                end_of_wires=wire + len(b.inputs),
                coefficients=coefficient,
                order=b.order,
                states=state,
                delay=b.delay,
                delay_line=line,
                every=b.every,
                phase=b.phase,
                zero_between=b.zero_between,
                direct=b.direct,
            )
            self._rows.append(row)
            wire = row.end_of_wires
            coefficient += b.order + 1
            state += b.order
            line += b.delay
        self._layout = np.array(self._rows, np.int64)
        self._states = line
        held = dict.fromkeys(self._place[b.output] for b in blocks if b.every > 1)
        self._held = np.array(list(held), np.int64)


def polynomial_response(num: ArrayLike, den: ArrayLike, z: Complex) -> Complex:
    """Return num/den at the points z, both in rising powers of z^-1."""
    top, bottom = (np.asarray(p, float)[::-1] for p in (num, den))
    return np.asarray(np.polyval(top, 1 / z) / np.polyval(bottom, 1 / z), complex)


def _check(blocks: tuple[Block, ...]) -> None:
    if not blocks:
        raise ModelError("a diagram needs blocks")
    written: dict[str, set[tuple[int, int]]] = {}
    for b in blocks:
        if not b.den or b.den[0] == 0.0 or not b.num:
            raise ModelError(f"block {b.output!r}: den[0] must not be 0, num not empty")
        if b.every < 1 or not 0 <= b.phase < b.every or b.delay < 0:
            raise ModelError(
                f"block {b.output!r}: every {b.every}, phase {b.phase}, delay {b.delay} "
                "(every >= 1, 0 <= phase < every, delay >= 0)"
            )
        seen = written.setdefault(b.output, set())
        if any(every != b.every or phase == b.phase for every, phase in seen):
            raise ModelError(f"signal {b.output!r} has two writers")
        seen.add((b.every, b.phase))


def _ordered(blocks: tuple[Block, ...]) -> tuple[Block, ...]:
    """Sort blocks with direct feedthrough after those that write their inputs."""
    done = [b for b in blocks if not b.direct]
    waiting = [b for b in blocks if b.direct]
    while waiting:
        missing = {b.output for b in waiting}
        ready = [b for b in waiting if not any(n in missing and n != b.output for n, _ in b.inputs)]
        ready = [b for b in ready if all(n != b.output for n, _ in b.inputs)]
        if not ready:
            raise ModelError(
                f"algebraic loop through {', '.join(sorted(missing))}: a sample of delay is "
                "missing (is the plant strictly proper?)"
            )
        done += ready
        waiting = [b for b in waiting if b not in ready]
    return tuple(done)


def _padded(coefficients: Coefficients, order: int) -> Array:
    return np.pad(np.asarray(coefficients, float), (0, order + 1 - len(coefficients)))


def _frame(block: Block) -> tuple[object, ...]:
    """Return what a replacement must keep."""
    return (
        [name for name, _ in block.inputs],
        block.order,
        block.delay,
        block.every,
        block.phase,
        block.direct,
    )
