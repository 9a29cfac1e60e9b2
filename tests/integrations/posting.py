"""Running the program for slicers, as a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from tests.checkout import PYTHONPATH

__all__ = ["PROGRAM", "ROOT", "environment", "finish", "post", "start"]

ROOT = Path(__file__).resolve().parents[2]
PROGRAM = ROOT / "integrations" / "slicers" / "stillpath_post.py"
_LONGEST_S = 600


def environment(folder: Path, **more: str) -> dict[str, str]:
    """A user's environment of its own, whose settings and data lie in `folder`."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("SLIC3R_", "STILLPATH_"))}
    # Compiled kernels lie in the cache of the real user.
    return kept | {
        "XDG_CONFIG_HOME": str(folder / "config"),
        "XDG_DATA_HOME": str(folder / "data"),
        "PYTHONPATH": PYTHONPATH,
        **more,
    }


def start(
    *arguments: object, home: Path, command: list[str] | None = None, **more: str
) -> subprocess.Popen[str]:
    """Start the program. Its standard input stays open and silent: reading it would hang."""
    program = [sys.executable, str(PROGRAM)] if command is None else command
    return subprocess.Popen(
        [*program, *map(str, arguments)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment(home, **more),
        cwd=home,
    )


def finish(process: subprocess.Popen[str]) -> subprocess.CompletedProcess[str]:
    """Wait for the end of both streams, then for the process, as slicers do."""
    assert process.stdin is not None
    assert process.stdout is not None
    assert process.stderr is not None
    try:
        # `communicate` would close the input.
        process.wait(_LONGEST_S)
        out, err = process.stdout.read(), process.stderr.read()
    finally:
        process.kill()
        process.wait()
        for stream in (process.stdin, process.stdout, process.stderr):
            stream.close()
    return subprocess.CompletedProcess(process.args, process.returncode, out, err)


def post(
    *arguments: object, home: Path, command: list[str] | None = None, **more: str
) -> subprocess.CompletedProcess[str]:
    """Run the program to its end."""
    return finish(start(*arguments, home=home, command=command, **more))
