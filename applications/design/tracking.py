"""Track one axis's whole path by filtered basis functions (paper 003, chapters 2 to 4, appendix I).

For research, and to compare with the method of prints, which designs for a window of the path at a
time. The axis stands at the path's first sample, and is held at the last for `rest_s`: samples near
the end can be corrected only by commands after it.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from stillpath.compensation.base import DesignError
from stillpath.compensation.basis import BASES
from stillpath.compensation.defaults import DT_S
from stillpath.compensation.full_preview import FullPreview, Solvability
from stillpath.compensation.ladder import functions_within
from stillpath.compensation.lifted import LiftedSet, lift, lifted_set
from stillpath.compensation.metrics import effort_metric, error_metric, robust_error_metric
from stillpath.compensation.nominal import lifted_optimum, two_step
from stillpath.compensation.nominal_frequency import robust_nominal
from stillpath.compensation.operators import DenseOperator, LiftedOperator
from stillpath.models.arrays import Array
from stillpath.models.machine import Machine
from stillpath.models.plants import PlantSet, plant_set
from stillpath.pipeline.columns import csv_table

__all__ = ["MOST_SAMPLES", "Nominal", "Tracked", "read_path", "track", "write_tracked"]

Nominal = Literal["plant", "ensemble", "optimum", "frequency"]
"""What functions are filtered through: the nominal plant, every plant of the set (least squares),
the nominal model (4.28), or G_r (I.3) with its kernel distribution (I.5)."""
MOST_SAMPLES = 3000
"""Robust functions of so many take a minute and 1 GB."""
_SLOW_FIRST = ("bspline", "dct")
_AXES: tuple[Literal["x", "y"], ...] = ("x", "y")


@dataclass(frozen=True, slots=True, eq=False)
class Tracked:
    """A command, and how well it tracks; samples of 1 ms, `rest` of them after the path.

    Attributes
    ----------
    path_mm, command_mm, output_mm : ndarray, shape (m,)
        The output is the nominal plant's.
    error, members : float, tuple of float
        e_RMS / y_d,RMS over the path, of the nominal plant and of the set's, the path counted from
        its first sample.
    effort, largest_mm : float
        u_RMS / y_d,RMS, and how far the command goes from that sample.
    j_e, j_er, j_c : float
        (2.18) of the nominal plant, (4.2) of the set, (3.4).
    """

    path_mm: Array
    command_mm: Array
    output_mm: Array
    rest: int
    report: Solvability
    error: float
    members: tuple[float, ...]
    effort: float
    largest_mm: float
    j_e: float
    j_er: float
    j_c: float


def track(
    machine: Machine,
    axis: str,
    path_mm: Array,
    *,
    basis: str = "ce-opt",
    functions: int | None = None,
    nominal: Nominal = "plant",
    rest_s: float = 0.2,
) -> Tracked:
    """Design a command for a whole path of one axis.

    Parameters
    ----------
    axis : {"x", "y"}
    path_mm : ndarray, shape (n,)
        One sample a millisecond.
    basis : str
        A name of `compensation.basis.BASES`.
    functions : int, optional
        How many; by default half of the samples, of B-splines and cosines at most as many as keep
        the command within the model's band.
    rest_s : float
        How long the axis is held at the end.

    Raises
    ------
    DesignError
        For an unknown name, a path that is too long or does not move, and as the design does.
    """
    plants = _plants(machine, axis, basis, nominal)
    band_hz = machine.axes["x" if axis == "x" else "y"].band_hz
    rest = round(rest_s / DT_S)
    y_d, scale = _desired(path_mm, rest)
    m = len(y_d)
    n = functions if functions is not None else _count(basis, band_hz, m)
    design = _designed(plants, m, basis, n, nominal)
    u = design.command(y_d)
    controller = design.controller()
    own = lift(plants.nominal, m)
    used = slice(len(path_mm))

    def error(plant: LiftedOperator) -> float:
        return float(np.sqrt(np.mean((y_d - plant.apply(u))[used] ** 2))) / scale

    return Tracked(
        y_d + path_mm[0],
        u + path_mm[0],
        own.apply(u) + path_mm[0],
        rest,
        design.report,
        error(own),
        tuple(error(lift(plant, m)) for plant in plants.members),
        float(np.sqrt(np.mean(u[used] ** 2))) / scale,
        float(np.abs(u).max()),
        error_metric(own, controller),
        robust_error_metric(_set_of(plants, m), controller),
        effort_metric(controller),
    )


def _desired(path_mm: Array, rest: int) -> tuple[Array, float]:
    """Return the path from 0 on, held for `rest` samples at its end, and its rms without these."""
    y_d = np.pad(path_mm - path_mm[0], (0, rest), mode="edge")
    if len(y_d) > MOST_SAMPLES:
        raise DesignError(
            f"path of {len(path_mm)} ms and {rest} ms of rest: at most {MOST_SAMPLES} ms together; "
            "cut it, or compensate the print"
        )
    scale = float(np.sqrt(np.mean(y_d[: len(path_mm)] ** 2)))
    if scale == 0.0:
        raise DesignError(f"the path stays at {path_mm[0]:g} mm: there is nothing to track")
    return y_d, scale


def read_path(file: Path, axis: str) -> Array:
    """Read a path: one number a line, or the column ``x_mm`` or ``y_mm`` of a table with a head.

    Raises
    ------
    DesignError
        Naming file, line and value.
    """
    with file.open(encoding="utf-8", errors="replace", newline="") as lines:
        # Not more than a design takes: anything may be named here.
        rows = list(islice((row for row in csv.reader(lines) if row), MOST_SAMPLES + 2))
    if not rows:
        raise DesignError(f"{file}: the file is empty; give one number a line, or a table")
    head, at = [cell.strip() for cell in rows[0]], 0
    first = 0 if len(head) == 1 and _number(head[0]) is not None else 1
    if len(head) > 1:
        name = f"{axis}_mm"
        if name not in head:
            raise DesignError(f"{file}: no column is called {name}; there are {', '.join(head)}")
        at = head.index(name)
    path = []
    for number, row in enumerate(rows[first:], first + 1):
        value = _number(row[at]) if at < len(row) else None
        if value is None:
            raise DesignError(f"{file}: row {number}: {','.join(row)!r} has no number there")
        path.append(value)
    if len(path) < 2:
        raise DesignError(f"{file}: {len(path)} samples; a path has at least two")
    return np.array(path)


def write_tracked(tracked: Tracked, target: Path) -> None:
    """Write path, command and output as a table, whole or not at all."""
    columns = {
        "t_s": np.arange(len(tracked.path_mm)) * DT_S,
        "path_mm": tracked.path_mm,
        "command_mm": tracked.command_mm,
        "output_mm": tracked.output_mm,
    }
    with csv_table(target, {"t_s": "%.3f"} | dict.fromkeys(list(columns)[1:], "%.6f")) as table:
        table.write(columns)


def _plants(machine: Machine, axis: str, basis: str, nominal: str) -> PlantSet:
    for what, given, known in (
        ("axis", axis, _AXES),
        ("basis", basis, tuple(BASES)),
        ("nominal model", nominal, get_args(Nominal)),
    ):
        if given not in known:
            raise DesignError(f"no {what} is called {given!r}; there are {', '.join(known)}")
    plants = plant_set(machine.axes["x" if axis == "x" else "y"].without_delay(), DT_S)
    if len(plants.members) == 1 and (basis == "robust" or nominal != "plant"):
        asked = "--basis robust" if basis == "robust" else f"--nominal {nominal}"
        raise DesignError(
            f"{asked} needs a set of plants, and axis {axis} of {machine.name} has one; take "
            "another basis with the nominal plant, or a machine that was measured"
        )
    return plants


def _count(basis: str, band_hz: tuple[float, float] | None, m: int) -> int:
    """Return how many functions to take if nobody says it."""
    if basis not in _SLOW_FIRST:
        # What the plant answers most comes first: slow motion may be behind a whole resonance.
        return m // 2
    return max(1, min(m // 2, functions_within(band_hz, DT_S) * m // 300))


def _set_of(plants: PlantSet, m: int) -> LiftedSet:
    markov = np.array([plant.impulse_response(m) for plant in plants.members])
    return lifted_set(markov, plants.weights)


def _designed(plants: PlantSet, m: int, basis: str, n: int, nominal: Nominal) -> FullPreview:
    if nominal == "ensemble":
        members = _set_of(plants, m)
        return FullPreview(members, BASES[basis](members, n))
    if nominal == "optimum":
        members = _set_of(plants, m)
        model: LiftedOperator = DenseOperator(lifted_optimum(members))
    elif nominal == "frequency":
        points = 2 ** int(np.ceil(np.log2(4 * m)))
        model = robust_nominal(plants.members, points=max(points, 4096)).operator(m)
    else:
        model = lift(plants.nominal, m)
    dense = model.dense()
    if basis == "robust":
        given = None if nominal == "optimum" else dense
        return FullPreview(model, two_step(_set_of(plants, m), n, nominal=given).basis)
    return FullPreview(model, BASES[basis](LiftedSet(dense.T @ dense, dense, m), n))


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if np.isfinite(value) else None
