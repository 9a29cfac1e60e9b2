"""Klipper's macros, expanded and run as Klipper does, on a printer that only takes notes.

The rules are those of klippy/configfile.py (`_parse_config`: comments, sections with their case),
klippy/gcode.py (commands of two forms, `M117`-like ones aside) and klippy/extras/gcode_macro.py
(delimiters of the templates, context, `rename_existing` in the order of the sections once all are
read, variables as literals), pause_resume.py and toolhead.py (`SET_VELOCITY_LIMIT`), as of 2026-08.
"""

from __future__ import annotations

import ast
import configparser
import copy
import functools
import json
import re
import shlex
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jinja2

__all__ = ["CommandError", "ConfigError", "Klipper", "macros_of"]

SETTINGS: dict[str, dict[str, Any]] = {
    "printer": {
        "kinematics": "corexy",
        "max_velocity": 300.0,
        "max_accel": 5000.0,
        "minimum_cruise_ratio": 0.5,
        "square_corner_velocity": 5.0,
    },
    "input_shaper": {
        "shaper_type_x": "mzv",
        "shaper_freq_x": 57.8,
        "shaper_type_y": "ei",
        "shaper_freq_y": 45.2,
        "damping_ratio_x": 0.1,
        "damping_ratio_y": 0.05,
    },
}
_TRADITIONAL = re.compile(r"[A-Z]\d+(\.\d+)?$")


class ConfigError(Exception):
    """Klipper does not start."""


class CommandError(Exception):
    """A command fails; a print ends with it."""


def macros_of(*files: Path | str) -> list[tuple[str, dict[str, str]]]:
    """Return the sections of configuration files (or their texts), in order, with their options."""
    parser = configparser.RawConfigParser(strict=False, inline_comment_prefixes=(";", "#"))
    for file in files:
        text = file.read_text(encoding="utf-8") if isinstance(file, Path) else file
        parser.read_string("\n".join(line.partition("#")[0] for line in text.split("\n")))
    return [(name, dict(parser[name])) for name in parser.sections()]


@dataclass
class _Macro:
    name: str
    template: jinja2.Template
    description: str
    renames: str | None
    variables: dict[str, Any]
    running: bool = False


@dataclass
class Klipper:
    """A printer with macros.

    Attributes
    ----------
    sections : list
        From `macros_of`.
    settings : dict
        What ``configfile.settings`` says of the other sections.
    shows_commands : bool
        Whether ``printer.gcode.commands`` is there (since 2023-12).
    extra : dict
        Other objects of ``printer``.
    sent : list of str
        Commands that came through to the firmware.
    told : list of str
        What the console showed.
    remote : callable
        Takes calls of remote methods.
    """

    sections: list[tuple[str, dict[str, str]]]
    settings: dict[str, dict[str, Any]] = field(default_factory=lambda: copy.deepcopy(SETTINGS))
    shows_commands: bool = True
    extra: dict[str, dict[str, Any]] = field(default_factory=dict)
    sent: list[str] = field(default_factory=list)
    told: list[str] = field(default_factory=list)
    remote: Callable[..., Any] = print

    def __post_init__(self) -> None:
        own = self.settings["printer"]
        self.toolhead = {
            name: own[name]
            for name in (
                "max_velocity",
                "max_accel",
                "square_corner_velocity",
                "minimum_cruise_ratio",
                "max_accel_to_decel",
            )
            if name in own
        }
        self.shaper = dict(self.settings.get("input_shaper", {}))
        self.is_paused = False
        self.state = "standby"
        self._macros: dict[str, _Macro] = {}
        self._help: dict[str, str] = {}
        self._delayed: dict[str, str] = {}
        self._due: list[str] = []
        self._commands: dict[str, Callable[[str, dict[str, str]], None]] = {
            "PAUSE": self._pause,
            "RESUME": self._resume,
            "CANCEL_PRINT": self._cancel,
            "SET_VELOCITY_LIMIT": self._limit,
            "SET_GCODE_VARIABLE": self._variable,
            "UPDATE_DELAYED_GCODE": self._delay,
        }
        if "input_shaper" in self.settings:
            self._commands["SET_INPUT_SHAPER"] = self._shape
        for section, options in self.sections:
            if section.split()[0] == "gcode_macro":
                self._load(section, options)
            elif section.startswith("delayed_gcode "):
                self._delayed[section.split()[1]] = options["gcode"]
        for macro in self._macros.values():
            if macro.renames is not None:
                self._rename(macro)

    def run(self, script: str) -> None:
        """Run a script, line by line, and behind it what it delayed, even if it fails."""
        try:
            self._run(script)
        finally:
            while self._due:
                self._run(self._delayed[self._due.pop()])

    def _run(self, script: str) -> None:
        for full in script.split("\n"):
            line = full.strip()
            name = line.partition(" ")[0].upper()
            if not line or line.startswith(";"):
                continue
            self.sent.append(line) if name not in self._commands else None
            if name in self._commands:
                self._commands[name](line, _parameters(line, name))

    # What templates see

    def __getitem__(self, name: str) -> Any:
        name = str(name).strip()
        objects: dict[str, Any] = {
            "configfile": {
                "settings": self.settings,
                "config": dict(self.sections),
            },
            "toolhead": self.toolhead,
            "pause_resume": {"is_paused": self.is_paused},
            "print_stats": {"state": self.state},
            **{f"gcode_macro {m.name}": m.variables for m in self._macros.values()},
            **self.extra,
        }
        if self.shows_commands:
            objects["gcode"] = {
                "commands": {
                    n: {"help": self._help[n]} if n in self._help else {} for n in self._commands
                }
            }
        return copy.deepcopy(objects[name])

    def __contains__(self, name: str) -> bool:
        try:
            self[name]
        except KeyError:
            return False
        return True

    def __iter__(self) -> Iterator[str]:
        raise TypeError("not needed")

    # Configuration

    def _load(self, section: str, options: dict[str, str]) -> None:
        name = section.split()[1]
        alias, renames = name.upper(), options.get("rename_existing")
        variables = {}
        for option, text in options.items():
            if option.startswith("variable_"):
                literal = ast.literal_eval(text)
                json.dumps(literal)
                variables[option.removeprefix("variable_")] = literal
        template = _template(options["gcode"])
        description = options.get("description", "G-Code macro")
        macro = _Macro(name, template, description, renames, variables)
        if renames is not None and bool(_TRADITIONAL.match(alias)) != bool(
            _TRADITIONAL.match(renames)
        ):
            raise ConfigError(f"G-Code macro rename of different types ('{alias}' vs '{renames}')")
        if renames is None and alias in self._commands:
            raise ConfigError(f"gcode command {alias} already registered")
        self._macros[name] = macro
        if renames is None:
            self._register(alias, macro)

    def _rename(self, macro: _Macro) -> None:
        alias = macro.name.upper()
        if alias not in self._commands:
            raise ConfigError(f"Existing command '{alias}' not found in gcode_macro rename")
        assert macro.renames is not None
        self._commands[macro.renames] = self._commands[alias]
        self._help[macro.renames] = f"Renamed builtin of '{alias}'"
        self._register(alias, macro)

    def _register(self, alias: str, macro: _Macro) -> None:
        self._commands[alias] = lambda line, given: self._expand(macro, line, given)
        self._help[alias] = macro.description

    def _expand(self, macro: _Macro, line: str, given: dict[str, str]) -> None:
        if macro.running:
            raise CommandError(f"Macro {macro.name.upper()} called recursively")
        context = {
            **macro.variables,
            "printer": self,
            "params": given,
            "rawparams": line.partition(" ")[2],
            "action_respond_info": self._respond,
            "action_raise_error": self._raise,
            "action_call_remote_method": self._call,
        }
        macro.running = True
        try:
            # The whole template is expanded before its first line runs.
            self._run(macro.template.render(context))
        finally:
            macro.running = False

    def _respond(self, message: str) -> str:
        self.told.append(message)
        return ""

    def _raise(self, message: str) -> None:
        raise CommandError(message)

    def _call(self, method: str, **given: Any) -> str:
        self.remote(method, **given)
        return ""

    # Commands

    def _pause(self, line: str, given: dict[str, str]) -> None:
        self.sent.append("PAUSE")
        self.is_paused = True

    def _resume(self, line: str, given: dict[str, str]) -> None:
        self.sent.append("RESUME")
        self.is_paused = False

    def _cancel(self, line: str, given: dict[str, str]) -> None:
        self.sent.append("CANCEL_PRINT")
        self.is_paused, self.state = False, "cancelled"

    def _limit(self, line: str, given: dict[str, str]) -> None:
        self.sent.append(line)
        names = {
            "VELOCITY": "max_velocity",
            "ACCEL": "max_accel",
            "SQUARE_CORNER_VELOCITY": "square_corner_velocity",
            "MINIMUM_CRUISE_RATIO": "minimum_cruise_ratio",
            "ACCEL_TO_DECEL": "max_accel_to_decel",
        }
        for name, value in given.items():
            if names.get(name) in self.toolhead:
                self.toolhead[names[name]] = float(value)

    def _shape(self, line: str, given: dict[str, str]) -> None:
        if given:
            self.sent.append(line)
        for name, value in given.items():
            self.shaper[name.lower()] = value if "TYPE" in name else float(value)
        told = (f"{name}:{value}" for name, value in self.shaper.items())
        self.told.append(" ".join(told))

    def _delay(self, line: str, given: dict[str, str]) -> None:
        self._due.append(given["ID"])

    def _variable(self, line: str, given: dict[str, str]) -> None:
        macro = self._macros[given["MACRO"]]
        if given["VARIABLE"] not in macro.variables:
            raise CommandError(f"Unknown gcode_macro variable '{given['VARIABLE']}'")
        literal = ast.literal_eval(given["VALUE"])
        json.dumps(literal)
        macro.variables[given["VARIABLE"]] = literal


@functools.cache
def _template(text: str) -> jinja2.Template:
    return jinja2.Environment("{%", "%}", "{", "}").from_string(text)


def _parameters(line: str, name: str) -> dict[str, str]:
    rest = line.partition(" ")[2]
    if _TRADITIONAL.match(name):
        return {word[0].upper(): word[1:] for word in rest.split()}
    pairs = (word.split("=", 1) for word in shlex.split(rest))
    return {pair[0].upper(): pair[1] for pair in pairs}
