"""Stillpath for programs: the functions and types that ``import stillpath`` offers.

Each is a thin entrance to what the command of the same name does, and takes the same options.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stillpath.compensation.base import DesignError
from stillpath.compensation.defaults import DEFAULT_BASIS
from stillpath.gcode.errors import GcodeError
from stillpath.models.errors import ModelError
from stillpath.models.machine import Machine
from stillpath.models.store import load_machine
from stillpath.service.client import Client

if TYPE_CHECKING:
    from stillpath.applications.design.figures import DesignReport
    from stillpath.pipeline.result import Result
    from stillpath.pipeline.simulate import PlannedTime

__all__ = [
    "Client",
    "DesignError",
    "GcodeError",
    "Machine",
    "ModelError",
    "compensate",
    "design",
    "identify",
    "load_machine",
    "plan",
    "simulate",
]


def compensate(
    source: str | Path, target: str | Path, machine: Machine | str, **options: Any
) -> Result:
    """Compensate a print file and measure what was written.

    Parameters
    ----------
    source, target : path
        G-code, binary G-code or 3MF. `target` is written next to itself, under another name, and
        renamed when it is complete; it may be `source`.
    machine : Machine or str
        A machine, the name of a built-in one, or a path to a machine's document.
    **options
        Fields of `stillpath.pipeline.options.Options`, for instance ``method="shaper:mzv"``,
        ``where="visible"``, ``budget_um=10.0``.

    Returns
    -------
    Result
        Predictions of the machine's model for the file as sliced and as written.

    Raises
    ------
    stillpath.gcode.errors.GcodeError
        The file cannot be read as G-code of this machine, or was processed before.
    stillpath.models.errors.ModelError, stillpath.compensation.base.DesignError
        The machine is unknown, or the method cannot be designed for it.
    pydantic.ValidationError
        An option is unknown or out of range.
    """
    from stillpath.pipeline.compensate import compensate_file
    from stillpath.pipeline.options import Options

    return compensate_file(Path(source), Path(target), _machine(machine), Options(**options))


def simulate(source: str | Path, machine: Machine | str) -> Result:
    """Predict how far the nozzle will be from its path when a file is printed as it is.

    Parameters
    ----------
    source : path
    machine : Machine or str
        As of `compensate`.

    Raises
    ------
    stillpath.gcode.errors.GcodeError, stillpath.models.errors.ModelError
    """
    from stillpath.pipeline.simulate import simulate_file

    return simulate_file(Path(source), _machine(machine))


def plan(
    source: str | Path, target: str | Path, machine: Machine | str, *, rate_hz: float = 1000.0
) -> PlannedTime:
    """Write the motion that the printer will make: columns t, x, y, z, e, as NumPy's npz.

    Parameters
    ----------
    source, target : path
    machine : Machine or str
        As of `compensate`.
    rate_hz : float
        Samples per second.

    Raises
    ------
    stillpath.gcode.errors.GcodeError, stillpath.models.errors.ModelError
        Also where `target` is the file that is read.
    """
    from stillpath.pipeline.simulate import plan_file

    return plan_file(Path(source), Path(target), _machine(machine), rate_hz=rate_hz)


def identify(
    files: Iterable[str | Path] | str | Path, base: Machine | str, *, name: str
) -> Machine:
    """Build a machine model from measurements: raw logs, resonance tables, and others.

    Parameters
    ----------
    files : path, or iterable of them
        Which axis a file belongs to is read from its name or its content.
    base : Machine or str
        The machine that all but the plants comes from.
    name : str
        Of the new machine.

    Raises
    ------
    stillpath.models.errors.ModelError
        A file cannot be used; the message names it and says what to measure instead.
    """
    from stillpath.applications.identification.run import identify_files, read_inputs

    listed = [files] if isinstance(files, str | Path) else files
    found = identify_files(read_inputs([str(file) for file in listed]), _machine(base), name=name)
    return found.machine


def design(
    machine: Machine | str, axis: str, *, basis: str = DEFAULT_BASIS, robust: str = "auto"
) -> DesignReport:
    """Return what the design for one axis does, and what errors of its plant cost.

    Parameters
    ----------
    machine : Machine or str
        As of `compensate`.
    axis : str
        ``x`` or ``y``.
    basis : str
        ``ce-opt``, ``robust``, ``bspline`` or ``dct``.
    robust : str
        ``auto``, ``off``, ``ensemble`` or ``minimax``.

    Raises
    ------
    stillpath.compensation.base.DesignError, stillpath.models.errors.ModelError
    """
    from stillpath.applications.design.design import design_report

    return design_report(_machine(machine), axis, basis=basis, robust=robust)


def _machine(machine: Machine | str) -> Machine:
    return machine if isinstance(machine, Machine) else load_machine(machine)
