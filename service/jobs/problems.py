"""Errors as problem documents (RFC 9457), for the job row and for the wire."""

from __future__ import annotations

import errno
from typing import Any

from stillpath.service.jobs.state import JobKind
from stillpath.service.storage.disk import DISK_FULL

__all__ = [
    "FILE_EMPTY",
    "FILE_TITLES",
    "FILE_TOO_LARGE",
    "LIMIT_TITLES",
    "PROBLEM_MEDIA_TYPE",
    "TOO_LARGE_A_RESULT",
    "TOO_LONG",
    "TOO_MUCH_MEMORY",
    "input_damaged",
    "input_gone",
    "never_fits",
    "problem",
    "problem_of",
    "storage_away",
    "storage_never_fits",
]

PROBLEM_MEDIA_TYPE = "application/problem+json"
FILE_EMPTY = "The file is empty"
FILE_TOO_LARGE = "File too large"
TOO_LONG = "The job takes too long"
TOO_MUCH_MEMORY = "The job needs too much memory"
TOO_LARGE_A_RESULT = "The job is larger than the disk"
LIMIT_TITLES = frozenset({TOO_LONG, TOO_MUCH_MEMORY, TOO_LARGE_A_RESULT})
"""Titles of problems that the same job most likely has again, however often it is done."""
_GCODE_REFUSED = "The G-code cannot be processed"
FILE_TITLES = frozenset({FILE_EMPTY, FILE_TOO_LARGE, _GCODE_REFUSED})
"""Titles of problems (4xx) for which the uploaded file is to blame, and nothing else."""
_REFUSED = {
    JobKind.TRAJECTORIES: "Trajectories not available",
    JobKind.IDENTIFICATION: "Identification not possible",
    JobKind.DESIGN: "Design not possible",
    JobKind.CONTROLLER: "Controller not possible",
    JobKind.LIVE: "Live printing not available",
}
"""Titles of requests that cannot be computed."""
_SMALLER = "Limit the size of the result (max_mb), cut the print into several files"
"""What helps where a result is too large: it may have ten times the size of the upload."""


def problem(status: int, title: str, detail: str, **extra: Any) -> dict[str, Any]:
    """Return a problem document.

    Parameters
    ----------
    title : str
        The kind of problem, the same for every occurrence.
    detail : str
        What happened here, the limit and the remedy.
    **extra
        Further members, for instance `line`.
    """
    return {"type": "about:blank", "title": title, "status": status, "detail": detail, **extra}


def problem_of(error: BaseException, kind: JobKind = JobKind.COMPENSATION) -> dict[str, Any]:
    """Return the problem document for an error of a job's work.

    The three base errors of the program are the input's fault (422) and are reported in full, as is
    a written file that the last check refuses (500); anything else is our fault, and its details
    are only logged.
    """
    from stillpath.compensation.base import DesignError
    from stillpath.gcode.errors import GcodeError
    from stillpath.models.errors import ModelError
    from stillpath.pipeline.last_check.errors import LastCheckError

    match error:
        case GcodeError() | ModelError() | DesignError() if kind in _REFUSED:
            reason = getattr(error, "reason", None)
            extra = {} if reason is None else {"reason": reason}
            return problem(422, _REFUSED[kind], str(error), **extra)
        case GcodeError():
            place = {} if error.line is None else {"line": error.line, "text": error.text}
            return problem(422, _GCODE_REFUSED, str(error), **place)
        case ModelError():
            return problem(422, "The machine model cannot be used", str(error))
        case DesignError():
            return problem(422, "No compensator can be designed", str(error))
        case LastCheckError():
            place = {"line": error.line, "written_line": error.written_line}
            return problem(500, "The last check failed", str(error), **place)
        case MemoryError():
            return problem(500, "Out of memory", "The worker ran out of memory; give it more.")
        case OSError() if error.errno in DISK_FULL:
            return problem(
                507,
                "No space left",
                "The disk of the data directory or of the storage is full; free space there and "
                "submit the job again.",
            )
        case OSError(errno=errno.EFBIG):
            return problem(
                507,
                FILE_TOO_LARGE,
                "A file of the job became larger than the file system of the data directory or of "
                f"the storage allows. {_SMALLER}, or give them one that allows more.",
            )
        case _:
            return problem(
                500,
                "Internal error",
                f"The job broke with {type(error).__name__}; the service's log holds the details.",
            )


def input_gone(name: str) -> dict[str, Any]:
    """Return the problem of a job whose input was deleted; `name` of the file."""
    detail = f"{name} is no longer in the storage. Submit it again."
    return problem(404, "The file is gone", detail)


def input_damaged(name: str) -> dict[str, Any]:
    """Return the problem of a job whose input is not what was submitted; `name` of the file."""
    return problem(
        404,
        "The file is damaged",
        f"{name} in the storage is not the file that was submitted: its SHA-256 differs. Check the "
        "disk of the storage, and submit the file again.",
    )


def never_fits(room_bytes: int, total_bytes: int) -> dict[str, Any]:
    """Return the problem of a job whose files are larger than the disk."""
    return problem(
        507,
        TOO_LARGE_A_RESULT,
        f"It had written {room_bytes >> 20} MiB when the disk was full; the disk of the worker has "
        f"{total_bytes >> 20} MiB in all, and some stay free (STILLPATH_DISK_RESERVE_BYTES). "
        f"{_SMALLER}, or give the service a larger disk.",
    )


def storage_never_fits(room_bytes: int, total_bytes: int) -> dict[str, Any]:
    """Return the problem of a job whose result is larger than the disk of the storage."""
    return problem(
        507,
        TOO_LARGE_A_RESULT,
        f"Its result has {room_bytes >> 20} MiB, and the disk of the storage {total_bytes >> 20} "
        f"MiB in all (STILLPATH_STORAGE_URL). {_SMALLER}, or give the storage a larger disk.",
    )


def storage_away(error: Exception) -> dict[str, Any]:
    """Return the problem of a job whose files repeatedly could not be fetched or stored."""
    return problem(
        503,
        "Storage unavailable",
        f"The job's files could not be fetched or stored: {error}. Submit the job again once the "
        "storage answers.",
    )
