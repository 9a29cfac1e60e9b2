"""Functions and modules stay as small as the house rules want them."""

from __future__ import annotations

import ast
import functools
from collections.abc import Iterator
from pathlib import Path

import pytest

HERE = Path(__file__).resolve().parents[1]
LAYERS = (
    "applications",
    "benchmarks",
    "cli",
    "compensation",
    "gcode",
    "integrations",
    "models",
    "pipeline",
    "reports",
    "service",
    "simulation",
    "src/stillpath",
)
MOST_LINES, MOST_PARAMETERS, MOST_MODULE_LINES = 60, 8, 500
INTERFACES = ("cli", "service/api")
"""Parameters of commands and routes, which are public there, are what a user sees."""
ALONE = ("integrations",)
"""A file that other programs take by itself cannot be divided."""

Function = ast.FunctionDef | ast.AsyncFunctionDef


def sources(layer: str) -> Iterator[tuple[str, str]]:
    for path in sorted((HERE / layer).rglob("*.py")):
        if not path.stem.endswith("_kernels"):
            yield path.relative_to(HERE).as_posix(), path.read_text("utf-8")


@functools.cache
def functions(layer: str) -> list[tuple[str, Function]]:
    return [
        (path, node)
        for path, text in sources(layer)
        for node in ast.walk(ast.parse(text))
        if isinstance(node, Function)
        and not any("njit" in ast.unparse(decorator) for decorator in node.decorator_list)
    ]


def parameters(function: Function) -> int:
    given = function.args
    names = [a.arg for a in (*given.posonlyargs, *given.args, *given.kwonlyargs)]
    names += [a.arg for a in (given.vararg, given.kwarg) if a is not None]
    return len([name for name in names if name not in ("self", "cls")])


@pytest.mark.parametrize("layer", LAYERS)
def test_functions_are_short(layer: str) -> None:
    found = [
        f"{path}:{one.lineno} {one.name}: {one.end_lineno - one.lineno + 1} lines"
        for path, one in functions(layer)
        if one.end_lineno is not None and one.end_lineno - one.lineno + 1 > MOST_LINES
    ]
    assert found == [], f"more than {MOST_LINES} lines, from def to end: find the natural part"


@pytest.mark.parametrize("layer", LAYERS)
def test_functions_take_few_parameters(layer: str) -> None:
    found = [
        f"{path}:{one.lineno} {one.name}: {parameters(one)} parameters"
        for path, one in functions(layer)
        if parameters(one) > MOST_PARAMETERS
        and not (path.startswith(INTERFACES) and not one.name.startswith("_"))
    ]
    assert found == [], f"more than {MOST_PARAMETERS} parameters: what belongs together is a record"


@pytest.mark.parametrize("layer", [layer for layer in LAYERS if layer not in ALONE])
def test_modules_hold_one_idea(layer: str) -> None:
    lines = {path: len(text.splitlines()) for path, text in sources(layer)}
    assert {path: n for path, n in lines.items() if n > MOST_MODULE_LINES} == {}
