"""Split one line into commands and their words, as the firmware of a dialect does.

This is the slow and complete parser; `_lex_kernels.run` parses the plain lines itself.

Sources: Klipper klippy/gcode.py, 2026-08; Marlin Marlin/src/gcode/parser.cpp and queue.cpp, 2.0.x
of 2021 and bugfix-2.1.x; RepRapFirmware src/GCodes/GCodeBuffer/StringParser.cpp, 3.5.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType

from stillpath.gcode.dialect import FURTHER_WORDS, Dialect
from stillpath.gcode.errors import GcodeError

__all__ = [
    "Command",
    "check_line_ends",
    "extended_parameters",
    "further_words",
    "odd_numbers",
    "split_classic",
    "split_line",
]

_LETTERS = re.compile(r"([A-Z_]+|[A-Z*])")
_LINE_NUMBER = re.compile(r"\s*[Nn]\s*-?\d+\s*")
_NAME = re.compile(r"([A-Za-z]) *(-?\d+)(\.\d+)?")
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)")
_EXPONENT = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?(?::[-+]?(?:\d+\.?\d*|\.\d+))*")
_BEHIND_RETURN = re.compile(rb"\r[ \t]*[GMNT] *\d", re.IGNORECASE)
_META = re.compile(
    r"(if|elif|else|while|break|continue|abort|var|global|set|echo|skip)(?=$|[\s{\"(])"
)


@dataclass(frozen=True, slots=True)
class Command:
    """A command.

    Attributes
    ----------
    name : str
        ``G1``, ``M117``, ``SET_VELOCITY_LIMIT``, ``if``; empty for a blank line or a comment.
    words : mapping of str to str
        Text after each letter; empty where there is no number.
    text : str
        The whole line as it was read.
    dropped : str
        Why the firmware skips the line without reading it; empty: it reads it.
    uncertain : bool
        A value is an expression that only the firmware can evaluate.
    """

    name: str
    words: Mapping[str, str]
    text: str = ""
    dropped: str = ""
    uncertain: bool = False


def check_line_ends(text: bytes, line: int, dialect: Dialect) -> None:
    """Refuse a line that goes on with a command after a carriage return.

    All firmwares but Klipper end a line there (Marlin queue.cpp, ISEOL; RepRapFirmware
    StringParser.cpp, Put).

    Parameters
    ----------
    text : bytes
        Whole lines.
    line : int
        Number of the first.

    Raises
    ------
    GcodeError
    """
    if dialect.extended_commands:
        return
    for found in _BEHIND_RETURN.finditer(text):
        begin = text.rfind(b"\n", 0, found.start()) + 1
        if text[begin : found.start()].strip():
            raise GcodeError(
                f"the line goes on after a carriage return, where {dialect.title} ends it; save "
                "the file with LF or CRLF line ends",
                line=line + text.count(b"\n", 0, begin),
                text=text[begin : found.end()].decode("utf-8", "replace"),
            )


def split_line(text: str, dialect: Dialect) -> list[Command]:
    """Cut a line into its commands; there is at least one.

    Parameters
    ----------
    text : str
        The line, with or without its newline.

    Raises
    ------
    GcodeError
        The command is longer than the firmware can take.
    """
    return [split_classic(text)] if dialect.extended_commands else _split_standard(text, dialect)


def split_classic(text: str) -> Command:
    """Cut a line at its first semicolon and into words as Klipper does."""
    name, found = _split_klipper(text.strip().split(";", 1)[0])
    return Command(name, found, text)


@lru_cache(maxsize=512)  # slicers repeat themselves
def _split_klipper(text: str) -> tuple[str, Mapping[str, str]]:
    parts = _LETTERS.split(text.upper())
    head = parts[3:5] if "".join(parts[:2]) == "N" else parts[:3]
    name = "".join(head).strip()
    found = {parts[k]: parts[k + 1].strip() for k in range(1, len(parts), 2)}
    if " " in name and name.split()[0] in ("M117", "M118", "M23"):
        name = name.split()[0]
    return name, MappingProxyType(found)


def _split_standard(text: str, dialect: Dialect) -> list[Command]:
    """Cut a line as Marlin and RepRapFirmware do."""
    first, *others = _without_comments(text.rstrip("\r\n"), dialect).split("\0")
    commands = _commands_of(first, text, dialect)
    if dialect.expressions:  # NUL ends a line; Marlin reads no further
        for other in others:
            if other.strip():
                commands += _commands_of(other, text, dialect)
    return commands or [Command("", {}, text)]


def _commands_of(code: str, text: str, dialect: Dialect) -> list[Command]:
    if dialect.cut_long_commands:
        code = code[: dialect.longest_command]
    number = _LINE_NUMBER.match(code)
    dropped = ""
    if number is not None and (dialect.fold_case or "n" not in number[0]):
        if dialect.expressions:
            dropped = _bad_checksum(code)
        code = code[number.end() :]
    if not dialect.expressions or number is not None:
        code = code.split("*", 1)[0]
    code = code.strip()
    if len(code) > dialect.longest_command:
        raise GcodeError(
            f"the command has {len(code)} characters; {dialect.title} aborts the print at more "
            f"than {dialect.longest_command}; shorten it, or slice for {dialect.title}",
            text=text,
        )
    if dialect.expressions:
        meta = _META.match(code)
        if meta is not None:
            return [Command(meta[1], {}, text, dropped)]
    commands: list[Command] = []
    while code:
        command, code = _next_command(code, dialect, text, dropped)
        commands.append(command)
    return commands


def _without_comments(line: str, dialect: Dialect) -> str:
    out: list[str] = []
    quoted = False
    depth = 0
    k = 0
    while k < len(line):
        c = line[k]
        if c == '"' and dialect.quoted_text:
            quoted = not quoted
        elif not quoted:
            if c == ";":
                break
            if c == "{" and dialect.expressions:
                depth += 1
            elif c == "}" and depth:
                depth -= 1
            elif c == "(" and dialect.paren_comments and not depth:
                close = line.find(")", k)
                if close < 0:
                    break
                k = close + 1
                continue
            elif c == "\\" and not dialect.expressions:
                k += 1
                if k >= len(line):
                    break
                c = line[k]
        out.append(c)
        k += 1
    return "".join(out)


def _bad_checksum(code: str) -> str:
    """Return why RepRapFirmware drops a numbered line; empty if it does not."""
    start = code.upper().find("N")
    star = code.find("*")
    if star < 0:
        return ""
    digits = re.match(r"\d*", code[star + 1 :])
    given = digits[0] if digits else ""
    if len(given) == 5:
        return ""  # a CRC; the firmware's own table is not public knowledge enough to judge by
    value = 0
    for byte in code[start:star].encode("utf-8", "replace"):
        value ^= byte
    if 1 <= len(given) <= 3 and int(given) == value:
        return ""
    return f"its checksum is {value}, not {given or 'missing'}"


def _next_command(code: str, dialect: Dialect, text: str, dropped: str) -> tuple[Command, str]:
    """Cut the first command off; return it and the rest."""
    name_match = _NAME.match(code)
    upper = code[0].upper() if dialect.fold_case else code[0]
    p = 1
    if name_match is not None and upper in "GMT":
        fraction = name_match[3] or ""
        name = f"{upper}{int(name_match[2])}{fraction}"
        if fraction and dialect.ignores_subcodes and name not in dialect.words:
            name = f"{upper}{int(name_match[2])}"
        p = name_match.end()
    elif upper in "GMT":
        name = upper
    elif dialect.modal_words and upper in "XYZEFIJKRPQ":
        name, p = "", 0
    else:
        return Command(code.split()[0], {}, text, dropped), ""
    quoted = dialect.quoted_text and code[p:].lstrip(" \t").startswith('"')
    if name in dialect.raw_text and not quoted:
        return Command(name, {}, text, dropped), ""
    found: dict[str, str] = {}
    uncertain = False
    while p < len(code):
        c = code[p]
        if c == '"' and dialect.quoted_text:
            close = code.find('"', p + 1)
            p = len(code) if close < 0 else close + 1
            continue
        if dialect.fold_case:
            c = c.upper()
        if not ("A" <= c <= "Z"):
            p += 1
            continue
        if c in "GM" and not dialect.one_command:
            break
        p += 1
        value, p, expression = _value(code, p, dialect)
        uncertain = uncertain or expression
        if not (dialect.first_wins and c in found):
            found[c] = value
    return Command(name, MappingProxyType(found), text, dropped, uncertain), code[p:].strip()


def _value(code: str, p: int, dialect: Dialect) -> tuple[str, int, bool]:
    """Read what stands after a letter: text, where it ends, whether it is an expression."""
    q = p
    while q < len(code) and code[q] == " ":
        q += 1
    if q < len(code) and code[q] == '"' and dialect.quoted_text:
        close = code.find('"', q + 1)
        close = len(code) if close < 0 else close
        return code[q + 1 : close], close + 1, False
    if q < len(code) and code[q] == "{" and dialect.expressions:
        depth = 0
        for k in range(q, len(code)):
            depth += {"{": 1, "}": -1}.get(code[k], 0)
            if depth == 0:
                return code[q : k + 1], k + 1, True
        return code[q:], len(code), True
    match = (_EXPONENT if dialect.exponents else _NUMBER).match(code, q)
    if match is None:
        return "", p, False
    end = match.end()
    while end < len(code) and code[end] in "0123456789.+-" and not dialect.exponents:
        end += 1  # Marlin passes over what is left of 1.2.3
    return match[0], end, False


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
        # After a line number there may be a checksum.
        star = rest.rfind("*")
        if star >= 0 and rest[star + 1 :].isdigit():
            rest = rest[:star]
    reader = shlex.shlex(rest, posix=True)
    reader.whitespace_split = True
    reader.commenters = "#;"
    pairs = [word.split("=", 1) for word in reader]
    return MappingProxyType({key.upper(): value for key, value in pairs})


def further_words(command: Command) -> str:
    """Return the letters of a move that a stream, of X, Y, Z and one E, would lose."""
    found = command.words.items()
    return ", ".join(k for k, text in found if ":" in text or (text and k in FURTHER_WORDS))


def odd_numbers(command: Command) -> Iterator[tuple[str, str]]:
    """Yield words of a move that are not numbers, each with the part that firmwares read.

    Firmwares that read as far as they can take X1.2.3 for X1.2 and skip XNaN.
    """
    code = command.text.split(";", 1)[0].upper()
    for letter, text in command.words.items():
        if letter not in "XYZEF":
            continue
        found = re.search(
            rf"{letter}\s*{re.escape(text)}(\S*)" if text else rf"{letter}(\S*)", code
        )
        if found is None:
            continue
        rest = found[1]
        if not text or (rest and not rest[0].isalpha() and rest[0] not in "*(:"):
            yield f"{letter}{text}{rest}", f"{letter}{text}" if text else ""
