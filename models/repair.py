"""Repair of printed transfer functions whose rounding moved the DC gain."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stillpath.models.errors import ModelError

__all__ = ["printed_decimals", "repair_rounded"]

_NUMBER = re.compile(r"[-+]?(\d*)(?:\.(\d*))?(?:[eE]([-+]?\d+))?")


def printed_decimals(texts: Sequence[str]) -> tuple[int | None, ...]:
    """Return how many decimals each coefficient of one polynomial was rounded to.

    Programs drop zeros at the end: among 8.283 and 3.479, -4.54 was -4.540. So a coefficient
    counts as rounded to the significant digits of the longest of its polynomial, yet to no
    more decimals than the most that any of them shows. Whole numbers are exact: None.

    Raises
    ------
    ModelError
        If a text is not a decimal number.
    """
    shown = [_decimals_and_digits(text) for text in texts]
    most = max((decimals for decimals, _, _ in shown if decimals is not None), default=0)
    longest = max((digits for decimals, digits, _ in shown if decimals is not None), default=0)
    return tuple(
        None if own is None else max(own, min(longest - before, most)) for own, _, before in shown
    )


def repair_rounded(
    num: ArrayLike,
    den: ArrayLike,
    num_decimals: Sequence[int | None],
    den_decimals: Sequence[int | None],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Move a discrete num/den as little as the rounding allows, so that num(1) = den(1).

    The smallest weighted change, weights the half units of the last printed decimal: with
    gap = den(1) - num(1) every coefficient moves by its share h^2 / sum h^2 of the gap.

    Parameters
    ----------
    num, den : array_like, highest power first
    num_decimals, den_decimals : sequence of int or None
        Printed decimals of each coefficient, None for an exact one; the leading 1 of `den`
        never moves.

    Returns
    -------
    num, den : ndarray
        The repaired coefficients.
    moved : ndarray
        The change of (num, den) in units of the half last decimal; 0 for exact ones.

    Raises
    ------
    ModelError
        If a coefficient would have to leave its rounding, or none was rounded.
    """
    b, a = np.array(num, float), np.array(den, float)
    half_b, half_a = _half_units(num_decimals), _half_units(den_decimals)
    half_a[0] = 0.0
    size = np.sum(half_b**2) + np.sum(half_a**2)
    if size == 0.0:
        raise ModelError("every coefficient is a whole number: there is no rounding to repair")
    share = (a.sum() - b.sum()) / size
    moved = np.concatenate([half_b, -half_a]) * share
    if np.abs(moved).max() > 1.0:
        raise ModelError(
            f"DC gain 1 needs {np.abs(moved).max():.2g} times the rounding of the coefficients: "
            "the model is off by more than its rounding, fit it again"
        )
    return b + half_b**2 * share, a - half_a**2 * share, moved


def _half_units(decimals: Sequence[int | None]) -> NDArray[np.float64]:
    return np.array([0.0 if d is None else 0.5 * 10.0**-d for d in decimals])


def _decimals_and_digits(text: str) -> tuple[int | None, int, int]:
    """Return decimals (None: whole), significant digits, and digits before the point.

    The last is negative by the zeros that follow the point directly.
    """
    found = _NUMBER.fullmatch(text.strip())
    if found is None or not (found[1] or found[2]):
        raise ModelError(f"{text!r} is not a decimal number")
    whole, fraction, power = found[1], found[2] or "", int(found[3] or 0)
    digits = (whole + fraction).lstrip("0")
    decimals = len(fraction) - power
    if not digits or (not fraction and found[3] is None):
        return None, 0, 0
    return decimals, len(digits), len(digits) - decimals
