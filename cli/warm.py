"""`stillpath warm`: compiles during installation what would be compiled at first use."""

from __future__ import annotations

import contextlib
import multiprocessing
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stillpath.cli.arguments import MachineOption, check_input

if TYPE_CHECKING:
    from stillpath.models.machine import Machine

__all__ = ["warm"]


def warm(
    source: Annotated[
        Path, typer.Argument(metavar="IN", help="A sliced file, as they will come: .gcode, ..")
    ],
    machine: MachineOption,
) -> None:
    """Compile the kernels that a job needs, by doing one; nothing of the job is kept.

    Compiled code lasts until the next version: in the installed package where it may be written,
    else in the user's cache folder (or NUMBA_CACHE_DIR).
    """
    check_input(source)

    from stillpath.cli.console import progress_shown
    from stillpath.cli.own_machines import open_machines
    from stillpath.pipeline.compensate import compensate_file
    from stillpath.pipeline.options import Options
    from stillpath.reports import write_report

    found = open_machines().for_job(machine, files=True)
    with (
        tempfile.TemporaryDirectory(prefix="stillpath-warm-") as folder,
        progress_shown() as progress,
    ):
        report = Path(folder) / "report"
        # A job designs its command before it reads the file: what reads is compiled meanwhile.
        reading = multiprocessing.get_context("spawn").Process(
            target=_read,
            args=(source, Path(folder) / "motion.npz", found.machine),
            daemon=True,
        )
        reading.start()
        try:
            result = compensate_file(
                source,
                Path(folder) / source.name,
                found.machine,
                Options(),
                cache_dir=Path(folder),
                progress=progress,
                layers=report,
            )
            write_report(result, report)
        except BaseException:
            reading.terminate()
            raise
        finally:
            reading.join()


def _read(source: Path, target: Path, machine: Machine) -> None:
    """Plan a file's motion; what is wrong with the file, the job beside it says."""
    from stillpath.pipeline.simulate import plan_file

    with contextlib.suppress(Exception):
        plan_file(source, target, machine)
