"""What Cura's PostProcessingPlugin does with a script, in small: loads it, keeps its settings,
calls it. After `plugins/PostProcessingPlugin` of Cura 4.13."""

from __future__ import annotations

import json
import re
import sys
import types
from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path
from typing import Any

import pytest

from tests.loading import module_at

__all__ = ["SCRIPT", "Cura", "layers_of"]

SCRIPT = Path(__file__).resolve().parents[2] / "integrations" / "cura" / "Stillpath.py"


@dataclass
class Cura:
    """Stands for Cura: its modules, the user's printer and job, and the messages he sees."""

    printer: str = "My Ender"
    job: str = "part"
    shown: list[tuple[str, str]] = field(default_factory=list)
    logged: list[str] = field(default_factory=list)

    def install(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Put the modules that scripts import in their places."""
        cura = self

        class Message:
            class MessageType(IntEnum):
                POSITIVE, NEUTRAL, WARNING, ERROR = range(4)

            def __init__(
                self, text: str, title: str = "", lifetime: int = 30, message_type: int = 1
            ) -> None:
                self._told = (self.MessageType(message_type).name, text)

            def show(self) -> None:
                cura.shown.append(self._told)

        class Logger:
            @staticmethod
            def log(level: str, message: str, *arguments: object) -> None:
                cura.logged.append(message % arguments)

        class Application:
            @staticmethod
            def getInstance() -> Any:
                stack = types.SimpleNamespace(getName=lambda: cura.printer)
                information = types.SimpleNamespace(jobName=cura.job)
                return types.SimpleNamespace(
                    getGlobalContainerStack=lambda: stack, getPrintInformation=lambda: information
                )

        class Script:
            def initialize(self) -> None:
                self.definition = json.loads(self.getSettingDataString())["settings"]
                self.values = {k: d["default_value"] for k, d in self.definition.items()}

            def getSettingValueByKey(self, key: str) -> Any:
                return self.values[key]

        for module, names in {
            "UM": {},
            "UM.Message": {"Message": Message},
            "UM.Logger": {"Logger": Logger},
            "UM.Application": {"Application": Application},
            "PostProcessingPlugin": {"__path__": []},
            "PostProcessingPlugin.PostProcessingPlugin": {},
            "PostProcessingPlugin.Script": {"Script": Script},
        }.items():
            made = types.ModuleType(module)
            vars(made).update(names)
            monkeypatch.setitem(sys.modules, module, made)

    def load(self) -> Any:
        """Return a script of the user's list: the class is called as its file."""
        name = f"PostProcessingPlugin.PostProcessingPlugin.{SCRIPT.stem}"
        script = getattr(module_at(SCRIPT, name), SCRIPT.stem)()
        script.initialize()
        return script

    def write_started(self, scripts: list[Any], data: list[str]) -> list[str]:
        """Run the scripts as Cura does when a file is saved."""
        if ";POSTPROCESSED" in data[0]:
            return data
        for script in scripts:
            try:
                data = script.execute(data)
            except Exception as error:
                self.logged.append(f"exception: {error}")
        data[0] += ";POSTPROCESSED\n"
        return data


def layers_of(text: str) -> list[str]:
    """Cut what CuraEngine wrote as Cura holds it: header, start, layers, end."""
    header, start, *layers = re.split(r"(?m)^(?=;Generated with|;LAYER:)", text)
    # The end G-code is an item of its own.
    last, end = re.split(r"(?m)^(?=;TIME_ELAPSED:)", layers.pop(), maxsplit=1)
    elapsed, end = end.split("\n", 1)
    return [header, start, *layers, f"{last}{elapsed}\n", end]
