"""Read RepRapFirmware's config.g, and the files that it calls, as the firmware does.

Source: src/GCodes/GCodes2.cpp (M92, M201, M203, M208, M350, M404, M505, M566, M669),
GCodes5.cpp (M204), src/Tools/Tool.cpp (M207), src/Movement/AxisShaper.cpp (M593), Move.cpp (M572)
and DDARing.cpp (M595), src/Platform/Platform.cpp (SetSysDir), 3.6-dev of 2024-10.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from stillpath.gcode.errors import GcodeError
from stillpath.gcode.firmware.reprapfirmware.dialect import reprapfirmware
from stillpath.gcode.lexer import Command, split_line
from stillpath.models.errors import ModelError
from stillpath.models.firmware import RepRapFirmware
from stillpath.models.user_files import as_utf8, read_bytes

__all__ = [
    "Setting",
    "Settings",
    "looks_like_config_g",
    "parse_config_g",
    "read_config_g",
]

_OWN = re.compile(r"(?mi)^[ \t]*(?:M98[ \t]*P|M563|M566|M584|M669)\b")
"""Commands of which one is in each config.g, and none in what Marlin prints."""
_SECTION = re.compile(r"(?m)^\[\w[^]]*\]")
"""A heading of Klipper's printer.cfg, whose macros may call anything."""
_LIMITS = frozenset({"M201", "M203", "M204", "M205", "M208", "M566"})
_READ = _LIMITS | {"M92", "M207", "M350", "M404", "M572", "M593", "M595", "M665", "M667", "M669"}
_TOOL = "M563"
_BLOCKS = frozenset({"if", "elif", "else", "while"})
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)"
_NAMED = re.compile(r"\{\s*((?:var|global)\.\w+|" + _NUMBER + r")\s*\}")
_EXPRESSION = re.compile(r"[^;{]*(\{[^}]*\}?)")
_NAMING = re.compile(
    r"\s*(?:(?P<new>var|global)\s+|set\s+(?P<old>var|global)\.)(?P<name>\w+)\s*="
    r"(?:\s*(?P<number>" + _NUMBER + r")\s*(?:;|$))?"
)
_LARGEST_BYTES = 4_000_000
_DEEPEST = 5
_OVERRIDE = "config-override.g"
_SYSTEM = PurePosixPath("/sys")


class Setting(NamedTuple):
    """A command that sets something of the machine.

    Attributes
    ----------
    words : dict of str to str
        Text behind each letter.
    place : str
        File and line, for messages.
    """

    name: str
    words: dict[str, str]
    place: str

    def numbers(self, letter: str) -> list[float]:
        """Return the numbers of a list like ``E420:415``; empty if the letter is not there.

        Raises
        ------
        ModelError
            If one is none.
        """
        text = self.words.get(letter)
        try:
            return [] if text is None else [float(part) for part in text.split(":")]
        except ValueError:
            raise ModelError(
                f"{self.place}: {self.name} {letter}{text:.60}: a number is needed"
            ) from None

    def number(self, letter: str) -> float | None:
        """Return a number, the first of a list; None if the letter is not there."""
        found = self.numbers(letter)
        return found[0] if found else None


@dataclass(frozen=True, slots=True)
class Settings:
    """What a config.g sets, in the order in which the firmware does.

    Attributes
    ----------
    unread : tuple of str
        Called files that were not found, so that what they set is unknown.
    called : tuple of Path
        Called files that were read.
    """

    name: str
    lines: tuple[Setting, ...] = ()
    unread: tuple[str, ...] = ()
    called: tuple[Path, ...] = ()

    def of(self, *names: str) -> Iterator[Setting]:
        """Yield the commands of these names."""
        return (line for line in self.lines if line.name in names)


def looks_like_config_g(text: str) -> bool:
    """Return whether a text is a config.g, as RepRapFirmware also answers M503."""
    return _OWN.search(text) is not None and _SECTION.search(text) is None


def read_config_g(path: Path) -> Settings:
    """Read a config.g and what it calls (M98, M501), beside it or in the card's other folders.

    Raises
    ------
    ModelError
        If a file cannot be read, or sets something only under a condition.
    """
    path = path.absolute()
    reader = _Reader(path.name, path.parent)
    reader.read(_text_of(path), path.name, [path])
    return reader.settings()


def parse_config_g(text: str, name: str) -> Settings:
    """Return what `read_config_g` does, of the text of a file called `name`, alone."""
    reader = _Reader(name, None)
    reader.read(text, name, [])
    return reader.settings()


def _text_of(path: Path) -> str:
    content = read_bytes(path, _LARGEST_BYTES, "not a config.g")
    return as_utf8(content).decode(errors="replace").removeprefix("\ufeff")


@dataclass(slots=True)
class _Reader:
    """Reads a file and what it calls; without a folder it notes what is called."""

    name: str
    folder: Path | None
    lines: list[Setting] = field(default_factory=list)
    unread: list[str] = field(default_factory=list)
    called: list[Path] = field(default_factory=list)
    named: dict[str, str] = field(default_factory=dict)
    """Numbers of variables, like ``global.x_max``."""
    system: PurePosixPath = _SYSTEM
    """Folder of the card in which M98 and M501 look, as M505 sets it; config.g is in /sys."""

    def settings(self) -> Settings:
        if not self.lines and not self.unread:
            raise ModelError(
                f"{self.name}: it sets nothing of the machine; give RepRapFirmware's config.g"
            )
        unread = tuple(dict.fromkeys(self.unread))
        return Settings(self.name, tuple(self.lines), unread, tuple(self.called))

    def read(self, text: str, name: str, calls: list[Path]) -> None:
        """Read a file's text; `calls` are those that called it, and it."""
        dialect = reprapfirmware(RepRapFirmware())
        depth: int | None = None
        """Indent of the outermost line that begins a block, inside of it."""
        for number, line in enumerate(text.splitlines(), 1):
            place = f"{name} line {number}"
            indent = len(line) - len(line.lstrip(" \t"))
            plain = self._plain(line)
            try:
                commands = split_line(plain, dialect)
            except GcodeError as error:
                raise ModelError(f"{place}: {error}") from None
            if depth is not None and commands[0].name and indent <= depth:
                depth = None
            for command in commands:
                if depth is None and command.name in _BLOCKS:
                    depth = indent
                self._take(command, place, calls, conditional=depth is not None)

    def _take(self, command: Command, place: str, calls: list[Path], *, conditional: bool) -> None:
        if command.name in ("var", "global", "set"):
            self._name(command.text, conditional=conditional)
        elif command.name == "M98":
            called = command.words.get("P", "")
            if conditional:
                self.unread.append(f"{called or 'M98'} ({place}, under a condition)")
            else:
                self._call(called, place, calls)
        elif command.name == "M501" and not conditional:
            self._call(_OVERRIDE, place, calls, optional=self.system == _SYSTEM)
        elif command.name in _READ or command.name in (_TOOL, "M505"):
            if conditional and command.name != _TOOL:
                raise ModelError(
                    f"{place}: {command.name} stands under a condition, which only the printer "
                    "can judge: give a copy of the file with just the lines that it executes"
                )
            if (found := _EXPRESSION.match(command.text)) and command.name != _TOOL:
                raise ModelError(
                    f"{place}: {command.name} has {found[1]}, which only the printer can "
                    "evaluate: give a copy of the file with the number in its place"
                )
            if command.name == "M505":
                self.system /= command.words.get("P", "").removeprefix("0:")
            else:
                self.lines.append(Setting(command.name, dict(command.words), place))

    def _name(self, text: str, *, conditional: bool) -> None:
        """Note a variable that is given a number; any other value is not known."""
        if (found := _NAMING.match(text)) is None:
            return
        name = f"{found['new'] or found['old']}.{found['name']}"
        self.named.pop(name, None)
        if found["number"] and not conditional:
            self.named[name] = found["number"]

    def _plain(self, line: str) -> str:
        """Put numbers in the place of names and braces; other expressions stay."""

        def number(found: re.Match[str]) -> str:
            return self.named.get(found[1], found[0] if found[1][0] in "vg" else found[1])

        return _NAMED.sub(number, line)

    def _call(self, called: str, place: str, calls: list[Path], *, optional: bool = False) -> None:
        path = self._found(called)
        if path is None:
            if not optional:
                self.unread.append(str(self.system / called) if self._is_moved else called or place)
            return
        if path in calls or len(calls) > _DEEPEST:
            raise ModelError(f"{place}: {called} is called while it is being read; remove the call")
        self.called.append(path)
        self.read(_text_of(path), path.name, [*calls, path])

    @property
    def _is_moved(self) -> bool:
        return self.system != _SYSTEM

    def _found(self, called: str) -> Path | None:
        """Return a file by its place on the printer's card, or one of its name beside config.g."""
        if self.folder is None or not called:
            return None
        path = self.system / called.removeprefix("0:")
        if path.is_relative_to(_SYSTEM):
            places = [(self.folder, path.relative_to(_SYSTEM).parts)]
        else:
            places = [(self.folder.parent, path.parts[1:])]
        if not self._is_moved:
            places.append((self.folder, path.parts[-1:]))
        return next((found for place in places if (found := _below(*place)) is not None), None)


def _below(folder: Path, parts: tuple[str, ...]) -> Path | None:
    """Return a file below a folder; cards do not tell capitals from small letters."""
    for part in parts:
        inside = sorted(folder.iterdir()) if folder.is_dir() else []
        alike = [path for path in inside if path.name.lower() == part.lower()]
        if not alike:
            return None
        folder = alike[0]
    return folder if folder.is_file() else None
