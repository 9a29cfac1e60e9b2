"""The result of every feedback design: coefficients, their blocks, and the expected performance.

A design passes its blocks (`models.diagrams`) and its add-on factor 1 - PQ to `judged`, which
predicts the loop with the add-on, checks every member of the plant set, and refuses unsafe
controllers. The blocks read ym, u, v, r of `models.loops` and write c.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from stillpath.compensation.base import DesignError
from stillpath.models.arrays import Array, Complex
from stillpath.models.diagrams import Block, Diagram
from stillpath.models.disturbances import SensorSpec
from stillpath.models.loops import Loop

__all__ = [
    "CoefficientSet",
    "Controller",
    "Design",
    "Extreme",
    "Prediction",
    "Refusal",
    "frequency_grid",
    "judged",
]

Values = float | int | tuple[float, ...] | tuple[tuple[float, ...], ...]
Uncertainty = float | Callable[[Array], Array]
"""Bound of the relative plant error |Delta(f)|: one number, or a function of the frequencies."""
_BEST_KNOWN = 1e-4
"""Least accepted bound: below it, rounding alone would decide whether a loop is stable."""
_NARROWER = "lower bandwidth_hz, drop the target where the plant is least known"
_QUIETER = "raise nyquist_pairs, name in notches_hz where the plant is least known"
_REMEDIES = {
    "fmsdob": f"lower detuning, {_NARROWER}",
    "inverse-dob": _NARROWER,
    "mmp": _NARROWER,
    "dob": "lower cutoff_hz",
    "rc-wide": f"raise alpha, {_QUIETER}",
    "rc-quasi": _QUIETER,
    "rc-multirate": _QUIETER,
}
"""What to change in the settings of a method whose loop would be unstable, or too near to it."""


class Refusal(DesignError):
    """A controller that must not be loaded.

    Attributes
    ----------
    reason : str
    f_hz : float or None
        Frequency of the violation.
    """

    def __init__(
        self,
        reason: Literal["small gain", "unstable", "singular", "inverse"],
        message: str,
        f_hz: float | None = None,
    ) -> None:
        super().__init__(message)
        self.reason = reason
        self.f_hz = f_hz


@dataclass(frozen=True, slots=True)
class CoefficientSet:
    """Named numbers of one part of a controller.

    Attributes
    ----------
    name : str
        A C identifier.
    kind : str
        "fir" (taps of z^0, z^-1, ...), "sos" (rows b0 b1 b2 1 a1 a2), "lattice" (k1, k2 of each
        section), "iir" (num, den in rising powers of z^-1), "predictor", "repetitive".
    values : mapping of str to numbers
    """

    name: str
    kind: Literal["fir", "sos", "lattice", "iir", "predictor", "repetitive"]
    values: Mapping[str, Values]


@dataclass(frozen=True, slots=True)
class Extreme:
    """The extreme of a curve and where it lies."""

    value: float
    f_hz: float

    @property
    def db(self) -> float:
        """The value in dB."""
        return 20 * math.log10(max(self.value, 1e-300))


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Frequency responses of the nominal loop, all of shape (n,).

    Attributes
    ----------
    f_hz : ndarray
    s0, s : ndarray of complex
        Sensitivity (d_out to y) without and with the add-on.
    add_on : ndarray of complex
        1 - PQ; s = s0 * add_on.
    """

    f_hz: Array
    s0: Complex
    add_on: Complex

    @property
    def s(self) -> Complex:
        """Sensitivity with the add-on."""
        return self.s0 * self.add_on

    @property
    def t(self) -> Complex:
        """Complementary sensitivity with the add-on."""
        return 1.0 - self.s

    @property
    def min_inverse_t(self) -> Extreme:
        """Smallest 1/|T|: the relative plant error that small gain allows at all frequencies."""
        i = int(np.argmax(np.abs(self.t)))
        return Extreme(1.0 / float(np.abs(self.t[i])), float(self.f_hz[i]))

    @property
    def max_add_on(self) -> Extreme:
        """Largest |1 - PQ|: the amplification elsewhere that the notches cost."""
        i = int(np.argmax(np.abs(self.add_on)))
        return Extreme(float(np.abs(self.add_on[i])), float(self.f_hz[i]))


@dataclass(frozen=True, slots=True, eq=False)
class Controller:
    """A designed add-on that passed all checks.

    Attributes
    ----------
    dt_s : float
        Sampling time of the blocks.
    blocks : tuple of Block
        The controller as difference equations, which `simulation.closed_loop` can run.
    noise_gain : float
        rms of y per rms of white sensor noise, unless `notes` says otherwise.
    spectral_radii : tuple of float
        Of the whole loop, for the nominal plant and every member; all below 1.
    settings : mapping
        The requested design (targets, widths, ...), for the record.
    """

    method: str
    machine: str
    dt_s: float
    coefficients: tuple[CoefficientSet, ...]
    blocks: tuple[Block, ...]
    prediction: Prediction
    noise_gain: float
    spectral_radii: tuple[float, ...]
    settings: Mapping[str, object]
    notes: tuple[str, ...] = ()

    @property
    def multiplications(self) -> float:
        """Multiplications per tick: the real-time budget."""
        return sum(b.multiplications for b in self.blocks)

    def to_dict(self, *, curves: bool = False) -> dict[str, object]:
        """Return everything as plain values; `curves` adds the sensitivities in dB."""
        p = self.prediction
        document: dict[str, object] = {
            "method": self.method,
            "machine": self.machine,
            "dt_s": self.dt_s,
            "settings": dict(self.settings),
            "coefficients": [
                {"name": c.name, "kind": c.kind, **dict(c.values)} for c in self.coefficients
            ],
            "difference_equations": [_equation(b) for b in self.blocks],
            "min_inverse_t_db": p.min_inverse_t.db,
            "min_inverse_t_at_hz": p.min_inverse_t.f_hz,
            "max_add_on_db": p.max_add_on.db,
            "max_add_on_at_hz": p.max_add_on.f_hz,
            "noise_gain": self.noise_gain,
            "multiplications_per_sample": self.multiplications,
            "spectral_radii": list(self.spectral_radii),
            "notes": list(self.notes),
        }
        if curves:
            document["f_hz"] = p.f_hz.tolist()
            document["sensitivity_before_db"] = _db(p.s0).tolist()
            document["sensitivity_db"] = _db(p.s).tolist()
            document["add_on_db"] = _db(p.add_on).tolist()
        return document

    def to_c_header(self) -> str:
        """Return the difference equations as a C header (C99, no dependency).

        Its comment has the equations in the order of computation, and names the constants that
        each of them uses: these are all that a controller needs.
        """
        guard = f"STILLPATH_{_identifier(self.method)}_{_identifier(self.machine)}_H".upper()
        prefix = _identifier(self.method).lower()
        ordered = Diagram(self.blocks).blocks
        lines = [
            f"/* {self.method} for {self.machine}: u = v - c, sampled every {self.dt_s!r} s.",
            " * r reference, ym measured output, v control without add-on, u plant input.",
            " * Constants are in rising powers of z^-1; den[0] divides the others.",
            *(f" *   {_c_comment(b, prefix)}" for b in ordered),
            " */",
            f"#ifndef {guard}",
            f"#define {guard}",
            "",
        ]
        for block in ordered:
            lines += [
                f"static const double {name}[{len(values)}] = "
                f"{{{', '.join(repr(float(v)) for v in values)}}};"
                for name, values in _c_constants(block, prefix).items()
            ]
        return "\n".join([*lines, "", f"#endif /* {guard} */", ""])


@dataclass(frozen=True, slots=True, eq=False)
class Design:
    """An add-on before it is checked; for its method there must be a remedy in `_REMEDIES`.

    Attributes
    ----------
    noise_gain : float, optional
        Default: the rms of T over frequency.
    every : int
        Block samples per sample of the loop.
    sensor : SensorSpec, optional
        Additional sensor of the add-on.
    """

    method: str
    blocks: tuple[Block, ...]
    prediction: Prediction
    coefficients: tuple[CoefficientSet, ...]
    settings: Mapping[str, object]
    notes: tuple[str, ...] = ()
    noise_gain: float | None = None
    every: int = 1
    sensor: SensorSpec | None = None


def judged(
    design: Design, loops: Sequence[Loop], uncertainty: Uncertainty | None = None
) -> Controller:
    """Return the controller if it passes all checks.

    Parameters
    ----------
    loops : sequence of Loop
        The nominal loop, then the members of its plant set.
    uncertainty : float or function of f_hz, optional
        Relative plant error to tolerate at every frequency (small gain; sufficient, not necessary),
        at least 1e-4. The members are always checked exactly.

    Raises
    ------
    Refusal
        If the loop with the add-on is unstable for a member, or |Delta| >= 1/|T| somewhere.
    """
    method, prediction = design.method, design.prediction
    _check_small_gain(method, prediction, uncertainty)
    radii = []
    for loop in loops:
        whole = Diagram((*loop.blocks(every=design.every, sensor=design.sensor), *design.blocks))
        radius = whole.spectral_radius()
        if radius >= 1.0 - 1e-12:
            raise Refusal(
                "unstable",
                f"{method} on {loop.name!r}: not internally stable, largest |z| = {radius:.8f}; "
                f"{_REMEDIES[method]}, or identify it better",
            )
        radii.append(radius)
    noise_gain = design.noise_gain
    if noise_gain is None:
        f = prediction.f_hz
        power = np.trapezoid(np.abs(prediction.t) ** 2, f) / (f[-1] - f[0])
        noise_gain = math.sqrt(float(power))
    nominal = loops[0]
    return Controller(
        method,
        nominal.name,
        float(nominal.dt_s) / design.every,
        design.coefficients,
        design.blocks,
        prediction,
        noise_gain,
        tuple(radii),
        dict(design.settings),
        (*nominal.notes, *design.notes),
    )


def frequency_grid(
    dt_s: float, targets_hz: Sequence[float] = (), widths_hz: Sequence[float] = ()
) -> Array:
    """Return frequencies from above 0 to half the sampling rate, dense around the targets."""
    top = 0.5 / dt_s
    coarse = np.linspace(0, top, 4097)
    near = [
        f + np.concatenate([-offsets[::-1], [0.0], offsets])
        for f, width in zip(targets_hz, widths_hz, strict=True)
        for offsets in (width * np.geomspace(1e-4, 30, 200),)
    ]
    grid = np.unique(np.concatenate([coarse, *near]))
    lowest = min([top / 8192, *(0.5 * f for f in targets_hz)])
    return grid[(grid >= lowest) & (grid <= top)]


def _check_small_gain(method: str, prediction: Prediction, uncertainty: Uncertainty | None) -> None:
    f, t = prediction.f_hz, np.abs(prediction.t)
    given = uncertainty(f) if callable(uncertainty) else np.full(len(f), uncertainty or 0.0)
    bound = np.maximum(np.abs(given), _BEST_KNOWN)
    product = bound * t
    if not np.all(np.isfinite(product)):
        at = float(f[np.argmin(np.isfinite(product))])
        raise Refusal(
            "small gain", f"{method}: no finite prediction or plant error at {at:.5g} Hz", at
        )
    worst = int(np.argmax(product))
    if product[worst] >= 1.0:
        off = "is never known better than" if bound[worst] == _BEST_KNOWN else "may be off by"
        raise Refusal(
            "small gain",
            f"{method}: the plant {off} {bound[worst]:.3g}, at {f[worst]:.5g} Hz the "
            f"loop allows 1/|T| = {1 / t[worst]:.3g}; "
            f"{_REMEDIES[method]}, or identify the plant better",
            float(f[worst]),
        )


def _db(response: Complex) -> Array:
    return 20 * np.log10(np.maximum(np.abs(response), 1e-15))


def _equation(block: Block) -> dict[str, object]:
    return {
        "output": block.output,
        "inputs": [list(wire) for wire in block.inputs],
        "num": list(block.num),
        "den": list(block.den),
        "delay": block.delay,
        "every": block.every,
        "phase": block.phase,
        "zero_between": block.zero_between,
    }


def _c_comment(block: Block, prefix: str) -> str:
    """Describe a block: output = num/den (sum of signals), and when it runs."""
    wires = " ".join(f"{gain:+.17g} {name}" for name, gain in block.inputs)
    through = "/".join(_c_constants(block, prefix))
    late = f", {block.delay} runs late" if block.delay else ""
    between = ", 0 at the others" if block.zero_between else ""
    when = f", at n mod {block.every} = {block.phase}{between}" if block.every > 1 else ""
    return f"{block.output} = {f'{through} ' if through else ''}({wires}){late}{when}"


def _c_constants(block: Block, prefix: str) -> dict[str, tuple[float, ...]]:
    """Return the polynomials of a block by the names of their constants; none where it is 1."""
    turn = f"_{block.phase}" if block.phase else ""
    parts = {"num": block.num, "den": block.den}
    return {
        f"{prefix}_{block.output}{turn}_{part}": values
        for part, values in parts.items()
        if (block.num, block.den) != ((1.0,), (1.0,))
    }


def _identifier(text: str) -> str:
    return "".join(ch if ch.isalnum() and ch.isascii() else "_" for ch in text)
