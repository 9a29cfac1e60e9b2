"""The one exception of this package.

`GcodeError` is raised for a file that the firmware would reject, or that would leave the machine.
"""

from __future__ import annotations

import re

__all__ = ["GcodeError"]

_SHOWN_CHARACTERS = 80
_LONGEST_MESSAGE = 1000
_LONG_WORD = re.compile(r"\S{61,}")


class GcodeError(ValueError):
    """A line that cannot be printed.

    Parameters
    ----------
    message : str
        What is wrong: the value, the limit and the remedy. Numbers and names of a file may have
        thousands of characters: long words are shortened.
    line : int, optional
        Line number, from 1.
    text : str
        The offending line; shortened for display.
    """

    def __init__(self, message: str, *, line: int | None = None, text: str = "") -> None:
        shown = text.strip()
        if len(shown) > _SHOWN_CHARACTERS:
            shown = shown[: _SHOWN_CHARACTERS - 3] + "..."
        message = _LONG_WORD.sub(lambda word: word[0][:57] + "...", message)[:_LONGEST_MESSAGE]
        self.message = message
        self.line = line
        self.text = shown
        where = "" if line is None else f"line {line}: "
        quoted = f" ({shown!r})" if shown else ""
        super().__init__(f"{where}{message}{quoted}")

    def __reduce__(self) -> tuple[object, ...]:
        return _rebuild, (self.message, self.line, self.text)


def _rebuild(message: str, line: int | None, text: str) -> GcodeError:
    return GcodeError(message, line=line, text=text)
