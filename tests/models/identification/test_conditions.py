"""What stands after the @ of a file's name."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stillpath.models.errors import ModelError
from stillpath.models.identification.conditions import Condition


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", Condition()),
        ("+0.5kg", Condition("+0.5kg", added_kg=0.5)),
        (" +500 g ", Condition("+0.5kg", added_kg=0.5)),
        ("+.5kg", Condition("+0.5kg", added_kg=0.5)),
        ("z=150", Condition("z=150", (("z", 150.0),))),
        ("z=150.0", Condition("z=150", (("z", 150.0),))),
        ("y=100, x=-50.5", Condition("x=-50.5,y=100", (("x", -50.5), ("y", 100.0)))),
        ("run 2", Condition("run 2")),
    ],
)
def test_what_is_read(text: str, expected: Condition) -> None:
    assert Condition.parse(text) == expected


@pytest.mark.parametrize(
    "text", ["0.5kg", "+0kg", "+0.5", "+-1kg", "+1lb", "z=", "z=1e3", "a=1", "x=1;y=2", "z=1,z=2"]
)
def test_what_is_refused(text: str) -> None:
    with pytest.raises(ModelError, match="condition"):
        Condition.parse(text)


@given(st.floats(0.01, 50.0))
def test_grams_and_kilograms_are_the_same(kg: float) -> None:
    grams, kilograms = (Condition.parse(f"+{v:.3f}{u}") for v, u in ((1e3 * kg, "g"), (kg, "kg")))
    assert grams.added_kg == pytest.approx(kg, abs=1e-6)
    assert kilograms.added_kg == pytest.approx(kg, abs=6e-4)


@given(st.text(max_size=20))
def test_any_text_is_read_or_refused(text: str) -> None:
    try:
        found = Condition.parse(text)
    except ModelError:
        return
    # What was read is written so that it is read again.
    assert Condition.parse(found.label).label == found.label
