"""Models fitted elsewhere: JSON of ours or of python-control's quantities, and MATLAB files."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from stillpath.models.errors import ModelError
from stillpath.models.identification.readers.matlab import matlab_variables
from stillpath.models.identification.readers.settings import ReadSettings
from stillpath.models.identification.readers.state_spaces import zeros_poles_gain
from stillpath.models.identification.types import PlantModel
from stillpath.models.plant_specs import PlantSpec, TfSpec
from stillpath.models.repair import printed_decimals, repair_rounded
from stillpath.models.roots import frequency_and_damping

__all__ = ["read_json_models", "read_matlab_models"]

_SPEC: TypeAdapter[PlantSpec] = TypeAdapter(PlantSpec)
_LARGEST_BYTES = 4_000_000
_MOST_NUMBERS = 600
_ALIASES = {
    "num": ("num", "numerator"),
    "den": ("den", "denominator"),
    "zeros": ("zeros", "z"),
    "poles": ("poles", "p"),
    "gain": ("gain", "k"),
    "dt": ("dt", "dt_s", "ts"),
}
_DELAYS = ("inputdelay", "outputdelay", "iodelay")
_FORMS = "num and den, zeros and poles (and gain), or A, B, C and D, with dt (Ts)"


def read_json_models(
    content: bytes, source: str, axis: str | None, settings: ReadSettings
) -> tuple[PlantModel, ...]:
    """Read one model, or an object with one model for each axis x and y.

    A model is a plant document of ours (`kind`), or an object with num/den, zeros/poles/gain
    or A/B/C/D, and dt. Complex numbers are [re, im], {"re", "im"} or "1+2j".

    Raises
    ------
    ModelError
        For anything that is not such a model, and for models that break a rule of plants:
        integrator, DC gain, stability, conjugates.
    """
    if len(content) > _LARGEST_BYTES:
        raise ModelError(f"{source}: over {_LARGEST_BYTES} bytes, not a model")
    try:
        document = json.loads(
            content.decode("utf-8-sig"),
            parse_float=_Printed,
            parse_int=_Printed,
            parse_constant=_no_constant,
        )
    except (ValueError, RecursionError) as error:
        raise ModelError(f"{source}: not a JSON model ({error!s:.120})") from None
    if not isinstance(document, dict):
        raise ModelError(f"{source}: a JSON model is an object with {_FORMS}")
    if document and set(document) <= {"x", "y"}:
        return tuple(_model(document[name], source, name, settings) for name in document)
    return (_model(document, source, axis, settings),)


def read_matlab_models(
    content: bytes, source: str, axis: str | None, settings: ReadSettings
) -> tuple[PlantModel, ...]:
    """Read the model in a file's variables, or one for each struct that holds a model.

    The names are num, den, Ts; z, p, k, Ts; or A, B, C, D, Ts. A struct called x or y gives
    the model of that axis.

    Raises
    ------
    ModelError
        As `read_json_models`, and for files of version 7.3.
    """
    variables = matlab_variables(content, source)
    if _form(variables):
        return (_model(variables, source, axis, settings),)
    structs = {name: v for name, v in variables.items() if isinstance(v, dict) and _form(v)}
    if not structs:
        raise ModelError(
            f"{source}: no model among the variables {', '.join(variables) or '(none)':.200}; "
            f"save {_FORMS}, as variables or fields of a struct. Of a tf object: "
            "[num, den] = tfdata(sys, 'v'); Ts = sys.Ts"
        )
    return tuple(
        _model(fields, f"{source}, {name}", name.lower() if name in "xyXY" else axis, settings)
        for name, fields in structs.items()
    )


class _Printed(float):
    """A number that remembers how it was written."""

    __slots__ = ("text",)
    text: str

    def __new__(cls, text: str) -> _Printed:
        number = super().__new__(cls, text)
        number.text = text
        return number


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a finite number")


def _model(fields: Any, source: str, axis: str | None, settings: ReadSettings) -> PlantModel:
    if not isinstance(fields, Mapping):
        raise ModelError(f"{source}: the model of axis {axis} is not an object with {_FORMS}")
    try:
        with np.errstate(over="raise", divide="raise", invalid="raise"):
            spec, notes = _specified(fields, settings)
    except ValidationError as error:
        raise ModelError(f"{source}: {_complaint(error)}") from None
    except ModelError as error:
        raise ModelError(f"{source}: {error}") from None
    except (ArithmeticError, np.linalg.LinAlgError):
        raise ModelError(
            f"{source}: the model's numbers are too large, too small or too close to singular to "
            "compute with; check units and powers of ten"
        ) from None
    return PlantModel(spec, axis, source, tuple(notes))


def _specified(fields: Mapping[str, Any], settings: ReadSettings) -> tuple[PlantSpec, list[str]]:
    document, notes = _document(fields, settings)
    if settings.dc_gain is not None:
        document = _divided(document, settings.dc_gain)
        notes.append(f"DC gain divided by the stated {settings.dc_gain:g} (steps per mm)")
    if settings.repair_rounding and document.get("kind") == "tf" and document.get("dt_s"):
        document, moved = _repaired(document)
        notes += moved
    spec = _SPEC.validate_python(_floats(document))
    return spec, [*notes, *spec.notes]


def _form(fields: Mapping[str, Any]) -> str:
    """Return which kind of model the fields make, "" for none."""
    names = {name.lower() for name in fields}
    if "kind" in fields:
        return str(fields["kind"])
    if all(names & set(_ALIASES[part]) for part in ("num", "den")):
        return "tf"
    if names & set(_ALIASES["poles"]) and names & {*_ALIASES["zeros"], *_ALIASES["gain"]}:
        return "zpk"
    return "ss" if {"a", "b", "c"} <= names else ""


def _document(
    fields: Mapping[str, Any], settings: ReadSettings
) -> tuple[dict[str, Any], list[str]]:
    """Convert the fields of any kind of model to a plant document."""
    form = _form(fields)
    if not form:
        raise ModelError(f"not a model: it has {', '.join(fields):.200}; it needs {_FORMS}")
    if form not in ("tf", "zpk", "ss"):
        return dict(fields), []
    lower = {name.lower(): value for name, value in fields.items()}
    delays = [name for name in _DELAYS if name in lower and np.any(_numbers(lower[name], name))]
    notes = [f"{name} is left out: a delay common to the axes does no harm" for name in delays]
    dt_s = _sampling_s(_field(lower, "dt"), settings)
    if form == "tf":
        return {
            "kind": "tf",
            "num": _polynomial(_field(lower, "num"), "num"),
            "den": _polynomial(_field(lower, "den"), "den"),
            "dt_s": dt_s,
        }, notes
    if form == "zpk":
        gain = _field(lower, "gain")
        return {
            "kind": "zpk",
            "zeros": _roots(_field(lower, "zeros"), "zeros"),
            "poles": _roots(_field(lower, "poles"), "poles"),
            "gain": None if gain is None else _one(gain, "gain"),
            "dt_s": dt_s,
        }, notes
    return _from_matrices(lower, dt_s), notes


def _field(lower: Mapping[str, Any], part: str) -> Any:
    return next((lower[name] for name in _ALIASES[part] if name in lower), None)


def _sampling_s(given: Any, settings: ReadSettings) -> float | None:
    """Return the sampling time, None for continuous.

    True in python-control and -1 in MATLAB are discrete models that do not say theirs.
    """
    if given is None:
        return settings.sampling_s
    value = (-1.0 if given else 0.0) if isinstance(given, bool) else _one(given, "dt")
    if value >= 0:
        return value or None
    if settings.sampling_s is None:
        raise ModelError(
            f"the model is discrete but does not say its sampling time (dt = {given}); "
            "give sampling_s"
        )
    return settings.sampling_s


def _polynomial(given: Any, name: str) -> list[float]:
    """Return coefficients, highest power first; a 1 x 1 system's nesting is taken off."""
    inner = given
    while isinstance(inner, (list, tuple)) and len(inner) == 1 and isinstance(inner[0], list):
        inner = inner[0]
    if isinstance(inner, list) and inner and all(isinstance(c, _Printed) for c in inner):
        return _few(inner, name)
    values = _numbers(inner, name)
    if values.size == 0:
        raise ModelError(f"{name} has no coefficients")
    if np.any(values.imag):
        raise ModelError(f"{name} has complex coefficients; they must be real")
    if values.ndim > 1 and sum(size > 1 for size in values.shape) > 1:
        raise ModelError(f"{name} has shape {values.shape}; one input and one output are needed")
    return _few([float(c) for c in values.real.reshape(-1)], name)


def _roots(given: Any, name: str) -> list[tuple[float, float]]:
    values = _numbers([] if given is None else given, name).reshape(-1)
    return _few([(float(r.real), float(r.imag)) for r in values], name)


def _few(values: list[Any], name: str) -> list[Any]:
    if len(values) > _MOST_NUMBERS:
        raise ModelError(f"{name} has {len(values)} entries, at most {_MOST_NUMBERS} are read")
    return values


def _one(given: Any, name: str) -> float:
    values = _numbers(given, name)
    if values.size != 1 or values.reshape(-1)[0].imag:
        raise ModelError(f"{name} must be one real number")
    return float(values.reshape(-1)[0].real)


def _numbers(given: Any, name: str) -> NDArray[np.complex128]:
    """Return an array of finite complex numbers from JSON or MATLAB values."""
    try:
        if isinstance(given, (list, tuple)):
            values = np.array([_complex(v) for v in given], np.complex128)
        else:
            values = np.asarray(_complex(given), np.complex128)
    except (TypeError, ValueError, KeyError, OverflowError):
        raise ModelError(f"{name} is {str(given)!r:.80}, which is not made of numbers") from None
    if not np.isfinite(values).all():
        raise ModelError(f"{name} has entries that are not finite")
    return values


def _complex(given: Any) -> Any:
    if isinstance(given, str):
        return complex(given.replace(" ", "").replace("i", "j"))
    if isinstance(given, dict):
        short = {"real": "re", "imag": "im"}
        parts = {short.get(name, name): float(value) for name, value in given.items()}
        return complex(parts["re"], parts.get("im", 0.0))
    if isinstance(given, list) and len(given) == 2:
        return complex(float(given[0]), float(given[1]))
    if isinstance(given, (list, dict, type(None), bool)):
        raise TypeError
    return given


def _from_matrices(lower: Mapping[str, Any], dt_s: float | None) -> dict[str, Any]:
    b, c = (_matrix(lower[name], name.upper()).reshape(-1) for name in ("b", "c"))
    d = _matrix(lower.get("d", 0.0), "D").reshape(-1)
    if len(d) != 1:
        raise ModelError(f"D has {len(d)} entries; one input and one output are needed")
    zeros, poles, gain = zeros_poles_gain(_matrix(lower["a"], "A"), b, c, float(d[0]), dt_s)
    return {
        "kind": "zpk",
        "zeros": [(float(z.real), float(z.imag)) for z in zeros],
        "poles": [(float(p.real), float(p.imag)) for p in poles],
        "gain": gain,
        "dt_s": dt_s,
    }


def _matrix(given: Any, name: str) -> NDArray[np.float64]:
    rows = given if isinstance(given, list) and given and isinstance(given[0], list) else [given]
    try:
        values = np.array(rows, dtype=np.float64)
    except (TypeError, ValueError):
        raise ModelError(f"{name} is not a matrix of real numbers") from None
    values = np.atleast_2d(np.squeeze(values))
    if values.ndim > 2 or values.size > _MOST_NUMBERS**2 or not np.isfinite(values).all():
        raise ModelError(f"{name} is not a finite matrix of at most {_MOST_NUMBERS} rows")
    return values


def _divided(document: dict[str, Any], gain: float) -> dict[str, Any]:
    """Return the document with its DC gain divided."""
    kind = document.get("kind")
    if kind == "tf":
        return {**document, "num": [float(c) / gain for c in document["num"]]}
    if kind == "fir":
        taps = _polynomial(document.get("taps"), "taps")
        return {**document, "taps": [float(c) / gain for c in taps]}
    if kind == "zpk" and document.get("gain") is not None:
        return {**document, "gain": document["gain"] / gain}
    raise ModelError(f"a model of kind {kind!r:.40} has no gain to divide; leave out dc_gain")


def _repaired(document: dict[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """Move the coefficients within their rounding so that the DC gain is 1; tell what moved."""
    num, den = document["num"], document["den"]
    texts = [[getattr(c, "text", repr(float(c))) for c in part] for part in (num, den)]
    decimals = [printed_decimals(part) for part in texts]
    new_num, new_den, moved = repair_rounded(num, den, decimals[0], decimals[1])
    if not moved.any():
        return document, []
    spec = TfSpec(num=tuple(new_num), den=tuple(new_den), dt_s=document["dt_s"])
    roots = spec.roots()
    changes = [
        f"{text} to {new:.9g}"
        for text, new, share in zip(texts[0] + texts[1], [*new_num, *new_den], moved, strict=True)
        if abs(share) > 0.5 * np.abs(moved).max()
    ]
    modes = ", ".join(
        f"{f:.3g} Hz damping {z:.2g}" for f, z in frequency_and_damping(roots.poles, roots.dt_s)
    )
    largest = np.abs(moved).max()
    what = (
        f"rounding repaired: the DC gain is 1 after moving coefficients by at most {largest:.0%} "
        f"of half their last decimal ({'; '.join(changes)})"
    )
    result = (
        f"poles after the repair: largest |z| {np.abs(roots.poles).max():.4f}; {modes}; do not "
        "trust the damping, it depends on decimals that were not printed"
    )
    return {**document, "num": spec.num, "den": spec.den}, [what, result]


def _floats(given: Any) -> Any:
    """Return the document with plain numbers."""
    if isinstance(given, float):
        return float(given)
    if isinstance(given, dict):
        return {name: _floats(value) for name, value in given.items()}
    if isinstance(given, (list, tuple)):
        return [_floats(value) for value in given]
    return given


def _complaint(error: ValidationError) -> str:
    """Tell the deepest complaint in one line, with the remedy for rounded coefficients."""
    first = max(error.errors(include_url=False), key=lambda c: len(c["loc"]))
    where = ".".join(str(part) for part in first["loc"][1:])
    message = first["msg"].removeprefix("Value error, ")
    text = f"{where}: {message}" if where else message
    if "integrator" in text and first["loc"][:1] == ("tf",):
        text += "; on reading, repair_rounding does this by the decimals printed in the file"
    if "DC gain" in text and "from 1" in text:
        text += "; if they are off by a known factor, give it as dc_gain"
    return text
