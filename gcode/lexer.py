"""Cut one line into a command and its words, as Klipper does.

This is the slow and complete reading; `_lex_kernels.run` reads the plain lines itself.
Rules: klippy/gcode.py, 2026-08.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType

from gcode.errors import GcodeError

__all__ = ["Command", "extended_parameters", "split_line"]

_LETTERS = re.compile(r"([A-Z_]+|[A-Z*])")
_RAW_COMMANDS = ("M117", "M118", "M23")


@dataclass(frozen=True, slots=True)
class Command:
    """A command line.

    Attributes
    ----------
    name : str
        ``G1``, ``M117``, ``SET_VELOCITY_LIMIT``; empty for a blank line or a comment.
    words : mapping of str to str
        Text behind each letter; the last of repeated words.
    """

    name: str
    words: Mapping[str, str]


def split_line(text: str) -> Command:
    """Cut a line at its first semicolon and into words.

    Parameters
    ----------
    text : str
        The line, with or without its newline.
    """
    return _split(text.strip().split(";", 1)[0])


@lru_cache(maxsize=512)  # slicers repeat themselves
def _split(text: str) -> Command:
    parts = _LETTERS.split(text.upper())
    head = parts[3:5] if "".join(parts[:2]) == "N" else parts[:3]
    name = "".join(head).strip()
    words = {parts[k]: parts[k + 1].strip() for k in range(1, len(parts), 2)}
    if " " in name and name.split()[0] in _RAW_COMMANDS:
        name = name.split()[0]
    return Command(name, MappingProxyType(words))


def extended_parameters(text: str, name: str, *, line: int | None = None) -> Mapping[str, str]:
    """Read ``KEY=VALUE`` pairs with the quoting rules of a POSIX shell.

    Parameters
    ----------
    text : str
        The whole line.
    name : str
        The command's name as `split_line` gives it.

    Raises
    ------
    GcodeError
        If a quote is not closed or a word has no ``=``.
    """
    try:
        return _pairs(text.strip(), name)
    except ValueError:
        raise GcodeError(
            f"cannot read the parameters of {name}: write KEY=VALUE and close every quote",
            line=line,
            text=text,
        ) from None


@lru_cache(maxsize=512)
def _pairs(text: str, name: str) -> Mapping[str, str]:
    rest = text[text.upper().find(name) + len(name) :]
    if not text.upper().startswith(name):
        # Behind a line number there may be a checksum.
        star = rest.rfind("*")
        if star >= 0 and rest[star + 1 :].isdigit():
            rest = rest[:star]
    reader = shlex.shlex(rest, posix=True)
    reader.whitespace_split = True
    reader.commenters = "#;"
    pairs = [word.split("=", 1) for word in reader]
    return MappingProxyType({key.upper(): value for key, value in pairs})
