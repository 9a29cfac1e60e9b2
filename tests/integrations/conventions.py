"""How slicers call their post-processing scripts, told anew from their sources.

PrusaSlicer, OrcaSlicer, BambuStudio: `src/libslic3r/GCode/PostProcessor.cpp` (PrusaSlicer 69c8e56);
SuperSlicer: the same file (3a97013). Windows: *Parsing C command-line arguments* and
`CommandLineToArgvW` in Microsoft's documentation.
"""

from __future__ import annotations

from collections.abc import Callable

__all__ = ["posix_call", "superslicer_call", "windows_call", "windows_quote", "windows_split"]


def posix_call(line: str, path: str, shell: str = "/bin/sh") -> list[str]:
    """The user's line is raw shell; the path behind it is quoted."""
    quoted = path.replace("'", "'\\''")
    return [shell, "-c", f"{line} '{quoted}'"]


def superslicer_call(line: str, path: str, shell: str = "/bin/sh") -> list[str]:
    """As above, but what stands before the first space is looked at by its ending."""
    command, space, rest = line.partition(" ")
    interpreter = {".py": "python3 ", ".pl": "perl "}.get(command[-3:].lower(), "")
    return posix_call(f"{interpreter}{command}{space}{rest}", path, shell)


def windows_call(line: str, path: str, exists: Callable[[str], bool]) -> str:
    """The command line for CreateProcessW, or FileNotFoundError as the slicer says it."""
    arguments = windows_split(line)
    if not exists(arguments[0]):
        raise FileNotFoundError(arguments[0])
    before = "cmd.exe /C " if arguments[0].lower().endswith(".bat") else ""
    return before + " ".join(windows_quote(a) for a in [*arguments, path])


def windows_quote(argument: str) -> str:
    """Quote one argument: backslashes count double before a quotation mark, and only there."""
    if argument and not any(c in argument for c in ' \t\n\v"'):
        return argument
    quoted, backslashes = '"', 0
    for character in argument:
        if character == "\\":
            backslashes += 1
            continue
        if character == '"':
            quoted += "\\" * (2 * backslashes + 1) + '"'
        else:
            quoted += "\\" * backslashes + character
        backslashes = 0
    return quoted + "\\" * (2 * backslashes) + '"'


def windows_split(line: str) -> list[str]:
    """Split a command line as CommandLineToArgvW does: the program's name knows no escapes."""
    if line.startswith('"'):
        program, _, rest = line[1:].partition('"')
    else:
        program, _, rest = line.partition(" ")
    arguments, current, quoted, begun = [program], "", False, False
    i = 0
    while i < len(rest):
        character = rest[i]
        if character in " \t" and not quoted:
            if begun:
                arguments.append(current)
            current, begun = "", False
            i += 1
            continue
        begun = True
        if character == "\\":
            count = len(rest[i:]) - len(rest[i:].lstrip("\\"))
            i += count
            if i < len(rest) and rest[i] == '"':
                current += "\\" * (count // 2)
                if count % 2:
                    current += '"'
                    i += 1
            else:
                current += "\\" * count
        elif character == '"':
            if quoted and rest[i + 1 : i + 2] == '"':
                current += '"'
                i += 1
            else:
                quoted = not quoted
            i += 1
        else:
            current += character
            i += 1
    return [*arguments, current] if begun else arguments
