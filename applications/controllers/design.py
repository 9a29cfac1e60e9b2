"""Design and check an add-on controller, and simulate the machine with and without it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillpath.applications.controllers.figures import (
    ControllerReport,
    ExtremeFigure,
    LoopFigures,
    SensitivityCurves,
)
from stillpath.applications.controllers.options import (
    METHODS,
    AdaptiveOptions,
    ControllerOptions,
    DobOptions,
    FmsdobOptions,
    InverseDobOptions,
    MmpOptions,
    MultirateOptions,
    QuasiOptions,
    WideOptions,
    builtin_loop,
)
from stillpath.applications.controllers.response import adapted, disturbance_of, time_figures
from stillpath.compensation.base import DesignError
from stillpath.compensation.feedback.controller import Controller, Extreme
from stillpath.compensation.feedback.disturbance_observer import design_disturbance_observer
from stillpath.compensation.feedback.fmsdob import Trim, fmsdob
from stillpath.compensation.feedback.inverse_dob import inverse_dob
from stillpath.compensation.feedback.mmp import mmp
from stillpath.compensation.feedback.multirate import design_multirate
from stillpath.compensation.feedback.repetitive import design_quasi, design_wide_band, shared_period
from stillpath.models.arrays import Array
from stillpath.models.disturbances import SensorSpec
from stillpath.models.loops import Loop, LoopSpec, builtin_loops, load_loop
from stillpath.version import __version__

__all__ = ["Designed", "design_controller", "fitting_methods", "loop_figures"]

_LARGEST_WORK = 1.2e9
"""Limit on states cubed times plants: about ten seconds of eigenvalues."""
_OTHER_STATES = 60
_SMALLEST = 1e-6
_BINS = 240
_LOWEST_SHARE = 1 / 2000
"""Lowest frequency of the curves, relative to the sampling rate."""


@dataclass(frozen=True, slots=True, eq=False)
class Designed:
    """A controller and its figures."""

    controller: Controller
    report: ControllerReport


def design_controller(spec: LoopSpec, options: ControllerOptions) -> Designed:
    """Design an add-on for a closed-loop machine, and simulate its effect.

    Raises
    ------
    DesignError
        If the method does not fit the machine, takes too long to check, or is refused
        (`compensation.feedback.controller.Refusal`).
    ModelError
        If the machine, or another that the options name, is not valid.
    """
    loops = spec.loops()
    _check_fit(spec, loops[0], options.method)
    _check_size(spec, loops, options)
    disturbance, enters = disturbance_of(options, loops[0])
    controller: Controller
    if isinstance(options, AdaptiveOptions):
        controller, retuned = adapted(loops, options, disturbance, enters)
    else:
        controller, retuned = _DESIGNS[type(options)](loops, options, spec), None
    time = time_figures(spec, loops, controller, options, disturbance, enters, retuned)
    p = controller.prediction
    return Designed(
        controller,
        ControllerReport(
            version=__version__,
            machine=spec.name,
            title=spec.title,
            source=spec.source,
            unit=spec.unit,
            method=options.method,
            min_inverse_t=_extreme(p.min_inverse_t),
            max_add_on=_extreme(p.max_add_on),
            noise_gain=controller.noise_gain,
            multiplications=controller.multiplications,
            rate_hz=1.0 / controller.dt_s,
            spectral_radius=max(controller.spectral_radii),
            uncertainty=options.uncertainty,
            notes=controller.notes,
            curves=_curves(controller, loops[0], options),
            time=time,
            controller=_document(controller, spec, loops[0], options),
        ),
    )


def fitting_methods(spec: LoopSpec) -> tuple[str, ...]:
    """Return the methods that can be designed for a machine, with settings that suit it.

    Methods with a plant inverse are tried, because that depends on the plant's zeros.
    """
    loops = spec.loops()
    rate = 1.0 / loops[0].dt_s
    tries: dict[str, Callable[[], Controller]] = {
        "inverse-dob": lambda: inverse_dob(loops, (0.1 * rate,)),
        "dob": lambda: design_disturbance_observer(loops, rate / 200),
    }

    def fits(method: str) -> bool:
        try:
            _check_fit(spec, loops[0], method)
            tries.get(method, lambda: None)()
        except DesignError:
            return False
        return True

    return tuple(method for method in METHODS if fits(method))


def loop_figures() -> list[LoopFigures]:
    """Return the built-in closed-loop machines and the methods that fit each."""
    found = []
    for name in builtin_loops():
        spec = load_loop(name)
        rate = 1.0 / spec.loop.dt_s
        found.append(
            LoopFigures(
                name=name,
                title=spec.title,
                source=spec.source,
                unit=spec.unit,
                rate_hz=rate,
                sensor_hz=rate / _every(spec),
                members=len(spec.members),
                methods=fitting_methods(spec),
            )
        )
    return found


def _fmsdob(loops: tuple[Loop, ...], o: FmsdobOptions, _: LoopSpec) -> Controller:
    return fmsdob(
        loops,
        o.targets_hz,
        shape=o.shape,
        bandwidth_hz=o.bandwidth_hz,
        trim=Trim(o.detuning, o.zeros, o.through_band),
        around=o.around,
        uncertainty=o.uncertainty,
    )


def _inverse(loops: tuple[Loop, ...], o: InverseDobOptions, _: LoopSpec) -> Controller:
    return inverse_dob(loops, o.targets_hz, bandwidth_hz=o.bandwidth_hz, uncertainty=o.uncertainty)


def _dob(loops: tuple[Loop, ...], o: DobOptions, _: LoopSpec) -> Controller:
    nominal = None if o.nominal is None else builtin_loop(o.nominal).nominal()
    if nominal is not None and nominal.dt_s != loops[0].dt_s:
        raise DesignError(
            f"dob: the nominal plant is sampled every {nominal.dt_s:g} s, the machine every "
            f"{loops[0].dt_s:g} s; they must be the same"
        )
    return design_disturbance_observer(
        loops, o.cutoff_hz, nominal=nominal, uncertainty=o.uncertainty
    )


def _mmp(loops: tuple[Loop, ...], o: MmpOptions, spec: LoopSpec) -> Controller:
    return mmp(
        loops,
        o.targets_hz,
        spec.sensor or SensorSpec(),
        alpha=o.alpha,
        bandwidth_hz=o.bandwidth_hz,
        shape=o.shape,
        noise_gain=o.noise_gain,
        uncertainty=o.uncertainty,
    )


def _single_rate(loops: tuple[Loop, ...], o: WideOptions | QuasiOptions, _: LoopSpec) -> Controller:
    design = design_wide_band if isinstance(o, WideOptions) else design_quasi
    return design(
        loops,
        o.fundamental_hz,
        alpha=o.alpha,
        nyquist_pairs=o.nyquist_pairs,
        notches_hz=o.notches_hz,
        compared=o.compared,
        uncertainty=o.uncertainty,
    )


def _multirate(loops: tuple[Loop, ...], o: MultirateOptions, _: LoopSpec) -> Controller:
    return design_multirate(
        loops,
        builtin_loop(o.fast).nominal(),
        o.fundamental_hz,
        alpha=o.alpha,
        nyquist_pairs=o.nyquist_pairs,
        notches_hz=o.notches_hz,
        compared=o.compared,
        uncertainty=o.uncertainty,
    )


_DESIGNS: dict[type, Callable[..., Controller]] = {
    FmsdobOptions: _fmsdob,
    InverseDobOptions: _inverse,
    DobOptions: _dob,
    MmpOptions: _mmp,
    WideOptions: _single_rate,
    QuasiOptions: _single_rate,
    MultirateOptions: _multirate,
}


def _check_fit(spec: LoopSpec, nominal: Loop, method: str) -> None:
    every = _every(spec)
    if method == "mmp" and (every < 2 or nominal.fed_back):
        raise DesignError(
            f"mmp is for machines watched by a sensor slower than the loop, which the servo does "
            f"not feed back; that of {spec.name!r} is sampled with the loop. Use fmsdob"
        )
    if method != "mmp" and every > 1:
        raise DesignError(
            f"{method} needs a sample of the sensor at every sample of the loop; that of "
            f"{spec.name!r} gives every {every}th one. Use mmp"
        )


def _check_size(spec: LoopSpec, loops: tuple[Loop, ...], options: ControllerOptions) -> None:
    """Refuse, before computing anything, designs that would take minutes to check."""
    states, other = _OTHER_STATES, "name fewer frequencies"
    if isinstance(options, WideOptions):
        states += round(1.0 / (loops[0].dt_s * options.fundamental_hz))
        other = "take a multiple of the fundamental"
    elif isinstance(options, QuasiOptions | MultirateOptions):
        states += shared_period(1 / loops[0].dt_s, options.fundamental_hz).denominator
        other = "round the frequency to a simpler fraction of the sampling rate, use rc-wide"
    elif isinstance(options, MmpOptions):
        states += 2 * len(options.targets_hz) * _every(spec)
    largest = int((_LARGEST_WORK / len(loops)) ** (1 / 3))
    if states > largest:
        raise DesignError(
            f"{options.method} would remember some {states} samples; with {len(loops)} plants "
            f"stability is judged up to {largest} here: {other}, or name fewer members"
        )


def _every(spec: LoopSpec) -> int:
    return spec.sensor.every if spec.sensor else 1


def _extreme(found: Extreme) -> ExtremeFigure:
    return ExtremeFigure(db=found.db, at_hz=found.f_hz)


def _curves(controller: Controller, nominal: Loop, options: ControllerOptions) -> SensitivityCurves:
    p = controller.prediction
    through = 1.0 - p.add_on
    if isinstance(options, FmsdobOptions | AdaptiveOptions | MmpOptions):
        # 1 - PQ with P the forward model; the other methods' Q has the plant's inverse in it.
        plant = isinstance(options, FmsdobOptions) and options.around == "plant"
        through = through / (nominal.plant(p.f_hz) if plant else nominal.servo(p.f_hz))
    size = [np.abs(c) for c in (p.s0, p.s, p.add_on, 1.0 / np.maximum(np.abs(p.t), 1e-12), through)]
    first = int(np.searchsorted(p.f_hz, _LOWEST_SHARE / nominal.dt_s))
    kept = first + _kept(p.f_hz[first:], [curve[first:] for curve in size[1:4]])
    names = ("s0", "s", "add_on", "inverse_t", "q")
    return SensitivityCurves(
        f_hz=tuple(p.f_hz[kept].tolist()),
        **{
            name: tuple(np.maximum(curve[kept], _SMALLEST).tolist())
            for name, curve in zip(names, size, strict=True)
        },
    )


def _kept(f_hz: Array, curves: list[Array]) -> NDArray[np.int64]:
    """Return samples of curves for a logarithmic axis that keep all extremes."""
    where = np.log(f_hz / f_hz[0]) / np.log(f_hz[-1] / f_hz[0])
    starts = np.unique(np.searchsorted(where, np.arange(_BINS) / _BINS))
    kept = [0, len(f_hz) - 1]
    for first, last in zip(starts, (*starts[1:], len(f_hz)), strict=True):
        for curve in curves:
            part = curve[first:last]
            kept += [first + int(np.argmin(part)), first + int(np.argmax(part))]
    return np.unique(kept)


def _document(
    controller: Controller, spec: LoopSpec, nominal: Loop, options: ControllerOptions
) -> dict[str, object]:
    """Return the document to load, including the inputs of the design."""
    return controller.to_dict() | {
        "stillpath_version": __version__,
        "every": round(nominal.dt_s / controller.dt_s),
        "unit": spec.unit,
        "loop": spec.model_dump(mode="json", exclude_none=True),
        "options": _written(options),
    }


def _written(options: ControllerOptions) -> dict[str, object]:
    """Return options as a document; null only where leaving out would mean something else."""
    written = options.model_dump(mode="json", exclude_none=True, exclude={"loop"})
    return written | {
        name: None
        for name, field in type(options).model_fields.items()
        if getattr(options, name) is None and field.default is not None
    }
