"""Read a Klipper printer.cfg and the files that it includes.

The rules are those of klippy/configfile.py (2024 to 2026).
"""

from __future__ import annotations

import glob
import math
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, TypeAlias

from stillpath.applications.machines.klipper_macros import LONGEST_MACRO
from stillpath.models.errors import ModelError
from stillpath.models.user_files import as_utf8, read_bytes

__all__ = [
    "Option",
    "PrinterConfig",
    "looks_like_printer_config",
    "parse_printer_config",
    "read_printer_config",
]

_LARGEST_BYTES = 4_000_000
_MOST_FILES = 500
_SAVED_PREFIX = "#*# "
_SECTION = re.compile(r"\[(?P<name>[^]]+)\]\s*$")
_OPTION = re.compile(r"(?P<name>[^\s:=][^:=]*)[:=]\s*(?P<value>.*)$")
_REFERENCE = re.compile(r"(?<!\\)\$\{(?:(?P<section>[^.:${}]+)[.:])?(?P<option>[^${}]+)\}")
"""To another option, as Kalico has them (klippy/configfile.py, 2026-07): ${constants.speed}."""
_MOST_REFERENCES = 10
_COMMENT = re.compile(r"#.*$|(?:^|\s);.*$")
_OWN_SECTION = re.compile(r"^\[(?:printer|extruder|stepper_[xyz]|include\s[^]]+)\]", re.MULTILINE)
"""Sections that each printer.cfg has, or gets by including others."""


class Option(NamedTuple):
    """Text of an option, its line, and the file of that if it was included."""

    value: str
    line: int
    file: str = ""


_Sections: TypeAlias = dict[str, dict[str, Option]]


@dataclass(frozen=True, slots=True)
class PrinterConfig:
    """Sections of a printer.cfg, each a dict of options; names in lower case.

    Attributes
    ----------
    includes : tuple of str
        Included files that were not found, so that their contents are unknown.
    included : tuple of Path
        Included files that were read.
    """

    name: str
    sections: _Sections = field(default_factory=dict)
    includes: tuple[str, ...] = ()
    included: tuple[Path, ...] = ()

    @property
    def texts(self) -> dict[str, dict[str, str]]:
        """The options' texts by section, as they are written."""
        return {
            section: {name: option.value for name, option in options.items()}
            for section, options in self.sections.items()
        }

    def text(self, section: str, option: str, default: str | None = None) -> str | None:
        """Return an option as text, or the default.

        Raises
        ------
        ModelError
            It refers to an option that is not there.
        """
        found = self._option(section, option)
        return default if found is None else found.value

    def number(self, section: str, option: str, default: float | None = None) -> float:
        """Return an option as a number, or the default.

        Raises
        ------
        ModelError
            Naming file, line, section and option: no number, or missing without a default.
        """
        found = self._option(section, option)
        if found is None:
            if default is None:
                raise self.lacks(section, option)
            return default
        try:
            value = float(found.value)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise ModelError(
                f"{found.file or self.name} line {found.line}: [{section}] {option}: "
                f"{found.value!r:.60} is no number"
            )
        return value

    def lacks(self, section: str, option: str) -> ModelError:
        """Return the error that an option is missing, with where it may stand."""
        return ModelError(f"{self.name}: [{section}] lacks {option}{_elsewhere(self.includes)}")

    def positive(self, section: str, option: str) -> float:
        """Return a number that must be there and above 0.

        Raises
        ------
        ModelError
            As `number` does, or because it is not above 0.
        """
        value = self.number(section, option)
        if value <= 0.0:
            _, line, file = self.sections[section][option]
            raise ModelError(
                f"{file or self.name} line {line}: [{section}] {option}: {value:g} must be above 0"
            )
        return value

    def _option(self, section: str, option: str) -> Option | None:
        """Return an option with what it refers to in place of the references."""
        found = self.sections.get(section, {}).get(option)
        for _ in range(_MOST_REFERENCES):
            if found is None or (reference := _REFERENCE.search(found.value)) is None:
                break
            where, name = (reference["section"] or section).lower(), reference["option"].lower()
            other = self.sections.get(where, {}).get(name)
            if other is None:
                remedy = _elsewhere(self.includes) if self.includes else ": put it there"
                raise ModelError(
                    f"{found.file or self.name} line {found.line}: [{section}] {option}: "
                    f"{reference[0]} refers to {name} of [{where}], which is not there{remedy}"
                )
            begin, end = reference.span()
            value = f"{found.value[:begin]}{other.value}{found.value[end:]}"
            found = found._replace(value=value)
        return found


def looks_like_printer_config(text: str) -> bool:
    """Return whether a text is meant as a printer.cfg."""
    return _OWN_SECTION.search(text) is not None


def read_printer_config(path: Path) -> PrinterConfig:
    """Read a printer.cfg with its SAVE_CONFIG block and what it includes.

    As in Klipper, a later option wins over an earlier one, and one of the file's own over the
    same in the block; the name of an included file may be a pattern, and counts from the folder of
    the file that includes it.

    Raises
    ------
    ModelError
        If a file cannot be read, is no configuration, or includes itself.
    """
    return _whole(_Reader(path.name), _text_of(path), path)


def parse_printer_config(
    text: str, name: str, wanted: str = "Klipper's printer.cfg"
) -> PrinterConfig:
    """Return what `read_printer_config` does, of the text of a file called `name`, alone.

    An error asks for what is `wanted`.
    """
    return _whole(_Reader(name), text, None, wanted)


def _text_of(path: Path) -> str:
    content = read_bytes(path, _LARGEST_BYTES, "not a printer.cfg")
    return as_utf8(content).decode(errors="replace").removeprefix("\ufeff")


def _whole(
    reader: _Reader, text: str, path: Path | None, wanted: str = "Klipper's printer.cfg"
) -> PrinterConfig:
    """Return a configuration of the text of a file; without its path nothing included is read."""
    lines = text.removeprefix("\ufeff").splitlines()
    reader.read(lines, [] if path is None else [path.absolute()])
    own, includes = reader.sections, tuple(reader.missing)
    if not own:
        elsewhere = _elsewhere(includes) if includes else f"; give {wanted}"
        raise ModelError(f"{reader.name}: no [section] in it{elsewhere}")
    block = _Reader(reader.name, saved=True)
    block.read(lines, [])
    names = dict.fromkeys([*own, *block.sections])
    sections = {name: block.sections.get(name, {}) | own.get(name, {}) for name in names}
    return PrinterConfig(reader.name, sections, includes, tuple(reader.included))


@dataclass(slots=True)
class _Reader:
    """Reads a configuration and what it includes, or with `saved` its SAVE_CONFIG block."""

    name: str
    saved: bool = False
    sections: _Sections = field(default_factory=dict)
    missing: list[str] = field(default_factory=list)
    included: list[Path] = field(default_factory=list)

    def read(self, lines: list[str], within: list[Path]) -> None:
        """Add the lines of the last file of `within`, which the others include in turn."""
        file = within[-1].name if len(within) > 1 else ""
        current: dict[str, Option] = {}
        begun = ""
        begun_at: int | None = None  # indentation of the option that deeper lines go on with
        for number, full in enumerate(lines, 1):
            if full.startswith("#*#") is not self.saved:
                continue
            text = full[len(_SAVED_PREFIX) :] if self.saved else full
            indented = _COMMENT.sub("", text).rstrip()
            line = indented.lstrip()
            indent = len(indented) - len(line)
            if not line:
                continue
            if begun_at is not None and indent > begun_at:
                # Numbers have one line, which may be the next; more of lists is not needed.
                kept = current[begun].value
                if not kept:
                    current[begun] = Option(line, number, file)
                elif begun.endswith("gcode") and len(kept) < LONGEST_MACRO:
                    current[begun] = current[begun]._replace(value=f"{kept}\n{line}")
                continue
            begun_at = None
            if section := _SECTION.match(line):
                name = section["name"].strip()
                if name.startswith("include "):
                    self._include(name[len("include ") :].strip(), within)
                else:
                    current = self.sections.setdefault(name.lower(), {})
            elif option := _OPTION.match(line):
                begun = option["name"].strip().lower()
                current[begun] = Option(option["value"], number, file)
                begun_at = indent

    def _include(self, name: str, within: list[Path]) -> None:
        """Read the files of an [include], in the order of their names."""
        found: list[str] = []
        if within:
            pattern = Path(glob.escape(str(within[-1].parent))) / name
            found = sorted(glob.glob(str(pattern)))  # noqa: PTH207 (hidden ones do not match)
        files = [file for file in map(Path, found) if file.is_file()]
        if not files:
            self.missing.append(name)
        for file in files:
            if file in within or len(self.included) == _MOST_FILES:
                raise ModelError(
                    f"{self.name}: [include {name}] in {within[-1].name} includes itself, or more "
                    f"than {_MOST_FILES} files are included; Klipper does not start with it"
                )
            self.included.append(file)
            self.read(_text_of(file).splitlines(), [*within, file])


def _elsewhere(includes: tuple[str, ...]) -> str:
    """Return where that may stand which a file lacks, and what to do."""
    if not includes:
        return "; is it a printer.cfg?"
    return (
        f"; it may stand in {', '.join(includes)}, which was not read: put it beside the file (on "
        "the command line), or give one file that holds all (cat them together)"
    )
