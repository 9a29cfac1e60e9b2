"""Judge the plants of a machine by logs of a ring test: confirmed, not confirmed, or undecided.

A log counts only if it contains the motion of the file, and enough of it above its own noise.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path

import numpy as np

from stillpath.applications.proof.drive import ringing_mode
from stillpath.applications.proof.judging import AxisMotion, judge
from stillpath.applications.proof.matching import read_log
from stillpath.applications.proof.ring_figures import AxisRing, Half, RingReport, Verdict
from stillpath.applications.proof.ring_log import (
    AxisLog,
    FrequencyBand,
    Power,
    floor,
    joined,
    lag_s,
    misplaced,
    misses,
    place,
    read_axis,
    residual,
    unusable,
)
from stillpath.applications.proof.ring_motion import (
    RATE_HZ,
    RingMotion,
    accelerations,
    read_ring_motion,
)
from stillpath.applications.proof.ring_test import AXES, Axis
from stillpath.models.arrays import Array
from stillpath.models.confirmation import Confirmation, plants_digest, rounded_um
from stillpath.models.errors import ModelError
from stillpath.models.identification.types import AccelerationLog
from stillpath.models.machine import Machine
from stillpath.models.plants import PlantSetSpec, discretise
from stillpath.models.provenance import SourceFile
from stillpath.version import __version__

__all__ = ["verify_ring"]

_RINGS = 0.3
"""Damping ratio above which nothing rings after a stop."""
_HIGHEST_HZ = 200.0
_FEWEST_STOPS, _SEEN_SHARE = 4, 0.7
_ABOVE_FLOOR = 3.0
_SIGMAS = 2.0
_LEAST_GAIN = 2.0
"""Factor by which compensation must lower the vibration."""
_MOST_MISSES = 0.35
_HELD = 0.5
"""Ringing over the least that is predicted, of an axis whose guides stop it."""
_NEAR, _SURE = 0.01, 3.0
"""A mode counts as moved if beyond both this share and this many standard deviations."""
_MOST_APART_S = 5e-4
"""Largest difference of the delays of X and Y: at 100 mm/s it distorts corners by 50 um."""
_OTHERWISE = (
    "where they are, the sensor felt another braking than the plants': guides rub, or something is "
    "loose. See to it that the axis moves freely, and measure the machine again"
)
_ANEW = "measure the machine again (`stillpath identify`) and write a new ring test"
_PHASE = (
    "The mode that rings most is where the plants have it, so its phase, its damping or other "
    "modes are wrong: raw data (OUTPUT=raw_data) hold the phase, tables do not."
)


def verify_ring(
    printed: Path, logs: Sequence[Path], machine: Machine, *, today: date | None = None
) -> RingReport:
    """Compare the vibration after the stops of a ring test with the machine's plants.

    Parameters
    ----------
    printed : Path
        The ring test as it was written.
    logs : sequence of Path
        Klipper's or RepRapFirmware's raw accelerations; each may hold one axis or both.
    today : date, optional
        Of the confirmation.

    Raises
    ------
    GcodeError, ModelError
        The file or a log cannot be read.
    """
    motion = read_ring_motion(printed, machine)
    nominal = np.stack([motion.predicted(axis, machine.axes[axis].nominal) for axis in AXES])
    notes: list[str] = []
    if machine.schedules:
        notes.append("The model follows mass or position; predicted is what the nominal plants do.")
    axes = {axis: _Axis(machine, motion, axis, today or date.today()) for axis in AXES}
    for source, recorded in _recordings(logs, notes):
        try:
            signal, found = place(recorded, nominal)
        except ModelError as error:
            _give_reason(axes.values(), str(error))
            continue
        if reason := misplaced(source.name, found):
            _give_reason(axes.values(), reason)
            continue
        for name, axis in axes.items():
            own = nominal[AXES.index(name)]
            axis.add(source, read_axis(recorded, signal, found, motion, own, name))
    judged = [axis.judged() for axis in axes.values()]
    return RingReport(
        version=__version__,
        machine=machine.name,
        machine_title=machine.title,
        machine_revision=machine.revision,
        printed=printed.name,
        logs=[path.name for path in logs],
        axes=_delays_compared(judged),
        notes=list(dict.fromkeys(notes)),
    )


def _recordings(
    logs: Sequence[Path], notes: list[str]
) -> Iterator[tuple[SourceFile, AccelerationLog]]:
    """Yield all logs once; the stops of a copy would be repeats that scatter by nothing."""
    known: dict[str, str] = {}
    for path in logs:
        recorded = read_log(path, "give what was logged while the ring test ran")
        source = SourceFile(name=path.name, sha256=hashlib.sha256(path.read_bytes()).hexdigest())
        if source.sha256 in known:
            notes.append(f"{path.name} is a copy of {known[source.sha256]}: it counts once.")
            continue
        known[source.sha256] = path.name
        notes += recorded.notes
        yield source, recorded


def _give_reason(axes: Iterable[_Axis], reason: str) -> None:
    for axis in axes:
        axis.add_reason(reason)


@dataclass(frozen=True, slots=True)
class _Level:
    """A mean square over stops and its standard error, noise floor taken off."""

    power: float
    error: float

    @property
    def rms(self) -> float:
        return float(np.sqrt(max(self.power, 0.0)))

    @property
    def scatter(self) -> float:
        """Standard error of the rms; for an rms of 0, what could be hidden in the noise."""
        return float(np.sqrt(max(self.power, 0.0) + self.error)) - self.rms

    def reaches(self, sigmas: float) -> float:
        return float(np.sqrt(max(self.power + sigmas * self.error, 0.0)))


class _Axis:
    """The combined evidence of all logs about one axis."""

    def __init__(self, machine: Machine, motion: RingMotion, axis: Axis, today: date) -> None:
        self._machine, self._motion, self._axis, self._today = machine, motion, axis, today
        self._plants = machine.axes[axis]
        self._band = _band(self._plants)
        self._command = motion.command.rows[AXES.index(axis)]
        self._members = [
            motion.predicted(axis, member.plant) for member in self._plants.weighted_members()
        ]
        self._reasons: list[str] = []
        self._sources: list[SourceFile] = []
        self._logs: list[AxisLog] = []

    def add_reason(self, reason: str) -> None:
        """Add a reason why a log cannot judge the axis."""
        self._reasons.append(reason)

    def add(self, source: SourceFile, log: AxisLog | None) -> None:
        """Add a log, or record why it does not count."""
        reason = self._unusable(source.name, log)
        if reason:
            self._reasons.append(reason)
        elif log is not None:
            self._sources.append(source)
            self._logs.append(log)

    def judged(self) -> AxisRing:
        """Return the verdict."""
        if self._motion.plants.get(self._axis) != plants_digest(self._plants):
            return self._said(
                "says nothing", "the file was compensated for other plants: write a new ring test"
            )
        if not self._logs:
            return self._said("says nothing", "; ".join(self._reasons) or "no log was given")
        planned, off = self._half(compensated=False)
        compensated, on = self._half(compensated=True)
        noise_um = float(np.sqrt(self._floor().way.mean()))
        missed = self._missed()
        verdict, text = self._verdict(planned, off, compensated, on, noise_um, missed)
        confirmation = None
        if verdict != "says nothing":
            confirmation = Confirmation(
                tested_on=self._today,
                verdict=verdict,
                predicted_um=compensated.predicted_um,
                measured_um=compensated.measured_um,
                scatter_um=compensated.scatter_um,
                uncompensated_um=planned.measured_um,
                ratio=on.rms / max(off.rms, 1e-9),
                sources=tuple(self._sources),
                machine=self._machine.name,
                revision=self._machine.revision,
                plants=plants_digest(self._plants),
            )
        lags = [1e3 * lag_s(self._logs[0], self._motion, member) for member in self._members]
        return self._said(
            verdict,
            text,
            logs=[source.name for source in self._sources],
            seen=sum(len(log.seen) for log in self._logs),
            within=sum(log.within for log in self._logs),
            gain=float(np.mean([log.gain for log in self._logs])),
            misses=missed,
            lag_ms=(min(lags), max(lags)),
            floor_um=noise_um,
            as_planned=planned,
            compensated=compensated,
            confirmation=confirmation,
        )

    def _unusable(self, name: str, log: AxisLog | None) -> str:
        """Return why a log is unusable for the axis; empty if it is usable."""
        axis = self._axis.upper()
        reason = unusable(name, log, self._axis)
        if reason or log is None:
            return reason
        seen = [sum(s.compensated is half for s in log.seen) for half in (False, True)]
        if min(seen) < _FEWEST_STOPS or len(log.seen) < _SEEN_SHARE * log.within:
            whole = log.within == sum(stop.axis == self._axis for stop in self._motion.stops)
            why = _OTHERWISE if whole else "log the whole file"
            return (
                f"{name} shows {seen[0]} stops as planned and {seen[1]} compensated of {axis}, of "
                f"{log.within} in its time ({_FEWEST_STOPS} of each are needed, and "
                f"{100 * _SEEN_SHARE:.0f} % of all): {why}"
            )
        if len(floor(log, self._motion, self._band).way) == 0:
            return f"{name} begins after the rest before {axis}: its noise is not known"
        return ""

    def _half(self, *, compensated: bool) -> tuple[Half, _Level]:
        measured, made, kinds = [], [], []
        for log in self._logs:
            stops = [s for s in log.seen if s.compensated is compensated]
            kinds += [stop.kind for stop in stops]
            measured.append(residual(log.measured, stops, self._band))
            made.append([residual(member, stops, self._band) for member in self._members])
        noise, found = self._floor(), joined(measured)
        predictions = [joined(one) for one in zip(*made, strict=True)]
        way = _level(found.way, noise.way, kinds)
        half = Half(
            stops=len(kinds),
            measured_mm_s2=_level(found.accel, noise.accel, kinds).rms,
            measured_um=way.rms,
            scatter_um=way.scatter,
            predicted_mm_s2=_range([one.accel for one in predictions]),
            predicted_um=_range([one.way for one in predictions]),
        )
        return half, way

    def _floor(self) -> Power:
        return joined([floor(log, self._motion, self._band) for log in self._logs])

    def _missed(self) -> float:
        """Return how much of the motion the best plant of the set misses, in the worst log."""
        return max(
            min(misses(log, self._motion, member, self._band) for member in self._members)
            for log in self._logs
        )

    def _verdict(
        self,
        planned: Half,
        off: _Level,
        compensated: Half,
        on: _Level,
        noise_um: float,
        missed: float,
    ) -> tuple[Verdict, str]:
        low, high = compensated.predicted_um
        said = (
            f"measured {rounded_um(compensated.measured_um)} ± "
            f"{rounded_um(compensated.scatter_um, 1)} µm after "
            f"{compensated.stops} compensated stops, predicted {rounded_um(low)} to "
            f"{rounded_um(high)}; "
            f"{rounded_um(planned.measured_um)} µm as planned"
        )
        if compensated.predicted_um[0] > planned.predicted_um[0] / _LEAST_GAIN:
            return "says nothing", (
                f"{said}: the stops that should be compensated are not, so that no plant of the "
                "set predicts half of that as planned; write a new ring test"
            )
        held = _held_text(planned)
        if off.rms < _ABOVE_FLOOR * noise_um:
            return "says nothing", (
                f"{said}: the noise of the log is {rounded_um(noise_um)} µm, too much for this "
                f"ringing{f'. {held}' if held else '; take a better sensor, or fix it better'}"
            )
        least, most = on.reaches(-_SIGMAS), on.reaches(_SIGMAS)
        moved = self._moved()
        why = ""
        if least > high:
            why = "above the prediction"
        elif least > off.rms / _LEAST_GAIN:
            why = "not half of that as planned"
        elif moved:
            why = "but the mode is not where the plants have it"
        elif missed > _MOST_MISSES:
            why = f"but {100 * missed:.0f} % of the motion is not what any plant of the set does"
        if why:
            return "not confirmed", f"{said}: {why}. {moved or held or _PHASE} To do: {_ANEW}."
        if most > off.rms / _LEAST_GAIN:
            return "says nothing", (
                f"{said}: repeated stops differ too much to tell whether compensation halves it; "
                "log once more"
            )
        return "confirmed", said

    def _moved(self) -> str:
        """Return a text on the dominant mode in the log if no plant of the set has it there.

        Ringing after compensated stops may be small even if the frequency is wrong.
        """
        log = self._logs[0]
        rows = np.flatnonzero(log.inside)
        part = slice(int(rows[0]), int(rows[-1]) + 1)
        axis = AxisMotion(
            self._axis,
            self._plants.nominal,
            accelerations(self._command[None])[0, part],
            self._motion.predicted(self._axis, self._plants.nominal)[part],
            log.measured[part],
        )
        try:
            found = judge(axis, 1.0 / RATE_HZ)
            modes = [ringing_mode(m.plant).f_hz for m in self._plants.weighted_members()]
        except ModelError:
            # Plants of taps have no frequencies to scale, or nothing that rings.
            return ""
        room = max(_NEAR, _SURE * found.f_sd_hz / found.f_hz)
        if min(modes) * (1.0 - room) <= found.f_hz <= max(modes) * (1.0 + room):
            return ""
        return (
            f"It rings at {found.f_hz:.2f} ± {max(found.f_sd_hz, 0.01):.2f} Hz, the plants at "
            f"{min(modes):.2f} to {max(modes):.2f} Hz."
        )

    def _said(self, verdict: Verdict, text: str, **more: object) -> AxisRing:
        return AxisRing.model_validate(
            {
                "axis": self._axis,
                "verdict": verdict,
                "text": f"{self._axis.upper()} {verdict}: {text}",
                "band_hz": (self._band.low_hz, self._band.high_hz),
                **more,
            }
        )


def _held_text(planned: Half) -> str:
    """Return a text on friction if stops as planned ring far less than all plants would."""
    low, high = planned.predicted_um
    if planned.measured_um >= _HELD * low:
        return ""
    return (
        f"As planned it rings far less than the predicted {rounded_um(low)} to {rounded_um(high)} "
        "µm: guides that rub hold what is so small. See to it that the axis moves freely; raw data "
        "(OUTPUT=raw_data) show how much they rub, tables do not."
    )


def _delays_compared(axes: list[AxisRing]) -> list[AxisRing]:
    """Revoke a confirmation if the axes of one log have different delays.

    One axis alone does not show it, as the start of the log is unknown.
    """
    x, y = axes
    if x.lag_ms is None or y.lag_ms is None or x.logs[:1] != y.logs[:1]:
        return axes
    apart_ms = max(x.lag_ms[0] - y.lag_ms[1], y.lag_ms[0] - x.lag_ms[1], 0.0)
    if apart_ms <= 1e3 * _MOST_APART_S:
        return axes
    return [_late(one, apart_ms) for one in axes]


def _late(axis: AxisRing, apart_ms: float) -> AxisRing:
    if axis.confirmation is None or axis.verdict != "confirmed":
        return axis
    text = axis.text.replace("confirmed", "not confirmed", 1)
    return axis.model_copy(
        update={
            "verdict": "not confirmed",
            "text": f"{text}: but X and Y are {apart_ms:.1f} ms apart, which the plants do not "
            f"predict and which distorts corners. To do: {_ANEW}.",
            "confirmation": axis.confirmation.model_copy(update={"verdict": "not confirmed"}),
        }
    )


def _band(plants: PlantSetSpec) -> FrequencyBand:
    """Return the band of all modes of a set that ring."""
    modes = np.concatenate(
        [discretise(m.plant, 1.0 / RATE_HZ).modes() for m in plants.weighted_members()]
    )
    rings = modes[modes[:, 1] < _RINGS, 0]
    if len(rings) == 0:
        rings = modes[:, 0] if len(modes) else np.array([_HIGHEST_HZ])
    high_hz = min(1.4 * float(rings.max()), _HIGHEST_HZ)
    return FrequencyBand(min(0.7 * float(rings.min()), 0.5 * high_hz), high_hz)


def _level(stops: Array, noise: Array, kinds: list[int]) -> _Level:
    error = np.hypot(_standard_error(stops, kinds), _standard_error(noise, [0] * len(noise)))
    return _Level(float(stops.mean() - noise.mean()), float(error))


def _standard_error(values: Array, kinds: list[int]) -> float:
    """Return the standard error of the mean of values, where equal kinds are repeats."""
    kind = np.array(kinds)
    groups = np.unique(kind)
    free = len(values) - len(groups)
    if free < 1:
        return float(np.std(values) / np.sqrt(max(len(values) - 1, 1)))
    rest = sum(float(np.sum((values[kind == g] - values[kind == g].mean()) ** 2)) for g in groups)
    return float(np.sqrt(rest / free / len(values)))


def _range(powers: list[Array]) -> tuple[float, float]:
    rms = [float(np.sqrt(power.mean())) for power in powers]
    return min(rms), max(rms)
