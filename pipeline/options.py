"""The options of a compensation job."""

from __future__ import annotations

import hashlib
import re
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    model_serializer,
    model_validator,
)

from stillpath.compensation.defaults import DEFAULT_BASIS, DEFAULT_METHOD
from stillpath.compensation.registry import COMPENSATORS
from stillpath.models.machine import Machine
from stillpath.version import __version__

__all__ = [
    "COARSE_UM",
    "LEAST_BUDGET_UM",
    "BasisName",
    "BudgetUm",
    "DialectName",
    "MaxMb",
    "MethodName",
    "Options",
    "RobustMode",
    "Where",
    "stamp",
    "unused",
]


_LATER = {"budget_um": None, "where": "all", "max_mb": None, "compare_live": False}

_PLAIN = (*COMPENSATORS, "none")
_AS_SLICED = {
    "advise": "leaves every move as it is",
    "live": "prints the file as sliced",
    "none": "writes the file as sliced",
}
"""Methods that do not compensate moves in the file, and what they do instead."""
_METHOD = rf"^(advise|live|({'|'.join(_PLAIN)})(\+ripple)?)$"


def _known(method: str) -> str:
    if re.fullmatch(_METHOD, method) is None:
        raise ValueError(
            f"unknown method; choose {', '.join(_PLAIN)}, each also with +ripple appended, "
            "advise, or live"
        )
    return method


MethodName = Annotated[str, AfterValidator(_known), Field(json_schema_extra={"pattern": _METHOD})]
BasisName = Literal["ce-opt", "robust", "bspline", "dct"]
RobustMode = Literal["auto", "off", "ensemble", "minimax"]
DialectName = Literal["klipper", "marlin", "prusa", "bambu", "reprapfirmware"]
Where = Literal["all", "visible", "walls"]
MaxMb = Annotated[float, Field(gt=0, le=100_000, allow_inf_nan=False)]
COARSE_UM = 5.0
"""Tolerance from which segments add an error of their own that counts."""
LEAST_BUDGET_UM = 0.5
BudgetUm = Annotated[float, Field(ge=LEAST_BUDGET_UM, le=1000, allow_inf_nan=False)]


class Options(BaseModel):
    """Settings of one compensation job; the same settings give the same bytes.

    `plate` is no setting of the compensation, and `compare_live` only adds to the report.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    method: MethodName = Field(
        default=DEFAULT_METHOD,
        description="`fbf` (limited-preview filtered basis functions), `npz-ignore`, `zmetc`, "
        "`zpetc`, `ebzpetc`, `ts` (approximate inverses), `shaper:NAME` (zv, mzv, ei, 2hump_ei, "
        "3hump_ei) or `none`; with `+ripple` appended the machine's ripple is undone as well. "
        "`advise` leaves all moves as they are and adds firmware commands. `live` returns the "
        "file as it is, and predicts the compensation inside Klipper.",
    )
    basis: BasisName = Field(default=DEFAULT_BASIS, description="Basis functions of `fbf`.")
    robust: RobustMode = Field(
        default="auto",
        description="What `fbf` is designed for: all plants that explain the measurement, "
        "mixed with a shaper as far as these plants contradict each other (`auto`), the nominal "
        "plant (`off`), or the machine's plant set by least squares (`ensemble`) or for its worst "
        "member (`minimax`).",
    )
    along: float | None = Field(
        default=None,
        ge=0.01,
        le=1,
        allow_inf_nan=False,
        description="Weight of errors along the path against those across it, for `fbf`; "
        "less than the default, 1, takes longer.",
    )
    plate: int | None = Field(
        default=None, ge=1, le=10_000, description="Which plate of a 3MF package with several."
    )
    tolerance_um: float = Field(
        default=2.0,
        ge=0.5,
        le=50,
        allow_inf_nan=False,
        description="How far the written path may be from the computed one; less where the machine "
        "is known well.",
    )
    times: Literal["new", "kept"] = Field(
        default="new", description="Whether the slicer's times in the file follow the new motion."
    )
    dialect: DialectName | None = Field(
        default=None,
        description="How the file is read; by default as the machine's firmware reads it.",
    )
    budget_um: BudgetUm | None = Field(
        default=None,
        description="Contour error that every feature may have, rms of the worst plant of the "
        "machine's set: the print becomes as fast as that allows. By default it keeps its speeds.",
    )
    where: Where = Field(
        default="all",
        description="What is compensated: everything, what is `visible` (outer walls, top and "
        "bottom surfaces), or outer `walls`. The rest stays as sliced, and the file is smaller.",
    )
    max_mb: MaxMb | None = Field(
        default=None,
        description="The most that the G-code may have, in millions of bytes: what is visible is "
        "compensated, then less exactly (tolerances of 8, 12 and 16), then outer walls alone, "
        "until it fits.",
    )
    compare_live: bool = Field(
        default=False,
        description="Also predict the sliced file with the compensation inside Klipper; this "
        "plans the print a second time.",
    )

    @property
    def vibration(self) -> str:
        """The method without `+ripple`."""
        return self.method.removesuffix("+ripple")

    @property
    def paced(self) -> bool:
        """Whether the print gets new speeds."""
        return self.budget_um is not None and self.method != "none"

    @model_validator(mode="after")
    def _one_way(self) -> Options:
        if self.compare_live and self.method.split("+")[0] in ("advise", "live", "none"):
            raise ValueError(
                f"compare_live compares a compensated file: method {self.method} writes none; "
                "choose fbf, or leave compare_live off"
            )
        whole = (self.where, self.max_mb, self.budget_um) == ("all", None, None)
        if self.method == "live" and not whole:
            raise ValueError(
                "method live prints the file as sliced: it cannot be combined with where, max_mb "
                "and budget_um, which are settings of a written file"
            )
        if self.method in _AS_SLICED and self.where != "all":
            raise ValueError(
                f"method {self.method} {_AS_SLICED[self.method]}: it cannot be combined with "
                "where, which says what is compensated; choose fbf, or use where=all"
            )
        return self

    @model_validator(mode="after")
    def _one_selection(self) -> Options:
        if self.budget_um is not None and (self.where != "all" or self.max_mb is not None):
            raise ValueError(
                "budget_um makes the whole print faster: it cannot be combined with where and "
                "max_mb, which leave parts of it as sliced"
            )
        return self

    @model_serializer(mode="wrap")
    def _without_unused(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        # Stored digests must stay valid: newer options count only where they are used.
        values: dict[str, Any] = handler(self)
        for name, unused in _LATER.items():
            if values.get(name) == unused:
                values.pop(name, None)
        return values


def unused(options: Options) -> list[str]:
    """Return warnings about options that the method does not use."""
    method = options.method
    names = [] if options.vibration == "fbf" else ["basis", "robust", "along"]
    if method in _AS_SLICED:
        names.append("tolerance_um")
    if method == "none":
        names.append("budget_um")
    chosen = [n for n in names if getattr(options, n) != Options.model_fields[n].default]
    if not chosen:
        return []
    does = _AS_SLICED.get(method, "has no such settings")
    return [f"Without effect: {', '.join(chosen)}. The method {method} {does}."]


def stamp(machine: Machine, options: Options) -> str:
    """Return the stamp of a written file with its options; the same stamp, the same bytes."""
    chosen = options.model_dump_json(exclude={"plate", "compare_live"})
    settings = hashlib.sha256(chosen.encode()).hexdigest()[:8]
    return (
        f"{__version__} machine={machine.name} model={machine.revision} "
        f"method={options.method} settings={settings}"
    )
