"""Figures of a whole print, added up piece by piece: before, after, and the best shaper.

Every channel is the nominal plant's answer to the motion that the firmware executes, measured
against the same planned path; plants that follow a schedule are those of the moment. Memory stays
bounded: errors go into tallies, into bins of time that double when they run out, and into a limited
number of layers with a limited number of points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compensation.shapers import shape, shaper_pulses
from models.machine import Machine
from models.schedule import EMPTY, OperatingPoint
from service.pipeline.band import BandContent
from service.pipeline.result import Channel, ErrorFigures, GroupFigures, LayerView, Track
from service.pipeline.yardstick import BestShaper
from simulation.measures import ContourErrors, MotionMeter, Tally
from simulation.scheduled import MachineStream

__all__ = ["Measurement", "MotionSamples", "part_of"]

Array = NDArray[np.float64]

STRIDE = 6
"""Contour errors are measured at every sixth sample: they change over tens of samples."""
_LAYERS_SHOWN = 24
_POINTS_PER_LAYER = 2500
_TRACK_BINS = 400


@dataclass(frozen=True, slots=True)
class MotionSamples:
    """Planned motion on the sampling grid with what belongs to each sample.

    Attributes
    ----------
    path_mm, executed_mm : ndarray, shape (2, n)
        X and Y as planned, and as the firmware executes them.
    z_mm : ndarray, shape (n,)
    extruding : ndarray of bool, shape (n,)
    line : ndarray of int64, shape (n,)
    layer, feature : ndarray of int32, shape (n,)
    """

    path_mm: Array
    executed_mm: Array
    z_mm: Array
    extruding: NDArray[np.bool_]
    line: NDArray[np.int64]
    layer: NDArray[np.int32]
    feature: NDArray[np.int32]

    def __len__(self) -> int:
        return int(self.path_mm.shape[1])


class Measurement:
    """Measure the motion of a print.

    Parameters
    ----------
    machine : Machine
    dt_s : float
    shaper : BestShaper
        The yardstick.
    compensated : bool
        Whether there is a channel `after` beside `before` and `shaper`.
    """

    def __init__(
        self, machine: Machine, dt_s: float, shaper: BestShaper, *, compensated: bool
    ) -> None:
        self._dt_s = dt_s
        self._machine = machine
        self._point = EMPTY
        self._band = BandContent(machine, dt_s)
        self._names = ("before", "after", "shaper") if compensated else ("before", "shaper")
        self._meters = {name: MotionMeter(dt_s, stride=STRIDE) for name in self._names}
        self._streams: dict[str, MachineStream] = {}
        self._shaper = _ShaperStream(shaper, dt_s)
        self._shaper_label = f"best shaper ({shaper.label})"
        self._track = {name: _Bins() for name in self._names}
        self._views = _Views(self._names)
        self._fresh = True
        self._last: MotionSamples | None = None

    def operate_at(self, point: OperatingPoint) -> None:
        """Say where the machine is from now on."""
        self._point = point
        for stream in self._streams.values():
            stream.operate_at(point)

    def add(self, samples: MotionSamples) -> None:
        """Add motion."""
        if len(samples):
            self._last = part_of(samples, len(samples) - 1, len(samples))
            self._band.add(samples.path_mm, samples.extruding)
            self._measure(self._shaper.push(samples))

    def stand(self, samples: int) -> Array | None:
        """Stand still; return the position for every sample, (2, n), if it is known."""
        if self._last is None or samples == 0:
            return None
        last = self._last
        rows = np.zeros(samples, dtype=np.int64)
        position = last.path_mm[:, rows]
        self.add(
            MotionSamples(
                path_mm=position,
                executed_mm=position,
                z_mm=last.z_mm[rows],
                extruding=np.zeros(samples, dtype=bool),
                line=last.line[rows],
                layer=last.layer[rows],
                feature=last.feature[rows],
            )
        )
        return position

    def jump(self) -> None:
        """Say that the position is lost: the machine stands still when motion goes on."""
        self._measure(self._shaper.flush())
        self._band.jump()
        self._fresh = True
        self._last = None

    def finish(self) -> None:
        """Say that the motion has ended."""
        self._measure(self._shaper.flush())
        self._note(None, {name: meter.flush() for name, meter in self._meters.items()})

    def _measure(self, shaped: tuple[Array, MotionSamples] | None) -> None:
        if shaped is None:
            return
        command, samples = shaped
        if self._fresh:
            self._streams = {
                name: MachineStream(self._machine, self._dt_s, self._point) for name in self._names
            }
            self._fresh = False
        commands = {"before": samples.path_mm, "after": samples.executed_mm, "shaper": command}
        errors = {}
        for name in self._names:
            y = self._streams[name].push(commands[name], samples.path_mm)
            errors[name] = self._meters[name].push(
                samples.path_mm, y, samples.extruding, samples.layer, samples.feature
            )
        self._note(samples, errors)

    def _note(self, samples: MotionSamples | None, errors: dict[str, ContourErrors]) -> None:
        for name, found in errors.items():
            self._track[name].add(found, self._dt_s)
        self._views.add(samples, errors)

    def channels(self) -> list[Channel]:
        """Return the figures of every channel."""
        labels = {"before": "as sliced", "after": "compensated", "shaper": self._shaper_label}
        return [
            Channel(
                name=name,
                label=labels[name],
                extruding=_figures(meter.contour_extruding, meter.tracking_extruding),
                all_motion=_figures(meter.contour_all, meter.tracking_all),
                residual_rms_um=1e3 * meter.residual.tally.rms,
            )
            for name, meter in self._meters.items()
        ]

    def warnings(self) -> list[str]:
        """Return what the figures do not stand for, in words."""
        return self._band.warnings()

    def layers(self) -> list[GroupFigures]:
        """Return the figures by layer."""
        return self._groups({n: m.layers.tallies() for n, m in self._meters.items()}, None)

    def features(self, names: Sequence[str]) -> list[GroupFigures]:
        """Return the figures by feature."""
        return self._groups({n: m.features.tallies() for n, m in self._meters.items()}, names)

    def _groups(
        self, tallies: dict[str, dict[int, Tally]], names: Sequence[str] | None
    ) -> list[GroupFigures]:
        out = []
        for key, tally in tallies["before"].items():
            label = f"{key}" if names is None else (names[key] if key >= 0 else "unnamed")
            if names is None and key < 0:
                label = "before the first layer"
            out.append(
                GroupFigures(
                    name=label,
                    seconds=round(STRIDE * tally.count * self._dt_s, 3),
                    contour_rms_um={n: 1e3 * t[key].rms for n, t in tallies.items() if key in t},
                    contour_max_um={n: 1e3 * t[key].max for n, t in tallies.items() if key in t},
                )
            )
        return out

    def track(self) -> Track:
        """Return the error along the print."""
        width = max(bins.width_s for bins in self._track.values())
        return Track(
            bin_s=width,
            contour_rms_um={n: bins.rms_um(width) for n, bins in self._track.items()},
        )

    def layer_views(self) -> list[LayerView]:
        """Return the layers to draw."""
        return self._views.views()


class _ShaperStream:
    """The best shaper's command for a motion that arrives in blocks, with the delay taken out."""

    def __init__(self, shaper: BestShaper, dt_s: float) -> None:
        self._dt_s = dt_s
        self._pulses = [
            shaper_pulses(shaper.type, f, shaper.zeta) for f in (shaper.fx_hz, shaper.fy_hz)
        ]
        self._reach = 2 + max(int(np.ceil(times[-1] / dt_s)) for _, times in self._pulses)
        self._held: MotionSamples | None = None
        self._before: Array | None = None

    def push(self, samples: MotionSamples) -> tuple[Array, MotionSamples] | None:
        """Return shaped commands and the samples they belong to, all but the last few."""
        held = samples if self._held is None else _join(self._held, samples)
        ready = len(held) - self._reach
        if ready <= 0:
            self._held = held
            return None
        out = self._shape(held, ready)
        self._before = held.path_mm[:, max(0, ready - self._reach) : ready].copy()
        self._held = part_of(held, ready, len(held))
        return out

    def flush(self) -> tuple[Array, MotionSamples] | None:
        """Return what is held, as if the machine stood still from now on."""
        if self._held is None:
            return None
        out = self._shape(self._held, len(self._held))
        self._held = self._before = None
        return out

    def _shape(self, held: MotionSamples, ready: int) -> tuple[Array, MotionSamples]:
        before = held.path_mm[:, :1] if self._before is None else self._before
        path = np.hstack([before, held.path_mm])
        first = before.shape[1]
        shaped = np.stack(
            [shape(row, self._dt_s, p) for row, p in zip(path, self._pulses, strict=True)]
        )
        return shaped[:, first : first + ready], part_of(held, 0, ready)


class _Bins:
    """Mean square over bins of time; two bins become one when there are too many."""

    def __init__(self) -> None:
        self.width_s = 1.0
        self._sum = np.zeros(_TRACK_BINS)
        self._count = np.zeros(_TRACK_BINS)
        self._used = 0

    def add(self, errors: ContourErrors, dt_s: float) -> None:
        if len(errors) == 0:
            return
        last = float(errors.index[-1]) * dt_s
        while last >= self.width_s * _TRACK_BINS:
            half = _TRACK_BINS // 2
            self._sum = np.append(self._sum.reshape(half, 2).sum(axis=1), np.zeros(half))
            self._count = np.append(self._count.reshape(half, 2).sum(axis=1), np.zeros(half))
            self.width_s *= 2.0
        at = (errors.index * (dt_s / self.width_s)).astype(np.int64)
        self._sum += np.bincount(at, errors.error_mm**2, _TRACK_BINS)
        self._count += np.bincount(at, minlength=_TRACK_BINS)
        self._used = int(last / self.width_s) + 1

    def rms_um(self, width_s: float) -> list[float]:
        step = max(1, round(width_s / self.width_s))
        used = -(-self._used // step) * step
        total = np.pad(self._sum, (0, step))[:used].reshape(-1, step).sum(axis=1)
        count = np.pad(self._count, (0, step))[:used].reshape(-1, step).sum(axis=1)
        return [round(float(v), 3) for v in 1e3 * np.sqrt(total / np.maximum(count, 1.0))]


class _Views:
    """Paths of some layers with their errors, thinned out as the print grows."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names = list(names)
        self._waiting: MotionSamples | None = None
        self._from = 0
        self._every = 1
        self._layers: dict[int, _View] = {}

    def add(self, samples: MotionSamples | None, errors: dict[str, ContourErrors]) -> None:
        if samples is not None:
            self._waiting = samples if self._waiting is None else _join(self._waiting, samples)
        first = next(iter(errors.values()))
        if self._waiting is None or len(first) == 0:
            return
        at = first.index - self._from
        held = self._waiting
        layer = held.layer[at]
        for number in np.unique(layer[layer >= 0]):
            if number % self._every:
                continue
            view = self._layers.setdefault(int(number), _View(self._names))
            chosen = layer == number
            view.add(held, at[chosen], {n: e.error_mm[chosen] for n, e in errors.items()})
        while len(self._layers) > 2 * _LAYERS_SHOWN:
            self._every *= 2
            self._layers = {k: v for k, v in self._layers.items() if k % self._every == 0}
        done = int(at[-1]) + 1
        self._from += done
        self._waiting = part_of(held, done, len(held))

    def views(self) -> list[LayerView]:
        numbers = sorted(k for k, v in self._layers.items() if v.count > 1)
        if len(numbers) > _LAYERS_SHOWN:
            pick = np.linspace(0, len(numbers) - 1, _LAYERS_SHOWN).round().astype(int)
            numbers = [numbers[i] for i in pick]
        return [self._layers[k].view(k) for k in numbers]


class _View:
    def __init__(self, names: Sequence[str]) -> None:
        self._step = 2
        self._rows: list[Array] = []
        self._names = list(names)
        self.count = 0

    def add(self, held: MotionSamples, at: NDArray[np.int64], errors: dict[str, Array]) -> None:
        keep = np.arange(0, len(at), self._step)
        rows = np.stack(
            [
                held.path_mm[0, at],
                held.path_mm[1, at],
                held.z_mm[at],
                held.extruding[at].astype(float),
                held.line[at].astype(float),
                *(1e3 * errors[n] for n in self._names),
            ]
        )[:, keep]
        self._rows.append(rows)
        self.count += rows.shape[1]
        while self.count > 2 * _POINTS_PER_LAYER:
            self._rows = [np.hstack(self._rows)[:, ::2]]
            self._step *= 2
            self.count = self._rows[0].shape[1]

    def view(self, layer: int) -> LayerView:
        rows = np.hstack(self._rows)
        extruding = rows[3] > 0.5
        z = rows[2][extruding] if np.any(extruding) else rows[2]
        return LayerView(
            layer=layer,
            z_mm=round(float(np.median(z)), 4),
            x_mm=np.round(rows[0], 3).tolist(),
            y_mm=np.round(rows[1], 3).tolist(),
            extruding=extruding.tolist(),
            line=rows[4].astype(int).tolist(),
            contour_um={n: np.round(rows[5 + i], 2).tolist() for i, n in enumerate(self._names)},
        )


def _figures(contour: Tally, tracking: Tally) -> ErrorFigures:
    return ErrorFigures(
        contour_rms_um=1e3 * contour.rms,
        contour_max_um=1e3 * contour.max,
        tracking_rms_um=1e3 * tracking.rms,
        tracking_max_um=1e3 * tracking.max,
    )


def _join(first: MotionSamples, second: MotionSamples) -> MotionSamples:
    return MotionSamples(
        np.hstack([first.path_mm, second.path_mm]),
        np.hstack([first.executed_mm, second.executed_mm]),
        np.concatenate([first.z_mm, second.z_mm]),
        np.concatenate([first.extruding, second.extruding]),
        np.concatenate([first.line, second.line]),
        np.concatenate([first.layer, second.layer]),
        np.concatenate([first.feature, second.feature]),
    )


def part_of(samples: MotionSamples, start: int, stop: int) -> MotionSamples:
    """Return the samples start..stop - 1."""
    return MotionSamples(
        samples.path_mm[:, start:stop],
        samples.executed_mm[:, start:stop],
        samples.z_mm[start:stop],
        samples.extruding[start:stop],
        samples.line[start:stop],
        samples.layer[start:stop],
        samples.feature[start:stop],
    )
