"""The script for Cura, called as its plugin does, with the real server and the real program."""

from __future__ import annotations

import ast
import shlex
import sys
import types
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stillpath.pipeline.options import Options
from tests.integrations.cura import Cura
from tests.integrations.posting import PROGRAM, environment

LAYERS = [
    ";FLAVOR:Marlin\n;TIME:6666\n",
    ";Generated with Cura_SteamEngine 4.13.0\nG28 ;zu Hause – größer\n",
    ";LAYER:0\nG1 X10 Y10 F6000\n",
    ";LAYER:1\nG1 X20\n",
    "",
    ";LAYER:2\nG1 X30",
    " Y40\nM84\n;End of Gcode\n",
]


both_ways = pytest.mark.parametrize("script", ["server", "command"], indirect=True)


@pytest.fixture
def cura(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Cura:
    for name, value in environment(tmp_path).items():
        monkeypatch.setenv(name, value)
    made = Cura()
    made.install(monkeypatch)
    return made


@pytest.fixture
def script(request: Any, cura: Cura, address: str) -> Any:
    """With the server itself, or where it is asked for with the program."""
    made = cura.load()
    made.values |= {
        "where": getattr(request, "param", "server"),
        "machine": "ender3",
        "server": address,
    }
    made.values["command"] = " ".join(
        shlex.quote(word) for word in (sys.executable, str(PROGRAM), "--server", address)
    )
    return made


@both_ways
def test_layers_come_back_as_layers(cura: Cura, script: Any):
    given_layers = list(LAYERS)
    made = cura.write_started([script], given_layers)
    assert given_layers == LAYERS
    # What does not begin on a line of its own has joined the item before it.
    assert made == [
        "; compensated\n" + LAYERS[0] + ";POSTPROCESSED\n",
        *LAYERS[1:5],
        LAYERS[5] + LAYERS[6],
        "",
    ]
    ((kind, text),) = cura.shown
    assert kind == "POSITIVE"
    assert "preview" in text
    assert cura.write_started([script], made) is made


@both_ways
def test_failures_are_seen_and_the_layers_stay(cura: Cura, script: Any):
    layers = ["bad\nG1\n", "G1\n", "G1\nG1\nG1 X1e400\n"]
    made = cura.write_started([script], list(layers))
    assert made == ["bad\nG1\n;POSTPROCESSED\n", *layers[1:]]
    ((kind, text),) = cura.shown
    assert kind == "ERROR"
    assert "NOT compensated" in text
    # The server's seventh line is Cura's fifth: two lines were ours.
    assert "line 5: X1e400 is too large" in text
    assert "slice again" in text
    assert cura.logged


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"where": "server", "machine": ""}, ("no machine",)),
        ({"where": "server", "machine": "nope"}, ("nope", "ender3")),
        ({"where": "server", "server": "nas"}, ("http://127.0.0.1:8000",)),
        ({"where": "server", "method": "magic"}, ("method", "magic")),
        ({"where": "command", "command": "/gone/stillpath-post"}, ("/gone/", "cannot be run")),
        ({"where": "command", "command": "false"}, ("does not say why", "exit code 1")),
        ({"where": "command", "command": "~/gone/x"}, (f"{Path.home()}/gone/x", "cannot be run")),
        ({"where": "command", "command": "'/gone/x"}, ("a quote is not closed",)),
        ({"where": "command", "command": ""}, ("cannot be run",)),
    ],
)
def test_mistakes_in_the_panel(cura: Cura, address: str, values: dict[str, str], words: tuple):
    made = cura.load()
    made.values |= {"server": address, "machine": "ender3", **values}
    assert cura.write_started([made], list(LAYERS))[1:] == LAYERS[1:]
    ((kind, text),) = cura.shown
    assert kind == "ERROR"
    for word in words:
        assert word in text


def test_nothing_to_do_and_marks_of_our_own(cura: Cura, script: Any):
    for layers in ([""], ["G1\n;STILLPATH_ITEM:1\n"]):
        assert script.execute(layers) == layers
        assert cura.shown[-1][0] == "ERROR"


def test_the_printer_of_cura_chooses_the_machine(cura: Cura, script: Any, tmp_path: Path):
    settings = tmp_path / "config" / "stillpath" / "post.toml"
    settings.parent.mkdir(parents=True)
    # A failure must be seen, whatever the settings of the program say.
    settings.write_text('on_error = "keep"\n[machines]\n"My *" = "voron-v0"\n')
    script.values |= {"machine": "", "where": "command"}
    cura.write_started([script], list(LAYERS))
    assert cura.shown[-1][0] == "POSITIVE", cura.shown
    cura.printer = "Another"
    cura.write_started([script], list(LAYERS))
    assert cura.shown[-1][0] == "ERROR"
    assert 'no machine is set for the printer "Another"' in cura.shown[-1][1]


def test_reports(cura: Cura, script: Any, tmp_path: Path):
    cura.job = "büste"
    script.values["reports"] = str(tmp_path / "my reports")
    cura.write_started([script], list(LAYERS))
    report = tmp_path / "my reports" / "büste.stillpath.html"
    assert report.read_text().startswith("<!doctype html>")
    assert str(report) in cura.shown[-1][1]


def test_a_report_that_cannot_be_written_stops_nothing(cura: Cura, script: Any, tmp_path: Path):
    (tmp_path / "file").touch()
    script.values["reports"] = str(tmp_path / "file")
    made = cura.write_started([script], list(LAYERS))
    assert made[0].startswith("; compensated\n")
    assert cura.shown[-1][0] == "POSITIVE", cura.shown


def test_a_report_that_does_not_come_stops_nothing(
    cura: Cura, script: Any, address: str, tmp_path: Path
):
    script.values |= {"server": f"{address}/unreported", "reports": str(tmp_path)}
    made = cura.write_started([script], list(LAYERS))
    assert made[0].startswith("; compensated\n")
    assert cura.shown[-1][0] == "POSITIVE", cura.shown
    assert "Report: none (The report is gone.)" in cura.shown[-1][1]


def test_settings_that_cura_read_back_are_text(cura: Cura, script: Any):
    script.values |= {key: str(value) for key, value in script.values.items()}
    script.values["tolerance_um"] = "2,5"
    cura.write_started([script], list(LAYERS))
    assert cura.shown[-1][0] == "POSITIVE", cura.shown


def test_a_budget_is_told_only_where_there_is_one(cura: Cura, script: Any):
    assert "budget_um" not in script._options()
    script.values["budget_um"] = 12.5
    assert Options(**script._options()).budget_um == 12.5
    # Not left out in silence: Stillpath says why it cannot be.
    script.values["features"] = "walls"
    with pytest.raises(ValueError, match="budget_um makes the whole print faster"):
        Options(**script._options())


def test_the_panel(cura: Cura):
    definition = cura.load().definition
    for key, setting in definition.items():
        assert key == key.lower()  # Cura's file of settings knows no capitals
        assert {"label", "description", "type", "default_value"} <= setting.keys()
        if setting["type"] == "enum":
            assert setting["default_value"] in setting["options"]
        enabled = setting.get("enabled")
        assert enabled is None or ast.parse(enabled).body[0].value.left.id in definition
    for method in definition["method"]["options"]:
        Options(method=method)
    for robust in definition["robust"]["options"]:
        Options(robust=robust)
    fields = Options.model_fields
    for key in ("method", "robust", "tolerance_um"):
        assert definition[key]["default_value"] == fields[key].default


@given(st.lists(st.text(st.sampled_from("ab;\n\r é"), max_size=6), min_size=1, max_size=6))
def test_cutting_gives_back_what_was_joined(items: list[str]):
    with pytest.MonkeyPatch.context() as monkeypatch:
        cura = Cura()
        cura.install(monkeypatch)
        module = _module(cura)
    text, marks = module._joined(items)
    made = module._parted(text, marks, len(items))
    assert len(made) == len(items)
    assert "".join(made) == "".join(items)
    whole = [i for i in range(len(items)) if all(not x or x.endswith("\n") for x in items[:i])]
    for index in whole[:-1]:
        assert made[index] == items[index]


def test_a_bundled_cura_lends_its_libraries_to_nobody(cura: Cura, monkeypatch):
    module = _module(cura)
    monkeypatch.setenv("LD_LIBRARY_PATH", "/opt/cura")
    monkeypatch.setenv("PYTHONHOME", "/opt/cura")
    assert module._environment("a")["LD_LIBRARY_PATH"] == "/opt/cura"
    monkeypatch.setattr(sys, "frozen", True, raising=False)
    assert not {"LD_LIBRARY_PATH", "PYTHONHOME"} & module._environment("a").keys()
    monkeypatch.setenv("LD_LIBRARY_PATH_ORIG", "/mine")
    assert module._environment("a")["LD_LIBRARY_PATH"] == "/mine"


def _module(cura: Cura) -> Any:
    """Return the names of the script's file."""
    return types.SimpleNamespace(**type(cura.load()).execute.__globals__)
