"""docs/architecture.md tells where every module is found."""

from __future__ import annotations

import re
from fnmatch import fnmatch
from pathlib import Path

import pytest

from tests.test_sizes import HERE, LAYERS

PAGE = (HERE / "docs" / "architecture.md").read_text("utf-8")
NAMED = set(re.findall(r"\w+", " ".join(re.findall(r"```.*?```|`[^`]+`", PAGE, re.DOTALL))))
PATTERNS = re.findall(r"`([\w/*]*\*[\w/*]*\.py)`", PAGE)
BESIDE_THE_LAYERS = {"benchmarks", "integrations", "src/stillpath"}


def is_found(path: Path) -> bool:
    """By its name, or by a pattern that stands for several."""
    place = path.relative_to(HERE).as_posix()
    return path.stem in NAMED or any(fnmatch(place, f"*{pattern}") for pattern in PATTERNS)


@pytest.mark.parametrize("layer", [one for one in LAYERS if one not in BESIDE_THE_LAYERS])
def test_every_module_is_named_on_the_page_of_the_architecture(layer: str) -> None:
    modules = [path for path in (HERE / layer).rglob("*.py") if not path.stem.startswith("__")]
    modules = [path for path in modules if "migrations" not in path.parts]
    missing = [path.relative_to(HERE).as_posix() for path in modules if not is_found(path)]
    assert missing == [], "say in docs/architecture.md what it is for"


def test_every_module_that_the_page_names_is_there() -> None:
    named = set(re.findall(r"`(?:[\w/]*/)?(\w+\.py)`", PAGE))
    layers = [path for one in (*LAYERS, "tests", "docs") for path in (HERE / one).rglob("*.py")]
    assert len(named) > 100
    assert named - {path.name for path in layers} == set()
