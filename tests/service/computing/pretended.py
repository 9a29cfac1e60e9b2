"""Tasks that do what a hostile question would; importable by name from a new process."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

from models.errors import ModelError

__all__ = ["break_down", "die", "echo", "grow", "refuse", "sleep"]


def echo(given: dict[str, Any]) -> Any:
    return given


def sleep(given: dict[str, Any]) -> None:
    Path(given["mark"]).write_text(str(os.getpid()))
    time.sleep(given["seconds"])


def grow(given: dict[str, Any]) -> int:
    return len(bytearray(b"x") * (given["mib"] << 20))


def refuse(_: dict[str, Any]) -> None:
    raise ModelError("7 bins, at least 16 are needed")


def break_down(_: dict[str, Any]) -> None:
    raise RuntimeError("a secret of the server")


def die(_: dict[str, Any]) -> None:
    os.abort()
