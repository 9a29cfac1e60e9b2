"""The command line against a server: `compensate --server`, and `stillpath jobs ...`."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Protocol

import typer

from stillpath.cli.arguments import CommandRefused, KeyOption, ServerOption, check_output

if TYPE_CHECKING:
    from stillpath.pipeline.options import Options
    from stillpath.service.api.schemas import JobView
    from stillpath.service.client import Client

__all__ = ["app", "compensate_on_server"]

Id = Annotated[str, typer.Argument(metavar="JOB", help="As `stillpath jobs list` names it.")]
Output = Annotated[
    Path | None,
    typer.Option("--output", "-o", metavar="OUT", help="[default: the name the service gives]"),
]
Report = Annotated[
    Path | None, typer.Option("--report", metavar="DIR", help="Folder for report.html and .json.")
]

app = typer.Typer(
    help="Jobs of a service (--server URL, or STILLPATH_SERVER).",
    no_args_is_help=True,
    rich_markup_mode=None,
)


def compensate_on_server(
    source: Path,
    target: Path,
    machine: str,
    options: Options,
    *,
    server: str,
    key: str | None,
    report: Path | None,
) -> None:
    """Let a service compensate a file. Ctrl-C cancels the job.

    Raises
    ------
    service.client.ClientError
    OSError
        If the file cannot be written, or the source was changed meanwhile.
    """
    from stillpath.cli.console import told_after
    from stillpath.pipeline.files import check_unchanged
    from stillpath.service.interruption import interruptible_at_once

    with interruptible_at_once(), _client(server, key) as client:
        with _progress() as tell:
            began = source.stat()
            made = client.submit(source, machine=machine, options=options, tell=tell)
            job = client.result_of(made, tell=_reports(tell))
            figures = client.report(job.id)
            # The target may be the source.
            client.fetch(job, target, tell=tell, check=lambda: check_unchanged(source, began))
        if report is not None:
            with told_after(target, "report"):
                client.save_report(job.id, report)
        with told_after(target, "figures"):
            _print_figures(figures)


@app.command("list")
def list_jobs(
    state: Annotated[
        list[str] | None, typer.Option(help="queued, running, done, failed or cancelled.")
    ] = None,
    batch: Annotated[str | None, typer.Option(help="Only jobs of a batch.")] = None,
    limit: Annotated[int, typer.Option(min=1, help="How many at most.")] = 50,
    server: ServerOption = None,
    key: KeyOption = None,
) -> None:
    """List jobs, newest first."""
    from itertools import islice

    from rich.console import Console
    from rich.table import Table

    with _client(server, key) as client:
        found = list(islice(client.jobs(state=state, batch=batch, limit=min(limit, 200)), limit))
    table = Table(box=None, pad_edge=False)
    for column in ("job", "state", "machine", "file", "made"):
        table.add_column(column, no_wrap=column != "file")
    for job in found:
        made = job.created_at.astimezone().strftime("%Y-%m-%d %H:%M")
        share = f" {100 * job.progress:.0f} %" if job.state.value == "running" else ""
        table.add_row(job.id, f"{job.state.value}{share}", job.machine, job.source_name, made)
    Console(highlight=False, markup=False, soft_wrap=True).print(table)


@app.command()
def show(job: Id, server: ServerOption = None, key: KeyOption = None) -> None:
    """Show how a job stands, as JSON."""
    with _client(server, key) as client:
        sys.stdout.write(client.job(job).model_dump_json(indent=2) + "\n")


@app.command()
def wait(
    job: Id,
    timeout: Annotated[float | None, typer.Option(min=0, help="Seconds.")] = None,
    server: ServerOption = None,
    key: KeyOption = None,
) -> None:
    """Wait until a job is over; exit code 0 if it is done. Ctrl-C leaves the job alone."""
    from stillpath.service.client import Submission
    from stillpath.service.interruption import interruptible_at_once

    with interruptible_at_once(), _client(server, key) as client, _progress() as tell:
        client.result_of(
            Submission(client.job(job), is_new=False),
            tell=_reports(tell),
            timeout_s=timeout,
        )


@app.command()
def fetch(
    job: Id,
    output: Output = None,
    report: Report = None,
    server: ServerOption = None,
    key: KeyOption = None,
) -> None:
    """Fetch the result of a job that is done."""
    from stillpath.cli.console import told_after
    from stillpath.service.api.uploads import safe_name
    from stillpath.service.interruption import interruptible_at_once

    with interruptible_at_once(), _client(server, key) as client:
        found = client.job(job)
        named = output or Path(safe_name(found.result_name))
        if output is None and named.exists():
            raise CommandRefused(f"{named} exists; name the file with -o to replace it")
        target = check_output(named)
        with _progress() as tell:
            client.fetch(found, target, tell=tell)
        if report is not None:
            with told_after(target, "report"):
                client.save_report(found.id, report)
    sys.stdout.write(f"{named}\n")


@app.command()
def cancel(job: Id, server: ServerOption = None, key: KeyOption = None) -> None:
    """Stop a job; it stays in the list."""
    with _client(server, key) as client:
        sys.stdout.write(f"{client.cancel(job).state.value}\n")


@app.command()
def delete(job: Id, server: ServerOption = None, key: KeyOption = None) -> None:
    """Stop a job if it runs, and delete its files."""
    with _client(server, key) as client:
        client.delete(job)


@contextmanager
def _client(server: str | None, key: str | None) -> Iterator[Client]:
    from stillpath.service.client import Client, ClientError

    if not server:
        raise ClientError("which service? Say --server URL, or set STILLPATH_SERVER", 400)
    with Client(server, key or None) as client:
        yield client


class _Tell(Protocol):
    def __call__(self, stage: str, share: float | None, eta_s: float | None = None, /) -> None: ...


@contextmanager
def _progress() -> Iterator[_Tell]:
    from stillpath.cli.console import shown
    from stillpath.pipeline.progress import Progress

    began = time.monotonic()
    with shown("stillpath") as show_it:

        def tell(stage: str, share: float | None, eta_s: float | None = None, /) -> None:
            show_it(Progress(stage, share or 0.0, 0.0, time.monotonic() - began, eta_s))

        yield tell


def _reports(tell: _Tell) -> Callable[[JobView], None]:
    def report(job: JobView) -> None:
        waits = job.state.value == "queued" and job.queue_position
        stage = f"waiting behind {job.queue_position} jobs" if waits else job.stage
        tell(stage, job.progress, job.eta_s)

    return report


def _print_figures(report: dict[str, Any]) -> None:
    """Print what was measured; a service of another version may tell it in another way."""
    from pydantic import ValidationError

    from stillpath.cli.console import print_result
    from stillpath.pipeline.result import Result

    report["track"] = _numbers(report.get("track"))
    try:
        result = Result.model_validate(report)
    except ValidationError:
        sys.stdout.write("done; the figures are in the report\n")
    else:
        print_result(result)


def _numbers(read: Any) -> Any:
    """Turn null into NaN, which is how JSON writes it."""
    if isinstance(read, dict):
        return {name: _numbers(value) for name, value in read.items()}
    if isinstance(read, list):
        return [_numbers(value) for value in read]
    return math.nan if read is None else read
