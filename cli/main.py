"""The command line. Heavy imports wait until a command needs them, so that --help is quick.

Exit codes: 0 done, 1 the computer failed us (disk, memory, permission), 2 the request cannot be
met (bad file, machine, model or option), 130 interrupted. Whatever is not 0 leaves no output
file, and the input as it was.
"""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import TextIOWrapper
from pathlib import Path
from typing import Annotated, NoReturn, TextIO

import typer

from stillpath.cli import (
    advice,
    backup,
    compensate,
    controllers,
    design,
    identify,
    keys,
    klipper,
    machines,
    printers,
    proof,
    remote,
    scan,
    serve,
    trajectories,
    warm,
)
from stillpath.cli.arguments import CommandRefused
from stillpath.cli.batch import commands as batch
from stillpath.cli.groups import GroupedCommands
from stillpath.cli.option_groups import grouped
from stillpath.service.environment import prepare_environment
from stillpath.service.interruption import Interrupted

__all__ = ["app", "main", "run"]

app = typer.Typer(
    name="stillpath",
    cls=GroupedCommands,
    help="Keeps a printer's nozzle on its path: compensates G-code for the machine's vibration.",
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

_INTERRUPTED = 130
_WITH_WORKERS = (["serve"], ["scheduler"], ["worker"])
"""Commands that compute in processes of their own."""


def main() -> NoReturn:
    """Run the command line and exit; the entry point of the `stillpath` command."""
    sys.stdout, sys.stderr = _Out.over(sys.stdout), _Errors.over(sys.stderr)
    prepare_environment(computing=sys.argv[1:2] not in _WITH_WORKERS)
    sys.exit(run(sys.argv[1:]))


@contextmanager
def _named() -> Iterator[None]:
    """Let an error say that it is the standard output that is full."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, error.strerror, "standard output") from error


class _Out(TextIOWrapper):
    """Standard output: what is done counts, also if nobody reads the figures to their end."""

    _unheard: type[OSError] = BrokenPipeError

    @classmethod
    def over(cls, stream: TextIO | None) -> TextIO:
        """Return a stream in place of Python's, which is None where it was closed."""
        if stream is None:
            return Path(os.devnull).open("w", encoding="utf-8")
        if not isinstance(stream, TextIOWrapper):
            return stream
        encoding, lines, at_once = stream.encoding, stream.line_buffering, stream.write_through
        # A console may know no micro sign and no frames.
        return cls(stream.detach(), encoding, "replace", None, lines, at_once)

    def write(self, text: str) -> int:
        """See `io.TextIOWrapper`."""
        with suppress(self._unheard), _named():
            return super().write(text)
        return len(text)

    def flush(self) -> None:
        """See `io.TextIOWrapper`."""
        with suppress(self._unheard), _named():
            super().flush()


class _Errors(_Out):
    """Standard error: a full disk or a terminal that went away does not end the work either."""

    _unheard = OSError


def run(arguments: list[str]) -> int:
    """Run one command and return its exit code; every failure is one line on stderr."""
    try:
        code = typer.main.get_command(app).main(
            args=arguments, prog_name="stillpath", standalone_mode=False
        )
        if code != _INTERRUPTED:
            return code if isinstance(code, int) else 0
        return _fail("interrupted; nothing was written", _INTERRUPTED)
    except (KeyboardInterrupt, typer.Abort):
        return _fail("interrupted; nothing was written", _INTERRUPTED)
    except Interrupted as interruption:
        return _fail("interrupted; nothing was written", interruption.exit_code)
    except typer.TyperException as error:
        return _fail(f"{_of_usage(error)} (stillpath COMMAND --help lists the options)", 2)
    except CommandRefused as error:
        return _fail(str(error), 2)
    except MemoryError:
        return _fail("out of memory; close other programs or use a larger machine", 1)
    except OSError as error:
        return _fail(_of_system(error), 1)
    except ValueError as error:
        if not _is_ours(error):
            raise
        return _fail(str(error), 2)
    except Exception as error:
        if hasattr(error, "exit_code"):  # of a service that was asked: it knows how bad it is
            return _fail(str(error), error.exit_code)
        remedy = next((_OF_PATHS[said] for said in _OF_PATHS if str(error).startswith(said)), None)
        if remedy is None:
            raise
        return _fail(f"{error}; {remedy}", 1)


@app.callback(invoke_without_command=True)
def _root(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Show the version.")] = False,
) -> None:
    if version:
        from stillpath.version import __version__

        typer.echo(f"stillpath {__version__}")
        raise typer.Exit
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


for _name, _group in (
    ("machines", machines.app),
    ("klipper", klipper.app),
    ("keys", keys.app),
    ("printers", printers.app),
    ("jobs", remote.app),
):
    app.add_typer(_group, name=_name)
for _command in (
    advice.remove_advice,
    *(backup.backup, backup.restore, backup.migrate),
    *(batch.batch, batch.watch),
    *(compensate.compensate, compensate.simulate),
    *(controllers.controller, controllers.loops),
    *(design.design, design.track),
    identify.identify,
    keys.audit,
    *(proof.coupon, proof.tower, proof.ring_test, proof.motor_test, proof.verify),
    scan.scan,
    *(serve.serve, serve.scheduler, serve.worker),
    *(trajectories.plan, trajectories.trajectories),
    warm.warm,
):
    app.command()(grouped(_command))


def _is_ours(error: ValueError) -> bool:
    from stillpath.compensation.base import DesignError
    from stillpath.gcode.errors import GcodeError
    from stillpath.models.errors import ModelError

    return isinstance(error, GcodeError | ModelError | DesignError)


def _of_usage(error: typer.TyperException) -> str:
    """Return what is wrong with the command line; a value that typer refused in our words."""
    from pydantic import ValidationError

    from stillpath.models.complaints import complaint

    refused, parameter = error.__cause__, getattr(error, "param", None)
    if not isinstance(refused, ValidationError) or parameter is None:
        return error.format_message()
    name = next((name for name in parameter.opts if name.startswith("--")), parameter.metavar)
    return f"{name or parameter.name}: {complaint(refused.errors(include_url=False)[0])}"


_REMEDIES = {
    errno.ENOSPC: "make room there, or write to another disk",
    errno.EDQUOT: "make room there, or write to another disk",
    errno.EFBIG: "its disk, or a limit of this user, takes no larger files: write elsewhere",
    errno.EROFS: "nothing can be written there: take another folder",
    errno.EACCES: "this user may not use it: take another one, or have it allowed",
}


_OF_PATHS = {
    "Symlink loop": "name a path that leads somewhere",
    "Could not determine home directory": "set HOME to a folder of this user",
}
"""What `pathlib` raises as a RuntimeError, and remedies."""


def _of_system(error: OSError) -> str:
    place = f"{error.filename}: " if error.filename else ""
    remedy = _REMEDIES.get(error.errno or 0)
    return f"{place}{error.strerror or error}{f'; {remedy}' if remedy else ''}"


def _fail(message: str, code: int) -> int:
    sys.stderr.write(f"stillpath: error: {' '.join(message.split())}\n")
    return code
