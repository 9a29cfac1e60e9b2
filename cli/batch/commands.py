"""`stillpath batch` and `stillpath watch`. Heavy imports wait until a command needs them."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stillpath.cli.arguments import CompensationOptions, KeyOption, ServerOption, check_folder

if TYPE_CHECKING:
    from stillpath.cli.batch.items import Group
    from stillpath.cli.batch.output import Outcome, OutputFolder
    from stillpath.cli.batch.worker_pool import WorkerPool
    from stillpath.pipeline.options import Options

__all__ = ["batch", "watch"]

_AT_A_SERVER = 8

OutputOption = Annotated[
    Path, typer.Option("--output", "-o", metavar="DIR", help="Folder for results and reports.")
]


@dataclass(frozen=True, slots=True)
class WorkOptions:
    """For which machines, and where the work is done."""

    machine: Annotated[
        str | None,
        typer.Option("--machine", "-m", help="A machine, or a group: names separated by commas."),
    ] = None
    machine_map: Annotated[
        list[str] | None,
        typer.Option(
            "--machine-map",
            metavar="PATTERN=M",
            help="Machine or group of the files that fit a pattern, like 'petg_*=mk4'; the first "
            "that fits counts. May be given several times.",
        ),
    ] = None
    jobs: Annotated[
        int | None,
        typer.Option(
            min=1, max=64, help="Files at a time. [default: one per processor; with --server 8]"
        ),
    ] = None
    server: ServerOption = None
    key: KeyOption = None


def batch(
    sources: Annotated[
        list[Path], typer.Argument(metavar="FILES|FOLDERS", help="Folders are searched through.")
    ],
    output: OutputOption,
    *,
    work: WorkOptions,
    how: CompensationOptions,
) -> None:
    """Compensate many files, with one summary.

    Goes on after a file that cannot be done. What was done before is not done again. Exit code 0
    if all are done, 2 if a file or machine is at fault, 1 if the computer or the server is.
    """
    from stillpath.cli.batch.batch import run_batch
    from stillpath.cli.batch.items import items_of, parse_map
    from stillpath.cli.batch.summary import print_summary, write_summary
    from stillpath.service.interruption import Interrupted

    options = how.chosen()
    group = parse_map(work.machine, work.machine_map or [])
    items = items_of(sources, group, output=output)
    outcomes: list[Outcome] = []

    def tell(outcome: Outcome) -> None:
        outcomes.append(outcome)
        _line(outcome, f"{len(outcomes)} of {len(items)}")

    try:
        with _at_work(output, group, options, work) as (worker_pool, folder, check):
            outcomes = run_batch(worker_pool, folder, items, tell=tell, check=check)
            write_summary(outcomes, output)
    except Interrupted as interruption:
        sys.stderr.write(
            f"stillpath: interrupted; {len(outcomes)} of {len(items)} are finished; run the "
            "same command again for the rest\n"
        )
        raise SystemExit(interruption.exit_code) from None
    print_summary(outcomes)
    typer.echo(f"summary: {output / 'summary.html'}, .json, .csv")
    troubles = {outcome.trouble for outcome in outcomes if outcome.state == "failed"}
    if troubles:
        raise typer.Exit(1 if troubles & {"computer", "work"} else 2)


def watch(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", exists=True, file_okay=False)],
    output: OutputOption,
    *,
    work: WorkOptions,
    settle_s: Annotated[
        float, typer.Option(min=0.1, help="A file is complete once it has not changed for so long.")
    ] = 2.0,
    every_s: Annotated[
        float,
        typer.Option(
            min=0.5, help="How often to look where changes are not reported, as on shares."
        ),
    ] = 10.0,
    how: CompensationOptions,
) -> None:
    """Compensate what arrives in a folder, until interrupted.

    Why a file could not be done stands beside it, in NAME.error.txt.
    """
    from stillpath.cli.batch.items import check_apart, parse_map
    from stillpath.cli.batch.watching import Watcher, run_watch
    from stillpath.service.interruption import Interrupted

    options = how.chosen()
    group = parse_map(work.machine, work.machine_map or [])
    check_apart(folder, output)
    with _at_work(output, group, options, work) as (worker_pool, kept, check):
        watcher = Watcher(folder, group, worker_pool, kept, settle_s=settle_s, tell=_line)
        sys.stderr.write(f"stillpath: watching {folder}\n")
        try:
            run_watch(watcher, folder, every_s=every_s, check=check)
        except Interrupted:
            sys.stderr.write("stillpath: stopped; the next start does what was in progress\n")


@contextmanager
def _at_work(
    output: Path, group: Group, options: Options, asked: WorkOptions
) -> Iterator[tuple[WorkerPool, OutputFolder, Any]]:
    """Yield a worker pool, its output folder, and a check to call now and then."""
    from stillpath.cli.batch.items import check_names
    from stillpath.cli.batch.output import OutputFolder
    from stillpath.cli.batch.worker_pool import Backend, LocalBackend, worker_pool
    from stillpath.cli.own_machines import open_machines
    from stillpath.service.interruption import interruptible

    check_folder(output, "--output")
    backend: Backend
    if not asked.server:
        jobs = asked.jobs or os.cpu_count() or 1
        machines = open_machines()
        check_names(group, machines)
        backend = LocalBackend(machines, options, jobs)
    else:
        from stillpath.cli.batch.server import ServerBackend, batch_name
        from stillpath.service.client import Client, ClientError

        jobs = asked.jobs or _AT_A_SERVER
        try:
            client = Client(asked.server, asked.key)
            backend = ServerBackend(client, options, batch_name(output))
        except ClientError as error:
            sys.stderr.write(f"stillpath: error: {error}\n")
            raise SystemExit(error.exit_code) from None
    with (
        interruptible() as check,
        OutputFolder.opened(output) as folder,
        worker_pool(backend, folder, options, jobs) as made,
    ):
        yield made, folder, check


def _line(outcome: Outcome, count: str = "") -> None:
    """Tell an outcome in one line on stderr."""
    what = outcome.error or outcome.output
    name = Path(outcome.source).name
    machine = f" for {outcome.machine}" if outcome.machine else ""
    sys.stderr.write(f"{count + ': ' if count else ''}{name}{machine}: {outcome.state}: {what}\n")
    sys.stderr.flush()
