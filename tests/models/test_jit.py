"""Machine code that is kept on disk is never older than the sources it was made from."""

from __future__ import annotations

import ast
import errno
import importlib
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from numba.core.caching import IndexDataCacheFile

from stillpath.models import jit
from tests.checkout import PYTHONPATH

ROOT = Path(jit.__file__).parents[1]
CALLER = """
from stillpath.models.jit import kernel
from tools.inner import double
from tools.numbers import OFFSET

@kernel
def outer(x: float) -> float:
    return double(x) + OFFSET

@kernel(allocates=False)
def fill(values, out) -> None:
    for k in range(len(out)):
        out[k] = double(values[k]) + OFFSET
"""
INNER = """
from stillpath.models.jit import kernel

@kernel
def double(x: float) -> float:
    return FACTOR * x
"""


@pytest.fixture
def tools(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    folder = tmp_path / "tools"
    folder.mkdir()
    (folder / "__init__.py").touch()
    (folder / "caller.py").write_text(CALLER)
    monkeypatch.syspath_prepend(str(tmp_path))
    # A change in the same second and of the same size leaves no other trace than its text.
    monkeypatch.setattr(sys, "dont_write_bytecode", True)

    def load(factor: float, offset: float) -> ModuleType:
        (folder / "inner.py").write_text(INNER.replace("FACTOR", f"{factor}"))
        (folder / "numbers.py").write_text(f"OFFSET = {offset}\n")
        for name in [name for name in sys.modules if name.split(".")[0] == "tools"]:
            del sys.modules[name]
        jit.source_digest.cache_clear()
        jit._text_digest.cache_clear()
        importlib.invalidate_caches()
        return importlib.import_module("tools.caller")

    yield load
    for name in [name for name in sys.modules if name.split(".")[0] == "tools"]:
        del sys.modules[name]


def test_a_change_in_what_a_kernel_imports_is_noticed(tools) -> None:
    assert tools(2.0, 1.0).outer(3.0) == 7.0
    again = tools(2.0, 1.0)
    assert again.outer(3.0) == 7.0
    assert sum(again.outer.stats.cache_hits.values()) == 1
    assert tools(5.0, 1.0).outer(3.0) == 16.0
    assert tools(5.0, 2.0).outer(3.0) == 17.0


@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
def test_a_damaged_file_is_compiled_anew(tools, suffix: str) -> None:
    first = tools(2.0, 1.0)
    assert first.outer(3.0) == 7.0
    (file,) = Path(first.outer.stats.cache_path).glob(f"caller.outer*.{suffix}")
    file.write_bytes(file.read_bytes()[:40])
    again = tools(2.0, 1.0)
    assert again.outer(3.0) == 7.0
    assert sum(again.outer.stats.cache_hits.values()) == 0
    third = tools(2.0, 1.0)
    assert third.outer(3.0) == 7.0
    assert sum(third.outer.stats.cache_hits.values()) == 1


def test_code_of_earlier_sources_is_not_taken_for_what_a_full_disk_lost(
    tools, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert tools(2.0, 1.0).outer(3.0) == 7.0

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    # The index is small, and is written first.
    with monkeypatch.context() as disk:
        disk.setattr(IndexDataCacheFile, "_save_data", full)
        assert tools(5.0, 1.0).outer(3.0) == 16.0
    assert tools(5.0, 1.0).outer(3.0) == 16.0
    again = tools(5.0, 1.0)
    assert again.outer(3.0) == 16.0
    assert sum(again.outer.stats.cache_hits.values()) == 1


def test_a_kernel_from_disk_fills_arrays_as_a_fresh_one(tools) -> None:
    values = np.linspace(-1.0, 1.0, 9)
    fresh, loaded = tools(3.0, 0.5), tools(3.0, 0.5)
    results = []
    for module in (fresh, loaded):
        out = np.zeros(9)
        module.fill(values, out)
        results.append(out)
    assert sum(loaded.fill.stats.cache_hits.values()) == 1
    np.testing.assert_array_equal(*results)
    np.testing.assert_array_equal(results[0], 3.0 * values + 0.5)


def test_a_kernel_from_disk_is_called_by_one_that_is_not(tools, tmp_path: Path) -> None:
    tools(2.0, 1.0)
    script = "import sys; import tools.caller as c; from tools.inner import double; {}; print({})"
    inner, outer = "double(3.0)", "c.outer(3.0)"
    found = [
        subprocess.run(
            [sys.executable, "-B", "-c", script.format(first, f"{then}, c.outer.stats.cache_hits")],
            env=os.environ | {"PYTHONPATH": f"{tmp_path}{os.pathsep}{PYTHONPATH}"},
            capture_output=True,
            check=True,
            text=True,
        ).stdout.strip()
        for first, then in ((inner, inner), (inner, outer), ("pass", outer))
    ]
    # Compiled for itself; read, and compiled into its caller; the caller read, it not.
    assert found == [
        "6.0 Counter()",
        "7.0 Counter()",
        "7.0 Counter({(float64,): 1})",
    ]


def _kernel_modules() -> list[Path]:
    names = ("models", "gcode", "compensation", "simulation", "pipeline", "reports", "applications")
    files = [file for name in names for file in (ROOT / name).rglob("*.py")]
    return [file for file in files if "models.jit import" in file.read_text(encoding="utf-8")]


def test_every_import_of_a_kernel_module_is_seen() -> None:
    """The digest finds imports by their line alone: whole modules, at the start of a line."""
    files = _kernel_modules()
    assert len(files) > 20
    for file in files:
        tree = ast.parse(file.read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom):
                modules = [node.module or ""]
            elif isinstance(node, ast.Import):
                modules = [alias.name for alias in node.names]
            else:
                continue
            for module in modules:
                assert not (ROOT / "src" / module.replace(".", "/")).is_dir(), (file, module)
                if (ROOT / "src" / f"{module.replace('.', '/')}.py").is_file():
                    assert module in jit._text_digest(file)[1], (file, module)
