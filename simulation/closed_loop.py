"""Simulate closed loops with an add-on controller, several rates, noise and limits.

A loop and its add-on form one block diagram (`models.diagrams`), driven by external signals.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from stillpath.models.arrays import Array
from stillpath.models.diagrams import Block, Diagram, Running
from stillpath.models.disturbances import SensorSpec
from stillpath.models.loops import Loop

__all__ = ["ClosedLoop", "Imperfections", "batch", "simulate"]


@dataclass(frozen=True, slots=True)
class Imperfections:
    """Nonlinearities and noise of a real loop.

    Attributes
    ----------
    noise_rms : float
        White sensor noise, in units of y.
    input_limit : float
        Saturation of the plant input u.
    friction, friction_speed : float
        Coulomb friction in units of u, and the change of y per sample at which it is full.
    """

    noise_rms: float = 0.0
    input_limit: float = math.inf
    friction: float = 0.0
    friction_speed: float = 1.0


class ClosedLoop:
    """A loop with an add-on, simulated block by block.

    Parameters
    ----------
    loop : Loop
        The true plant; the add-on may have been designed for another.
    add_on : iterable of Block
        Blocks that write c (see `models.loops`); empty for the baseline.
    every : int
        Ticks of the add-on per sample of the loop; signals are given and recorded per tick.
    sensor : SensorSpec, optional
        Rate, age and resolution of what the controller sees.
    generator : numpy.random.Generator, optional
        Needed if there is noise.
    """

    def __init__(
        self,
        loop: Loop,
        add_on: Iterable[Block] = (),
        *,
        every: int = 1,
        sensor: SensorSpec | None = None,
        imperfections: Imperfections | None = None,
        generator: np.random.Generator | None = None,
    ) -> None:
        real = imperfections or Imperfections()
        if real.noise_rms > 0 and generator is None:
            raise ValueError("noise is random: give a generator")
        self._noise_rms = real.noise_rms
        self._generator = generator
        servo = loop.blocks(
            every=every,
            sensor=sensor,
            input_limit=real.input_limit,
            friction=real.friction,
            friction_speed=real.friction_speed,
        )
        self.diagram = Diagram((*servo, *add_on))
        self._running = Running(self.diagram)

    def push(
        self, inputs: Mapping[str, ArrayLike], watch: Sequence[str] = ("y",)
    ) -> dict[str, Array]:
        """Return the signals `watch` for a stretch of outer signals (r, d_in, d_out, n).

        What is not given is 0; sensor noise is added to a given n.
        """
        given = dict(inputs)
        if self._generator is not None and self._noise_rms > 0:
            samples = max((np.size(x) for x in given.values()), default=0)
            noise = self._noise_rms * self._generator.standard_normal(samples)
            given["n"] = noise + np.asarray(given.get("n", 0.0), float)
        return self._running.push(given, watch)

    def retune(self, blocks: Iterable[Block], *, reset: bool) -> None:
        """Put new coefficients into running blocks; see `models.diagrams.Running.replace`."""
        self._running.replace(blocks, reset=reset)


def simulate(
    loop: Loop,
    add_on: Iterable[Block],
    inputs: Mapping[str, ArrayLike],
    watch: Sequence[str] = ("y",),
    *,
    every: int = 1,
    sensor: SensorSpec | None = None,
    imperfections: Imperfections | None = None,
    generator: np.random.Generator | None = None,
) -> dict[str, Array]:
    """Return the signals `watch` of a loop that starts at rest; see `ClosedLoop`."""
    return ClosedLoop(
        loop,
        add_on,
        every=every,
        sensor=sensor,
        imperfections=imperfections,
        generator=generator,
    ).push(inputs, watch)


def batch(
    loops: Sequence[Loop],
    add_on: Sequence[Block],
    inputs: Mapping[str, ArrayLike],
    *,
    signal: str = "y",
    every: int = 1,
    sensor: SensorSpec | None = None,
    imperfections: Imperfections | None = None,
    seed: int | None = None,
) -> Array:
    """Return one signal for every plant of a set, shape (len(loops), n).

    Every member sees the same noise, that of `seed`.
    """
    return np.array(
        [
            simulate(
                loop,
                add_on,
                inputs,
                (signal,),
                every=every,
                sensor=sensor,
                imperfections=imperfections,
                generator=None if seed is None else np.random.default_rng(seed),
            )[signal]
            for loop in loops
        ]
    )
