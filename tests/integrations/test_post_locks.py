"""Files that a virus scanner holds for a moment, as on Windows."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest
import stillpath_post

from stillpath.pipeline import files


@pytest.mark.parametrize("module", [files, stillpath_post])
@pytest.mark.parametrize(("held", "waits"), [(2, 5), (1, 0), (9, 3)])
def test_a_file_that_is_held_for_a_moment_is_replaced_then(
    module: ModuleType, held: int, waits: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "part.gcode"
    target.write_bytes(b"as sliced")
    left = held
    replace: Callable[[Path, Path], Path] = Path.replace

    def refused(source: Path, to: Path) -> Path:
        nonlocal left
        left -= 1
        if left >= 0:
            raise PermissionError(13, "used by another process", str(source), None, str(to))
        return replace(source, to)

    monkeypatch.setattr(Path, "replace", refused)
    monkeypatch.setattr(module, "_WAITS_S", (0.0,) * waits)

    def write() -> None:
        with module.replacing(target) as temporary:
            temporary.write_bytes(b"compensated")

    if held <= waits:
        write()
        assert target.read_bytes() == b"compensated"
    else:
        with pytest.raises(PermissionError, match="used by another process"):
            write()
        assert target.read_bytes() == b"as sliced"
    assert list(tmp_path.iterdir()) == [target]
