"""The base class of all JSON documents, and the constrained number types in them."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

__all__ = ["Document", "Finite", "NonNegative", "Positive"]

_LEAST, _MOST = 1e-100, 1e100


def _size(number: float) -> float:
    """Refuse numbers whose squares, or times computed from them, would be 0 or infinite."""
    if not _LEAST <= number <= _MOST:
        raise ValueError(
            f"{number:g} is not a plausible size: give something between {_LEAST:g} and {_MOST:g}"
        )
    return number


Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False), AfterValidator(_size)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class Document(BaseModel):
    """A document or a part of one: unknown names are refused, and nothing changes afterwards."""

    model_config = ConfigDict(extra="forbid", frozen=True)
