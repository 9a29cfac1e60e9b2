"""Measure a whole print piece by piece: as sliced, as compensated, and with the best shaper.

Every channel is the nominal plant's response to the motion that the firmware executes, compared
with the same planned path; scheduled plants are those of the current operating point. Memory is
bounded: errors go into sums, into time bins that double in width when they run out, and into tiles
of layers that are passed on.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillpath.gcode.slicers.features import feature_name, feature_title
from stillpath.models.arrays import Array
from stillpath.models.machine import Machine
from stillpath.models.schedule import OperatingPoint
from stillpath.pipeline.band import BandContent
from stillpath.pipeline.measuring.earlier import EarlierErrors
from stillpath.pipeline.measuring.excerpts import MotionExcerpts
from stillpath.pipeline.measuring.layer_views import LayerViews
from stillpath.pipeline.measuring.layers import LayerRecorder, LayerTile
from stillpath.pipeline.measuring.maxima import RINGING_S, Maxima
from stillpath.pipeline.measuring.points import MeasuredPoints, MotionSamples
from stillpath.pipeline.measuring.reference_shaper import BestShaper
from stillpath.pipeline.measuring.responses import Responses, ResponseSamples
from stillpath.pipeline.measuring.spectra import ErrorSpectra
from stillpath.pipeline.measuring.tracing import Trace, Tracer
from stillpath.pipeline.result import (
    AxisSpectrum,
    Channel,
    ErrorFigures,
    GroupFigures,
    LayerView,
    Track,
)
from stillpath.simulation.measures import ContourErrors, GroupTally, MotionMeter, Tally

__all__ = ["CHANNELS", "STRIDE", "UNCHANGED_CHANNELS", "Measurement"]

CHANNELS = ("before", "after", "shaper")
"""The measured channels, in the order of all tables."""
UNCHANGED_CHANNELS = ("before", "shaper")
"""The channels of a file that is not compensated."""
STRIDE = 6
"""Contour errors are measured at every sixth sample, since they change over tens of samples; maxima
of the written motion are also sought in between (`maxima`)."""
_SMALL_BYTES = 200_000
"""Smaller files are measured at every sample: they have too few for a fair average."""
_TRACK_BINS = 400


class Measurement:
    """Measure the motion of a print.

    Parameters
    ----------
    shaper : BestShaper
        The reference shaper.
    names : tuple of str
        Some of `CHANNELS`. Without `after`, `before` is the executed motion, which may include the
        firmware's own shaper.
    earlier : EarlierErrors, optional
        Without `after`, stores the errors of `before` and `shaper`; with it, supplies them for what
        is shown along the path.
    take_layer : callable, optional
        Receives every layer as soon as it is measured.
    trace : callable, optional
        Receives the motion. Errors are then measured at every sample.
    size : int, optional
        Size of the file [bytes].

    Attributes
    ----------
    excerpts : MotionExcerpts
        Some of the motion, for the range of its errors.
    """

    def __init__(
        self,
        machine: Machine,
        dt_s: float,
        shaper: BestShaper,
        names: tuple[str, ...] = CHANNELS,
        *,
        take_layer: Callable[[LayerTile], None] | None = None,
        trace: Callable[[Trace], None] | None = None,
        earlier: EarlierErrors | None = None,
        size: int | None = None,
    ) -> None:
        compensated = "after" in names
        self._beside = earlier.at if earlier and compensated else None
        self._noted = earlier.note if earlier and not compensated else None
        all_of_it = trace is not None or (size is not None and size < _SMALL_BYTES)
        self._stride = 1 if all_of_it else STRIDE
        self._tracer = None if trace is None else Tracer(trace)
        self._dt_s = dt_s
        self._band = BandContent(machine, dt_s)
        self._names = names
        self._shown = shown = CHANNELS if self._beside else names
        self._meter = MotionMeter(dt_s, stride=self._stride, channels=len(names))
        self._layers, self._features = (GroupTally(len(names)) for _ in range(2))
        exact = names.index("after") if self._stride > 1 and compensated else None
        self._maxima = Maxima(dt_s, len(names), exact)
        self._responses = Responses(machine, dt_s, shaper, names)
        self._shaper_label = f"best shaper ({shaper.label})"
        self._track = _Bins(len(shown))
        self._spectra = ErrorSpectra(machine, dt_s, names)
        self._views = LayerViews(shown)
        takers = [self._views.add] + ([take_layer] if take_layer else [])
        self._tiles = LayerRecorder(len(shown), self._stride * dt_s, takers)
        self._count = 0
        self._waiting: list[MeasuredPoints] = []
        self._jumped = True
        self._last: MotionSamples | None = None
        self.excerpts = MotionExcerpts(dt_s)

    def operate_at(self, point: OperatingPoint) -> None:
        """Set the operating point of the motion that follows."""
        self._responses.operate_at(point)

    def add(self, samples: MotionSamples) -> None:
        """Add motion."""
        if len(samples):
            self._last = samples
            self.excerpts.add(samples)
            which = slice(-self._count % self._stride, None, self._stride)
            points = MeasuredPoints.of(samples, which, jumped=self._jumped)
            if len(points):
                self._waiting.append(points)
                self._jumped = False
            self._count += len(samples)
            self._band.add(samples.path_mm, samples.extruding)
            self._maxima.add(samples)
            self._measure(self._responses.push(samples))

    def stand(self, samples: int) -> Array | None:
        """Stand still; return the position for every sample, (2, n), if known."""
        if self._last is None or samples == 0:
            return None
        stood = self._last.standing(samples)
        self.add(stood)
        return stood.path_mm

    def jump(self) -> None:
        """Forget the position: the machine stands still when motion resumes."""
        self._measure(self._responses.flush())
        self._note(self._meter.flush())
        self._band.jump()
        self._maxima.jump()
        self._spectra.jump()
        self._jumped = True
        self._last = None

    def finish(self) -> None:
        """Finish: let the machine ring out at the end of the motion."""
        self.stand(round(RINGING_S / self._dt_s))
        self._measure(self._responses.flush())
        self._note(self._meter.flush())
        self._maxima.finish()
        self._tiles.finish()

    def _measure(self, found: ResponseSamples | None) -> None:
        if found is None:
            return
        path_mm, response_mm, extruding = found.path_mm, found.response_mm, found.extruding
        self._spectra.add(path_mm, response_mm, extruding)
        self._maxima.add_responses(path_mm, response_mm)
        if self._tracer is not None:
            self._tracer.wait(found.executed_mm, response_mm)
        self._note(self._meter.push(path_mm, response_mm, extruding))

    def _note(self, errors: ContourErrors) -> None:
        done = 0
        while done < len(errors):
            points = self._waiting[0]
            count = min(len(points), len(errors) - done)
            found = np.ascontiguousarray(errors.error_mm[:, done : done + count])
            done += count
            if count < len(points):
                self._waiting[0] = points.part(slice(count, None))
                points = points.part(slice(count))
            else:
                del self._waiting[0]
            moves, row = points.moves, points.row
            if self._tracer is not None:
                self._tracer.tell(points, found)
            self._layers.add(found, moves.layer[row], points.extruding)
            self._features.add(found, moves.feature[row], points.extruding)
            if self._noted is not None:
                self._noted(points, found)
            shown = found
            if self._beside is not None:
                before, shaper = self._beside(points)
                shown = np.stack([before, found[0], shaper])
                index = errors.index[done - count : done]
                self._track.add(index, shown, self._dt_s)
            self._tiles.add(
                points.path_mm,
                points.z_mm,
                points.extruding,
                row,
                moves,
                points.first_move,
                shown,
                jumped=points.jumped,
            )
        if self._beside is None:
            self._track.add(errors.index, errors.error_mm, self._dt_s)

    def channels(self, after: str = "compensated") -> list[Channel]:
        """Return the figures of every channel; `after` is the label of the executed motion."""
        labels = {"before": "as sliced", "after": after, "shaper": self._shaper_label}
        meter, most_mm = self._meter, self._maxima.max_mm
        return [
            Channel(
                name=name,
                label=labels[name],
                extruding=_figures(
                    meter.contour_extruding[c], meter.tracking_extruding[c], most_mm[c]
                ),
                all_motion=_figures(meter.contour_all[c], meter.tracking_all[c], most_mm[c]),
                residual_rms_um=1e3 * meter.residual[c].rms,
            )
            for c, name in enumerate(self._names)
        ]

    def warnings(self) -> list[str]:
        """Return warnings about what the figures do not cover."""
        return self._band.warnings()

    def layers(self) -> list[GroupFigures]:
        """Return the figures by layer."""
        return self._groups(self._layers, self._maxima.layers, _layer_label)

    def features(self, names: Sequence[str]) -> list[GroupFigures]:
        """Return the figures by feature."""

        def label(number: int) -> tuple[str, str]:
            name = feature_name(number, names)
            return name, feature_title(name)

        return self._groups(self._features, self._maxima.features, label)

    def _groups(
        self,
        groups: GroupTally,
        ends_mm: dict[int, Array],
        label: Callable[[int], tuple[str, str]],
    ) -> list[GroupFigures]:
        """Return the figures of groups; `label` maps a number to name and title."""
        tallies = {name: groups.tallies(c) for c, name in enumerate(self._names)}
        out = []
        for key, tally in tallies[self._names[0]].items():
            name, title = label(key)
            behind_mm = ends_mm.get(key, np.zeros(len(tallies)))
            out.append(
                GroupFigures(
                    name=name,
                    title=title,
                    seconds=round(self._stride * tally.count * self._dt_s, 3),
                    contour_rms_um={n: 1e3 * t[key].rms for n, t in tallies.items() if key in t},
                    contour_max_um={
                        n: 1e3 * max(t[key].max, float(most))
                        for (n, t), most in zip(tallies.items(), behind_mm, strict=True)
                        if key in t
                    },
                )
            )
        return out

    def track(self) -> Track:
        """Return the error along the print."""
        rows = self._track.rms_um()
        return Track(
            bin_s=self._track.width_s, contour_rms_um=dict(zip(self._shown, rows, strict=True))
        )

    def layer_views(self) -> list[LayerView]:
        """Return the layers to draw."""
        return self._views.views()

    def spectra(self) -> list[AxisSpectrum]:
        """Return the spectra of the error along X and Y."""
        return self._spectra.spectra()

    def details(self, names: Sequence[str]) -> dict[str, Any]:
        """Return the other fields of `Result`; `names` are those of features."""
        return {
            "layers": self.layers(),
            "features": self.features(names),
            "track": self.track(),
            "spectra": self.spectra(),
            "layer_views": self.layer_views(),
        }


def _layer_label(number: int) -> tuple[str, str]:
    label = f"{number}" if number >= 0 else "before the first layer"
    return label, label


class _Bins:
    """Mean squares in bins of time; pairs of bins are merged when there are too many."""

    def __init__(self, channels: int) -> None:
        self.width_s = 1.0
        self._sum = np.zeros((channels, _TRACK_BINS))
        self._count = np.zeros(_TRACK_BINS)
        self._used = 0

    def add(self, index: NDArray[np.int64], error_mm: Array, dt_s: float) -> None:
        if len(index) == 0:
            return
        last = float(index[-1]) * dt_s
        while last >= self.width_s * _TRACK_BINS:
            half = _TRACK_BINS // 2
            pairs = self._sum.reshape(-1, half, 2).sum(axis=2)
            self._sum = np.pad(pairs, ((0, 0), (0, half)))
            self._count = np.pad(self._count.reshape(half, 2).sum(axis=1), (0, half))
            self.width_s *= 2.0
        place = index * (dt_s / self.width_s)
        first, end = int(place[0]), int(place[-1]) + 1
        # No bin is empty: bins are much wider than the spacing of errors.
        begins = np.searchsorted(place, np.arange(first, end + 1))
        self._sum[:, first:end] += np.add.reduceat(error_mm**2, begins[:-1], axis=1)
        self._count[first:end] += np.diff(begins)
        self._used = end

    def rms_um(self) -> list[list[float]]:
        """Return the bins of every channel."""
        mean = self._sum / np.maximum(self._count, 1.0)
        return [[round(float(v), 3) for v in 1e3 * np.sqrt(row[: self._used])] for row in mean]


def _figures(contour: Tally, tracking: Tally, ends_mm: float) -> ErrorFigures:
    return ErrorFigures(
        contour_rms_um=1e3 * contour.rms,
        contour_max_um=1e3 * max(contour.max, ends_mm),
        tracking_rms_um=1e3 * tracking.rms,
        tracking_max_um=1e3 * tracking.max,
    )
