"""The error raised where a written file differs from its original."""

from __future__ import annotations

__all__ = ["LastCheckError", "shown"]

_LONGEST = 60


class LastCheckError(Exception):
    """The written file differs from what it should be; it must not be delivered.

    Attributes
    ----------
    line, written_line : int
        Lines of the original and of the written file, from 1.
    reason : str
        What differs there.
    stream_line : int
        Line of the original at which the preceding stream begins; 0: none.
    """

    exit_code = 1

    def __init__(self, message: str, line: int, written_line: int) -> None:
        self.line, self.written_line, self.reason = line, written_line, message
        self.stream_line = 0
        super().__init__(
            f"the last check refuses the written file at its line {written_line} (line {line} of "
            f"the original): {message}. This is an error of Stillpath, nothing was written: "
            "please report it with the file, and print the original"
        )

    def __reduce__(self) -> tuple[object, ...]:
        of_message = (self.args[0], self.line, self.written_line, self.reason)
        return _rebuilt, of_message, {"stream_line": self.stream_line}


def _rebuilt(text: str, line: int, written_line: int, reason: str) -> LastCheckError:
    error = LastCheckError(reason, line, written_line)
    error.args = (text,)
    return error


def shown(line: bytes) -> str:
    """Return a line as quoted in a message, cut if it is long."""
    text = line.strip().decode("utf-8", "replace")
    return text if len(text) <= _LONGEST else text[: _LONGEST - 3] + "..."
