"""Takes the steps of a Dockerfile without an engine: below a folder, as scripts of this computer.

The paths that the file names (``/opt/stillpath`` and so on) are put below that folder wherever they
stand; both stages see them at the same place, as in an image. Base images are this Python.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

__all__ = ["Image", "build", "context_of"]

_MOVED = re.compile(r"(?<![\w.$}/-])/(opt/stillpath|src|dist|data)(?=[/\s:]|$)")
_SHIMS = {
    # Users are the host's business.
    "useradd": "exit 0",
    "install": 'for last; do :; done; mkdir -p "$last"',
}


@dataclass
class Image:
    """What the last stage says of how it is run; paths are already below `root`."""

    root: Path
    environment: dict[str, str] = field(default_factory=dict)
    workdir: str = "/"
    user: str = ""
    command: list[str] = field(default_factory=list)
    healthcheck: list[str] = field(default_factory=list)
    stop_signal: str = ""


def build(dockerfile: Path, context: Path, root: Path) -> Image:
    """Take all steps.

    Parameters
    ----------
    dockerfile, context : Path
        `context` as `context_of` makes it.
    root : Path
        A folder for everything; its path must hold no white space.
    """
    stages: dict[str, Path] = {}
    variables: dict[str, str] = {}
    image, stage, name = Image(root), root / "stage", ""
    bin_dir = _tools(root)
    for word, rest in _instructions(dockerfile.read_text()):
        match word:
            case "ARG":
                key, _, value = rest.partition("=")
                variables[key] = value
            case "FROM":
                assert _expand(rest.split()[0], variables) == f"python:{variables['PYTHON']}-slim"
                if stage.exists():
                    # Both stages have the same paths, so the first one makes way.
                    stages[name] = root / f"done-{name}"
                    stage.rename(stages[name])
                name = rest.split(" AS ")[1] if " AS " in rest else ""
                stage.mkdir()
                image = Image(root, {"PATH": f"{bin_dir}:{os.environ['PATH']}"})
            case "ENV":
                for part in shlex.split(rest):
                    key, _, value = part.partition("=")
                    value = _expand(value, image.environment)
                    image.environment[key] = ":".join(_moved(v, stage) for v in value.split(":"))
            case "WORKDIR":
                image.workdir = _moved(rest, stage)
                Path(image.workdir).mkdir(parents=True, exist_ok=True)
            case "COPY":
                _copy(rest, context, stages, stage, image.workdir)
            case "RUN":
                _run(_moved(rest, stage), image)
            case "USER":
                image.user = rest
            case "CMD":
                image.command = json.loads(rest)
            case "HEALTHCHECK":
                image.healthcheck = json.loads(rest.split("CMD", 1)[1])
            case "STOPSIGNAL":
                image.stop_signal = rest
            case "LABEL" | "VOLUME" | "EXPOSE":
                pass
            case _:
                raise AssertionError(f"no rule for {word}")
    return image


def context_of(checkout: Path, target: Path) -> Path:
    """Copy what a build is sent; .dockerignore is a list of exceptions to ``*``."""
    lines = (checkout / ".dockerignore").read_text().split()
    assert lines[0] == "*"
    for line in lines[1:]:
        if not line.startswith("!"):
            assert line == "**/__pycache__"
            continue
        source, place = checkout / line[1:], target / line[1:]
        place.parent.mkdir(parents=True, exist_ok=True)
        if source.is_dir():
            shutil.copytree(
                source, place, symlinks=True, ignore=shutil.ignore_patterns("__pycache__")
            )
        else:
            shutil.copy2(source, place)
    return target


def _instructions(text: str) -> list[tuple[str, str]]:
    lines = [line for line in text.splitlines() if not line.lstrip().startswith("#")]
    joined = re.sub(r"\\\n\s*", " ", "\n".join(lines))
    found = [line.split(None, 1) for line in joined.splitlines() if line.strip()]
    return [(word, rest.strip()) for word, rest in found]


def _moved(text: str, stage: Path) -> str:
    return _MOVED.sub(lambda match: f"{stage}/{match[1]}", text)


def _expand(text: str, variables: dict[str, str]) -> str:
    return re.sub(r"\$\{?(\w+)\}?", lambda match: variables[match[1]], text)


def _tools(root: Path) -> Path:
    """Make a folder of programs: this Python as ``python``, and what only an image needs."""
    folder = root / "bin"
    folder.mkdir(parents=True)
    (folder / "python").symlink_to(Path(sys.executable).resolve())
    for name, script in _SHIMS.items():
        (folder / name).write_text(f"#!/bin/sh\n{script}\n")
        (folder / name).chmod(0o755)
    return folder


def _copy(rest: str, context: Path, stages: dict[str, Path], stage: Path, workdir: str) -> None:
    *sources, place = rest.split()
    base = context
    if sources[0].startswith("--from="):
        base = stages[sources.pop(0).removeprefix("--from=")]
    target = Path(_moved(place, stage)) if place.startswith("/") else Path(workdir) / place
    for source in (base / source.lstrip("/") for source in sources):
        assert source.exists(), f"COPY {source.name}: .dockerignore keeps it out, or it is gone"
        if source.is_dir():
            shutil.copytree(source, target, symlinks=True, dirs_exist_ok=True)
        elif place.endswith("/"):
            target.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source, target / source.name)
        else:
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source, target)
    for path in target.rglob("*"):
        if not path.is_symlink():  # layers keep whole seconds
            os.utime(path, ns=(time := path.stat().st_mtime_ns // 10**9 * 10**9, time))


def _run(script: str, image: Image) -> None:
    done = subprocess.run(
        ["/bin/sh", "-ec", script],
        cwd=image.workdir,
        env={**image.environment, "HOME": str(image.root)},
        capture_output=True,
        text=True,
        timeout=1800,
    )
    assert done.returncode == 0, f"RUN {script}\n{done.stdout[-3000:]}\n{done.stderr[-3000:]}"
