"""Response of a machine over time under its disturbance, without and with an add-on controller."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stillpath.applications.controllers.figures import (
    Envelope,
    MemberFigures,
    PredictorFigures,
    ResponseFigures,
    TimeFigures,
)
from stillpath.applications.controllers.options import (
    AdaptiveOptions,
    ControllerOptions,
    DobOptions,
    MmpOptions,
    MultirateOptions,
    QuasiOptions,
    WideOptions,
)
from stillpath.compensation.base import DesignError
from stillpath.compensation.feedback.adaptive import AdaptiveFmsdob
from stillpath.compensation.feedback.controller import Controller
from stillpath.compensation.feedback.fmsdob import fmsdob
from stillpath.models.arrays import Array
from stillpath.models.diagrams import Block
from stillpath.models.disturbances import (
    DisturbanceSpec,
    Narrowband,
    Periodic,
    SensorSpec,
    Switched,
    Tone,
    Wideband,
    sample,
)
from stillpath.models.loops import Loop, LoopSpec
from stillpath.simulation.closed_loop import ClosedLoop, simulate

__all__ = [
    "RetunedRun",
    "adapted",
    "answer",
    "disturbance_of",
    "disturbance_text",
    "settling_ticks",
    "time_figures",
]

_LEAST_SAMPLES, _MOST_SAMPLES = 2000, 200_000
_MOST_TICKS = 3e7
"""Limit for all plants together: about ten seconds."""
_POINTS = 400
_PERIODS_SHOWN = 12
_PART_SAMPLES = 3000
_SLOWEST_HZ = 1e-3
_LATEST_S = 60.0
"""Latest beginning of a disturbance's last part."""
_HEARD_S = 1e-3
_HARMONICS = 5
_SEED = 0
_LARGEST_SIZE = 1e9


@dataclass(frozen=True, slots=True, eq=False)
class RetunedRun:
    """A run during which the add-on was retuned.

    Attributes
    ----------
    d, after : ndarray, shape (n,)
        The disturbance, and the output with the add-on, at the loop's rate.
    """

    d: Array
    after: Array


def disturbance_of(options: ControllerOptions, loop: Loop) -> tuple[DisturbanceSpec, str]:
    """Return the disturbance of the time response, and where it enters.

    By default it is what the method is made for: its tones, five harmonics of its fundamental, or a
    slow load that changes sign.
    """
    made: DisturbanceSpec
    if isinstance(options, WideOptions | QuasiOptions | MultirateOptions):
        count = min(_HARMONICS, max(1, math.ceil(0.5 / (loop.dt_s * options.fundamental_hz)) - 1))
        made, enters = Periodic(f_hz=options.fundamental_hz, amplitudes=(1.0,) * count), "input"
    elif isinstance(options, DobOptions):
        made = Periodic(f_hz=options.cutoff_hz / 20, amplitudes=(1, 0, 1 / 3, 0, 1 / 5))
        enters = "input"
    elif isinstance(options, AdaptiveOptions):
        made, enters = _jumping(options.tones, loop.dt_s), "output"
    else:
        tones = tuple(Tone(f_hz=f, phase_rad=i) for i, f in enumerate(options.targets_hz))
        made, enters = Narrowband(tones=tones), "output"
    return options.disturbance or made, options.enters or enters


def answer(
    loop: Loop,
    blocks: Sequence[Block],
    d: Array,
    enters: str,
    *,
    every: int = 1,
    sensor: SensorSpec | None = None,
    watch: Sequence[str] = ("y",),
) -> dict[str, Array]:
    """Return signals of a loop under a disturbance, one value per sample of the loop.

    Parameters
    ----------
    d : ndarray, shape (n,)
    enters : "output" or "input"
    every : int
        Ticks of the blocks per sample of the loop.
    """
    source = "d_out" if enters == "output" else "d_in"
    found = simulate(loop, blocks, {source: np.repeat(d, every)}, watch, every=every, sensor=sensor)
    return {name: signal[::every] for name, signal in found.items()}


def adapted(
    loops: Sequence[Loop], options: AdaptiveOptions, disturbance: DisturbanceSpec, enters: str
) -> tuple[Controller, RetunedRun]:
    """Run an adaptive observer through the disturbance; return its last controller and the run.

    Raises
    ------
    DesignError
        If it rejects no tone at the end, or that controller is refused.
    """
    _check(disturbance)
    nominal = loops[0]
    samples = _samples(options.duration_s, nominal.dt_s, _spoken(disturbance, nominal.dt_s))
    d = sample(disturbance, samples, nominal.dt_s, np.random.default_rng(_SEED))
    observer = AdaptiveFmsdob(
        loops, options.tones, bandwidth_hz=options.bandwidth_hz, floor_rms=options.floor_rms
    )
    running = ClosedLoop(nominal, observer.blocks)
    source = "d_out" if enters == "output" else "d_in"
    step = max(1, round(_HEARD_S / nominal.dt_s))
    y = np.empty(samples)
    for i in range(0, samples, step):
        out = running.push({source: d[i : i + step]}, ("y", "dhat"))
        y[i : i + step] = out["y"]
        change = observer.hear(out["dhat"])
        if change is not None:
            running.retune(change.blocks, reset=change.reset)
    controller = observer.controller()
    if options.uncertainty is not None:
        controller = fmsdob(
            loops,
            observer.targets_hz,
            bandwidth_hz=options.bandwidth_hz,
            uncertainty=options.uncertainty,
        )
    return controller, RetunedRun(d, y)


def time_figures(
    spec: LoopSpec,
    loops: Sequence[Loop],
    controller: Controller,
    options: ControllerOptions,
    disturbance: DisturbanceSpec,
    enters: str,
    retuned: RetunedRun | None,
) -> TimeFigures:
    """Simulate the nominal loop and its members, without and with the controller.

    Raises
    ------
    ModelError
        If a frequency of the disturbance is not below half the sampling rate.
    DesignError
        If the requested time has too many samples.
    """
    nominal = loops[0]
    every = round(nominal.dt_s / controller.dt_s)
    if retuned is None:
        _check(disturbance)
        settled = settling_ticks(max(controller.spectral_radii)) / every
        periods = _PERIODS_SHOWN / (min(_frequencies(disturbance), default=math.inf) * nominal.dt_s)
        needed = int(max(1.5 * settled, 2 * periods))
        ticks = len(loops) * (1 + every)
        samples = _samples(options.duration_s, nominal.dt_s, needed, ticks)
        d = sample(disturbance, samples, nominal.dt_s, np.random.default_rng(_SEED))
    else:
        d = retuned.d
    before = [answer(loop, (), d, enters, sensor=spec.sensor)["y"] for loop in loops]
    watch = ("y", "dhat", "dslow") if isinstance(options, MmpOptions) else ("y",)
    runs = [
        answer(loop, controller.blocks, d, enters, every=every, sensor=spec.sensor, watch=watch)
        for loop in loops
    ]
    shown = runs[0]["y"] if retuned is None else retuned.after
    end = _last_periods(disturbance, nominal.dt_s, len(d))
    return TimeFigures(
        disturbance=disturbance_text(disturbance),
        enters=enters,
        duration_s=len(d) * nominal.dt_s,
        before=_response(before[0], nominal.dt_s, end),
        after=_response(shown, nominal.dt_s, end),
        members=tuple(
            MemberFigures(
                name=loop.name.removeprefix(spec.name).strip(" ()") or "nominal",
                before_rms=_rms(before[i]),
                after_rms=_rms(shown if i == 0 else runs[i]["y"]),
                spectral_radius=controller.spectral_radii[i],
            )
            for i, loop in enumerate(loops)
        ),
        predictor=_predictor(runs[0], d, nominal.dt_s, end) if "dhat" in runs[0] else None,
    )


def settling_ticks(radius: float) -> float:
    """Return the ticks in which the slowest transient decays to 1e-3."""
    return math.log(1e-3) / math.log(max(radius, 1e-6))


def disturbance_text(disturbance: DisturbanceSpec) -> str:
    """Return the disturbance in words."""
    if isinstance(disturbance, Wideband):
        return f"random, {len(disturbance.peaks)} humps in its spectrum"
    if isinstance(disturbance, Periodic):
        return f"{len(disturbance.amplitudes)} harmonics of {disturbance.f_hz:g} Hz"
    if isinstance(disturbance, Switched):
        jumps = ("+".join(f"{tone.f_hz:g}" for tone in part) for part in disturbance.parts)
        return f"tones that jump: {', '.join(j or 'silence' for j in jumps)} Hz"
    return f"tones of {', '.join(f'{tone.f_hz:g}' for tone in disturbance.tones)} Hz"


def _check(disturbance: DisturbanceSpec) -> None:
    if isinstance(disturbance, Switched):
        count, starts = len(disturbance.parts), disturbance.start_s
        if not count or len(starts) != count:
            raise DesignError(
                f"a switched disturbance of {count} parts with {len(starts)} times (start_s): give "
                "at least one part, and a time for each"
            )
        if starts[-1] > _LATEST_S:
            raise DesignError(
                f"the last part of the disturbance begins at {starts[-1]:g} s; the latest possible "
                f"is {_LATEST_S:g} s"
            )
    if isinstance(disturbance, Wideband):
        sizes = [disturbance.floor_rms, *(peak.rms for peak in disturbance.peaks)]
    elif isinstance(disturbance, Periodic):
        sizes = list(disturbance.amplitudes)
    else:
        parts = disturbance.parts if isinstance(disturbance, Switched) else (disturbance.tones,)
        sizes = [tone.amplitude for part in parts for tone in part]
    slowest_hz = min(_frequencies(disturbance), default=_SLOWEST_HZ)
    if slowest_hz < _SLOWEST_HZ:
        raise DesignError(
            f"the disturbance has {slowest_hz:g} Hz; the lowest possible is {_SLOWEST_HZ:g} Hz"
        )
    if sum(map(abs, sizes)) > _LARGEST_SIZE:
        raise DesignError(
            f"the disturbance is larger than {_LARGEST_SIZE:g}; give it in the machine's unit"
        )


def _jumping(tones: int, dt_s: float) -> Switched:
    """Silence, then tones that jump four times."""
    sets = ((0.05, 0.2, 0.32), (0.15, 0.26, 0.38), (0.05, 0.2, 0.32), (0.3, 0.21, 0.12))
    starts = [1000 * dt_s] + [(1000 + _PART_SAMPLES * (i + 1)) * dt_s for i in range(3)]
    return Switched(
        start_s=tuple(starts),
        parts=tuple(tuple(Tone(f_hz=f / dt_s) for f in part[:tones]) for part in sets),
    )


def _spoken(disturbance: DisturbanceSpec, dt_s: float) -> int:
    """Return the samples needed until the last of switched tones has settled."""
    last = disturbance.start_s[-1] if isinstance(disturbance, Switched) else 0.0
    return round(last / dt_s) + 2 * _PART_SAMPLES


def _samples(duration_s: float | None, dt_s: float, needed: int, ticks: int = 1) -> int:
    """Return the samples of a run, `ticks` of all plants for each."""
    most = min(_MOST_SAMPLES, int(_MOST_TICKS / ticks))
    if duration_s is None:
        return min(max(needed, _LEAST_SAMPLES), most)
    samples = round(duration_s / dt_s)
    if not 100 <= samples <= most:
        raise DesignError(
            f"a time response of {duration_s:g} s has {samples} samples; 100 to {most} are possible"
        )
    return samples


def _last_periods(disturbance: DisturbanceSpec, dt_s: float, samples: int) -> int:
    """Return how many of the last samples show some periods of the slowest tone."""
    lowest = min(_frequencies(disturbance), default=50 / (samples * dt_s))
    return int(min(max(_PERIODS_SHOWN / (lowest * dt_s), 60), samples // 4, _POINTS))


def _frequencies(disturbance: DisturbanceSpec) -> list[float]:
    if isinstance(disturbance, Periodic):
        return [disturbance.f_hz]
    if isinstance(disturbance, Wideband):
        return [peak.f_hz for peak in disturbance.peaks]
    parts = disturbance.parts if isinstance(disturbance, Switched) else (disturbance.tones,)
    return [tone.f_hz for tone in parts[-1]]


def _response(y: Array, dt_s: float, end: int) -> ResponseFigures:
    last = y[-(len(y) // 4) :]
    t: Array = np.arange(len(y), dtype=np.float64) * dt_s
    return ResponseFigures(
        rms=_rms(y),
        peak=float(np.abs(last).max()),
        whole=_envelope(t, y),
        end=Envelope(t_s=tuple(t[-end:].tolist()), values=tuple(y[-end:].tolist())),
    )


def _rms(y: Array) -> float:
    """Return the rms of the last quarter."""
    last = y[-(len(y) // 4) :]
    return float(np.sqrt(np.mean(last**2)))


def _envelope(t: Array, y: Array) -> Envelope:
    """Return the extremes of every stretch, in the order in which they come."""
    kept: list[int] = []
    for part in np.array_split(np.arange(len(y)), min(_POINTS // 2, len(y))):
        kept += sorted({int(part[np.argmin(y[part])]), int(part[np.argmax(y[part])])})
    return Envelope(t_s=tuple(t[kept].tolist()), values=tuple(y[kept].tolist()))


def _predictor(run: dict[str, Array], d: Array, dt_s: float, end: int) -> PredictorFigures:
    shown = slice(len(d) - min(end, 60), None)
    last = slice(-(len(d) // 4), None)
    t = np.arange(len(d)) * dt_s
    return PredictorFigures(
        t_s=tuple(t[shown].tolist()),
        true=tuple(d[shown].tolist()),
        held=tuple(run["dslow"][shown].tolist()),
        predicted=tuple(run["dhat"][shown].tolist()),
        error_rms=float(np.sqrt(np.mean((run["dhat"][last] - d[last]) ** 2))),
    )
