"""Compute the design report for one axis of a machine, from the plant to the cost of model errors.

The command is designed in increments (docs/method.md), so the metrics and the ladder are those of
the plant with two integrators in front, lifted over the preview window. Sources: dissertation of K.
S. Ramani (paper 003), equation numbers beside each figure.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillpath.applications.design.figures import (
    AxisFigures,
    Curve,
    DesignReport,
    Frequencies,
    LiftedFigures,
    Member,
    Metrics,
    ModeFigures,
    RobustMetric,
    Robustness,
    RungFigures,
    ZeroFigures,
)
from stillpath.applications.design.robustness import OffDesignTrial
from stillpath.compensation.base import DesignError
from stillpath.compensation.basis import BASES, ZERO
from stillpath.compensation.defaults import DEFAULT_BASIS, DT_S
from stillpath.compensation.fbf import ROBUST, UPDATE_S, WINDOW_S, PreviewFbf
from stillpath.compensation.ladder import Designs, designs, functions_within
from stillpath.compensation.lifted import LiftedSet, integrated, lift, lifted_set
from stillpath.compensation.lifted_window import LiftedWindow, lifted_window
from stillpath.compensation.metrics import (
    effort_metric,
    effort_of_ce_opt,
    error_of_functions,
    robust_error_metric,
    robust_error_of_spread,
)
from stillpath.compensation.nominal import two_step
from stillpath.compensation.shapers import SHAPERS
from stillpath.models.arrays import Array
from stillpath.models.machine import Machine
from stillpath.models.plants import DiscretePlant, PlantSet, plant_set
from stillpath.pipeline.caution import design_mode
from stillpath.pipeline.measuring.reference_shaper import BestShaper, tune_each
from stillpath.version import __version__

__all__ = ["AXES", "ERRORS_PERCENT", "design_report"]

AXES = ("x", "y")
ERRORS_PERCENT = tuple(range(-20, 21, 2))
"""Frequency errors at which every command is evaluated."""
_WINDOW, _UPDATE = round(WINDOW_S / DT_S), round(UPDATE_S / DT_S)
_FREQUENCIES_HZ = tuple(np.geomspace(5.0, 200.0, 160).round(3).tolist())


def design_report(
    machine: Machine,
    axis: str,
    *,
    basis: str = DEFAULT_BASIS,
    robust: str = "off",
    errors_percent: Sequence[float] = ERRORS_PERCENT,
    shapers: Sequence[str] = SHAPERS,
    motion: tuple[Array, NDArray[np.bool_]] | None = None,
    tuned: Mapping[str, BestShaper] | None = None,
) -> DesignReport:
    """Compute every figure of a design.

    Parameters
    ----------
    axis : {"x", "y"}
    basis, robust : str
        As of `compensation.fbf.PreviewFbf`; ``auto`` is the mode of jobs, without a shaper's share.
    errors_percent, shapers : sequences of float and str
        Frequency errors of this axis at which every command is evaluated, among them shapers.
    motion : (path, extruding), optional
        Shapes (2, n) in mm and (n,); default: the reference motion, some 25 s.
    tuned : mapping, optional
        Shapers already tuned on this machine and motion
        (`pipeline.measuring.reference_shaper.tune_each`).

    Raises
    ------
    DesignError
        For an unknown axis, basis or robust mode; why a design is refused stands in the report.
    """
    made = _designed(machine, axis, basis, robust)
    trial = OffDesignTrial(machine, axis, DT_S, motion, errors_percent)
    missing = [*made.missing, *trial.notes]
    own = _own_curves(trial, made.by_mode, made.ladder, missing)
    if tuned is None:
        tuned = tune_each(machine, trial.y_d_mm, DT_S, trial.extruding, shapers)
    curves = (trial.uncompensated(), *own.values(), *(trial.shaped(tuned[k]) for k in shapers))
    chosen, row = made.by_mode.get(made.mode), made.row
    limit = next((d.accel_limits_mm_s2(trial.y_d_mm)[row] for d in made.by_mode.values()), None)
    path_peak, path_rms = trial.path_acceleration()
    return DesignReport.model_validate(
        {
            "version": __version__,
            "machine": machine.name,
            "machine_title": machine.title,
            "machine_revision": machine.revision,
            "frequencies": _frequencies(machine, axis),
            "basis": basis,
            **made.figures(),
            "chosen": chosen.rungs[row] if chosen and made.mode in own else None,
            "path_peak_accel_mm_s2": path_peak,
            "path_rms_accel_mm_s2": path_rms,
            "accel_limit_mm_s2": limit,
            "robustness": Robustness(
                errors_percent=trial.errors_percent, curves=curves, missing=tuple(missing)
            ),
        }
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Designed:
    """The designs of an axis, before they are evaluated.

    Attributes
    ----------
    by_mode : dict of str to PreviewFbf
        For every robust mode that can be designed.
    missing : list of str
        Why the others cannot.
    robust, mode : str
        Requested mode, and designed mode: without a set all modes are equal.
    """

    plants: PlantSet
    row: int
    by_mode: dict[str, PreviewFbf]
    missing: list[str]
    robust: str
    mode: str
    lifted: LiftedWindow
    ladder: tuple[RungFigures, ...]

    def figures(self) -> dict[str, Any]:
        """Return the figures of the report."""
        plants, lifted = self.plants, self.lifted
        guarded = lifted.weights if self.mode == "minimax" else plants.weights
        return {
            "axis": AXES[self.row],
            "robust": self.robust,
            "sampling_s": DT_S,
            "window_s": WINDOW_S,
            "update_s": UPDATE_S,
            "plant": _plant(plants, self.by_mode.get("minimax"), self.row),
            "lifted": _singular_values(lifted.plants, lifted.weights),
            "metrics": _metrics(plants, guarded),
            "ladder": self.ladder,
        }


def _designed(machine: Machine, axis: str, basis: str, robust: str) -> _Designed:
    _check_names(axis, basis, robust)
    row = AXES.index(axis)
    spec = machine.axes["x" if axis == "x" else "y"]
    # As in `PreviewFbf`, designs ignore delays of slow motion.
    plants = plant_set(spec.without_delay(), DT_S)
    by_mode, missing = _designers(machine, basis)
    if robust == "auto":
        # As in jobs: if the set is refused, design for the nominal plants.
        mode = design_mode(machine)
        robust = mode if mode in by_mode else "off"
    # Without a set all robust modes are equal.
    mode = robust if robust in by_mode or len(plants.members) > 1 else "off"
    if mode in by_mode:
        lifted = by_mode[mode].lifted[row]
    else:
        # Refused entirely: the figures say why.
        members, weights = plants.members, plants.weights
        if mode == "off":
            members, weights = (plants.nominal,), np.ones(1)
        lifted = lifted_window(members, weights, _WINDOW, _UPDATE)
    # If the compensator is refused entirely, none of its rungs can be used.
    whole = next((text for text in missing if text.startswith(f"fbf {mode}: ")), None)
    most = functions_within(spec.band_hz, DT_S)
    ladder = _ladder(plants, lifted, basis, whole, most)
    return _Designed(plants, row, by_mode, missing, robust, mode, lifted, ladder)


def _check_names(axis: str, basis: str, robust: str) -> None:
    for what, given, known in (
        ("axis", axis, AXES),
        ("basis", basis, tuple(BASES)),
        ("robust mode", robust, ("auto", *ROBUST)),
    ):
        if given not in known:
            raise DesignError(f"no {what} is called {given!r}; there are {', '.join(known)}")


def _designers(machine: Machine, basis: str) -> tuple[dict[str, PreviewFbf], list[str]]:
    """Return the compensators of all distinct robust modes, and why others are missing."""
    sets = any(len(axis.weighted_members()) > 1 for axis in machine.axes.values())
    made, missing = {}, []
    for mode in ROBUST if sets else ROBUST[:1]:
        try:
            made[mode] = PreviewFbf(machine, DT_S, robust=mode, basis=basis)
        except DesignError as error:
            missing.append(f"fbf {mode}: {error}")
    return made, missing


def _own_curves(
    trial: OffDesignTrial,
    designers: Mapping[str, PreviewFbf],
    ladder: Sequence[RungFigures],
    missing: list[str],
) -> dict[str, Curve]:
    """Return the curve of every mode; those that refuse the motion are added to `missing`."""
    rungs = [f"n {rung.n}, price {rung.price:g}" for rung in ladder]
    curves = {}
    for mode, designer in designers.items():
        try:
            curves[mode] = trial.compensated(designer, mode, rungs)
        except DesignError as error:
            missing.append(f"fbf {mode}: {error}")
    return curves


def _plant(plants: PlantSet, guarded: PreviewFbf | None, row: int) -> AxisFigures:
    nominal = plants.nominal
    zeros = nominal.zeros()
    outside = sorted(zeros[(np.abs(zeros) > 1.0) & (zeros.imag >= 0)], key=abs)
    minimax = [None] * len(plants.members) if guarded is None else guarded.lifted[row].weights
    return AxisFigures(
        order=nominal.order,
        settling_s=nominal.settling_time_s(),
        modes=_modes(nominal),
        zeros_outside=tuple(
            ZeroFigures(
                real=float(z.real),
                imag=float(z.imag),
                radius=float(abs(z)),
                f_hz=float(np.angle(z) / (2 * np.pi * nominal.dt_s)),
            )
            for z in outside
        ),
        members=tuple(
            Member(modes=_modes(member), weight=weight, minimax_weight=guard)
            for member, weight, guard in zip(plants.members, plants.weights, minimax, strict=True)
        ),
        notes=plants.notes,
    )


def _frequencies(machine: Machine, axis: str) -> Frequencies:
    spec = machine.axes["x" if axis == "x" else "y"]
    plants = plant_set(spec.without_delay(), DT_S)
    responses = [p.frequency_response(_FREQUENCIES_HZ) for p in (plants.nominal, *plants.members)]
    gain = np.abs(responses)
    phase_deg = np.degrees(np.unwrap(np.angle(responses), axis=1))
    found: dict[str, object] = {"f_hz": _FREQUENCIES_HZ}
    for name, unit, rows in (("gain", "", gain), ("phase", "_deg", phase_deg)):
        found[f"{name}{unit}"] = rows[0].tolist()
        found[f"{name}_low{unit}"] = rows.min(axis=0).tolist()
        found[f"{name}_high{unit}"] = rows.max(axis=0).tolist()
    measured = spec.provenance is not None and not spec.provenance.magnitude_only
    return Frequencies.model_validate({**found, "phase_measured": measured})


def _modes(plant: DiscretePlant) -> tuple[ModeFigures, ...]:
    return tuple(ModeFigures(f_hz=float(f), zeta=float(zeta)) for f, zeta in plant.modes())


def _singular_values(members: Sequence[DiscretePlant], weights: Array) -> LiftedFigures:
    """Return the singular values of the stack of sqrt(l_j) G_j; for one plant, its own."""
    markov = np.array([p.impulse_response(_WINDOW) for p in members])
    roots = np.sqrt(weights)
    position, increments = (
        np.linalg.svd(
            np.concatenate([r * lift(h, _WINDOW).dense() for r, h in zip(roots, hs, strict=True)]),
            compute_uv=False,
        )
        for hs in (markov, integrated(markov))
    )
    return LiftedFigures(
        samples=_WINDOW, position=tuple(position.tolist()), increments=tuple(increments.tolist())
    )


def _metrics(plants: PlantSet, weights: Array) -> Metrics:
    """Return the closed forms of the nominal plant, and of the set if there is one."""
    own = _singular_values((plants.nominal,), np.ones(1))
    per_um = plants.dt_s**-2 / 1e3
    robust = []
    if len(plants.members) > 1:
        members = _increments(plants.members, weights)
        nominal = _increments((plants.nominal,), np.ones(1)).mean
        robust = [_robust(members, "plant", nominal), _robust(members, "optimum", None)]
    return Metrics(
        error=tuple(error_of_functions(n, _WINDOW) for n in range(1, _WINDOW + 1)),
        effort_position=_effort(own.position, 1.0),
        effort_increments=_effort(own.increments, per_um),
        robust=tuple(robust),
    )


def _effort(singular_values: Sequence[float], scale: float) -> tuple[float | None, ...]:
    sigma = np.asarray(singular_values)
    return tuple(
        scale * effort_of_ce_opt(sigma, n) if sigma[n - 1] > ZERO * sigma[0] else None
        for n in range(1, len(sigma) + 1)
    )


def _robust(members: LiftedSet, name: str, nominal: Array | None) -> RobustMetric:
    found = two_step(members, nominal=nominal)
    sigma, window = found.singular_values, members.samples
    counts = range(1, len(sigma) + 1)
    return RobustMetric.model_validate(
        {
            "nominal": name,
            "best": found.best,
            "left_out": found.r,
            "singular_values": tuple(sigma.tolist()),
            "error": tuple(robust_error_of_spread(sigma, n, window) for n in counts),
            "nominal_part": tuple(error_of_functions(n, window) for n in counts),
            "uncertainty_part": tuple(np.sqrt(np.cumsum(sigma**2) / window).tolist()),
        }
    )


def _increments(members: Sequence[DiscretePlant], weights: Array) -> LiftedSet:
    markov = np.array([p.impulse_response(_WINDOW) for p in members])
    return lifted_set(integrated(markov), weights)


def _ladder(
    plants: PlantSet,
    lifted: LiftedWindow,
    basis: str,
    refused: str | None,
    most: int,
) -> tuple[RungFigures, ...]:
    nominal = _increments((plants.nominal,), np.ones(1))
    every = None
    if len(plants.members) > 1:
        every = _increments(plants.members, plants.weights)
    # The same designs as in jobs.
    weights = tuple(lifted.weights.tolist())
    table = designs(lifted.plants, weights, _WINDOW, _UPDATE, basis, most)
    rungs = range(len(table.ladder))
    return tuple(_rung(k, table, nominal, every, refused) for k in rungs)


def _rung(
    number: int,
    table: Designs,
    nominal: LiftedSet,
    every: LiftedSet | None,
    refused: str | None,
) -> RungFigures:
    rung, lifted = table.ladder[number], table.lifted
    n = max(4, round(rung.n * _WINDOW / 300))
    cutoff_hz = n / (2 * WINDOW_S)
    try:
        design = table.design(number)
    except DesignError as error:
        return RungFigures(n=n, cutoff_hz=cutoff_hz, price=rung.price, refused=str(error))
    if refused is not None:
        return RungFigures(n=n, cutoff_hz=cutoff_hz, price=rung.price, refused=refused)
    seen = np.einsum("k,kwn->nw", lifted.target, design.filtered)
    controller = design.basis @ np.linalg.solve(np.eye(n) + rung.price * design.effort, seen)
    return RungFigures(
        n=n,
        cutoff_hz=cutoff_hz,
        price=rung.price,
        spectral_radius=design.spectral_radius,
        condition=design.condition,
        error=robust_error_metric(nominal, controller),
        robust_error=None if every is None else robust_error_metric(every, controller),
        effort=effort_metric(controller) / DT_S**2 / 1e3,
    )
