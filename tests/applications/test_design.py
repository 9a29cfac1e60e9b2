"""The look at a design: figures checked from outside, files, the command, the API."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import toeplitz
from scipy.signal import dfreqresp

from stillpath.applications.design import design as module
from stillpath.applications.design.design import design_report
from stillpath.applications.design.figures import DesignReport
from stillpath.applications.design.page import render_design, write_design
from stillpath.applications.design.summary import Summary
from stillpath.cli.design_tables import print_design
from stillpath.cli.main import run
from stillpath.compensation.fbf import LADDER, PreviewFbf
from stillpath.compensation.shapers import shape, shaper_pulses
from stillpath.models.machine import Machine
from stillpath.models.plants import (
    FirSpec,
    PlantSetSpec,
    RelativeMode,
    RelativeModesSpec,
    WeightedMember,
    discretise,
    plant_set,
)
from stillpath.models.store import load_machine
from stillpath.pipeline.measuring.reference_shaper import BestShaper
from stillpath.reports.charts import Chart, Line, Mark, draw

GOLDEN = Path(__file__).parents[2] / "examples" / "machines" / "klipper-golden.json"
DT = 1e-3
ERRORS = (-20.0, 0.0, 10.0)
TUNED = {
    "zv": BestShaper("zv", 45.0, 33.0, 0.1, 0.0, 0.0),
    "mzv": BestShaper("mzv", 52.0, 38.0, 0.1, 0.0, 0.0),
}


def short_motion() -> tuple[np.ndarray, np.ndarray]:
    """Two rounds of a square, each side in .2 s with a soft start and stop; then it stands."""
    t = np.arange(200) / 200
    side = 20 * (t - np.sin(2 * np.pi * t) / (2 * np.pi))
    level, full = np.zeros(200), np.full(200, 20.0)
    x = np.concatenate([side, full, 20 - side, level] * 2)
    y = np.concatenate([level, side, full, 20 - side] * 2)
    path = np.pad(np.stack([x, y]), ((0, 0), (1, 100)))
    return path, np.arange(path.shape[1]) < 1600


MOTION = short_motion()


def report_of(machine: Machine, **settings: Any) -> DesignReport:
    given: dict[str, Any] = {
        "errors_percent": ERRORS,
        "shapers": tuple(TUNED),
        "motion": MOTION,
        "tuned": TUNED,
    }
    given |= {name: settings.pop(name) for name in given if name in settings}
    return design_report(machine, settings.pop("axis", "x"), **settings, **given)


@pytest.fixture(scope="module")
def machine() -> Machine:
    return load_machine("ender3")


@pytest.fixture(scope="module")
def off(machine: Machine) -> DesignReport:
    return report_of(machine)


@pytest.fixture(scope="module")
def ensemble(machine: Machine) -> DesignReport:
    return report_of(machine, axis="y", robust="ensemble")


def impulse(machine: Machine, axis: str) -> np.ndarray:
    """Answer of the nominal plant to one, sample by sample, from its state space."""
    p = plant_set(machine.axes[axis], DT).nominal
    out, x, u = [], np.zeros(p.order), 1.0
    for _ in range(300):
        out.append(p.c @ x + p.d * u)
        x, u = p.a @ x + p.b * u, 0.0
    return np.array(out)


def test_axis_and_set(machine: Machine, off: DesignReport) -> None:
    spec = machine.axes["x"].nominal
    assert [m.f_hz for m in off.plant.modes] == pytest.approx(sorted(m.f_hz for m in spec.modes))
    (zero,) = off.plant.zeros_outside
    assert zero.radius == pytest.approx(abs(zero.real))
    assert zero.f_hz == pytest.approx(500)
    assert sum(m.weight for m in off.plant.members) == pytest.approx(1)
    assert sum(m.minimax_weight for m in off.plant.members) == pytest.approx(1)
    assert len(off.plant.members) == 16
    taz = report_of(load_machine("taz6-x"), errors_percent=())
    (pair,) = taz.plant.zeros_outside
    assert pair.radius > 1
    assert pair.imag > 0
    assert pair.f_hz == pytest.approx(np.arctan2(pair.imag, pair.real) / (2 * np.pi * DT))


def test_the_band_holds_the_set(machine: Machine, off: DesignReport) -> None:
    found = off.frequencies
    f_hz, gain = np.array(found.f_hz), np.array(found.gain)
    low, high = np.array(found.gain_low), np.array(found.gain_high)
    p = plant_set(machine.axes["x"], DT).nominal
    _, expected = dfreqresp((p.a, p.b[:, None], p.c[None], p.d, DT), 2 * np.pi * f_hz * DT)
    np.testing.assert_allclose(gain, np.abs(expected), rtol=1e-6)
    np.testing.assert_allclose(
        np.exp(1j * np.radians(found.phase_deg)), expected / np.abs(expected), rtol=1e-6
    )
    assert np.all((low <= gain) & (gain <= high))
    # Slow motion is on time in every plant; where nothing was measured they differ most.
    assert abs(low[0] - 1) < 0.05 > abs(high[0] - 1)
    assert max(np.abs(found.phase_low_deg[:1] + found.phase_high_deg[:1])) < 2
    spread = high / low
    assert spread[f_hz > 150].max() > 3 * spread[f_hz < 30].max()
    assert not found.phase_measured


def test_singular_values_are_those_of_the_dense_matrices(
    machine: Machine, off: DesignReport, ensemble: DesignReport
) -> None:
    h = impulse(machine, "x")
    position = toeplitz(h, np.zeros(300))
    summed = np.tril(np.ones((300, 300)))
    for matrix, found in (
        (position, off.lifted.position),
        (position @ summed @ summed, off.lifted.increments),
    ):
        expected = np.linalg.svd(matrix, compute_uv=False)
        np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-10 * expected[0])
    # A set: the weighted stack of its members.
    plants = plant_set(machine.axes["y"].without_delay(), DT)
    gram = np.zeros((300, 300))
    for plant, weight in zip(plants.members, plants.weights, strict=True):
        g = toeplitz(plant.impulse_response(300), np.zeros(300))
        gram += weight * g.T @ g
    expected = np.sqrt(np.abs(np.linalg.eigvalsh(gram)[::-1]))
    np.testing.assert_allclose(
        ensemble.lifted.position[:200], expected[:200], rtol=1e-6, atol=1e-7 * expected[0]
    )


def test_closed_forms_agree_with_controllers(machine: Machine, off: DesignReport) -> None:
    """J_e (2.26) and J_c (3.23) against the pseudo-inverse of the n leading directions."""
    g = toeplitz(impulse(machine, "x"), np.zeros(300)) @ np.linalg.matrix_power(
        np.tril(np.ones((300, 300))), 2
    )
    u, s, vt = np.linalg.svd(g)
    for n in (1, 34, 90):
        controller = (vt[:n].T / s[:n]) @ u[:, :n].T
        error = np.linalg.norm(np.eye(300) - g @ controller) / np.sqrt(300)
        effort = np.linalg.norm(controller) / np.sqrt(300) / DT**2 / 1e3
        assert off.metrics.error[n - 1] == pytest.approx(error, rel=1e-7)
        assert off.metrics.effort_increments[n - 1] == pytest.approx(effort, rel=1e-6)
    assert off.metrics.effort_position[299] is None  # the sampling zero: not answered


def test_robust_metrics_add_up(machine: Machine, off: DesignReport) -> None:
    plants = plant_set(machine.axes["x"].without_delay(), DT)
    by_name = {m.nominal: m for m in off.metrics.robust}
    assert set(by_name) == {"plant", "optimum"}
    for metric in by_name.values():
        parts = np.square(metric.nominal_part) + np.square(metric.uncertainty_part)
        np.testing.assert_allclose(np.square(metric.error), parts, rtol=1e-9)
        below = int(np.sum(np.array(metric.singular_values) < 1.0))
        assert metric.best == max(1, below)
        assert metric.left_out + len(metric.singular_values) == 300
    assert by_name["optimum"].error[89] < by_name["plant"].error[89]
    # The most uncertain of 150 directions, from the members one by one.
    summed = np.linalg.matrix_power(np.tril(np.ones((300, 300))), 2)
    nominal = toeplitz(impulse(machine, "x"), np.zeros(300)) @ summed
    spread = np.zeros((300, 300))
    for plant, weight in zip(plants.members, plants.weights, strict=True):
        delta = toeplitz(plant.impulse_response(300), np.zeros(300)) @ summed - nominal
        spread += weight * delta.T @ delta
    _, s, vt = np.linalg.svd(nominal)
    scaled = vt[:150].T / s[:150]
    largest = np.sqrt(np.linalg.eigvalsh(scaled.T @ spread @ scaled)[-1])
    assert largest <= by_name["plant"].singular_values[-1] + 1e-6


def test_ladder_is_the_compensator_s(machine: Machine, off: DesignReport) -> None:
    assert [(r.n, r.price) for r in off.ladder] == [(r.n, r.price) for r in LADDER]
    for rung in off.ladder:
        assert rung.refused is None
        assert rung.cutoff_hz == pytest.approx(rung.n / 0.6)
        # The price takes accuracy and effort from the closed forms of its n functions.
        assert rung.error >= off.metrics.error[rung.n - 1] - 1e-9
        assert rung.effort <= off.metrics.effort_increments[rung.n - 1] * (1 + 1e-9)
        assert rung.robust_error > rung.error
    fbf = PreviewFbf(machine, DT)
    path, extruding = padded(MOTION)
    fbf.reset(path[:, 0])
    command = fbf.compensate(path, extruding, np.zeros((0, 2), np.int64))
    assert off.chosen == fbf.rungs[0]
    curve = Summary(off).own
    bend = np.diff(command[0], 2) / DT**2
    assert curve.peak_accel_mm_s2 == pytest.approx(np.abs(bend).max())
    assert curve.rms_accel_mm_s2 == pytest.approx(np.sqrt(np.mean(bend**2)))
    assert curve.peak_accel_mm_s2 <= off.accel_limit_mm_s2


def padded(motion: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    path, extruding = motion
    return np.pad(path, ((0, 0), (120, 120)), mode="edge"), np.pad(extruding, 120)


def contour_rms_um(path: np.ndarray, y: np.ndarray, use: np.ndarray) -> float:
    """Distance of every other point to the polyline within 80 ms, by brute force."""
    squares = []
    for k in np.flatnonzero(use[::2]) * 2:
        a = path[:, max(0, k - 80) : k + 81]
        step, away = np.diff(a), y[:, [k]] - a[:, :-1]
        length = np.maximum((step**2).sum(0), 1e-300)
        t = np.clip((step * away).sum(0) / length, 0, 1)
        squares.append(((away - t * step) ** 2).sum(0).min())
    return 1e3 * float(np.sqrt(np.mean(squares)))


def answer(plant: Any, u: np.ndarray) -> np.ndarray:
    x, out = plant.rest_state(float(u[0])), np.empty_like(u)
    for k, value in enumerate(u):
        out[k] = plant.c @ x + plant.d * value
        x = plant.a @ x + plant.b * value
    return out


def test_curves_equal_direct_simulations(machine: Machine, off: DesignReport) -> None:
    path, use = padded(MOTION)
    other = discretise(machine.axes["y"].nominal, DT)
    nominal = machine.axes["x"].nominal
    fbf = PreviewFbf(machine, DT)
    fbf.reset(path[:, 0])
    pulses = [shaper_pulses("zv", f_hz, 0.1) for f_hz in (45.0, 33.0)]
    commands = {
        "none": path,
        "fbf-off": fbf.compensate(path, use, np.zeros((0, 2), np.int64)),
        "zv": np.stack([shape(r, DT, p) for r, p in zip(path, pulses, strict=True)]),
    }
    curves = {curve.name: curve for curve in off.robustness.curves}
    assert off.robustness.errors_percent == ERRORS
    for name, command in commands.items():
        still = answer(other, command[1])
        for error, found in zip(ERRORS, curves[name].contour_um, strict=True):
            plant = discretise(nominal.scaled(1 + error / 100, 1.0), DT)
            y = np.stack([answer(plant, command[0]), still])
            assert found == pytest.approx(contour_rms_um(path, y, use), rel=1e-6)
        assert curves[name].nominal_um == pytest.approx(curves[name].contour_um[1], rel=1e-9)
        member = plant_set(machine.axes["x"], DT).members[0]
        y = np.stack([answer(member, command[0]), still])
        assert curves[name].members_um[0] == pytest.approx(contour_rms_um(path, y, use), rel=1e-6)
        assert curves[name].members_worst_um == max(curves[name].members_um)
        weights = plant_set(machine.axes["x"], DT).weights
        mean = np.average(curves[name].members_um, weights=weights)
        assert curves[name].members_mean_um == pytest.approx(mean)


def test_modes_shapers_and_summary(off: DesignReport, ensemble: DesignReport) -> None:
    names = [curve.name for curve in off.robustness.curves]
    assert names == ["none", "fbf-off", "fbf-ensemble", "fbf-minimax", "zv", "mzv"]
    summary = Summary(ensemble)
    assert summary.own.name == "fbf-ensemble"
    assert (
        summary.own.nominal_um < summary.best_shaper.nominal_um < summary.uncompensated.nominal_um
    )
    assert summary.reaches == [10.0, 20.0]
    assert summary.worst(summary.own)[1] == max(summary.own.contour_um)


def test_the_same_again_and_through_json(machine: Machine, off: DesignReport) -> None:
    assert report_of(machine) == off
    again = DesignReport.model_validate_json(off.model_dump_json())
    assert again == off
    assert render_design(again) == render_design(off)


def test_refusals_are_findings(capsys: pytest.CaptureFixture[str]) -> None:
    lone = load_machine(GOLDEN)
    report = report_of(lone, basis="robust")
    assert report.chosen is None
    assert Summary(report).own is None
    assert all("choose robust ensemble" in rung.refused for rung in report.ladder)
    assert any("fbf" in reason for reason in report.robustness.missing)
    assert report.metrics.robust == ()
    assert "every design was refused" in render_design(report)
    print_design(report)
    assert capsys.readouterr().out.count("refused: fbf off") == 1
    assert report_of(lone, robust="minimax").chosen is not None


def test_taps_have_no_frequencies() -> None:
    taps = FirSpec(taps=(0.1, 0.3, 0.4, 0.2), dt_s=DT)
    axis = PlantSetSpec(nominal=taps)
    made = load_machine(GOLDEN).model_copy(update={"axes": {"x": axis, "y": axis}})
    report = report_of(made)
    assert report.robustness.errors_percent == ()
    assert "no frequencies to scale" in " ".join(report.robustness.missing)
    assert "as measured" in render_design(report)


class Page(HTMLParser):
    """Checks nesting, and collects what a screen reader is told."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.about: list[str] = []
        self.outside: list[str] = []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        if tag == "svg" and given.get("aria-hidden") != "true":
            assert given["role"] == "img"
            self.about.append(given["aria-label"] or "")
        self.outside += [v or "" for k, v in attrs if k in ("src", "href") and v != "data:,"]
        if tag not in ("meta", "link", "path", "line"):
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        pass

    def handle_endtag(self, tag: str) -> None:
        if tag not in ("path", "line"):
            assert self.open.pop() == tag


def test_page_and_files(tmp_path: Path, ensemble: DesignReport) -> None:
    write_design(ensemble, tmp_path / "new")
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == [
        "design.html",
        "design.json",
    ]
    assert json.loads((tmp_path / "new" / "design.json").read_text())["axis"] == "y"
    text = (tmp_path / "new" / "design.html").read_text(encoding="utf-8")
    page = Page(text)
    assert page.outside == []
    assert "<script" not in text
    assert "http" not in text.replace("http-equiv", "")
    assert len(page.about) == 2 + 2 + 6
    assert all("against" in about for about in page.about)
    assert text.count('class="band"') == 2
    for words in (
        "fbf ensemble",
        "mzv",
        "remark 4.5",
        "taken",
        "zv",
        "from the model; not measured",
    ):
        assert words in text
    hostile = ensemble.model_copy(update={"machine_title": "<script>alert(1)</script>"})
    assert "<script" not in render_design(hostile)


def test_charts_stay_within_their_frame() -> None:
    n = list(range(50))
    chart = Chart(
        about="a < b",
        x_title="n",
        y_title="y",
        lines=[
            Line(n, [10.0 ** (k / 5 - 5) for k in n], "a", "rising"),
            Line(n, [None, 0.0, *(3.0 for _ in n[2:])], "b", "flat"),
            Line(n, [3.0 for _ in n], "b", "flat again"),
        ],
        log=True,
        marks=[Mark(40, "here")],
    )
    text = draw(chart, 400, 300)
    assert "a &lt; b" in text
    for x, y in re.findall(r"[ML]([-\d.]+) ([-\d.]+)", text):
        assert 0 <= float(x) <= 400
        assert 0 <= float(y) <= 300
    ends = [float(y) for y in re.findall(r'y="([\d.]+)" text-anchor="start">(?:rising|flat)', text)]
    assert min(np.abs(np.diff(sorted(ends)))) >= 12


def test_the_command_passes_its_options_on_and_writes_the_page(
    tmp_path: Path, off: DesignReport, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    asked = []

    def pretended(machine: Machine, axis: str, **settings: str) -> DesignReport:
        asked.append((machine.name, axis, settings))
        return off

    monkeypatch.setattr(module, "design_report", pretended)
    command = ["design", "-m", "ender3", "--axis", "x", "--robust", "off"]
    assert run([*command, "--report", str(tmp_path / "d")]) == 0
    assert asked == [("ender3", "x", {"basis": "ce-opt", "robust": "off"})]
    assert (tmp_path / "d" / "design.html").exists()
    shown = capsys.readouterr().out
    for words in ("rho(F)", "fbf minimax", "singular values", "remark 4.5", "n 90"):
        assert words in shown
    assert max(map(len, shown.splitlines())) <= 80
    monkeypatch.undo()
    for wrong in (["--axis", "z"], ["--axis", "x", "--basis", "fourier"], []):
        assert run(["design", "-m", "ender3", *wrong]) == 2
        assert capsys.readouterr().err.startswith("stillpath: error: ")


@pytest.mark.slow
def test_whole_report() -> None:
    report = design_report(load_machine("taz6-x"), "x")
    assert len(report.robustness.errors_percent) == 21
    assert len(report.robustness.curves) == 9
    assert report.robustness.missing == ()
    summary = Summary(report)
    assert summary.own.nominal_um < 0.5 * summary.best_shaper.nominal_um
    for curve in report.robustness.curves:
        assert curve.contour_um[10] == pytest.approx(curve.nominal_um, rel=1e-6)
    Page(render_design(report))


@pytest.mark.parametrize(("name", "mode"), [("ender3", "ensemble"), ("generic-corexy", "off")])
def test_automatic_is_what_jobs_take(name: str, mode: str) -> None:
    machine = load_machine(name)
    assert report_of(machine, robust="auto").robust == mode


def test_automatic_leaves_a_set_that_cannot_be_designed_for() -> None:
    slow = [
        RelativeModesSpec(modes=(RelativeMode(f_hz=f, zeta=0.001, share=1.0),)) for f in (3.0, 3.2)
    ]
    usual = RelativeModesSpec(modes=(RelativeMode(f_hz=45.0, zeta=0.06, share=1.0),))
    axis = PlantSetSpec(nominal=usual, members=tuple(WeightedMember(plant=p) for p in slow))
    machine = load_machine("generic-corexy").model_copy(update={"axes": {"x": axis, "y": axis}})
    report = report_of(machine, robust="auto")
    assert report.robust == "off"
    assert report.chosen is not None
    assert any(reason.startswith("fbf ensemble: ") for reason in report.robustness.missing)
