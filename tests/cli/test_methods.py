"""Methods and defaults stand in places that must not import one another; here they are compared."""

from __future__ import annotations

import ast
import re
from pathlib import Path
from typing import Any

import pytest
from pydantic import TypeAdapter, ValidationError

from stillpath.cli.arguments import METHODS, CompensationOptions
from stillpath.cli.post import Refused, compensate_in_place
from stillpath.compensation.defaults import DEFAULT_BASIS, DEFAULT_METHOD
from stillpath.compensation.fbf import PreviewFbf
from stillpath.compensation.registry import COMPENSATORS
from stillpath.models.store import load_machine
from stillpath.pipeline.options import MethodName, Options
from stillpath.service.api.schemas import JobQuery

ROOT = Path(__file__).parents[2]
ALL = {*COMPENSATORS, "none", "advise", "live"}


def literal(path: str, name: str) -> Any:
    """Return what a module assigns to a name, without running it."""
    for node in ast.parse((ROOT / path).read_text()).body:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        if any(isinstance(target, ast.Name) and target.id == name for target in targets):
            return ast.literal_eval(node.value)
    raise LookupError(name)


def test_options_take_every_compensator_and_nothing_else():
    method: TypeAdapter[str] = TypeAdapter(MethodName)
    for name in COMPENSATORS:
        assert method.validate_python(name) == name
        assert method.validate_python(f"{name}+ripple") == f"{name}+ripple"
    for name in ("none", "none+ripple", "advise", "live"):
        assert method.validate_python(name) == name
    for wrong in (
        "",
        "magic",
        "fbf+",
        "fbf\n",
        "advise+ripple",
        "shaper:",
        "FBF",
        "fbf+ripple+ripple",
    ):
        with pytest.raises(ValidationError, match="unknown method; choose fbf"):
            Options(method=wrong)


def test_what_slicers_call_says_which_option_is_wrong(tmp_path: Path):
    options = {"machine": "ender3", "budget_um": -1.0}
    with pytest.raises(Refused, match=r"^--budget-um: must be at least 0\.5 µm \(given: -1\)$"):
        compensate_in_place(tmp_path / "part.gcode", options, name="part", tell=print)


def test_the_help_names_them_all():
    listed = re.split(r"; any with", METHODS)[0]
    assert {*listed.split(", "), "advise", "live"} == ALL
    assert "or advise: " in METHODS
    assert "or live: " in METHODS


def test_the_api_names_them_all():
    description = str(JobQuery.model_fields["method"].description)
    named = set(re.findall(r"`([a-z-]+)`", description))
    shapers = re.search(r"`shaper:NAME` \(([^)]+)\)", description)
    assert shapers is not None
    assert named | {f"shaper:{name}" for name in shapers[1].split(", ")} == ALL


def test_the_page_offers_them_all():
    methods = (ROOT / "service/web/lib/methods.js").read_text()
    block = methods.split("const METHODS = [", 1)[1].split("];\n", 1)[0]
    assert set(re.findall(r'\["([^"]+)", "', block)) == ALL - {"live"}
    assert 'method: "live"' in (ROOT / "service/web/views/new-job.js").read_text()


def test_cura_offers_all_that_write_a_file():
    offered = literal("integrations/cura/Stillpath.py", "_SETTINGS")["method"]["options"]
    assert set(offered) == ALL - {"live"}


def test_octoprint_offers_all_that_change_a_file():
    offered = literal("integrations/octoprint/octoprint_stillpath/choices.py", "METHODS")
    assert {name for name, _ in offered} == ALL - {"none", "live"}


def test_every_place_has_the_same_defaults():
    usual = Options()
    assert (usual.method, usual.basis) == (DEFAULT_METHOD, DEFAULT_BASIS)
    asked = JobQuery(machine="ender3")
    on_the_command_line = CompensationOptions()
    for name in ("method", "basis", "robust", "where"):
        assert getattr(asked, name) == getattr(on_the_command_line, name) == getattr(usual, name)
    assert on_the_command_line.chosen() == usual
    octoprint = literal("integrations/octoprint/octoprint_stillpath/choices.py", "DEFAULTS")
    cura = literal("integrations/cura/Stillpath.py", "_SETTINGS")
    for name in ("method", "robust", "tolerance_um"):
        assert octoprint[name] == cura[name]["default_value"] == getattr(usual, name)


def test_the_page_offers_the_defaults_first():
    script = (ROOT / "service/web/views/new-job.js").read_text()
    methods = (ROOT / "service/web/lib/methods.js").read_text()
    usual = Options()
    for name in ("basis", "robust", "where", "times"):
        first = re.search(rf'const {name} = select\("{name}", \[\["", \[\["([^"]+)", ', script)
        assert first is not None
        assert first[1] == getattr(usual, name)
    assert methods.split("const METHODS = [", 1)[1].split('["', 3)[2].startswith(f'{usual.method}"')
    along = re.search(r'id: "along",.*placeholder: "([^"]+)"', script)
    assert along is not None
    compensator = PreviewFbf(load_machine("generic-corexy"), 1e-3, along=usual.along)
    assert float(along[1]) == compensator.along
