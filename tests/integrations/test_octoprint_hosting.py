"""What the plugin writes into OctoPrint's storage, with a stand-in for its file manager."""

from __future__ import annotations

import sys
import types
from pathlib import Path
from typing import Any

import pytest

from tests.integrations.test_octoprint_parts import _part, compensators, ledger, reports


class Files:
    """OctoPrint 2.0's file manager: it keeps metadata, and its functions for links do nothing."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.metadata: dict[str, dict[str, Any]] = {"part.gcode": {}}

    def file_exists(self, _: str, path: str) -> bool:
        return (self._folder / path).exists()

    def path_on_disk(self, _: str, path: str) -> str:
        return str(self._folder / path)

    def add_file(self, _: str, path: str, file: Any, **__: Any) -> str:
        file.save(self.path_on_disk(_, path))
        self.metadata.setdefault(path, {})
        return path

    def get_metadata(self, _: str, path: str) -> dict[str, Any] | None:
        return self.metadata.get(path)

    def set_additional_metadata(
        self, _: str, path: str, key: str, data: Any, *, overwrite: bool
    ) -> None:
        assert overwrite
        self.metadata[path][key] = data

    def add_link(self, *_: Any) -> None:
        """Deprecated: filemanager/storage/common.py, 2.0.0rc7."""

    remove_link = add_link


@pytest.fixture
def hosting(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The module, with stand-ins for what it imports of OctoPrint."""
    wrapper = type("AbstractFileWrapper", (), {"__init__": lambda self, name: None})
    for name, content in (
        ("octoprint", {}),
        ("octoprint.filemanager", {"FileDestinations": types.SimpleNamespace(LOCAL="local")}),
        ("octoprint.filemanager.util", {"AbstractFileWrapper": wrapper}),
    ):
        module = types.ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    return _part("hosting")


def test_results_link_to_their_reports_where_octoprint_adds_no_links(hosting: Any, tmp_path: Path):
    files = Files(tmp_path)
    plugin = types.SimpleNamespace(_file_manager=files, _printer=None, _settings=None, _logger=None)
    book = ledger.Ledger(tmp_path / "files.json")
    host = hosting.OctoPrintHost(plugin, book, reports.Reports(tmp_path), lambda _: None)
    made = tmp_path / "made"
    made.write_text("; Processed by stillpath 1.0\n")
    model = {"rel": "model", "name": "part.stl"}  # somebody else's

    for others in ([], [model]):
        files.metadata.setdefault("part.sp.gcode", {}).setdefault("links", []).extend(others)
        entry = ledger.Entry("part.gcode", "ender3", {}, where="server")
        book.add(entry)
        host.deliver(entry, compensators.Made(made, b"<!doctype html>"))
        report = {"rel": "web", "href": f"plugin/stillpath/reports/{entry.id}"}
        assert files.metadata["part.sp.gcode"]["links"] == [*others, report]
