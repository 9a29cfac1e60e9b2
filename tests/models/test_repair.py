"""Decimals as printed, and the smallest change within their rounding."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stillpath.models.errors import ModelError
from stillpath.models.repair import printed_decimals, repair_rounded


@pytest.mark.parametrize(
    ("texts", "decimals"),
    [
        (["1.0", "-4.54", "8.283", "-7.583", "3.479", "-0.639"], (3, 3, 3, 3, 3, 3)),
        (["0.0874", "-0.3415", "0.5118", "-0.3481", "0.09063"], (5, 4, 4, 4, 5)),
        (["12.34", "0.09063"], (2, 5)),
        (["1", "0", "-3", "0.50"], (None, None, None, 2)),
        (["1.5e-3", "2e-4", "0.0"], (4, 4, None)),
        (["+.25", "4."], (2, None)),
    ],
)
def test_printed_decimals(texts: list[str], decimals: tuple[int | None, ...]) -> None:
    assert printed_decimals(texts) == decimals


@given(st.lists(st.floats(0.01, 99.0), min_size=1, max_size=8), st.integers(1, 6))
def test_dropped_zeros_do_not_widen_the_rounding(values: list[float], decimals: int) -> None:
    texts = [f"{value:.{decimals}f}".rstrip("0") for value in values]
    for text, found in zip(texts, printed_decimals(texts), strict=True):
        shown = len(text.partition(".")[2])
        assert found is None or shown <= found <= decimals


@pytest.mark.parametrize("text", ["", "abc", "nan", "1,5", "0x1", ".", "1e"])
def test_not_a_number(text: str) -> None:
    with pytest.raises(ModelError, match="is not a decimal number"):
        printed_decimals([text])


@given(st.floats(-0.4, 0.4), st.integers(2, 5))
def test_gap_closes_and_exact_coefficients_stay(share: float, decimals: int) -> None:
    num, den = [0.25, 0.5], [1.0, -0.25 + share * 10.0**-decimals]
    new_num, new_den, moved = repair_rounded(num, den, (decimals, None), (None, decimals))
    assert new_num.sum() == pytest.approx(new_den.sum(), abs=1e-14)
    assert new_num[1] == 0.5
    assert new_den[0] == 1.0
    assert moved[1] == moved[2] == 0.0
    assert np.abs(moved).max() <= 1.0
