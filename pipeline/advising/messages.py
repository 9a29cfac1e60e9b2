"""Warnings and notes of the report about advice."""

from __future__ import annotations

from collections.abc import Sequence

from stillpath.pipeline.result import AdvisedFeature

__all__ = [
    "beyond_bounds",
    "is_a_test",
    "kept_beyond",
    "shaper_warnings",
    "stored_settings",
    "withdrawn",
]


def shaper_warnings(
    unmodelled: Sequence[str], *, none_known: bool, stated: bool, left: bool
) -> list[str]:
    """Return warnings about unknown settings of the printer's shaper.

    Parameters
    ----------
    unmodelled : sequence of str
        Shaper types in the machine document that have no model.
    none_known : bool
        The firmware does not take a shaper from a file.
    stated : bool
        The machine document says which shaper the printer has, or that it has none.
    left : bool
        Our shaper stays in force after the file.
    """
    found = [
        f"The shaper {kind} (firmware.shaper in the machine) has no model: figures of the file "
        "as sliced are those without it."
        for kind in unmodelled
    ]
    if none_known:
        found.append(
            "No shaper is advised: this firmware takes none from a file, or the machine does "
            "not say that it has one (firmware.shaper). Klipper takes one where printer.cfg has a "
            "section [input_shaper], which may be empty: add it, and make the machine again."
        )
        if not stated:
            found.append(
                "The printer's own shaper is not known (firmware.shaper in the machine): if it is "
                "on, the printer rings less than these figures, and may print faster than advised."
            )
    if left:
        found.append(
            "The printer's own shaper is not known (firmware.shaper in the machine): the one "
            "advised stays in force after the print, until the firmware restarts."
        )
    return found


def stored_settings(lines: Sequence[int], *, shaper: str | None) -> list[str]:
    """Return warnings about commands of a file that store the settings in force.

    Parameters
    ----------
    shaper : str, optional
        Shaper restored before them; empty: it was never changed; None: unknown, so none is
        advised.
    """
    if not lines:
        return []
    what = "; no shaper is advised, as the printer's is not known (firmware.shaper in the machine)"
    if shaper is not None:
        what = f" and the shaper ({shaper})" if shaper else ""
    said = (
        f"Line {lines[0]} stores the current settings for good. Before it the printer gets back "
        f"the acceleration that the file or the machine's document says{what}: check that they are "
        "the printer's, or remove the line."
    )
    return [said]


def is_a_test(why: str) -> str:
    """Return the warning that a file gets no advice because it is a test of settings."""
    return (
        f"No advice is given, so that the file shows what it tests: {why}. If it is no test, slice "
        "one setting for the whole print."
    )


def beyond_bounds(
    features: Sequence[AdvisedFeature],
    lowest_mm_s2: float,
    helpless: Sequence[str],
    *,
    has_budget: bool,
) -> list[str]:
    """Return warnings about visible features that exceed their bounds, with the reason.

    Parameters
    ----------
    lowest_mm_s2 : float
        The lowest acceleration that was tried.
    helpless : sequence of str
        Names of features that no acceleration would bring within their bounds.
    """
    return [
        f"{feature.name}: {feature.after_um:.1f} µm are predicted, more than the "
        f"{feature.bound_um:.1f} µm it may have"
        + (
            f": no acceleration from {lowest_mm_s2:.0f} mm/s^2 on would do. Corners shake the "
            "machine too (square corner velocity, jerk, junction deviation)."
            if feature.name in helpless
            else "; a larger budget is needed."
            if has_budget
            else " as sliced."
        )
        for feature in features
        if not feature.within_bound and feature.exact
    ]


def kept_beyond(features: Sequence[AdvisedFeature]) -> list[str]:
    """Return warnings about invisible features beyond the budget, which are not slowed down."""
    names = [
        f"{f.name} ({f.after_um:.1f} µm)" for f in features if not f.within_bound and not f.exact
    ]
    if not names:
        return []
    return [f"Above its bound, but not slowed below what the file asks for: {', '.join(names)}."]


def withdrawn(longer_s: float, *, less_exact: bool) -> str:
    """Return the note that a file keeps its own settings, as advice did not improve it."""
    why = "be less exact" if less_exact else f"take {longer_s:.2f} s longer"
    return (
        f"Advice was withdrawn: with it, the file would {why}. A budget (budget_um) says how much "
        "may be lost."
    )
