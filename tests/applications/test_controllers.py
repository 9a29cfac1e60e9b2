"""Add-on controllers: designed, written, read back, run by an independent simulator, refused."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from stillpath.applications.controllers.design import (
    Designed,
    design_controller,
    fitting_methods,
    loop_figures,
)
from stillpath.applications.controllers.loading import load_controller, read_controller
from stillpath.applications.controllers.options import METHODS, builtin_loop, read_options
from stillpath.applications.controllers.page import render_controller, write_controller
from stillpath.applications.controllers.response import answer, disturbance_of
from stillpath.cli.main import run
from stillpath.compensation.base import DesignError
from stillpath.compensation.feedback.fmsdob import fmsdob
from stillpath.models.disturbances import sample
from stillpath.models.errors import ModelError
from stillpath.models.loops import LoopSpec, builtin_loops, load_loop
from stillpath.simulation.closed_loop import simulate

Array = np.ndarray
CASES: list[tuple[str, dict[str, Any]]] = [
    ("galvo-40khz", {"method": "fmsdob", "targets_hz": [2000, 4000, 7000], "bandwidth_hz": 40}),
    ("galvo-10khz", {"method": "fmsdob-adaptive", "tones": 1}),
    ("galvo-10khz", {"method": "inverse-dob", "targets_hz": [500, 1200]}),
    ("direct-drive-table", {"method": "dob", "cutoff_hz": 50}),
    ("galvo-camera", {"method": "mmp", "targets_hz": [500, 2000, 2900]}),
    ("galvo-crosstalk-16khz", {"method": "rc-wide", "fundamental_hz": 1200}),
    ("galvo-crosstalk-16khz", {"method": "rc-quasi", "fundamental_hz": 1200}),
    (
        "galvo-crosstalk-16khz",
        {"method": "rc-multirate", "fundamental_hz": 1200, "fast": "galvo-crosstalk-48khz"},
    ),
]
IDS = [document["method"] for _, document in CASES]
FMSDOB = {"method": "fmsdob", "targets_hz": [2000]}


def made(index: int, cache: dict[int, Designed] = {}) -> Designed:  # noqa: B006 - made once
    if index not in cache:
        name, document = CASES[index]
        cache[index] = design_controller(load_loop(name), read_options(document))
    return cache[index]


def test_every_method_is_tried() -> None:
    assert tuple(IDS) == METHODS


@pytest.mark.parametrize("index", range(len(CASES)), ids=IDS)
def test_less_is_left_on_every_plant(index: int) -> None:
    report = made(index).report
    for member in report.time.members:
        assert member.spectral_radius is not None
        assert member.spectral_radius < 1
        assert member.after_rms < 0.75 * member.before_rms
    assert report.min_inverse_t.db < 3
    assert report.curves.f_hz[-1] == pytest.approx(0.5 / load_loop(report.machine).loop.dt_s)


@pytest.mark.parametrize(("index", "cut"), [(5, 0.325), (6, 0.351), (7, 0.642)])
def test_published_cuts_of_paper_004(index: int, cut: float) -> None:
    time = made(index).report.time
    assert 1 - time.after.rms / time.before.rms == pytest.approx(cut, abs=0.005)


def test_predictor_sees_beyond_nyquist() -> None:
    found = made(4).report.time.predictor
    assert found is not None
    assert found.error_rms < 1e-9
    assert np.ptp(np.array(found.held) - np.array(found.true)) > 1


def replay(equations: list[dict[str, Any]], signals: dict[str, Array]) -> Array:
    """c by its difference equations from recorded signals; nothing of ours but the numbers."""
    known = dict(signals)
    samples = len(next(iter(known.values())))
    waiting = list(equations)
    result = np.zeros(samples)
    while waiting:
        e = next(w for w in waiting if all(name in known for name, _ in w["inputs"]))
        writers = [w for w in waiting if w["output"] == e["output"]]
        waiting = [w for w in waiting if w["output"] != e["output"]]
        out = np.zeros(samples)
        for w in writers:
            at = np.arange(w["phase"], samples, w["every"])
            x = sum(gain * known[name][at] for name, gain in w["inputs"])
            x = np.concatenate([np.zeros(w["delay"]), x])[: len(at)]
            out[at] = lfilter(w["num"], w["den"], x)
        if len(writers) == 1 and e["every"] > 1 and not e["zero_between"]:
            out = np.repeat(out[:: e["every"]], e["every"])[:samples]
        if e["output"] == "c":
            result = out
        else:
            known[e["output"]] = out
    return result


@pytest.mark.parametrize("index", range(len(CASES)), ids=IDS)
def test_the_file_is_all_a_controller_needs(index: int, tmp_path: Path) -> None:
    designed = made(index)
    file = tmp_path / "controller.json"
    file.write_text(json.dumps(designed.report.controller))
    loaded = load_controller(file)
    spec, options = loaded.spec, loaded.options
    assert spec == load_loop(CASES[index][0])
    loop = spec.nominal()
    disturbance, enters = disturbance_of(options, loop)
    d = sample(disturbance, 4000, loop.dt_s)
    given = {"every": loaded.every, "sensor": spec.sensor}
    first = answer(loop, designed.controller.blocks, d, enters, **given)["y"]
    again = answer(loop, loaded.blocks, d, enters, **given)["y"]
    np.testing.assert_array_equal(first, again)

    inputs = {"d_out" if enters == "output" else "d_in": np.repeat(d, loaded.every)}
    names = ("ym", "u", "v", "c")
    run_of = simulate(loop, loaded.blocks, inputs, names, **given)
    signals = {**run_of, "r": np.zeros(len(run_of["ym"]))}
    equations = json.loads(file.read_text())["difference_equations"]
    scale = np.abs(run_of["c"]).max()
    assert scale > 0
    np.testing.assert_allclose(replay(equations, signals), run_of["c"], atol=1e-9 * scale)


def equations_of(header: str) -> list[dict[str, Any]]:
    """The difference equations that a C header describes, from its text alone."""
    constants = {
        name: [float(v) for v in values.split(",")]
        for name, values in re.findall(r"double (\w+)\[\d+\] = {(.*)};", header)
    }
    found = []
    for line in re.findall(r"^ \*   (.*)$", header, re.MULTILINE):
        output, through, wires, when = re.fullmatch(r"(\w+) = (\S*) ?\((.*)\)(.*)", line).groups()
        num, den = through.split("/") if through else ("1", "1")
        late = re.search(r"(\d+) runs late", when)
        turn = re.search(r"n mod (\d+) = (\d+)", when)
        every, phase = (int(v) for v in turn.groups()) if turn else (1, 0)
        found.append(
            {
                "output": output,
                "inputs": [(n, float(g)) for g, n in re.findall(r"(\S+) (\w+)", wires)],
                "num": constants.get(num, [1.0]),
                "den": constants.get(den, [1.0]),
                "delay": int(late[1]) if late else 0,
                "every": every,
                "phase": phase,
                "zero_between": "0 at the others" in when,
            }
        )
    return found


DETUNED = ("galvo-10khz", {"method": "fmsdob", "targets_hz": [500, 1500], "detuning": 0.8})
TABLE = ("direct-drive-table", {"method": "fmsdob", "targets_hz": [120], "bandwidth_hz": 10})


@pytest.mark.parametrize(("name", "document"), [*CASES, DETUNED, TABLE])
def test_the_c_header_is_all_a_controller_needs(name: str, document: dict[str, Any]) -> None:
    spec = load_loop(name)
    made = design_controller(spec, read_options(document)).controller
    every = round(spec.loop.dt_s / made.dt_s)
    generator = np.random.default_rng(1)
    inputs = {s: np.repeat(generator.normal(size=2000), every) for s in ("r", "d_in", "d_out")}
    watch = ("ym", "u", "v", "c")
    loop = spec.nominal()
    signals = inputs | simulate(loop, made.blocks, inputs, watch, every=every, sensor=spec.sensor)
    c = signals["c"]
    assert np.abs(c).max() > 0
    found = replay(equations_of(made.to_c_header()), signals)
    np.testing.assert_allclose(found, c, atol=1e-9 * np.abs(c).max())


def test_page_holds_everything_itself(tmp_path: Path) -> None:
    for index in (4, 7):
        write_controller(made(index), tmp_path)
        page = (tmp_path / "controller.html").read_text()
        assert page == render_controller(made(index).report)
        assert "<script" not in page
        links = Links()
        links.feed(page)
        assert links.found == ["data:,"]
        body = page[page.index("<body") :]  # a digest in the head may hold any letters
        assert "nan" not in body.lower().replace("nan-", "")
        json.loads((tmp_path / "controller.json").read_text())
        assert (tmp_path / "controller.h").read_text().startswith("/*")


class Links(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found += [v for k, v in attrs if k in ("href", "src") and v]


def test_names_cannot_become_code() -> None:
    document = load_loop("galvo-40khz").model_dump(mode="json", exclude_none=True)
    spec = LoopSpec.model_validate(document | {"title": "<script>x</script>"})
    page = render_controller(design_controller(spec, read_options(FMSDOB)).report)
    assert "<script" not in page


def test_methods_that_fit() -> None:
    fitting = {figures.name: figures.methods for figures in loop_figures()}
    assert sorted(fitting) == builtin_loops()
    assert fitting["galvo-camera"] == ("mmp",)
    assert "inverse-dob" in fitting["galvo-10khz"]
    assert "inverse-dob" not in fitting["galvo-40khz"]
    assert "dob" in fitting["direct-drive-table"]
    for name, document in CASES:
        assert document["method"] in fitting_methods(load_loop(name))


REFUSED: list[tuple[str, dict[str, Any], str]] = [
    ("galvo-40khz", FMSDOB | {"uncertainty": 2.0}, r"1/\|T\|"),
    ("galvo-40khz", FMSDOB | {"targets_hz": [2000, 30000]}, "30000 Hz"),
    ("galvo-40khz", FMSDOB | {"targets_hz": []}, "targets_hz"),
    ("galvo-40khz", FMSDOB | {"alpha": 0.5}, "no setting alpha"),
    ("galvo-40khz", {"method": "fmsdob"}, "needs targets_hz"),
    ("galvo-40khz", {"method": "magic"}, "'magic'; there are fmsdob"),
    (
        "galvo-40khz",
        FMSDOB | {"disturbance": {"kind": "sine"}},
        r"fmsdob: disturbance: 'kind' is 'sine', and must be one of 'narrowband'",
    ),
    ("galvo-40khz", FMSDOB | {"disturbance": {}}, "fmsdob: disturbance: must have a 'kind'"),
    ("galvo-40khz", {"method": "dob", "cutoff_hz": 100}, "zero"),
    ("galvo-40khz", {"method": "inverse-dob", "targets_hz": [2000]}, "fmsdob"),
    ("galvo-40khz", {"method": "mmp", "targets_hz": [2000]}, "slower than the loop"),
    ("galvo-camera", FMSDOB, "every 3th one"),
    ("galvo-camera", {"method": "mmp", "targets_hz": [5000 / 3]}, "singular|told apart"),
    ("galvo-40khz", {"method": "rc-quasi", "fundamental_hz": 1201}, "rc-wide"),
    ("galvo-40khz", {"method": "rc-wide", "fundamental_hz": 20}, "take a multiple of the fund"),
    ("galvo-40khz", FMSDOB | {"duration_s": 50}, "200000"),
    ("galvo-10khz", {"method": "fmsdob-adaptive", "floor_rms": 100}, "floor_rms 100 rms is heard"),
    (
        "galvo-10khz",
        {"method": "fmsdob-adaptive", "disturbance": {"kind": "wideband", "floor_rms": 0.01}},
        r"galvo-10khz.*Hz still moves by more than 12.5 Hz.*its tones are not 1; change tones",
    ),
    ("galvo-10khz", {"method": "fmsdob-adaptive", "uncertainty": 2}, "allows"),
    (
        "galvo-10khz",
        {"method": "rc-multirate", "fundamental_hz": 1200, "fast": "galvo-10khz"},
        "30000 Hz",
    ),
]


@pytest.mark.parametrize(("name", "document", "words"), REFUSED)
def test_refusals_say_why(name: str, document: dict[str, Any], words: str) -> None:
    with pytest.raises((DesignError, ModelError), match=words):
        design_controller(load_loop(name), read_options(document))


def test_documented_options_are_right() -> None:
    text = (Path(__file__).parents[2] / "docs" / "controllers.md").read_text()
    document = text.split("```json")[1].split("```")[0]
    report = design_controller(load_loop("galvo-40khz"), read_options(json.loads(document))).report
    assert report.time.duration_s == pytest.approx(0.5)
    for method in METHODS:
        assert f"| `{method}` |" in text


def test_options_hold_no_paths(tmp_path: Path) -> None:
    with pytest.raises(DesignError):
        read_options(FMSDOB | {"method": "rc-multirate", "fast": "../x.json"})
    with pytest.raises(ModelError):
        builtin_loop(str(tmp_path / "x.json"))


EDITS: list[tuple[Callable[[dict[str, Any]], Any], str]] = [
    (lambda d: d.pop("loop"), "loop"),
    (lambda d: d["difference_equations"].pop(), "write c"),
    (lambda d: d["difference_equations"][0].update(den=[1.0, -1.5]), "not stable"),
    (lambda d: d["difference_equations"][0].update(num=[]), "num"),
    (lambda d: d["difference_equations"][0].update(inputs=[["secret", 1.0]]), "must read"),
]


@pytest.mark.parametrize(("edit", "words"), EDITS)
def test_damaged_controllers_are_not_loaded(edit: Callable[[Any], Any], words: str) -> None:
    document = json.loads(json.dumps(made(0).report.controller))
    edit(document)
    with pytest.raises(DesignError, match=words):
        read_controller(json.dumps(document))


def test_the_command_writes_json_header_and_pages(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    targets = {name: tmp_path / name for name in ("c.json", "c.h", "pages")}
    files = ["--json", str(targets["c.json"]), "--c-header", str(targets["c.h"])]
    asked = ["controller", "--machine", "galvo-40khz", "--method", "fmsdob"]
    asked += ["--report", str(targets["pages"]), *files]
    assert run([*asked, "--targets-hz", "2000,4000", "--bandwidth-hz", "40"]) == 0
    shown = capsys.readouterr().out
    for words in ("min 1/|T|", "max |1 - PQ|", "noise gain", "multiplications", "largest |z|"):
        assert words in shown
    assert load_controller(targets["c.json"]).options == read_options(
        {"method": "fmsdob", "targets_hz": [2000, 4000], "bandwidth_hz": 40}
    )
    assert "static const double" in targets["c.h"].read_text()
    pages = sorted(p.name for p in targets["pages"].iterdir())
    assert pages == ["controller.h", "controller.html", "controller.json"]


@pytest.mark.parametrize(("said", "widths"), [("300,500", (300.0, 500.0)), ("none", None)])
def test_every_tone_may_have_a_band_of_its_own_or_none(
    said: str, widths: tuple[float, float] | None, tmp_path: Path
) -> None:
    """Paper 000: B_w,i of (16); without a band pass, propositions 4 and 6 alone."""
    file = tmp_path / "c.json"
    asked = ["controller", "-m", "galvo-40khz", "--method", "fmsdob", "--json", str(file)]
    assert run([*asked, "--targets-hz", "2000,7000", "--bandwidth-hz", said]) == 0
    wanted = fmsdob(load_loop("galvo-40khz").loops(), (2000.0, 7000.0), bandwidth_hz=widths)
    document = json.loads(file.read_text())
    assert document["coefficients"] == json.loads(json.dumps(wanted.to_dict()))["coefficients"]
    assert load_controller(file).options == read_options(
        {"method": "fmsdob", "targets_hz": [2000, 7000], "bandwidth_hz": widths}
    )


def test_the_tones_of_a_slow_sensor_may_have_bands_of_their_own(tmp_path: Path) -> None:
    """Paper 001, theorem 1: a width for each tone; the wide one settles sooner."""
    file = tmp_path / "c.json"
    asked = ["controller", "-m", "galvo-camera", "--method", "mmp", "--json", str(file)]
    assert run([*asked, "--targets-hz", "500,2000", "--bandwidth-hz", "2,40"]) == 0
    loaded = load_controller(file)
    assert loaded.options == read_options(
        {"method": "mmp", "targets_hz": [500, 2000], "bandwidth_hz": [2, 40]}
    )
    loop = load_loop("galvo-camera")
    t = np.arange(2000) * loop.loop.dt_s
    left = []
    for f_hz in (500, 2000):
        d = {"d_out": np.sin(2 * np.pi * f_hz * t)}
        y = simulate(loop.nominal(), loaded.blocks, d, sensor=loop.sensor)["y"]
        left.append(np.abs(y[-200:]).max())
    assert left[1] < 1e-3 < 0.1 < left[0]


@pytest.mark.parametrize("index", [i for i, name in enumerate(IDS) if name != "fmsdob-adaptive"])
def test_a_refusal_names_settings_that_the_method_has(index: int) -> None:
    name, document = CASES[index]
    options = read_options(document | {"uncertainty": 10})
    with pytest.raises(DesignError) as told:
        design_controller(load_loop(name), options)
    named = re.findall(r"detuning|alpha|[a-z]+_[a-z]+", str(told.value).rpartition(";")[2])
    assert named
    assert set(named) <= set(type(options).model_fields)


def test_a_document_keeps_a_null_that_is_not_the_default() -> None:
    """Else the same options would make another controller: alpha 0.95 in place of the fastest."""
    name, document = CASES[4]
    options = read_options(document | {"alpha": None})
    written = design_controller(load_loop(name), options).report.controller
    assert read_controller(json.dumps(written)).options == options
    assert "uncertainty" not in written["options"]


@pytest.mark.parametrize(
    ("widths", "said"),
    [
        ("a", "fmsdob: bandwidth_hz: must be a number"),
        ([40, 0], "fmsdob: bandwidth_hz.1: must be at least 0.001"),
        ([], "fmsdob: bandwidth_hz: "),
    ],
)
def test_a_wrong_width_is_told_where_it_stands(widths: object, said: str) -> None:
    with pytest.raises(DesignError) as told:
        read_options(FMSDOB | {"bandwidth_hz": widths})
    assert str(told.value).startswith(said)


@pytest.mark.parametrize(
    "wrong",
    [
        ["--targets-hz", "30000"],
        ["--targets-hz", "2000", "--bandwidth-hz", "40,50"],
        ["--targets-hz", "2000,x"],
        ["--targets-hz", "2000", "--uncertainty", "2"],
        ["--targets-hz", "2000", "--tones", "2"],
        [],
    ],
)
def test_refusals_leave_nothing(
    wrong: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = ["--json", str(tmp_path / "c.json"), "--c-header", str(tmp_path / "c.h")]
    asked = ["controller", "-m", "galvo-40khz", "--method", "fmsdob", *files]
    assert run([*asked, "--report", str(tmp_path / "pages"), *wrong]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_own_machine_and_options_from_files(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = load_loop("galvo-40khz").model_dump(mode="json", exclude_none=True) | {"name": "mine"}
    machine, options = tmp_path / "mine.json", tmp_path / "options.json"
    machine.write_text(json.dumps(own))
    tone = {"kind": "narrowband", "tones": [{"f_hz": 2000, "amplitude": 0.1}]}
    options.write_text(json.dumps(FMSDOB | {"disturbance": tone, "enters": "input"}))
    asked = ["controller", "-m", str(machine), "--options", str(options)]
    assert run([*asked, "--json", str(tmp_path / "c.json"), "--detuning", "0.9"]) == 0
    loaded = load_controller(tmp_path / "c.json")
    assert loaded.spec.name == "mine"
    assert loaded.options == read_options(json.loads(options.read_text()) | {"detuning": 0.9})
    both = str(tmp_path / "both")
    assert run([*asked, "--json", both, "--c-header", both]) == 2
    assert "name two files" in capsys.readouterr().err
    options.write_text("[1")
    assert run(asked) == 2
    assert "not JSON" in capsys.readouterr().err


def test_loops_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["loops"]) == 0
    shown = capsys.readouterr().out
    assert run(["controller", "--list"]) == 0
    assert capsys.readouterr().out == shown
    for name in builtin_loops():
        assert name in shown
