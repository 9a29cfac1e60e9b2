"""Limited preview beside full preview: agreement, boundedness over a long run, cost, acceptance.

Full preview is the same problem with a single window over the whole path: the command's increments
v = Psi c minimise |y_d - G_a v|^2 + price |v|^2, where G_a is the plant with two integrators in
front, from rest, the path standing at its end. Psi has as many functions per sample:

- CE-Opt: the right singular vectors of G_a with the largest singular values, so the command is the
  truncated singular value decomposition. As a function of G_a'G_a it needs no singular vectors:
  with x^2q / (x^2q + s^4q) in place of the step at x = s^2 it is a sum over the poles, each term a
  banded system (`full_ce_opt`). q = 32 blurs the edge by 1 % of the functions. s follows from the
  frequency response: the same share of all frequencies has more gain.
- B-splines: clamped at both ends, with the spacing of the windows' knots, which fall on the same
  samples: windows of 301, the last one being the first of the next but one. One sparse system
  (`full_bsplines`).

Both hold for the fraction b(q) / a(q) of the plant: with v = (1 - q^-1)^2 a w the output is b w, so
that all matrices are banded, whatever the length.

Error and difference are those of the plant's answers, rms over the path, both axes together, the
difference as a share of the tracking error in full preview. A limited preview whose error is the
smaller one passes. CPU times are the best of several, one
thread, compilation apart.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.sparse import block_array, csc_array, diags_array
from scipy.sparse.linalg import splu
from scipy.special import expit

from stillpath.compensation._preview_kernels import run_windows
from stillpath.compensation.base import DesignError
from stillpath.compensation.basis import BASES
from stillpath.compensation.fbf import PreviewFbf
from stillpath.compensation.lifted_window import lifted_window
from stillpath.compensation.preview import PreviewDesign
from stillpath.models.arrays import Array
from stillpath.models.plants import DiscretePlant, Mode, ModesSpec, discretise, plant_set
from stillpath.models.reference_motion import reference_motion
from stillpath.models.store import builtin_machines, load_machine
from stillpath.simulation.measures import contour_error, tracking_error
from stillpath.simulation.response import response

__all__ = [
    "CASES",
    "Case",
    "Comparison",
    "Deviations",
    "answer",
    "compare",
    "deviations",
    "full_bsplines",
    "full_ce_opt",
    "limited",
    "long_path",
    "nine_members",
    "one_mode",
    "taz",
]

DT_S = 1e-3
SHARPNESS = 32
"""q of `full_ce_opt`."""


class Case(NamedTuple):
    """A design in limited preview; half of each window is committed."""

    basis: str
    n: int
    window: int
    price: float

    def __str__(self) -> str:
        return f"{self.basis} {self.n} of {self.window}, price {self.price:g}"

    @property
    def update(self) -> int:
        """Samples from window to window."""
        return self.window // 2

    def design(self, plants: Sequence[DiscretePlant]) -> PreviewDesign:
        """Return the design for a set of plants of equal weights."""
        weights = np.full(len(plants), 1.0 / len(plants))
        lifted = lifted_window(plants, weights, self.window, self.update)
        return PreviewDesign(lifted, self.n, self.basis, self.price)


SHARP, PRODUCT = Case("ce-opt", 60, 300, 0.0), Case("ce-opt", 90, 300, 0.03)
PRICED, LONG = Case("ce-opt", 90, 300, 0.3), Case("ce-opt", 360, 1200, 0.03)
SPLINES = Case("bspline", 93, 301, 0.03)
CASES = (SHARP, PRODUCT, PRICED, LONG, SPLINES)
"""The cut-off alone; the first and the third rung of the product's ladder; the first with four
times the window; splines of its density and price."""


class Row(NamedTuple):
    """A line of the table; `good` is None where nothing is required."""

    quantity: str
    required: str
    ours: str
    good: bool | None


# Plants and paths


def one_mode(f_hz: float = 45.0, zeta: float = 0.05) -> DiscretePlant:
    """Return a plant of one mode."""
    return discretise(ModesSpec(modes=(Mode(f_hz=f_hz, zeta=zeta),)), DT_S)


def nine_members() -> list[DiscretePlant]:
    """Return the set of 45 Hz +-8 %."""
    return [one_mode(f_hz) for f_hz in np.linspace(0.92 * 45, 1.08 * 45, 9)]


def taz() -> DiscretePlant:
    """Return the x axis of the Taz 6, which is not minimum-phase."""
    return plant_set(load_machine("taz6-x").axes["x"], DT_S).nominal


def long_path(seconds: float) -> Array:
    """Return squares, zigzags and circles, shape (2, n), from the origin; the end is a stand.

    The reference motion backwards (its fast figures first), forwards, backwards and so on, up to
    the last rest in time.
    """
    samples = round(seconds / DT_S)
    there = reference_motion(DT_S)[0]
    both = np.hstack([there[:, ::-1], there])
    whole = np.hstack([both] * (samples // both.shape[1] + 1))
    standing = np.flatnonzero(np.all(np.diff(whole) == 0, axis=0))
    end = int(standing[standing < samples][-1])
    cut = whole[:, : end + 1] - whole[:, :1]
    return np.pad(cut, [(0, 0), (0, samples - end - 1)], mode="edge")


# Limited preview


def limited(design: PreviewDesign, path: Array, z: Array | None = None) -> Array:
    """Return the command of one axis by the condensed recursion.

    Parameters
    ----------
    path : ndarray, shape (windows * update + window - update,)
        Planned positions, up to the end of the last window's preview.
    z : ndarray, shape (nz,), optional
        State, moved on in place; at rest at 0 by default.

    Returns
    -------
    ndarray, shape (windows * update,)
    """
    z = np.zeros(design.lifted.states) if z is None else z
    views = np.lib.stride_tricks.sliding_window_view(path, design.window)[:: design.update]
    commands = views @ design.path_gain.T
    states = np.hstack([commands @ design.lifted.drive.T, commands[:, :-3:-1]])
    u = np.empty(commands.size)
    gains = design.command_gain, design.state_gain
    run_windows(*gains, commands, states, z, 0, len(views), u)
    return u


# Full preview


def full_ce_opt(
    plant: DiscretePlant, path: Array, share: float, price: float, q: int = SHARPNESS
) -> Array:
    """Return the command of a whole path in its CE-Opt functions.

    With A = G_a'G_a, v = g(A) G_a'y_d and g(x) = x^2q / (x^2q + s^4q) / (x + price), the sum of its
    partial fractions. In the variable w (see `_fraction`) (A - x)^-1 G_a' is D (N'N - x D'D)^-1 N'.

    Parameters
    ----------
    path : ndarray, shape (axes, n)
    share : float
        Functions per sample.
    q : int
        Sharpness of the cut-off.
    """
    b, a = _fraction(plant)
    integrated = np.convolve(a, [1.0, -2.0, 1.0])
    samples = path.shape[1]
    numerator, denominator = _toeplitz(b, samples), _toeplitz(integrated, samples)
    nn, dd = numerator.T @ numerator, denominator.T @ denominator
    seen = numerator.T @ path.T
    squared = _cut_off(b, integrated, share) ** 2
    turns = np.exp(1j * np.pi * (np.arange(q) + 0.5) / q)
    w = np.zeros(seen.shape)
    for pole in squared * turns:
        residue = pole / (2 * q * (pole + price))
        w += 2 * (residue * _solve(nn - pole * dd, seen.astype(complex))).real
    if price:
        w += expit(2 * q * np.log(price / squared)) * _solve(nn + price * dd, seen)
    return np.asarray((_toeplitz(a, samples) @ w).T)


def full_bsplines(plant: DiscretePlant, path: Array, spacing: float, price: float) -> Array:
    """Return the command of a whole path whose increments are B-splines.

    min |y_d - N w|^2 + price |Psi c|^2 with D w = Psi c, by Lagrange multipliers.

    Parameters
    ----------
    path : ndarray, shape (axes, n)
    spacing : float
        Samples from knot to knot.
    """
    degree = 3
    b, a = _fraction(plant)
    samples = path.shape[1]
    numerator = _toeplitz(b, samples)
    denominator = _toeplitz(np.convolve(a, [1.0, -2.0, 1.0]), samples)
    inner = np.linspace(0.0, samples - 1.0, round((samples - 1) / spacing) + 1)
    knots = np.pad(inner, degree, mode="edge")
    psi = csc_array(BSpline.design_matrix(np.arange(samples, dtype=float), knots, degree))
    system = block_array(
        [
            [numerator.T @ numerator, None, denominator.T],
            [None, price * (psi.T @ psi), -psi.T],
            [denominator, -psi, None],
        ]
    )
    seen = np.zeros((system.shape[0], len(path)))
    seen[:samples] = numerator.T @ path.T
    return np.asarray((_toeplitz(a, samples) @ _solve(system, seen)[:samples]).T)


def _fraction(plant: DiscretePlant) -> tuple[Array, Array]:
    """Numerator and denominator of the plant in powers of q^-1, equally long."""
    a = np.asarray(np.poly(plant.poles()).real, np.float64)
    return np.convolve(a, plant.impulse_response(len(a)))[: len(a)], a


def _toeplitz(taps: Array, samples: int) -> csc_array:
    columns = [np.full(samples - k, tap) for k, tap in enumerate(taps)]
    return csc_array(diags_array(columns, offsets=[-k for k in range(len(taps))]))


def _solve(system: csc_array, right: NDArray[Any]) -> NDArray[Any]:
    factors = splu(csc_array(system))
    found = factors.solve(right)
    return np.asarray(found + factors.solve(right - system @ found))


def _cut_off(b: Array, integrated: Array, share: float) -> float:
    """Gain that this share of all frequencies exceeds: the singular values' distribution."""
    points = np.exp(-1j * np.pi * (np.arange(100_000) + 0.5) / 100_000)
    gain = np.abs(np.polyval(b[::-1], points) / np.polyval(integrated[::-1], points))
    return float(np.quantile(gain, 1.0 - share))


# 1. Agreement


@dataclass(frozen=True, slots=True)
class Comparison:
    """Rms errors and difference of the outputs, um, limited first."""

    tracking_um: tuple[float, float]
    contour_um: tuple[float, float]
    difference_um: float


def compare(plant: DiscretePlant, case: Case, seconds: float) -> Comparison:
    """Compare limited with full preview on a path."""
    path = long_path(seconds)
    samples = path.shape[1]
    more = -samples % case.update + case.window
    longer = np.pad(path, [(0, 0), (0, more)], mode="edge")
    design = case.design([plant])
    ours = np.stack([limited(design, row)[:samples] for row in longer])
    if case.basis == "bspline":
        spacing = (case.window - 1) / (case.n - 3)
        full = full_bsplines(plant, longer, spacing, case.price)
    else:
        full = full_ce_opt(plant, longer, case.n / case.window, case.price)
    answers = [answer(plant, u) for u in (ours, full[:, :samples])]
    tracking = [_rms_um(tracking_error(path, y)) for y in answers]
    contour = [_rms_um(contour_error(path, y, DT_S)) for y in answers]
    difference = _rms_um(tracking_error(*answers))
    return Comparison((tracking[0], tracking[1]), (contour[0], contour[1]), difference)


def agreement(quick: bool) -> Iterator[Row]:
    """Rows of limited against full preview."""
    lengths = [(6.0, CASES)] if quick else [(26.0, CASES), (60.0, (SPLINES,))]
    for seconds, cases in lengths:
        for case in cases:
            for name, plant in (("45 Hz", one_mode()), ("taz6-x", taz())):
                found = compare(plant, case, seconds)
                title = f"{seconds:.0f} s, {name}, {case}: "
                for what, (ours, full) in (
                    ("tracking", found.tracking_um),
                    ("contour", found.contour_um),
                ):
                    more = ours / full - 1.0
                    text = f"{100 * more:+.2f} % ({ours:.3f}, full {full:.3f} um)"
                    yield Row(title + what + " error rms", "<= +3 %", text, more <= 0.03)
                share = found.difference_um / found.tracking_um[1]
                text = f"{100 * share:.1f} % ({found.difference_um:.3f} um)"
                yield Row(title + "outputs' difference rms", "<= 3 %", text, share <= 0.03)


def answer(plant: DiscretePlant, u: Array) -> Array:
    """Return what two equal axes do that stand at the origin before the command begins."""
    return response([plant, plant], np.pad(u, [(0, 0), (1, 0)]))[:, 1:]


def _rms_um(error_mm: Array) -> float:
    return 1e3 * float(np.sqrt(np.mean(error_mm**2)))


# 2. Boundedness


class Deviations(NamedTuple):
    """Maximum |u - y_d| in mm: first and last 1e5 samples, and all."""

    first: float
    last: float
    overall: float


def deviations(design: PreviewDesign, samples: int) -> Deviations:
    """Run a periodic path through the recursion, one axis, memory of one period."""
    period = long_path(52.0)[0]
    period = np.pad(period, (0, -len(period) % design.update), mode="edge")
    # Beyond the end of a period the next one begins.
    ahead = np.append(period, period[: design.window - design.update])
    z = np.zeros(design.lifted.states)
    edge = 100_000
    first = last = overall = 0.0
    for start in range(0, samples, len(period)):
        away = np.abs(limited(design, ahead, z) - period)[: samples - start]
        overall = max(overall, float(away.max()))
        first = max(first, float(away[: max(0, edge - start)].max(initial=0.0)))
        last = max(last, float(away[max(0, samples - edge - start) :].max(initial=0.0)))
    return Deviations(first, last, overall)


def boundedness(quick: bool) -> Iterator[Row]:
    """Rows of the long run."""
    samples = 300_000 if quick else 10_000_000
    for case in (SHARP, PRODUCT):
        for name, plants in (
            ("45 Hz, zeta .005", [one_mode(zeta=0.005)]),
            ("taz6-x", [taz()]),
            ("9 members", nine_members()),
        ):
            design = case.design(plants)
            found = deviations(design, samples)
            text = (
                f"{found.first:.4f} / {found.last:.4f} / {found.overall:.4f} mm, "
                f"last - first {1e6 * (found.last - found.first):+.3f} nm, "
                f"rho(F) {design.spectral_radius:.3f}"
            )
            good = found.last <= found.first + 1e-6 and found.overall <= found.first + 1e-6
            title = (
                f"{samples:.0e} samples, {name}, {case}: u off y_d at most, first / last 1e5 / all"
            )
            yield Row(title, "no drift", text, good)


# 3. Cost


def cost(quick: bool) -> Iterator[Row]:
    """Rows of CPU seconds and samples per second."""
    sets = {"1 plant": [one_mode()], "9 members": nine_members()}
    rates = {"1 plant": 5e6, "9 members": 3e6}
    times = 2 if quick else 7
    Case("ce-opt", 12, 60, 0.0).design(sets["1 plant"])
    for name, plants in sets.items():
        spent = min(_cpu_s(partial(PRODUCT.design, plants)) for _ in range(times))
        limit = 2.0 if name == "9 members" else None
        title = f"design, cold, {name}, {PRODUCT}: lifted_window + PreviewDesign"
        required = "" if limit is None else f"<= {limit:g} s"
        yield Row(title, required, f"{spent:.3f} CPU s", None if limit is None else spent <= limit)
    yield from _cached()
    path = long_path(52.0)[0]
    windows = (len(path) - PRODUCT.window) // PRODUCT.update
    path = path[: windows * PRODUCT.update + PRODUCT.window - PRODUCT.update]
    for name, plants in sets.items():
        design = PRODUCT.design(plants)
        spent = min(_cpu_s(partial(limited, design, path)) for _ in range(5 * times))
        rate = windows * PRODUCT.update / spent
        title = f"recursion, {name}, {PRODUCT}, nz = {design.lifted.states}: samples/s per axis"
        required = f">= {rates[name] / 1e6:g} million"
        yield Row(title, required, f"{rate / 1e6:.1f} million", rate >= rates[name])


def _cached() -> Iterator[Row]:
    """A compensator made again in the same process finds its designs."""
    machine = load_machine("taz6-x")
    path = long_path(6.0)
    feeds, rests = np.ones(path.shape[1], bool), np.zeros((0, 2), np.int64)

    def job() -> None:
        PreviewFbf(machine, DT_S, robust="ensemble").compensate(path, feeds, rests)

    PreviewFbf(machine, DT_S).compensate(path, feeds, rests)
    first = _cpu_s(job)
    again = min(_cpu_s(job) for _ in range(3))
    made = min(_cpu_s(lambda: PreviewFbf(machine, DT_S, robust="ensemble")) for _ in range(3))
    text = f"{first:.3f}, then {again:.3f} CPU s; the compensator alone {1e3 * made:.2f} ms"
    title = "taz6-x, 10 members, two axes: compensator and 6 s of path, first and from the cache"
    yield Row(title, "<= 2 s", text, again <= 2.0)


def _cpu_s(work: Callable[[], object]) -> float:
    started = time.process_time()
    work()
    return time.process_time() - started


# 4. Acceptance


def acceptance(quick: bool) -> Iterator[Row]:
    """Rows of rho(F) and cond(R) over windows and functions: which designs are refused."""
    windows = (60, 300) if quick else (60, 100, 150, 200, 300, 400, 600)
    counts = (18, 26, 34, 45, 60, 75, 90, 120, 150)
    careless = 0
    for name in builtin_machines():
        machine = load_machine(name)
        axes = ["x"] if machine.axes["x"] == machine.axes["y"] else ["x", "y"]
        for axis in axes:
            plant = plant_set(machine.axes[axis], DT_S).nominal
            tried, radius, condition = 0, 0.0, 0.0
            refused: dict[int, list[int]] = {}
            for window in windows:
                lifted = lifted_window([plant], [1.0], window, window // 2)
                fitting = [n for n in counts if n <= window]
                psi = BASES["ce-opt"](lifted.lifted_set(), fitting[-1])
                for n in fitting:
                    tried += 1
                    try:
                        design = PreviewDesign(lifted, n, psi=psi)
                    except DesignError:
                        refused.setdefault(window, []).append(n)
                        careless += window >= 150 and 2 * n <= window
                        continue
                    radius = max(radius, design.spectral_radius)
                    condition = max(condition, design.condition)
            text = f"rho(F) <= {radius:.3f}, cond(R) <= {condition:.0e}; refused: " + (
                "; ".join(
                    f"{', '.join(map(str, ns))} of {window}" for window, ns in refused.items()
                )
                or "none"
            )
            both = "x, y" if len(axes) == 1 else axis
            yield Row(f"{name} {both}, ce-opt, price 0: {tried} designs", "", text, None)
    title = "refused with a window of 150 or more and n / window <= .5"
    yield Row(title, "0", str(careless), careless == 0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="short paths and runs, fewer windows")
    given = parser.parse_args()
    print("| quantity | required | ours | pass |\n|---|---|---|---|")
    for section in (agreement, boundedness, cost, acceptance):
        for row in section(given.quick):
            verdict = "" if row.good is None else "PASS" if row.good else "MISS"
            print(f"| {row.quantity} | {row.required} | {row.ours} | {verdict} |", flush=True)


if __name__ == "__main__":
    main()
