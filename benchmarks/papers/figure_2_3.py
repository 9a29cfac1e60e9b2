"""Figures 2.3 and 2.4 of the dissertation (paper 003): ZPETC and TS against the plant's zero.

The plant is (q - a) / (q - 0.5); M = 1000, n1 = 5. Both methods leave the zero uncancelled wherever
it is, as the figures do. The figures are curves without printed numbers, so each is judged by what
is printed about it: figure 2.4 by its closed forms (2.28, 2.29), figure 2.3, the error of one
white-noise record, by the same forms, which "predict" it (section 2.7). With a seed per run.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stillpath.compensation.base import DesignError
from stillpath.compensation.inversion import Inversion, invert
from stillpath.models.plants import DiscretePlant

SAMPLES, ORDER, POLE, DT_S = 1001, 5, 0.5, 1e-4
ZEROS = (-5.0, -2.0, -1.1, -1.0, -0.9, -0.5, 0.5, 0.9, 1.0, 1.02, 1.1, 2.0, 5.0)

Row = tuple[str, str, str, str]
"""Quantity, the paper's value, ours, and what the comparison is."""


def rows(seed: int = 1) -> list[Row]:
    """Both figures: error metric J_e (2.4) and simulated e_RMS / y_d,RMS (2.3) over a."""
    y_d = np.random.default_rng(seed).normal(size=SAMPLES)
    out: list[Row] = []
    for kind in ("zpetc", "ts"):
        for a in ZEROS:
            plant = first_order(a)
            expected = closed_form(kind, a)
            place = f"{kind.upper()}, a = {a:g}"
            try:
                design = invert(kind, plant, ORDER, cancel_below=0.0)
            except DesignError as error:
                reason = str(error).split(":", 1)[1].split("; use")[0].strip()
                said = "not applicable" if expected is None else _text(expected)
                out.append((f"{place}: J_e and e/y_d", said, "refused", reason))
                continue
            if expected is None:
                out.append((f"{place}: J_e and e/y_d", "not applicable", "accepted", "differs"))
                continue
            metric = float(np.linalg.norm(design.lifted_error(SAMPLES))) / np.sqrt(SAMPLES)
            off = abs(metric / expected - 1)
            out.append((f"{place}: J_e", _text(expected), _text(metric), f"2.28/29, {off:.1e} off"))
            measured = relative_error(design, y_d)
            cut = simulated_error(design, plant, y_d)
            note = f"{measured / expected - 1:+.1%} of J_e; {_text(cut)} with the record cut off"
            out.append((f"{place}: e/y_d", _text(expected), _text(measured), note))
    return out


def first_order(a: float) -> DiscretePlant:
    """(q - a) / (q - 0.5), equation 2.27, sampled at 10 kHz."""
    return DiscretePlant(np.array([[POLE]]), np.ones(1), np.array([POLE - a]), 1.0, (), DT_S)


def closed_form(kind: str, a: float) -> float | None:
    """J_e by equations 2.28 and 2.29; None where the method is not applicable."""
    if (kind == "zpetc" and a == 1.0) or (kind == "ts" and abs(a) == 1.0):
        return None
    if kind == "zpetc":
        return float(np.sqrt(6 - 2 / SAMPLES) * abs(a) / (1 - a) ** 2)
    return float(np.sqrt(1 - ORDER / SAMPLES) * abs(a) ** (-ORDER if abs(a) > 1 else ORDER))


def relative_error(design: Inversion, y_d: NDArray[np.float64]) -> float:
    """e_RMS / y_d,RMS with the error's own lifted matrix: the record is zero beyond its ends."""
    return float(np.linalg.norm(design.lifted_error(len(y_d)) @ y_d) / np.linalg.norm(y_d))


def simulated_error(design: Inversion, plant: DiscretePlant, y_d: NDArray[np.float64]) -> float:
    """The same with the command cut to the record: what would be sent before it is not."""
    u = design.lifted(len(y_d)) @ y_d
    y = np.convolve(plant.impulse_response(len(y_d)), u)[: len(y_d)]
    return float(np.linalg.norm(y_d - y) / np.linalg.norm(y_d))


def _text(value: float) -> str:
    return f"{value:.4g}"


def main() -> None:
    for quantity, paper, ours, note in rows():
        print(f"{quantity:32} {paper:>15} {ours:>10}  {note}")


if __name__ == "__main__":
    main()
