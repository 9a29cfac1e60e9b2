"""What is said of wrong values: what they must be, and what they were."""

from __future__ import annotations

from datetime import date
from typing import Annotated, Literal

import pytest
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from stillpath.models.complaints import complaint


class Example(BaseModel):
    model_config = ConfigDict(extra="forbid")

    budget_um: Annotated[float, Field(ge=0.5, le=1000, allow_inf_nan=False)] = 1.0
    accel_mm_s2: Annotated[float, Field(gt=0)] = 1.0
    speed_mm_s: Annotated[float, Field(lt=2)] = 1.0
    plate: int = 1
    on: bool = True
    basis: Literal["ce-opt", "robust", "dct"] = "dct"
    name: Annotated[str, Field(max_length=3)] = ""
    day: date = date(2026, 3, 2)
    word: str = ""

    @field_validator("word")
    @classmethod
    def _word(cls, word: str) -> str:
        if word == "bad":
            raise ValueError("the word is bad")
        return word


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("budget_um", -1.0, "must be at least 0.5 µm (given: -1)"),
        ("budget_um", "-1", "must be at least 0.5 µm (given: '-1')"),
        ("budget_um", 1001, "must be at most 1000 µm (given: 1001)"),
        ("budget_um", float("nan"), "must be a finite number (given: nan)"),
        ("budget_um", "wide", "must be a number (given: 'wide')"),
        ("accel_mm_s2", 0, "must be more than 0 mm/s² (given: 0)"),
        ("speed_mm_s", 2, "must be less than 2 mm/s (given: 2)"),
        ("plate", "two", "must be a whole number (given: 'two')"),
        ("plate", 1.5, "must be a whole number (given: 1.5)"),
        ("on", "perhaps", "must be true or false (given: 'perhaps')"),
        ("basis", "foo", "must be ce-opt, robust or dct (given: 'foo')"),
        ("name", "x" * 90, "must have at most 3 characters (given: '" + "x" * 79 + "...)"),
        ("day", "monday", "must be a day like 2026-03-02 (given: 'monday')"),
        ("word", "bad", "the word is bad (given: 'bad')"),
        ("word", [1, 2], "must be text"),
        ("other", 1, "is not known here (given: 1)"),
    ],
)
def test_in_plain_words(field, value, said):
    with pytest.raises(ValidationError) as caught:
        Example(**{field: value})
    entry = caught.value.errors()[0]
    assert complaint(entry) == said
    assert complaint(entry, repeat=False) == said.partition(" (given")[0]


def test_what_is_missing_and_what_pydantic_says_of_the_rest():
    assert complaint({"type": "missing", "msg": "Field required", "input": {}}) == "is missing"
    entry = {"type": "url_type", "msg": "URL input should be a string", "input": 3}
    assert complaint(entry) == "URL input should be a string (given: 3)"
    entry = {"type": "bytes_type", "msg": "Input should be a valid bytes", "input": 3}
    assert complaint(entry) == "must be a valid bytes (given: 3)"
