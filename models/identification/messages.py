"""Notes and warnings about a measurement and about the model that was fitted to it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from stillpath.models.arrays import Array
from stillpath.models.errors import ModelError
from stillpath.models.friction import LEAST_MM_S2, Guides
from stillpath.models.identification.estimation import plateau_gain
from stillpath.models.identification.nozzle import Frame
from stillpath.models.identification.readers.checks import RangeEnded
from stillpath.models.identification.readers.spectra import GAINS_TEXT
from stillpath.models.identification.spectrum_model import moved_most
from stillpath.models.identification.trust import main_mode, main_mode_known
from stillpath.models.identification.types import (
    LEAST_COHERENCE,
    AxisIdentification,
    Excitation,
    Fit,
    FrequencyResponse,
    Spectrum,
)
from stillpath.models.notes import WarningNote, by_file
from stillpath.models.plants import PairsSpec, PlantSetSpec, PlantSpec, RelativeModesSpec

__all__ = [
    "apart_warning",
    "body_notes",
    "cross_axis_warning",
    "drowned_warning",
    "fit_warnings",
    "frame_mode_warnings",
    "friction_notes",
    "level_warnings",
    "mounting_notes",
    "no_frame_note",
    "phase_fault",
    "phase_warning",
    "scale_warnings",
    "spectrum_level_warning",
    "strength_notes",
    "table_mounting_notes",
    "unvaried_notes",
]

_MOSTLY = 0.8
_CROSS = 0.2
_APART_DB = 2.0
"""Repeats within a session differ by .3 to 1 dB, tables of one axis weeks apart by up to 1.5 dB."""
_DB = 10 / np.log(10)
_LEVEL_TOLERANCE = 0.15
_LEVELS = (0.3, 3.0)
_TABLE_LEVELS = (0.2, 5.0)
"""Of tables, which do not say their accel_per_hz: 12 to 300 where it is not stated."""
_LEAST_MM_S = 3.0
"""Least accel_per_hz: a test of 3 mm/s^2 per Hz is lost in the noise of sensors."""
_AS_WEAK = 0.1
_POOR, _POOR_DB = 0.15, 1.1
_USELESS, _USELESS_DB = 0.5, 6.0
"""Residuals beyond which a fit is no model of what was measured."""
_AHEAD_S = 1e-3
_COPIED = (
    ". Creality's K1 writes the table of Y as that of X, too, after SHAPER_CALIBRATE AXIS=Y: then "
    "measure X (TEST_RESONANCES AXIS=X)"
)
"""cmd_SHAPER_CALIBRATE of its klippy/extras/resonance_tester.py (2025-08)."""
_ALIKE = 0.6
"""Of a unit vector: as much along two axes of the sensor, give or take 8 degrees."""
_BETWEEN = (
    "the sensor moved as much along its {} as along its {}, so it was taken to be turned by half a "
    "right angle; if it is not, this is the test of a belt (AXIS=1,1 or 1,-1), which is of neither "
    "X nor Y"
)
_LEAST_POINTS, _SLOPE_TOLERANCE = 4, 0.2


def mounting_notes(axis: str, responses: Sequence[FrequencyResponse]) -> list[str]:
    """Return notes on a sensor whose axes are not the machine's, as is common."""
    notes = []
    for response in responses:
        along = dict(zip("xyz", map(abs, response.sensor_direction or ()), strict=False))
        most = max(along, key=along.__getitem__, default=axis)
        if most != axis and along[most] > _MOSTLY:
            notes.append((response.source, _turned_text(most, axis, "log")))
        alike = [name for name, share in along.items() if share > _ALIKE]
        if len(alike) == 2:
            notes.append((response.source, WarningNote(_BETWEEN.format(*alike))))
    return by_file(notes)


def table_mounting_notes(
    axis: str, spectra: Sequence[Spectrum], *, turned: bool = False
) -> list[tuple[str, str]]:
    """Return files and notes where a table shows the test in another of the sensor's axes.

    A warning where that is the other axis of the plane, as files of X and Y may be exchanged;
    not if the sensor was said to be `turned` between them.
    """
    moved = [(one.source, *moved_most(one)) for one in spectra]
    notes = []
    for source, most, share in moved:
        if most != axis and share > _MOSTLY:
            kind = WarningNote if most in "xy" and not turned else str
            cause = _COPIED if (axis, most) == ("x", "y") else ""
            notes.append((source, kind(_turned_text(most, axis, "table") + cause)))
    return notes


def _turned_text(most: str, axis: str, kind: str) -> str:
    return (
        f"the sensor's {most} moved in the test of axis {axis}, so it was taken "
        "to be mounted so; if it is not, another axis was measured (sensor_axis "
        f"{axis} refuses such a {kind})"
    )


def body_notes(friction_mm: float, frame: Frame | None) -> list[str]:
    """Return notes on other effects that were found: friction and frame."""
    notes = []
    if friction_mm:
        notes.append(
            f"dry friction holds the axis {1e3 * friction_mm:.1f} µm behind its command: "
            "commands compensate for it"
        )
    if frame is not None:
        notes.append(
            f"the frame shakes on its feet at {frame.f_hz:.1f} Hz (the moving "
            f"parts are {frame.mass_ratio:.0%} of its mass): the sensor feels it, but the nozzle "
            "does not move against the bed, so it was removed (frame_firm keeps it)"
        )
    return notes


def friction_notes(plants: PlantSetSpec, guides: Guides | None) -> list[str]:
    """Return what is assumed of friction, which neither spectra show nor logs without a model."""
    if not plants.friction_assumed:
        return []
    held_um, guides = 1e3 * (plants.friction_mm or 0.0), guides or "rails"
    note = (
        "dry friction is not known (raw logs that a model explains show it): "
        f"{1e-3 * LEAST_MM_S2[guides]:g} N per kg of moving mass is assumed, as for light "
        f"{guides} (option guides), which holds the axis {held_um:.1f} µm behind its command"
    )
    return [note]


def frame_mode_warnings(felt: PlantSpec, kept: PlantSpec, *, table: bool = False) -> list[str]:
    """Warn of modes of a log, or of a table, that are left out as the frame's."""
    known_hz = _modes_hz(kept)
    left_out = [f"{f_hz:.1f} Hz" for f_hz in _modes_hz(felt) if f_hz not in known_hz]
    if not left_out:
        return []
    better = "; raw logs would tell" if table else ""
    note = (
        f"what shakes weakly at {' and '.join(left_out)}, far below the strongest resonance, is "
        "taken to be the frame on its feet, or what it stands on: the sensor feels it, the nozzle "
        f"over the bed does not (frame_firm leaves it in{better})"
    )
    return [note]


def _modes_hz(plant: PlantSpec) -> list[float]:
    if isinstance(plant, RelativeModesSpec):
        return [mode.f_hz for mode in plant.modes]
    return [pole.f_hz for pole in plant.poles] if isinstance(plant, PairsSpec) else []


def no_frame_note(frames_hz: Mapping[Literal["x", "y"], float | None]) -> str:
    """Say why weak modes are kept: a frame's would be alike in X and Y."""
    seen = " and ".join(f"{f:.1f} Hz in {a.upper()}" for a, f in sorted(frames_hz.items()) if f)
    return (
        f"what shakes weakly at {seen} lies too far apart to be one frame on its feet, so most "
        "plants keep it (frame_firm: all of them; raw logs would tell)"
    )


def unvaried_notes(plants: PlantSetSpec) -> tuple[str, ...]:
    """Say of a model from a file that it has no members."""
    if plants.members:
        return ()
    note = (
        "the model's frequencies cannot be varied, so commands are designed for it alone, as if it "
        "were exact; give its modes, or zeros and poles"
    )
    return (note,)


def fit_warnings(fit: Fit, sources: Sequence[str], warned: Sequence[str]) -> tuple[str, ...]:
    """Return warnings about an unreliable model; refuse a useless one, with what was `warned`."""
    if fit.magnitude_only:
        limits, missed = (_POOR_DB, _USELESS_DB), f"{fit.residual:.1f} dB"
    else:
        limits, missed = (_POOR, _USELESS), f"{fit.residual:.0%}"
    remedy = (
        "Leave out files of another state of the machine, measure again, or allow more modes "
        "(max_order, over HTTP and on the command line)"
    )
    if fit.residual > limits[1]:
        raise ModelError(
            f"{', '.join(sources)}: no stable model of {fit.order} modes explains this: it misses "
            f"{missed}. Check that file, axis and test belong together. "
            + "".join(f"And: {warning}. " for warning in warned)
            + remedy
        )
    if fit.residual > limits[0]:
        text = f"the model misses {missed} of what was measured: look at the curves before it is"
        return (f"{text} used. {remedy}",)
    return ()


def phase_fault(found: AxisIdentification) -> str | None:
    """Return why the phase of raw logs cannot be used, by the best fit to them; else None."""
    fit = found.fit
    main = main_mode(fit) if fit else None
    if fit is None or main is None or fit.magnitude_only:
        return None
    if fit.residual > _POOR:
        return (
            f"the best model misses {fit.residual:.0%} of what the logs say, {_POOR:.0%} at most "
            "is to be expected"
        )
    # Beyond the test nothing was measured, and a table would not tell either.
    if fit.band_hz[1] < main.f_hz < max(float(one.f_hz[-1]) for one in found.measured):
        return (
            f"the axis follows its command up to {fit.band_hz[1]:.1f} Hz only, and what rings most "
            f"would be at {main.f_hz:.1f} Hz"
        )
    if not main_mode_known(fit):
        return (
            f"what rings most would be at {main.f_hz:.1f} Hz, give or take "
            f"{2 * main.f_sd_hz:.1f} Hz"
        )
    return None


def phase_warning(axis: str, fault: str, notes: Sequence[str]) -> str:
    """Say why of logs with these notes only the magnitude is used."""
    clipped = any(isinstance(note, RangeEnded) for note in notes)
    cause, remedy = (
        ("the sensor's range ended", "Set a larger range, or test with a lower accel_per_hz")
        if clipped
        else (
            "how the axis moves depends on how far it moves (much friction, play)",
            "Look for what rubs or is loose",
        )
    )
    return (
        f"axis {axis.upper()}: {fault}: {cause}. So only the size of the vibrations is "
        f"used, as from a resonance table, and the compensation is more cautious. {remedy}, and "
        "measure again"
    )


def level_warnings(responses: Sequence[FrequencyResponse], fit: Fit) -> list[str]:
    """Judge the level by the fit, where nothing followed at the frequencies that tell it.

    Raises
    ------
    ModelError
        If no sensor on what moves can have shown it.
    """
    names = ", ".join(r.source for r in responses if plateau_gain(r) is None)
    if not names or abs(fit.gain - 1.0) <= _LEVEL_TOLERANCE:
        return []
    seen = f"{names}: by the fit the sensor moved {fit.gain:.2g} times as much as commanded"
    if not _LEVELS[0] < fit.gain < _LEVELS[1]:
        raise ModelError(
            f"{seen}: it is not mounted on what moves, or accel_per_hz or its scale is wrong; "
            "measure at the part that the axis moves"
        )
    return [f"{seen}; check accel_per_hz in printer.cfg and the sensor's scale"]


def strength_notes(response: FrequencyResponse, test: Excitation) -> tuple[str, ...]:
    """Return a warning where a log without slow sweep may be of Klipper's weaker test.

    Only its level tells Kalico's test (accel_per_hz 75, resonance_tester.py, 2026-07) from
    Klipper's with sweeping_period 0 (60).

    Parameters
    ----------
    test : Excitation
        As it was assumed.
    """
    gain, usual = plateau_gain(response), Excitation(test.direction)
    weaker = usual.accel_per_hz_mm_s / test.accel_per_hz_mm_s
    as_long = test.f_end_hz == usual.f_end_hz and test.sweeping_accel_mm_s2 == 0.0
    if gain is None or not as_long or not weaker < 1.0 or abs(gain / weaker - 1.0) > _AS_WEAK:
        return ()
    text = (
        f"below 15 Hz the axis moved {gain:.2f} times as much as accel_per_hz = "
        f"{test.accel_per_hz_mm_s:g} commands, which is Kalico's. Klipper since 2024-12 has "
        f"{usual.accel_per_hz_mm_s:g}, also with sweeping_period 0: state yours (accel_per_hz). If "
        "it is right, the axis rubs much, or the sensor's scale is off"
    )
    return (WarningNote(text),)


def scale_warnings(responses: Sequence[FrequencyResponse], fit: Fit) -> list[str]:
    """Warn if command and measurement seem to differ in axis or unit."""
    names, warnings = ", ".join(dict.fromkeys(r.source for r in responses)), []
    if abs(fit.gain - 1.0) > _LEVEL_TOLERANCE:
        warnings.append(
            f"{names}: at low frequencies the measurement is {fit.gain:.3g} times the command, and "
            "was divided by that: an axis that keeps its steps ends where it is told; check that "
            "both have the same unit, and which columns they are"
        )
    warnings += by_file((r.source, text) for r in responses if (text := _slope_text(r)))
    if fit.delay_s < -_AHEAD_S:
        warnings.append(
            f"{names}: the measurement is {-fit.delay_s * 1e3:.2g} ms ahead of the command: check "
            "that the two are not exchanged, and their clocks"
        )
    return warnings


def _slope_text(response: FrequencyResponse) -> str:
    """Describe a response that follows a power of f over its lowest octave."""
    f_hz = response.f_hz
    known = (f_hz > 0) & (np.abs(response.response) > 0) & ~(response.coherence < LEAST_COHERENCE)
    if np.count_nonzero(known) < _LEAST_POINTS:
        return ""
    lowest = known & (f_hz <= 2.0 * f_hz[known].min())
    if np.count_nonzero(lowest) < _LEAST_POINTS:
        return ""
    slope = np.polyfit(np.log(f_hz[lowest]), np.log(np.abs(response.response[lowest])), 1)[0]
    power = round(float(slope))
    if power == 0 or abs(slope - power) > _SLOPE_TOLERANCE:
        return ""
    return (
        f"towards low frequencies the response goes like f^{power:d} instead of being level: "
        "command and measurement must be the same quantity (both position, or both acceleration); "
        f"multiply the response by (2 pi j f)^{-power:d}"
    )


def spectrum_level_warning(gain: float, excitation: Excitation, names: str) -> tuple[str, ...]:
    """Warn of a level that another accel_per_hz would explain better; refuse one that none does.

    Raises
    ------
    ModelError
        If the sensor hardly moved with the test, or far too much.
    """
    stated = excitation.accel_per_hz_mm_s
    seen = (
        f"{names}: at low frequency the sensor moved {gain:.2g} times as much as a test with "
        f"accel_per_hz {stated:g} commands"
    )
    if not gain * stated >= _LEAST_MM_S:
        raise ModelError(
            f"{seen}, so accel_per_hz would be {gain * stated:.2g}, and no test is below "
            f"{_LEAST_MM_S:g}: the table holds only noise, the sensor was not mounted on what this "
            f"axis moves, the test began above {excitation.f_start_hz:g} Hz (then give min_freq), "
            f"or it is no test of Klipper's: {GAINS_TEXT}. Else measure again"
        )
    if not _TABLE_LEVELS[0] < gain < _TABLE_LEVELS[1]:
        raise ModelError(
            f"{seen}, {_TABLE_LEVELS[0]:g} to {_TABLE_LEVELS[1]:g} is to be expected: it was not "
            "mounted on what this axis moves (the head; the bed of a bed slinger), the table holds "
            f"only noise, or the test began at a higher min_freq than {excitation.f_start_hz:g} "
            f"Hz. If that, or accel_per_hz {gain * stated:.3g}, was so, "
            "say it; else measure again"
        )
    if abs(gain - 1) <= 2 * _LEVEL_TOLERANCE:
        return ()
    rubs = "; an axis that rubs much moves less, too" if gain < 1.0 else ""
    return (
        (
            f"the level at low frequency implies accel_per_hz = {gain * stated:.0f}, stated are "
            f"{stated:g} ({gain - 1:+.0%}); check accel_per_hz, and that this axis was tested and "
            f"its sensor reads right (the shape of the model hardly depends on it){rubs}"
        ),
    )


def apart_warning(spectra: Sequence[Spectrum], logs: Array) -> tuple[str, ...]:
    """Warn of the two tables that differ most in shape, if they are not of one machine."""
    pairs = [
        (float(_DB * np.std(logs[i] - logs[j])), spectra[i].source, spectra[j].source)
        for i in range(len(logs))
        for j in range(i)
    ]
    apart_db, one, other = max(pairs, default=(0.0, "", ""))
    if apart_db <= _APART_DB:
        return ()
    return (
        (
            f"{other} and {one} differ by {apart_db:.1f} dB in shape (repeats: below "
            f"{_APART_DB:g} dB): something was changed between them (belt tension, mass, "
            "mounting); give only tables of the machine as it prints today"
        ),
    )


def drowned_warning(spectrum: Spectrum, column: str) -> tuple[str, ...]:
    """Warn where another of the sensor's axes shows more at the beginning of the test."""
    most, share = moved_most(spectrum)
    if most in ("", column) or share > _MOSTLY or column not in "xyz":
        return ()
    text = (
        f"{spectrum.source}: at low frequency, where the test is weakest, the sensor's {most} "
        f"shows more than its {column}, which moved most in the whole test and is used: noise as "
        "strong as the test. Damping and level may be off: shield the sensor's cable, or lower the "
        "rate of its bus, and measure again"
    )
    return (text,)


def cross_axis_warning(share: float, other: str, column: str) -> tuple[str, ...]:
    """Warn of another axis that moved too."""
    if share <= _CROSS:
        return ()
    return (
        (
            f"sensor axis {other!r} has {share:.0%} of the power of {column!r}: the axes are "
            "coupled (CoreXY belts of unequal tension?), the frame rocks, or the sensor is turned; "
            f"the model describes {column!r} alone"
        ),
    )
