"""Closed-loop machines: a plant with its feedback, as documents and in computable form.

Polynomials are in rising powers of z^-1 throughout. An identified servo is written down as its
complementary sensitivity T0 = N/M, never as the open loop P = N/(M - N): of published models of
the latter, rounding had moved the integrator outside the unit circle.

Signals of the loop (see `Loop.blocks`): reference r, disturbances d_in (at the plant's input) and
d_out (at its output), sensor noise n, output y, measured output ym, control v, plant input u, and
c, which an add-on controller takes off the control: u = v - c.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, ValidationError

from stillpath.models.arrays import Complex
from stillpath.models.complaints import explain
from stillpath.models.diagrams import Block, polynomial_response
from stillpath.models.disturbances import SensorSpec
from stillpath.models.document import Document, Finite, Positive
from stillpath.models.errors import ModelError
from stillpath.models.user_files import as_json, names_a_file, read_bytes

__all__ = [
    "Loop",
    "LoopSpec",
    "PidLoop",
    "ServoLoop",
    "Variation",
    "builtin_loops",
    "load_loop",
    "read_loop",
]

Coefficients = tuple[float, ...]
Polynomial = Annotated[tuple[Finite, ...], Field(min_length=1, max_length=64)]
_LIBRARY = Path(__file__).parent / "library_loops"
_LARGEST_BYTES = 4_000_000


@dataclass(frozen=True, slots=True)
class Loop:
    """A plant and its baseline feedback v = C_e (r - ym) - C_y ym.

    Attributes
    ----------
    plant_num, plant_den : tuple of float
        P, strictly proper.
    error_num, error_den : tuple of float
        C_e, on the control error. 0: the output is not fed back, v = r.
    rate_num, rate_den : tuple of float
        C_y, on the measured output alone (velocity feedback).
    notes : tuple of str
        What was changed on reading.
    """

    plant_num: Coefficients
    plant_den: Coefficients
    dt_s: float
    error_num: Coefficients = (1.0,)
    error_den: Coefficients = (1.0,)
    rate_num: Coefficients = (0.0,)
    rate_den: Coefficients = (1.0,)
    name: str = "loop"
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        polynomials = (self.plant_num, self.plant_den, self.error_num, self.error_den,
                       self.rate_num, self.rate_den)  # fmt: skip
        if not all(math.isfinite(c) for polynomial in polynomials for c in polynomial):
            raise ModelError(f"loop {self.name!r}: coefficients must be finite numbers")
        if not any(self.plant_num) or 0.0 in (
            self.plant_den[0], self.error_den[0], self.rate_den[0]
        ):  # fmt: skip
            raise ModelError(
                f"loop {self.name!r}: the plant is 0, or a denominator begins with 0 (what z^0 "
                "multiplies must not vanish)"
            )
        if self.plant_num[0] != 0.0:
            raise ModelError(
                f"loop {self.name!r}: the plant answers within the sample (num[0] = "
                f"{self.plant_num[0]:g}); a sampled loop needs a strictly proper plant"
            )
        radius = _radius(self.t0_den)
        if radius >= 1.0:
            raise ModelError(
                f"loop {self.name!r}: the baseline loop is unstable, |z| = {radius:.6f}; "
                "give T0 with more decimals, or another controller"
            )

    @classmethod
    def from_t0(
        cls, num: Sequence[float], den: Sequence[float], dt_s: float, name: str = "loop"
    ) -> Loop:
        """Make the loop P = N/(M - N) with C = 1 of a complementary sensitivity N/M.

        A dc gain above 1 is scaled to 1: it would put the integrator of P outside the circle.

        Raises
        ------
        ModelError
            If N/M has no finite gain at standstill.
        """
        top, bottom = _aligned(num, den)
        if not (np.all(np.isfinite(top)) and np.all(np.isfinite(bottom)) and bottom.sum()):
            raise ModelError(
                f"loop {name!r}: T0 has no finite gain at standstill; its denominator must be that "
                "of a stable servo"
            )
        gain = float(top.sum() / bottom.sum())
        notes: tuple[str, ...] = ()
        if gain > 1.0:
            top = top / gain
            notes = (f"T0(1) = {gain:.5g} scaled to 1",)
        return cls(_tuple(top), _tuple(bottom - top), dt_s, name=name, notes=notes)

    @property
    def fed_back(self) -> bool:
        """Whether the output is fed back at all."""
        return any(self.controller[0])

    @property
    def controller(self) -> tuple[Coefficients, Coefficients]:
        """C = C_e + C_y, numerator and denominator."""
        return (
            _tuple(
                _sum(
                    np.convolve(self.error_num, self.rate_den),
                    np.convolve(self.rate_num, self.error_den),
                )
                if any(self.rate_num)
                else np.asarray(self.error_num, float)
            ),
            _tuple(np.convolve(self.error_den, self.rate_den)),
        )

    @property
    def t0_num(self) -> Coefficients:
        """Numerator of T0 = PC/(1 + PC)."""
        return _tuple(np.convolve(self.plant_num, self.controller[0]))

    @property
    def t0_den(self) -> Coefficients:
        """Denominator of T0 and S0: the characteristic polynomial of the baseline loop."""
        return _tuple(
            _sum(np.convolve(self.plant_den, self.controller[1]), np.asarray(self.t0_num))
        )

    @property
    def servo_num(self) -> Coefficients:
        """Numerator of P/(1 + PC), over `t0_den`: what the loop answers to -c. T0 if C = 1."""
        return _tuple(np.convolve(self.plant_num, self.controller[1]))

    @property
    def tracking_num(self) -> Coefficients:
        """Numerator of y/r, over `t0_den`."""
        if not self.fed_back:
            return self.servo_num
        return _tuple(np.convolve(np.convolve(self.plant_num, self.rate_den), self.error_num))

    @property
    def plant_radius(self) -> float:
        """Largest pole modulus of P; 1 for an integrator."""
        return _radius(self.plant_den)

    def z(self, f_hz: ArrayLike) -> Complex:
        """Return exp(2 pi j f dt)."""
        f = np.atleast_1d(np.asarray(f_hz, float))
        return np.asarray(np.exp(2j * np.pi * f * self.dt_s), complex)

    def plant(self, f_hz: ArrayLike) -> Complex:
        """Return P at `f_hz`."""
        return polynomial_response(self.plant_num, self.plant_den, self.z(f_hz))

    def t0(self, f_hz: ArrayLike) -> Complex:
        """Return T0 = PC/(1 + PC) at `f_hz`."""
        return polynomial_response(self.t0_num, self.t0_den, self.z(f_hz))

    def s0(self, f_hz: ArrayLike) -> Complex:
        """Return S0 = 1/(1 + PC) at `f_hz`, finite where P is not."""
        num = np.convolve(self.plant_den, self.controller[1])
        return polynomial_response(num, self.t0_den, self.z(f_hz))

    def servo(self, f_hz: ArrayLike) -> Complex:
        """Return P/(1 + PC) at `f_hz`."""
        return polynomial_response(self.servo_num, self.t0_den, self.z(f_hz))

    def tracking(self, f_hz: ArrayLike) -> Complex:
        """Return y/r at `f_hz`."""
        return polynomial_response(self.tracking_num, self.t0_den, self.z(f_hz))

    def varied(self, gain: float = 1.0, delay_samples: float = 0.0) -> Loop:
        """Return the loop with another plant gain and more delay, its controller unchanged.

        A fraction of a sample, in steps of .001, is a first-order all-pass (Thiran), exact at
        low frequency.
        """
        whole = math.floor(delay_samples)
        fraction = round(delay_samples - whole, 3)
        a = (1 - fraction) / (1 + fraction)
        allpass = ((a, 1.0), (1.0, a)) if fraction else ((1.0,), (1.0,))
        num = np.convolve(gain * np.asarray(self.plant_num), allpass[0])
        return replace(
            self,
            plant_num=(0.0,) * whole + _tuple(num),
            plant_den=_tuple(np.convolve(self.plant_den, allpass[1])),
            name=f"{self.name} (gain {gain:g}, delay {delay_samples:g})",
        )

    def blocks(
        self,
        *,
        every: int = 1,
        sensor: SensorSpec | None = None,
        input_limit: float = math.inf,
        friction: float = 0.0,
        friction_speed: float = 1.0,
    ) -> tuple[Block, ...]:
        """Return the loop as blocks.

        Parameters
        ----------
        every : int
            Ticks per sample of the loop, for add-ons that run faster than the plant is driven.
        sensor : SensorSpec, optional
            What the controller sees of y; nothing in between if None.
        input_limit : float
            Saturation of the plant input u.
        friction : float
            Coulomb friction, in units of u: opposes the velocity of the plant's output.
        friction_speed : float
            Output change per sample at which friction is fully developed.
        """
        s = sensor or SensorSpec()
        rubbing = friction / friction_speed
        error = (("r", 1.0), ("ym", -1.0)) if self.fed_back else (("r", 1.0),)
        servo = [
            Block(
                "p",
                (("u", 1.0), ("d_in", 1.0), ("f", -1.0)),
                self.plant_num,
                self.plant_den,
                every=every,
            ),
            Block("y", (("p", 1.0), ("d_out", 1.0)), every=every),
            Block("ym", (("y", 1.0), ("n", 1.0)), delay=s.delay_samples, every=every * s.every,
                  quantum=s.quantum),
            Block("ve", error, *self._on_error(), every=every),
            Block("v", (("ve", 1.0), ("vy", -1.0)), every=every),
            Block("u", (("v", 1.0), ("c", -1.0)), limit=input_limit, every=every),
        ]  # fmt: skip
        if any(self.rate_num):
            servo.append(Block("vy", (("ym", 1.0),), self.rate_num, self.rate_den, every=every))
        if friction:
            servo.append(Block("f", (("p", rubbing),), (1.0, -1.0), limit=friction, every=every))
        return tuple(servo)

    def _on_error(self) -> tuple[Coefficients, Coefficients]:
        return (self.error_num, self.error_den) if self.fed_back else ((1.0,), (1.0,))


class ServoLoop(Document):
    """An identified closed servo T0 = num/den, rising powers of z^-1.

    Attributes
    ----------
    disturbed : "inside" or "outside"
        Whether the servo's own sensor sees the disturbance ("outside": the optics behind a
        galvo's encoder). Outside, the servo is the plant of whatever is added.
    """

    kind: Literal["servo"] = "servo"
    num: Polynomial
    den: Polynomial
    dt_s: Positive
    disturbed: Literal["inside", "outside"] = "inside"

    def loop(self, name: str) -> Loop:
        """Return the loop."""
        if self.disturbed == "inside":
            return Loop.from_t0(self.num, self.den, self.dt_s, name)
        return Loop(self.num, self.den, self.dt_s, error_num=(0.0,), name=name)


class PidLoop(Document):
    """A plant with kp + ki dt/(1 - z^-1) and a filtered velocity.

    v = (kp + ki dt/(1 - z^-1)) (r - ym) - kv (1 - p)(1 - z^-1)/(1 - p z^-1) x, with
    p = exp(-2 pi velocity_corner_hz dt) and x = ym (velocity_from "output") or ym - r ("error").

    Attributes
    ----------
    plant_num, plant_den : tuple of float
        Rising powers of z^-1, without `delay_samples`.
    kv : float
        In units of u per change of y in a sample.
    """

    kind: Literal["pid"] = "pid"
    plant_num: Polynomial
    plant_den: Polynomial
    delay_samples: Annotated[int, Field(ge=0, le=64)] = 0
    dt_s: Positive
    kp: Finite
    ki: Finite = 0.0
    kv: Finite = 0.0
    velocity_corner_hz: Positive | None = None
    velocity_from: Literal["output", "error"] = "output"

    def loop(self, name: str) -> Loop:
        """Return the loop."""
        corner = self.velocity_corner_hz
        p = math.exp(-2 * math.pi * corner * self.dt_s) if corner else 0.0
        rate_num = (self.kv * (1 - p), -self.kv * (1 - p)) if self.kv else (0.0,)
        rate_den = (1.0, -p) if self.kv and p else (1.0,)
        error_num: Coefficients = (self.kp,)
        error_den: Coefficients = (1.0,)
        if self.ki:
            error_num, error_den = (self.kp + self.ki * self.dt_s, -self.kp), (1.0, -1.0)
        bare = Loop(
            (0.0,) * self.delay_samples + self.plant_num,
            self.plant_den,
            self.dt_s,
            error_num,
            error_den,
            rate_num,
            rate_den,
            name,
        )
        if self.velocity_from == "output":
            return bare
        num, den = bare.controller
        return replace(bare, error_num=num, error_den=den, rate_num=(0.0,), rate_den=(1.0,))


class Variation(Document):
    """A member of the plant set: gain and delay of the plant changed."""

    gain: Positive = 1.0
    delay_samples: Annotated[float, Field(ge=0, le=64, allow_inf_nan=False)] = 0.0


class LoopSpec(Document):
    """A closed-loop machine as a document.

    Attributes
    ----------
    title, source : str
        What it is, and the paper and equation it comes from.
    unit : str
        Of the output.
    members : tuple of Variation
        What the plant may turn into.
    sensor : SensorSpec, optional
        A sensor apart from the servo's own (a camera); what an add-on sees.
    """

    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9-]*$", max_length=64)]
    title: str
    source: str = ""
    unit: str = ""
    loop: Annotated[ServoLoop | PidLoop, Field(discriminator="kind")]
    members: Annotated[tuple[Variation, ...], Field(max_length=64)] = ()
    sensor: SensorSpec | None = None

    def nominal(self) -> Loop:
        """Return the nominal loop.

        Raises
        ------
        ModelError
            If it is unstable or not strictly proper.
        """
        return self.loop.loop(self.name)

    def loops(self) -> tuple[Loop, ...]:
        """Return the nominal loop and its members.

        Raises
        ------
        ModelError
            If the baseline is unstable on one of them.
        """
        nominal = self.nominal()
        return (nominal, *(nominal.varied(m.gain, m.delay_samples) for m in self.members))


def builtin_loops() -> list[str]:
    """Return the names of the built-in closed-loop machines, sorted."""
    return sorted(path.stem for path in _LIBRARY.glob("*.json"))


def load_loop(name_or_path: str | Path) -> LoopSpec:
    """Load a built-in closed-loop machine by name, or one from a JSON file.

    Whatever ends in `.json` or holds a slash is a path, all else a name.

    Raises
    ------
    ModelError
        If there is none, or the document is not valid.
    """
    text = str(name_or_path)
    if isinstance(name_or_path, Path) or names_a_file(text):
        path = Path(name_or_path)
    elif text in builtin_loops():
        path = _LIBRARY / f"{text}.json"
    else:
        raise ModelError(
            f"no closed-loop machine is called {text!r}; built in are "
            f"{', '.join(builtin_loops())}; a file of your own is given by its path"
        )
    return read_loop(read_bytes(path, _LARGEST_BYTES, "not a closed-loop machine"), str(path))


def read_loop(document: str | bytes, source: str = "loop") -> LoopSpec:
    """Read a closed-loop machine from its JSON text; `source` names it in messages.

    Raises
    ------
    ModelError
        Naming the field that is wrong.
    """
    parsed = as_json(document.encode() if isinstance(document, str) else document, source)
    try:
        spec = LoopSpec.model_validate(parsed)
    except ValidationError as error:
        raise ModelError(f"{source}: {explain(error)}") from None
    spec.loops()
    return spec


def _aligned(
    num: Sequence[float], den: Sequence[float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return both polynomials of one length."""
    length = max(len(num), len(den))
    return (
        np.pad(np.asarray(num, float), (0, length - len(num))),
        np.pad(np.asarray(den, float), (0, length - len(den))),
    )


def _sum(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    left, right = _aligned(a.tolist(), b.tolist())
    return left + right


def _tuple(values: NDArray[np.float64]) -> Coefficients:
    return tuple(float(v) for v in values)


def _radius(den: Coefficients) -> float:
    roots = np.roots(np.asarray(den, float))
    return float(np.abs(roots).max()) if len(roots) else 0.0
