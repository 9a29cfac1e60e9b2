"""One attempt at a job as passed to a computation: plain values and local files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stillpath.pipeline.progress import Progress
from stillpath.service.jobs.state import JobKind

if TYPE_CHECKING:
    from stillpath.applications.machines.resolve import PinnedMachine

__all__ = ["Runner", "Task"]


@dataclass(frozen=True, slots=True)
class Task:
    """One attempt at a job.

    Attributes
    ----------
    machine, machine_revision : str
        Name and revision of the machine that the job was accepted with.
    machine_file : Path
        The machine itself (`applications.machines.resolve.PinnedMachine`).
    sources : tuple of Path
        Read-only.
    target, report : Path
        File and folder to create; their parents exist.
    cache_dir : Path
        Cache kept between jobs.
    attempt : int
        Number of the attempt, from 1.
    """

    machine: str
    machine_revision: str
    machine_file: Path
    options: dict[str, Any]
    sources: tuple[Path, ...]
    target: Path
    report: Path
    cache_dir: Path
    kind: JobKind = JobKind.COMPENSATION
    attempt: int = 1

    @property
    def source(self) -> Path:
        """The only source."""
        (source,) = self.sources
        return source

    def pinned(self) -> PinnedMachine:
        """Return the machine.

        Raises
        ------
        ModelError
            If its file is gone or damaged.
        """
        from stillpath.applications.machines.resolve import PinnedMachine

        return PinnedMachine.read(self.machine_file, self.machine, self.machine_revision)


Runner = Callable[[Task, Callable[[Progress], None]], dict[str, Any]]
"""Does the work of a task, and returns the figures shown in lists; importable by name."""
