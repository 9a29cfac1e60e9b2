"""Numbers printed in the dissertation (paper 003), at its sizes; n + 1 functions are its n."""

from __future__ import annotations

import runpy
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import cont2discrete

from stillpath.compensation.basis import (
    bspline_basis,
    ce_opt_basis,
    ce_opt_basis_of,
    dct_basis,
    robust_basis_for,
    spread_functions,
)
from stillpath.compensation.full_preview import FullPreview
from stillpath.compensation.lifted import LiftedSet, lift, lifted_set
from stillpath.compensation.metrics import best_number, effort_metric, effort_of_ce_opt
from stillpath.compensation.nominal import lifted_optimum, spread_gram, two_step
from stillpath.compensation.operators import DenseOperator, LiftedOperator
from stillpath.models.plants import DiscretePlant, discretise
from stillpath.models.store import load_machine
from tests.loading import module_at

ROOT = Path(__file__).resolve().parents[2]
SAMPLES = 1001


def oscillator(f_hz: float, zeta: float) -> np.ndarray:
    """Equation 4.1, zero-order hold at 1 kHz."""
    w = 2 * np.pi * f_hz
    a = np.array([[0, 1], [-w * w, -2 * zeta * w]])
    b, c = np.array([[0], [w * w]]), np.array([[1.0, 0]])
    phi, gamma, _, _, _ = cont2discrete((a, b, c, np.zeros((1, 1))), 1e-3)
    return DiscretePlant(phi, gamma[:, 0], c[0], 0.0).impulse_response(SAMPLES)


@cache
def section_42() -> tuple[np.ndarray, LiftedSet]:
    """41 frequencies x 10 dampings, these in equal ratios."""
    markov = np.array([oscillator(f, z) for f in np.linspace(180, 220, 41)
                       for z in np.geomspace(1e-3, 0.1, 10)])  # fmt: skip
    return markov, lifted_set(markov, np.full(410, 1 / 410))


def first_order(a: float) -> np.ndarray:
    """Equation 2.27 with p = .5."""
    return np.append(1.0, (0.5 - a) * 0.5 ** np.arange(SAMPLES - 1.0))


def rms(x: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(x**2, axis=0))


def white(records: int) -> np.ndarray:
    return np.random.default_rng(0).normal(size=(SAMPLES, records))


def test_set_at_full_size_is_the_dense_sum() -> None:
    markov, _ = section_42()
    few = lifted_set(markov[:3], [0.2, 0.3, 0.5])
    dense = sum(w * lift(h, SAMPLES).dense().T @ lift(h, SAMPLES).dense()
                for w, h in zip([0.2, 0.3, 0.5], markov[:3], strict=True))  # fmt: skip
    np.testing.assert_allclose(few.gram, dense, atol=1e-10 * np.abs(dense).max())


def test_best_number_for_the_standard_model() -> None:
    """Section 4.6.1: the optimum should be achieved at n = 891."""
    _, members = section_42()
    standard = lift(oscillator(200.0, 0.01), SAMPLES).dense()
    _, sigma = spread_functions(standard, spread_gram(members, standard), 1)
    assert best_number(sigma) - 1 == 891
    assert sigma[0] < 1 < sigma[-1]  # scenario (iii)


def test_singular_values_for_the_lifted_optimum() -> None:
    """Figure 4.4: the maximum is .9748, scenario (i)."""
    _, members = section_42()
    design = two_step(members)
    assert design.r == 1
    assert design.best == SAMPLES - 1
    assert round(float(design.singular_values[-1]), 4) == 0.9748


def test_taz_saturates_without_optimal_functions() -> None:
    """Section 3.5.2: B-splines and DCT leave +-10 mm near the end, optimal functions never."""
    g = lift(discretise(load_machine("taz6-x").axes["x"].nominal, 1e-3), SAMPLES)
    t = np.linspace(0, 2 * np.pi, SAMPLES)
    x = np.sin(t) * (np.exp(np.cos(t)) - 2 * np.cos(4 * t) - np.sin(t / 12) ** 5)
    y_d = np.round(x * 4.37 / rms(x), 2)
    peak, late = {}, {}
    for name, phi in {
        "ce-opt": ce_opt_basis(lifted_set(g.markov[None], [1.0]).gram, 501),
        "bspline": bspline_basis(SAMPLES, 501),
        "dct": dct_basis(SAMPLES, 501),
    }.items():
        u = FullPreview(g, phi).command(y_d)
        peak[name] = np.abs(u).max()
        late[name] = np.argmax(np.abs(u) > 10)
        assert rms(y_d - g.apply(u)) / rms(y_d) < 0.001
    assert peak["ce-opt"] < 9.5
    assert peak["bspline"] > 10
    assert peak["dct"] > peak["bspline"]
    assert abs(late["bspline"] - 947) < 20


def test_effort_of_the_taz() -> None:
    g = lift(discretise(load_machine("taz6-x").axes["x"].nominal, 1e-3), SAMPLES)
    phi = ce_opt_basis(lifted_set(g.markov[None], [1.0]).gram, 501)
    sigma = np.linalg.svd(g.dense(), compute_uv=False)
    got = effort_metric(FullPreview(g, phi).controller())
    assert got == pytest.approx(effort_of_ce_opt(sigma, 501), rel=1e-6)


def test_effort_beside_a_zero_just_outside_the_circle() -> None:
    """Figure 3.1: B-splines need 11 800 times the effort of DCT at a = 1.02; no rounding noise."""
    g, records, bsplines = lift(first_order(1.02), SAMPLES), white(10), bspline_basis(SAMPLES, 991)
    dct = FullPreview(g, dct_basis(SAMPLES, 991))
    for tolerance in (1e-11, 0.0):
        made = FullPreview(g, bsplines, rank_tolerance=tolerance)
        j_c = np.linalg.norm(made.functions) / np.linalg.norm(dct.functions)
        assert j_c == pytest.approx(9550, rel=0.01)
        ratios = rms(made.command(records)) / rms(dct.command(records))
        assert ratios.min() < 11_800 < ratios.max()


def test_example_runs(capsys: pytest.CaptureFixture[str]) -> None:
    runpy.run_path(str(ROOT / "examples" / "filtered_basis_functions.py"))
    assert "two steps: best n = 599 of 600" in capsys.readouterr().out


def test_quick_start_of_the_manual() -> None:
    text = (ROOT / "docs" / "fbf.md").read_text()
    names: dict[str, object] = {}
    exec(text.split("```python\n")[1].split("```")[0], names)
    error = names["error"]
    assert isinstance(error, np.ndarray)
    assert rms(error) < 0.01


@pytest.mark.slow
def test_table_31() -> None:
    """Mean over the zero: e/y_d .0783 (DCT), .0828 (CE-Opt); u/y_d .706 (CE-Opt)."""
    noise = white(10)
    error, effort = {"dct": [], "ce-opt": []}, {"dct": [], "ce-opt": []}
    for a in np.linspace(-5, 5, 11):
        g = lift(first_order(a), SAMPLES)
        bases = {"dct": dct_basis(SAMPLES, 991),
                 "ce-opt": ce_opt_basis(lifted_set(g.markov[None], [1.0]).gram, 991)}  # fmt: skip
        for name, phi in bases.items():
            u = FullPreview(g, phi).command(noise)
            error[name].append(rms(noise - g.apply(u)) / rms(noise))
            effort[name].append(rms(u) / rms(noise))
    # One record leaves 10 of 1001 directions: chi-square with 10 degrees of freedom.
    for name, printed in {"dct": 0.0783, "ce-opt": 0.0828}.items():
        mean = np.mean(error[name], axis=0)
        assert abs(mean.mean() - printed) < 2.5 * mean.std()
    assert np.mean(effort["ce-opt"]) == pytest.approx(0.706, rel=0.35)  # 1 / 5 of the zeros
    assert np.mean(effort["dct"]) > 2 * np.mean(effort["ce-opt"])


@pytest.mark.slow
def test_tables_41_and_42() -> None:
    """Mean errors within 6 % of what is printed, greatest efforts within its spread."""
    markov, members = section_42()
    counts = np.arange(30, 991, 60)
    noise = white(2)
    printed = {
        "standard": {"dct": (0.88, 1.1e3), "ce-opt": (0.99, 9.26), "robust": (0.69, 23.9)},
        "proposed": {"dct": (0.71, 681), "ce-opt": (0.74, 7.77), "robust": (0.67, 9.16)},
    }
    optimum = lifted_optimum(members)
    models: dict[str, LiftedOperator] = {
        "standard": lift(oscillator(200.0, 0.01), SAMPLES), "proposed": DenseOperator(optimum)
    }  # fmt: skip
    for kind, model in models.items():
        dense = model.dense()
        bases = {
            "dct": dct_basis(SAMPLES, 991),
            "ce-opt": ce_opt_basis(dense.T @ dense, 991),
            "robust": robust_basis_for(dense, spread_gram(members, dense), 991, 1),
        }
        for name, phi in bases.items():
            design = FullPreview(model, phi)
            u = np.concatenate([design.commands(y, counts + 1) for y in noise.T], axis=1)
            y_d = np.repeat(noise, len(counts), axis=1)
            errors = [rms(y_d - lift(h, SAMPLES).apply(u)) / rms(y_d) for h in markov[::3]]
            error, effort = printed[kind][name]
            assert np.mean(errors) == pytest.approx(error, rel=0.06), (kind, name)
            # DCT: the smallest singular value meets one record more and another less.
            most = 10 if name == "dct" else 1.6
            assert effort / most < np.max(rms(u) / rms(y_d)) < effort * most, (kind, name)


@pytest.mark.slow
def test_singular_vectors_of_a_long_path() -> None:
    """Appendix H (M = 10 000, n = 600) at a quarter of the size: vectors without a matrix of it."""
    samples, n = 2501, 151
    k = np.arange(samples)
    g = lift(0.9985**k * np.sin(0.012 * k) + 0.3 * 0.997**k * np.sin(0.04 * k), samples)
    psi = ce_opt_basis_of(g, n)
    np.testing.assert_allclose(psi.T @ psi, np.eye(n), atol=1e-9)
    image = g.apply_adjoint(g.apply(psi))
    squares = np.sum(psi * image, axis=0)
    assert np.all(np.diff(squares) < 1e-9 * squares[0])
    np.testing.assert_allclose(image, psi * squares, atol=1e-9 * squares[0])


@pytest.mark.slow
def test_table_43(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of one class with the experiment: which design is the most robust, and by how much."""
    papers = ROOT / "benchmarks" / "papers"
    monkeypatch.syspath_prepend(str(papers))
    table = module_at(papers / "table_4_3.py", "table_4_3")
    found = {row[0].removeprefix("table 4.3 "): row[2] for row in table.rows()}

    def deviation(name: str) -> float:
        return float(found[name].split(" ± ")[1])

    for model in ("FRF at 2 m/s2", "FRF at 3 m/s2", "FRF at 4 m/s2", "FRF at 5 m/s2"):
        assert deviation(f"{model}, robust") < 0.6 * deviation(f"{model}, CE-Opt")
        assert deviation("model (4.28), robust") < deviation(f"{model}, robust")
        assert deviation("model (4.28), CE-Opt") < deviation(f"{model}, CE-Opt")
    better = found["deviation: robust functions, both steps, up to x better"]
    assert float(better.split(", ")[0]) > 2  # the paper's 3.73 is of its own responses
    assert found["model (4.28), robust, inputs up to 500 Hz"].startswith("0.99")
