"""The base of everything that is read from a JSON document, and the kinds of numbers in it."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

__all__ = ["Document", "Finite", "NonNegative", "Positive"]

_LEAST, _MOST = 1e-100, 1e100


def _computable(number: float) -> float:
    """Refuse what is nothing that exists: its square would be 0 or infinite."""
    if number and not _LEAST <= abs(number) <= _MOST:
        raise ValueError(
            f"{number:g} is no size of anything: give 0 or something between {_LEAST:g} and "
            f"{_MOST:g}, as far as the field allows it"
        )
    return number


_Computable = AfterValidator(_computable)

Finite = Annotated[float, Field(allow_inf_nan=False), _Computable]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False), _Computable]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False), _Computable]


class Document(BaseModel):
    """A document or a part of one: unknown names are refused, and nothing changes afterwards."""

    model_config = ConfigDict(extra="forbid", frozen=True)
