"""Refuse models that a measurement cannot support, and axes that do not fit together; say why."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stillpath.models.errors import ModelError
from stillpath.models.identification.alignment import check_pair
from stillpath.models.identification.response_data import coherent
from stillpath.models.identification.spectrum_model import moved_most
from stillpath.models.identification.types import (
    LEAST_COHERENCE,
    UNSEEN_ZETA,
    Axis,
    AxisIdentification,
    Fit,
    FrequencyResponse,
    ModeEstimate,
    Spectrum,
)

__all__ = [
    "check_axes",
    "check_directions",
    "check_informative",
    "check_repeats",
    "delay_warning",
    "delays_compared",
    "keeps_time",
    "main_mode",
    "main_mode_known",
]

_LEAST_SHARE, _LEAST_COUNT = 0.1, 30
_WIDEST_GAP = 4.0
"""Ratio of the frequencies between which the motion may not follow. Where guides that rub hold an
axis from 16 to 100 Hz, the maximum below that is friction's and no resonance; beyond a resonance
that is seen, axes that rub were without coherence for a ratio of up to 3.3."""
_SLOWEST_HZ, _PRINTERS_HZ = 5.0, 150.0
"""Printers have their modes below this frequency: a model need not follow above it."""
_HIGHEST_TEST_HZ, _WIDER = 300.0, 1.4
"""Klipper's largest max_freq, and how far a test should go beyond a resonance."""
_MAIN_HZ = (1.0, 500.0)
"""As for a resonance that is typed in."""
_MOST_UNSURE = 0.05
"""Relative standard deviation of the frequency of the mode that rings most."""
_MOST_LEVEL = 2.0
_ONE_DIRECTION = 0.8
"""Share of power from which an axis of the sensor lies within 27 degrees of the motion: two
perpendicular motions cannot both."""
_MOST_APART_S = 2e-3
"""Largest plausible difference between the delays of two axes: beyond it, a wrong clock or noise
is the cause rather than a drive, belt or sensor."""
_DELAYS_DIFFER_S = 0.2e-3
"""Difference from which corners would shear."""
_MEASURE = (
    "Measure the whole band: Klipper's TEST_RESONANCES with OUTPUT=raw_data, or a swept sine from "
    "5 to 130 Hz, with the sensor on what moves (the head; the bed of a bed slinger)"
)


def check_informative(
    fit: Fit,
    measured: Sequence[FrequencyResponse | Spectrum],
    sources: Sequence[str],
    warnings: Sequence[str] = (),
) -> None:
    """Refuse a model that the measurement does not determine.

    Parameters
    ----------
    warnings : sequence of str
        Other findings, which are often the reason.

    Raises
    ------
    ModelError
        If hardly any frequency is coherent, or the mode that rings most lies outside of what was
        measured, is no printer's, or might be anywhere.
    """
    names = ", ".join(sources)
    for one in measured:
        _check_coherent(one, names)
    low, high = fit.band_hz
    told = "".join(f"And: {warning}. " for warning in warnings)
    main = main_mode(fit)
    if main is None:
        return
    if not low <= main.f_hz <= high:
        raise ModelError(
            f"{names}: the mode that rings most would be at {main.f_hz:.1f} Hz, outside the "
            f"measured {low:.1f} to {high:.1f} Hz, so it was not measured. "
            f"{told}{_above(main.f_hz) if high < main.f_hz < _HIGHEST_TEST_HZ else _MEASURE}"
        )
    if not _MAIN_HZ[0] <= main.f_hz <= _MAIN_HZ[1]:
        raise ModelError(
            f"{names}: the mode that rings most would be at {main.f_hz:.3g} Hz; that of a printer "
            f"lies between {_MAIN_HZ[0]:g} and {_MAIN_HZ[1]:g} Hz: frequencies must be in Hz (not "
            "kHz or rad/s), and times in seconds"
        )
    # Modes of a spectrum trade places with each other; its set knows how far it can be trusted.
    if not fit.magnitude_only and not main_mode_known(fit):
        raise ModelError(
            f"{names}: the mode that rings most is at {main.f_hz:.1f} Hz, give or take "
            f"{2 * main.f_sd_hz:.1f} Hz; it must be known within {2 * _MOST_UNSURE:.0%} to be "
            f"compensated. {told}{_MEASURE}"
        )


def _above(f_hz: float) -> str:
    """Say how to measure a mode above what was measured."""
    most_hz = min(10.0 * np.ceil(0.1 * _WIDER * f_hz), _HIGHEST_TEST_HZ)
    return (
        f"Measure up to {most_hz:.0f} Hz (Klipper: max_freq in [resonance_tester]; a lower "
        "accel_per_hz keeps the acceleration as it was), with the sensor on what moves"
    )


def main_mode(fit: Fit) -> ModeEstimate | None:
    """Return the mode that rings most; None without modes.

    In a spectrum, modes beyond the band only shape its flank. In a response, too, their damping is
    hardly known: they count with a usual one if they seem to have less.
    """
    low, high = fit.band_hz
    seen = [m for m in fit.modes if low <= m.f_hz <= high] if fit.magnitude_only else []

    def rings(mode: ModeEstimate) -> float:
        known = mode.f_hz <= high or mode.zeta >= UNSEEN_ZETA
        return mode.peak if known else mode.peak * mode.zeta / UNSEEN_ZETA

    return max(seen or fit.modes, key=rings, default=None)


def main_mode_known(fit: Fit) -> bool:
    """Return whether the mode that rings most is known closely enough to be compensated."""
    main = main_mode(fit)
    return main is None or not main.f_sd_hz > _MOST_UNSURE * main.f_hz or np.isinf(main.f_sd_hz)


def check_axes(found: Sequence[AxisIdentification]) -> None:
    """Refuse two axes that differ in ways that only noise or a mistake explains.

    Raises
    ------
    ModelError
        If one level is more than twice the other, or delays that are known are 2 ms apart.
    """
    fits = [(one.axis.upper(), one.fit) for one in found if one.fit is not None]
    if len(fits) != 2:
        return
    (x, of_x), (y, of_y) = fits
    both = f"axes {x} and {y}"
    alike = len({one.plants.provenance.kind for one in found if one.plants.provenance})
    ratio = max(of_x.gain, of_y.gain) / min(of_x.gain, of_y.gain)
    if alike == 1 and ratio > _MOST_LEVEL:
        raise ModelError(
            f"{both}: slow motion was measured at {of_x.gain:.3g} and {of_y.gain:.3g} times what "
            f"was commanded, {ratio:.1f} times apart, at most {_MOST_LEVEL:g} is to be expected: "
            "another axis, a loose sensor, or two units. Measure both again in one session, with "
            "the sensor on what each of them moves, and give both in one unit"
        )
    apart_s = abs(of_x.delay_s - of_y.delay_s)
    if all(map(keeps_time, found)) and apart_s > _MOST_APART_S:
        raise ModelError(
            f"{both}: the delays differ by {apart_s * 1e3:.1f} ms ({of_x.delay_s * 1e3:.2f} and "
            f"{of_y.delay_s * 1e3:.2f} ms), at most {_MOST_APART_S * 1e3:g} ms is to be expected "
            "of one machine: clocks that differ, or noise. Measure both axes again in one session"
        )


def delay_warning(x: Fit, y: Fit) -> str | None:
    """Return a warning if the delays of two axes differ by more than 0.2 ms.

    A delay that both share only shifts time; one that differs shears corners.
    """
    apart = abs(x.delay_s - y.delay_s)
    if apart <= _DELAYS_DIFFER_S or x.magnitude_only or y.magnitude_only:
        return None
    return (
        f"the delays of the axes differ by {apart * 1e3:.2f} ms (X {x.delay_s * 1e3:.2f}, "
        f"Y {y.delay_s * 1e3:.2f} ms), more than {_DELAYS_DIFFER_S * 1e3:g} ms: corners would "
        "shear; measure both axes again in one session"
    )


def delays_compared(found: dict[Axis, AxisIdentification]) -> dict[Axis, AxisIdentification]:
    """Warn about delays that differ, where the measurement shared a clock with its command."""
    fits = [one.fit for _, one in sorted(found.items()) if keeps_time(one) and one.fit]
    warning = delay_warning(fits[0], fits[1]) if len(fits) == 2 else None
    if warning is None:
        return found
    return {a: replace(one, warnings=(*one.warnings, warning)) for a, one in found.items()}


def check_directions(found: Iterable[AxisIdentification], *, stated: bool = False) -> None:
    """Refuse logs, or tables, of X and Y that moved the sensor along the same of its directions.

    Parameters
    ----------
    stated : bool
        Along which axis of the sensor tables were measured was said.
    """
    first = [one.measured[0] for one in found if one.measured]
    along = [
        (r.source, r.sensor_direction)
        for r in first
        if isinstance(r, FrequencyResponse) and r.sensor_direction is not None
    ]
    if len(along) == 2:
        (x, x_direction), (y, y_direction) = along
        try:
            check_pair(x_direction, y_direction)
        except ModelError as error:
            raise ModelError(f"{x}, {y}: {error}") from None
    moved = [(r.source, *moved_most(r)) for r in first if isinstance(r, Spectrum)]
    if len(moved) == 2 and not stated:
        (x, in_x, x_share), (y, in_y, y_share) = moved
        if in_x == in_y and min(x_share, y_share) >= _ONE_DIRECTION:
            raise ModelError(
                f"{x}, {y}: the tests of X and Y both moved the sensor along its {in_x} "
                f"({x_share:.0%} and {y_share:.0%} of the power from 8 to 15 Hz, where tests of "
                f"two axes share less than {_ONE_DIRECTION:.0%}): the same axis was measured "
                "twice, so measure the other one; if the sensor was mounted differently for X and "
                "for Y, say so (option sensor_turned), or give one axis at a time"
            )


def check_repeats(spectra: Sequence[Spectrum], axis: str) -> None:
    """Refuse tables of an axis that moved the sensor along different ones of its directions.

    Their mean would be of no axis: a renamed or misnamed table of the other one is among them.

    Raises
    ------
    ModelError
    """
    moved = [(one.source, *moved_most(one)) for one in spectra]
    clear: dict[str, list[str]] = {}
    for source, most, share in moved:
        if share >= _ONE_DIRECTION:
            clear.setdefault(most, []).append(source)
    if len(clear) < 2:
        return
    listed = "; ".join(f"its {most} in {', '.join(names)}" for most, names in clear.items())
    raise ModelError(
        f"axis {axis.upper()}: these tables moved the sensor along different axes ({listed}), so "
        "some are of the other axis: rename those that have a wrong name, or leave them out; if "
        f"the sensor was mounted differently between tests of {axis.upper()}, give tables of one "
        "mounting"
    )


def keeps_time(found: AxisIdentification) -> bool:
    """Return whether the measurement of an axis shared a clock with its command."""
    about = found.plants.provenance
    return about is not None and about.kind in ("frequency response", "recorded drive")


def _check_coherent(one: FrequencyResponse | Spectrum, names: str) -> None:
    if not isinstance(one, FrequencyResponse) or not np.isfinite(one.coherence).any():
        return
    follows = coherent(one.coherence)
    count = int(np.count_nonzero(follows))
    top_hz = max(_PRINTERS_HZ, float(one.f_hz[follows].max(initial=0.0)))
    of = int(np.count_nonzero(one.f_hz <= top_hz))
    if count >= min(_LEAST_COUNT, of) and count >= _LEAST_SHARE * of:
        _check_gap(one, follows, names)
        return
    raise ModelError(
        f"{names}: the motion follows the command at {count} of {of} frequencies between "
        f"{one.f_hz.min():.1f} and {min(top_hz, one.f_hz.max()):.1f} Hz (coherence "
        f"{LEAST_COHERENCE:g} or more, side by side); {_LEAST_COUNT} and {_LEAST_SHARE:.0%} of "
        f"them are needed, so no model follows from it. {_MEASURE}"
    )


def _check_gap(one: FrequencyResponse, follows: NDArray[np.bool_], names: str) -> None:
    """Refuse a motion that does not follow its command where a printer has its resonance."""
    at = np.flatnonzero(follows & (one.f_hz >= _SLOWEST_HZ))
    known_hz = one.f_hz[at]
    if len(at) < 2:
        return
    # Frequencies of a sparse sweep are apart, too, with nothing between them.
    ratio = np.where(np.diff(at) > 1, known_hz[1:] / known_hz[:-1], 1.0)
    widest = int(np.argmax(ratio))
    low_hz, high_hz = known_hz[widest : widest + 2]
    if ratio[widest] <= _WIDEST_GAP or low_hz >= _PRINTERS_HZ:
        return
    raise ModelError(
        f"{names}: the motion does not follow the command between {low_hz:.1f} and {high_hz:.1f} "
        f"Hz (coherence below {LEAST_COHERENCE:g}; at most a factor of {_WIDEST_GAP:g} may lie "
        "between frequencies that it follows): a resonance there was not measured. An axis whose "
        "guides rub much sticks while it is driven so little: look for what rubs or is loose, or "
        "test with a larger accel_per_hz (ring-test: --accel-mm-s2), and measure again"
    )
