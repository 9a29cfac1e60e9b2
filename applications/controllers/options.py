"""Options of add-on controllers: one document per method, discriminated by `method`.

The limits keep a design within seconds: a request of the service must not compute for minutes.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Discriminator, Field, Tag, TypeAdapter, ValidationError

from stillpath.compensation.base import DesignError
from stillpath.models.complaints import complaint
from stillpath.models.disturbances import DisturbanceSpec
from stillpath.models.document import Document
from stillpath.models.loops import LoopSpec, load_loop

__all__ = [
    "METHODS",
    "AdaptiveOptions",
    "ControllerOptions",
    "DobOptions",
    "FmsdobOptions",
    "InverseDobOptions",
    "LoopReference",
    "MmpOptions",
    "MultirateOptions",
    "QuasiOptions",
    "WideOptions",
    "builtin_loop",
    "read_options",
    "resolved",
]

Frequency = Annotated[float, Field(ge=1e-3, le=1e6, allow_inf_nan=False)]
Targets = Annotated[tuple[Frequency, ...], Field(min_length=1, max_length=8)]
Widths = Annotated[
    Annotated[Frequency, Tag("one-width")] | Annotated[Targets, Tag("width-of-each")],
    Discriminator(lambda v: "width-of-each" if isinstance(v, list | tuple) else "one-width"),
]
Shape = Literal["pointwise", "hermite"]
LoopName = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9-]*$", max_length=64)]
LoopReference = LoopName | LoopSpec
"""A built-in closed-loop machine, or a whole one as a document; never a path."""


class _Options(Document):
    """What all methods share.

    Attributes
    ----------
    loop : LoopSpec, optional
        The machine itself, instead of a built-in one.
    uncertainty : float, optional
        Relative plant error that small gain must allow at every frequency. The members of the
        machine's plant set are checked in any case, exactly.
    disturbance : optional
        For the time response; left out, what the method is made for, of amplitude 1.
    enters : "output" or "input"
        Whether the disturbance adds to the plant's output or input. [default: of the method]
    duration_s : float, optional
        Of the time response; left out, until the slowest transient is gone.
    """

    loop: LoopSpec | None = None
    uncertainty: Annotated[float, Field(gt=0, le=10, allow_inf_nan=False)] | None = None
    disturbance: DisturbanceSpec | None = None
    enters: Literal["output", "input"] | None = None
    duration_s: Annotated[float, Field(gt=0, le=60, allow_inf_nan=False)] | None = None


class FmsdobOptions(_Options):
    """Forward-model selective disturbance observer (paper 000); `compensation.feedback.fmsdob`.

    Attributes
    ----------
    bandwidth_hz : float, sequence of float, or None
        -3 dB width of the band pass, one for all targets or one for each; None leaves it out.
    zeros : sequence of (radius, Hz)
        Fixed zeros of Q.
    """

    method: Literal["fmsdob"]
    targets_hz: Targets
    bandwidth_hz: Widths | None = 50.0
    shape: Shape = "pointwise"
    detuning: Annotated[float, Field(gt=0, le=1)] = 1.0
    zeros: Annotated[
        tuple[
            tuple[Annotated[float, Field(ge=0, le=2)], Annotated[float, Field(ge=0, le=1e6)]], ...
        ],
        Field(max_length=8),
    ] = ()
    through_band: bool = False
    around: Literal["servo", "plant"] = "servo"


class AdaptiveOptions(_Options):
    """The same with frequencies found while it runs; `compensation.feedback.adaptive`.

    Attributes
    ----------
    floor_rms : float
        Of the disturbance estimate, in the machine's unit; silence below.
    """

    method: Literal["fmsdob-adaptive"]
    tones: Annotated[int, Field(ge=1, le=3)] = 1
    bandwidth_hz: Frequency = 50.0
    floor_rms: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 1e-6


class InverseDobOptions(_Options):
    """Disturbance observer with a plant inverse at tones; `compensation.feedback.inverse_dob`."""

    method: Literal["inverse-dob"]
    targets_hz: Targets
    bandwidth_hz: Frequency = 50.0


class DobOptions(_Options):
    """Disturbance observer with delay, from dc on; `compensation.feedback.disturbance_observer`.

    Attributes
    ----------
    cutoff_hz : float
        1/(2 pi tau) of its filter.
    nominal : str or LoopSpec, optional
        Whose plant it assumes (an inertia with delay, say).
    """

    method: Literal["dob"]
    cutoff_hz: Frequency
    nominal: LoopReference | None = None


class MmpOptions(_Options):
    """Multirate predictor for tones beyond a slow sensor's Nyquist; `compensation.feedback.mmp`.

    Attributes
    ----------
    bandwidth_hz : float or sequence of float
        Width of each notch, one for all tones or one for each.
    alpha : float or None
        Pole radius of the predictor per slow sample; None: the fastest within `noise_gain`.
    noise_gain : float
        Largest multiplication of sensor noise that is accepted.
    """

    method: Literal["mmp"]
    targets_hz: Targets
    bandwidth_hz: Widths = 10.0
    alpha: Annotated[float, Field(ge=0, lt=1)] | None = 0.95
    shape: Shape = "pointwise"
    noise_gain: Annotated[float, Field(gt=0, le=100)] = 2.0


class _Repetitive(_Options):
    """What the repetitive methods share.

    Attributes
    ----------
    compared : "response" or "reference"
        Whether the error is the output less the loop's response to the reference, or less the
        reference itself; `compensation.feedback.repetitive.Compared`.
    """

    fundamental_hz: Frequency
    compared: Literal["response", "reference"] = "response"
    nyquist_pairs: Annotated[int, Field(ge=0, le=20)] = 3
    notches_hz: Annotated[tuple[Frequency, ...], Field(max_length=8)] = ()


class WideOptions(_Repetitive):
    """Repetitive, period rounded, notches widened; `compensation.feedback.repetitive`."""

    method: Literal["rc-wide"]
    alpha: Annotated[float, Field(gt=0, lt=1)] = 0.8


class QuasiOptions(_Repetitive):
    """Repetitive at the greatest common divisor; `compensation.feedback.repetitive`."""

    method: Literal["rc-quasi"]
    alpha: Annotated[float, Field(gt=0, lt=1)] = 0.999


class MultirateOptions(_Repetitive):
    """Repetitive at the least common multiple; `compensation.feedback.multirate`.

    Attributes
    ----------
    fast : str or LoopSpec
        The same machine, identified at the least common multiple of sampling rate and fundamental.
    """

    method: Literal["rc-multirate"]
    fast: LoopReference
    alpha: Annotated[float, Field(gt=0, lt=1)] = 0.999


ControllerOptions = Annotated[
    FmsdobOptions
    | AdaptiveOptions
    | InverseDobOptions
    | DobOptions
    | MmpOptions
    | WideOptions
    | QuasiOptions
    | MultirateOptions,
    Field(discriminator="method"),
]
METHODS = (
    "fmsdob",
    "fmsdob-adaptive",
    "inverse-dob",
    "dob",
    "mmp",
    "rc-wide",
    "rc-quasi",
    "rc-multirate",
)
_ADAPTER: TypeAdapter[ControllerOptions] = TypeAdapter(ControllerOptions)


def read_options(document: Mapping[str, Any]) -> ControllerOptions:
    """Return the options of a document.

    Raises
    ------
    DesignError
        Naming the field, the value and what is possible.
    """
    try:
        return _ADAPTER.validate_python(document)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        method = document.get("method")
        if first["type"].startswith("union_tag") and not first["loc"]:
            raise DesignError(
                f"unknown method {method!r}; there are {', '.join(METHODS)}"
            ) from None
        # Without the names of types, which a setting that may be one or another has in its place.
        parts = (str(part) for part in first["loc"][1:])
        where = ".".join(part for part in parts if re.fullmatch("[a-z0-9_]+", part))
        if first["type"] == "missing":
            raise DesignError(f"{method} needs {where}") from None
        if first["type"] == "extra_forbidden":
            raise DesignError(f"{method} has no setting {where}") from None
        said = complaint(first, repeat=first["type"] != "model_type")
        raise DesignError(f"{method}: {where}: {said}") from None


def resolved(name: str, options: ControllerOptions) -> LoopSpec:
    """Return the machine: the one in the options, or the built-in one of that name.

    Raises
    ------
    ModelError
        If there is none of that name.
    DesignError
        If the document in the options has another name.
    """
    if options.loop is None:
        return builtin_loop(name)
    if options.loop.name != name:
        raise DesignError(
            f"the machine asked for is {name!r}, the document's {options.loop.name!r}"
        )
    return options.loop


def builtin_loop(reference: LoopReference) -> LoopSpec:
    """Return a built-in machine by name, or the document itself.

    Raises
    ------
    ModelError
        If there is none of that name; names that look like paths are not followed.
    """
    if isinstance(reference, LoopSpec):
        return reference
    # What could be a path is turned into what can only be a name.
    return load_loop(re.sub(r"[^A-Za-z0-9-]", "?", reference))
