"""The public Python interface: the examples of docs/python.md run as they stand there."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

import stillpath
from stillpath.models.identification.synthetic import simulate_log, write_raw_data
from stillpath.models.identification.types import Excitation
from stillpath.models.plants import PairsSpec, PolePair
from tests.checkout import PYTHONPATH
from tests.web.served import running

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
LAYERS = [path.name for path in (ROOT / "src" / "stillpath").iterdir() if path.is_symlink()]
EXAMPLES = dict(re.findall(r"^## (.+?)\n.*?```python\n(.+?)```", PAGE, re.DOTALL | re.MULTILINE))


def test_what_is_public_is_there_and_told() -> None:
    for name in stillpath.__all__:
        assert getattr(stillpath, name) is not None
        assert name == "__version__" or f"`{name}" in PAGE
    with pytest.raises(AttributeError, match="no attribute 'compensator'"):
        stillpath.compensator  # noqa: B018


def test_processes_of_tests_run_this_checkout(tmp_path: Path) -> None:
    """They ran the one that is installed, whose code may be another."""
    code = "import stillpath, tests; print(stillpath.__file__, tests.__path__[0])"
    found = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"PYTHONPATH": PYTHONPATH},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.split()
    assert found == [str(ROOT / "src" / "stillpath" / "__init__.py"), str(ROOT / "tests")]


def test_a_motion_does_not_take_the_place_of_its_print(tmp_path: Path) -> None:
    source, link = tmp_path / "part.gcode", tmp_path / "motion.npz"
    source.write_text("G28\nG1 X10 Y10 F3000\n")
    link.symlink_to(source)
    for target in (source, link):
        with pytest.raises(stillpath.GcodeError, match="is the file that is read"):
            stillpath.plan(source, target, "ender3")
    assert source.read_text() == "G28\nG1 X10 Y10 F3000\n"


@pytest.mark.parametrize("kind", [str, Path])
def test_one_measurement_needs_no_list(kind: type, tmp_path: Path) -> None:
    with pytest.raises(stillpath.ModelError, match=r"cannot read .*lost\.csv"):
        stillpath.identify(kind(tmp_path / "lost.csv"), "ender3", name="mine")


def test_rooms_are_imported_below_stillpath_only() -> None:
    package = ROOT / "src" / "stillpath"
    layers = [path.name for path in package.iterdir() if path.is_dir() and path.name[0] != "_"]
    files = [path for layer in layers for path in (package / layer).rglob("*.py")]
    assert len(files) > 300
    other = re.compile(rf"^\s*(?:from|import) (?:{'|'.join(layers)})\b", re.MULTILINE)
    assert [path for path in files if other.search(path.read_text(encoding="utf-8"))] == []


def test_a_checkout_without_links_makes_the_same_wheel(tmp_path: Path) -> None:
    # Git on Windows and zip files leave short texts in their place.
    checkout, package = tmp_path / "checkout", tmp_path / "checkout" / "src" / "stillpath"
    package.mkdir(parents=True)
    for path in (ROOT / "src" / "stillpath").iterdir():
        if path.is_symlink():
            (package / path.name).write_text(f"../../{path.name}")
        elif path.is_file():
            shutil.copy(path, package)
    for name in ("pyproject.toml", "README.md", "LICENSE", "docs", "integrations", *LAYERS):
        (checkout / name).symlink_to(ROOT / name)
    build = [sys.executable, "-m", "hatchling", "build", "--target", "wheel", "-d", str(tmp_path)]
    subprocess.run(build, cwd=checkout, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    made = {name for name in names if name.endswith(".py")}
    package = ROOT / "src" / "stillpath"
    modules = [*package.glob("*.py"), *(p for k in LAYERS for p in (package / k).rglob("*.py"))]
    assert made == {p.relative_to(ROOT / "src").as_posix() for p in modules} | {"stillpath_post.py"}
    texts = {p.relative_to(ROOT).as_posix() for p in (ROOT / "docs").rglob("*.md")}
    assert {f"stillpath/{text}" for text in texts} == {
        n for n in names if "/docs/" in n and n.endswith(".md")
    }
    assert "stillpath/docs/images/corner.svg" in names


def test_python_runs_it_as_a_module() -> None:
    told = subprocess.run(
        [sys.executable, "-m", "stillpath", "--version"], capture_output=True, text=True, check=True
    )
    assert stillpath.__version__ in told.stdout


@pytest.mark.slow
def test_it_is_installed_beside_modules_of_the_same_names(tmp_path: Path) -> None:
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    build = ["wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", str(tmp_path), str(ROOT)]
    subprocess.run([*pip, *build], check=True)
    (wheel,) = tmp_path.glob("stillpath-*.whl")
    site = tmp_path / "site"
    subprocess.run([*pip, "install", "--no-deps", "--target", str(site), str(wheel)], check=True)
    for name in ("models", "service", "gcode", "pipeline"):
        (site / f"{name}.py").write_text("WHOSE = 'another project'\n")
    code = (
        "import models, service, gcode, pipeline, stillpath; "
        "print(models.WHOSE, service.WHOSE, stillpath.load_machine('ender3').name, "
        "stillpath.__file__)"
    )
    told = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"PYTHONPATH": str(site)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    assert told.stdout.startswith(f"another project another project ender3 {site}")
    assert sorted(path.name for path in site.glob("stillpath*")) == [
        "stillpath",
        f"stillpath-{stillpath.__version__}.dist-info",
        "stillpath_post.py",
    ]


@pytest.mark.slow
@pytest.mark.parametrize("title", EXAMPLES)
def test_an_example_of_the_page_runs(
    title: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(ROOT / "examples" / "ps_ender3_pauses_hept24f.gcode", "part.gcode")
    code = EXAMPLES[title]
    if "raw_data" in code:
        for k, axis in enumerate("xy"):
            plants = {axis: PairsSpec(poles=(PolePair(f_hz=40.0 + 10.0 * k, zeta=0.05),))}
            direction = Excitation((1.0, 0.0) if axis == "x" else (0.0, 1.0))
            log = simulate_log(plants, direction, rng=np.random.default_rng(k))
            write_raw_data(log, tmp_path, f"20261120_18{10 + 5 * k}00")
    if "Client" in code:
        with running(tmp_path / "service") as service:
            exec(code.replace("http://127.0.0.1:8000", service.url), {})
    else:
        exec(code, {})
    if "part.stillpath.gcode" in code:
        assert b"; Processed by stillpath" in Path("part.stillpath.gcode").read_bytes()
    if "print" in code:
        assert capsys.readouterr().out.strip()


def test_there_are_examples() -> None:
    assert len(EXAMPLES) >= 5
