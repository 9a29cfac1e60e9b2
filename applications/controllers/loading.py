"""Load a controller from the JSON of `stillpath controller --json`, as a real controller would."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from stillpath.applications.controllers.options import ControllerOptions
from stillpath.applications.controllers.response import settling_ticks
from stillpath.compensation.base import DesignError
from stillpath.models.complaints import complaint
from stillpath.models.diagrams import Block, Diagram
from stillpath.models.document import Document
from stillpath.models.loops import LoopSpec

__all__ = ["LoadedController", "load_controller", "read_controller"]

Finite = Annotated[float, Field(allow_inf_nan=False)]
Polynomial = Annotated[tuple[Finite, ...], Field(min_length=1, max_length=5000)]
_OPTIONS: TypeAdapter[ControllerOptions] = TypeAdapter(ControllerOptions)
_MOST_STATES = 1200


@dataclass(frozen=True, slots=True)
class LoadedController:
    """A controller as its difference equations.

    Attributes
    ----------
    spec : LoopSpec
        The machine it was designed for.
    every : int
        Block samples per sample of the machine's loop.
    settling : int
        Samples of the loop in which the slowest transient decays to 1e-3.
    """

    method: str
    spec: LoopSpec
    options: ControllerOptions
    blocks: tuple[Block, ...]
    every: int
    settling: int


def load_controller(path: Path) -> LoadedController:
    """Load a controller from a file; errors as `read_controller`."""
    return read_controller(path.read_bytes(), str(path))


def read_controller(document: str | bytes, source: str = "controller") -> LoadedController:
    """Read a controller from its JSON text; `source` names it in messages.

    Raises
    ------
    DesignError
        If the document is not valid, or its equations do not make a stable loop.
    ModelError
        If the machine in it is not valid, or the equations are no diagram.
    """
    try:
        found = _Document.model_validate_json(document)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        raise DesignError(
            f"{source}: {where or 'document'}: {complaint(first)}; a file of "
            "`stillpath controller --json` is needed"
        ) from None
    blocks = tuple(equation.block() for equation in found.difference_equations)
    radius = _checked_radius(found, blocks, source)
    settling = math.ceil(settling_ticks(radius) / found.every)
    return LoadedController(found.method, found.loop, found.options, blocks, found.every, settling)


class _Equation(Document):
    output: Annotated[str, Field(max_length=64)]
    inputs: Annotated[tuple[tuple[str, Finite], ...], Field(min_length=1, max_length=16)]
    num: Polynomial
    den: Polynomial
    delay: Annotated[int, Field(ge=0, le=5000)]
    every: Annotated[int, Field(ge=1, le=10_000)]
    phase: Annotated[int, Field(ge=0)]
    zero_between: bool

    def block(self) -> Block:
        return Block(
            self.output,
            self.inputs,
            self.num,
            self.den,
            self.delay,
            self.every,
            self.phase,
            self.zero_between,
        )


class _Document(BaseModel):
    # The rest (settings, coefficients, figures) is for people and for other programs.
    model_config = ConfigDict(extra="ignore", frozen=True)

    method: str
    loop: LoopSpec
    options: ControllerOptions
    every: Annotated[int, Field(ge=1, le=64)]
    difference_equations: Annotated[tuple[_Equation, ...], Field(min_length=1, max_length=4096)]


def _checked_radius(found: _Document, blocks: tuple[Block, ...], source: str) -> float:
    nominal = found.loop.nominal()
    servo = nominal.blocks(every=found.every, sensor=found.loop.sensor)
    whole = Diagram((*servo, *blocks))
    known = set(Diagram(nominal.blocks()).sources)
    if "c" in whole.sources or not known >= set(whole.sources):
        raise DesignError(f"{source}: the equations must read ym, u, v, r and write c")
    if whole.states > _MOST_STATES:
        raise DesignError(
            f"{source}: the loop has {whole.states} states; up to {_MOST_STATES} are checked here"
        )
    radius = whole.spectral_radius()
    if radius >= 1.0:
        raise DesignError(
            f"{source}: not stable with {found.loop.name!r}, largest |z| = {radius:.8f}; design "
            "the controller anew"
        )
    return radius
