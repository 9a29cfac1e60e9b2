"""A watched folder: what arrives there is done once, when it has stopped growing.

The folder is looked through again and again; messages of the system only say when to look at once.
So nothing is lost where they are: on network shares, with too many files at a time, while nobody
watched. What was done is known by its content, from the records of the output folder.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from stillpath.cli.batch.items import Group, Item, is_stamped, is_unfinished, print_files
from stillpath.cli.batch.output import Outcome, OutputFolder
from stillpath.cli.batch.worker_pool import WorkerPool
from stillpath.pipeline.files import replacing

__all__ = ["Watcher", "run_watch"]

_AGAIN_S = (10.0, 30.0, 60.0, 300.0)
"""How long to wait before what was not the file's fault is tried once more."""
_TRIES_OF_WORK = 2
"""How often work is begun that broke: on a computer that prints it may disturb the print."""
_STALLED_S = 60.0
"""How long a file without its end is waited for: the copy may have come to a halt."""
_STEP_S = 0.5

_Signature = tuple[int, int, int]


@dataclass(slots=True)
class _Work:
    """One file for one machine."""

    future: Future[Outcome] | None = None
    is_over: bool = False
    error: str = ""
    tries: int = 0
    breaks: int = 0
    next_at: float = 0.0


@dataclass(slots=True)
class _Seen:
    """A file as it was found; another signature makes it another file."""

    signature: _Signature
    since: float
    is_unfinished: bool | None = None
    """None until it has stopped growing."""
    works: dict[str, _Work] | None = None
    """By machine; None until the file has stopped growing."""
    reported: str = field(default="", repr=False)


class Watcher:
    """Looks through a folder and hands over what has arrived.

    Parameters
    ----------
    group : Group
        Machines of every file.
    output : OutputFolder
        May lie in the watched folder.
    settle_s : float
        A file counts as complete when it has not changed for so long; without its slicer's last
        comment, for a minute.
    tell : callable
        Is given every outcome that is new.
    """

    def __init__(
        self,
        folder: Path,
        group: Group,
        worker_pool: WorkerPool,
        output: OutputFolder,
        *,
        settle_s: float = 2.0,
        tell: Callable[[Outcome], None] = lambda _: None,
    ) -> None:
        self._folder = folder
        self._group = group
        self._pool = worker_pool
        self._output = output
        self._kept_out = output.root.resolve()
        self._settle_s = settle_s
        self._tell = tell
        self._seen: dict[Path, _Seen] = {}

    def look(self, now: float) -> bool:
        """Look through the folder once, at the time `now` of a clock that only goes forward.

        Returns
        -------
        bool
            Whether files are under way or still settling: look again soon.
        """
        present = self._present()
        busy = False
        for path, seen in list(self._seen.items()):
            is_same = present.get(path) == seen.signature
            if self._collect(path, seen, now, is_same=is_same):
                busy = True
            elif not is_same:
                del self._seen[path]
        for path, signature in present.items():
            seen = self._seen.setdefault(path, _Seen(signature, now))
            if seen.signature != signature or self._may_grow(path, seen, now - seen.since):
                busy = True
            else:
                busy |= self._hand_over(path, seen, now)
        return busy

    def is_of_interest(self, path: Path) -> bool:
        """Return whether a change of `path` is a reason to look."""
        return not path.is_relative_to(self._kept_out) and not path.name.endswith(".error.txt")

    def _present(self) -> dict[Path, _Signature]:
        found: dict[Path, _Signature] = {}
        for path in print_files(self._folder, self._kept_out):
            with suppress(OSError):  # it may be gone by now
                state = path.stat()
                found[path] = (state.st_size, state.st_mtime_ns, state.st_ino)
        return found

    def _may_grow(self, path: Path, seen: _Seen, quiet_s: float) -> bool:
        if quiet_s < self._settle_s:
            return True
        if seen.is_unfinished is None:
            seen.is_unfinished = is_unfinished(path)
        return seen.is_unfinished and quiet_s < _STALLED_S

    def _hand_over(self, path: Path, seen: _Seen, now: float) -> bool:
        place = path.relative_to(self._folder).as_posix()
        if seen.works is None:
            machines = () if is_stamped(path) else self._group.of(place)
            seen.works = {machine: _Work() for machine in machines}
        for machine, work in seen.works.items():
            if work.future is None and not work.is_over and now >= work.next_at:
                work.future = self._pool.add(Item(path, place, machine), self._is_done)
        return any(work.future is not None for work in seen.works.values())

    def _collect(self, path: Path, seen: _Seen, now: float, *, is_same: bool) -> bool:
        """Take in what is finished; return whether anything is still under way."""
        works = (seen.works or {}).values()
        came = False
        for work in works:
            if work.future is None or not work.future.done():
                continue
            outcome = _judged(work, work.future.result(), now)
            work.future, came = None, True
            if outcome.state == "done":
                self._tell(outcome)
            if outcome.state == "failed" and outcome.trouble == "file" and is_same:
                with suppress(OSError):  # a full disk: the next start tries the file again
                    self._output.note(outcome.output, outcome)
            if work.error and work.error != seen.reported and is_same:
                self._tell(outcome)
        if came and is_same:
            seen.reported = "\n".join(dict.fromkeys(work.error for work in works if work.error))
            self._say_why(path, seen.reported)
        return any(work.future is not None for work in works)

    def _is_done(self, _: Item, now: Outcome, known: Outcome) -> bool:
        """Say that a file is done once, whatever has changed about machine, options or version."""
        same = known.source_sha256 == now.source_sha256
        return same and (known.state == "done" or known.trouble == "file")

    def _say_why(self, path: Path, why: str) -> None:
        """Leave the reason beside the file, or where that is not allowed, with the output."""
        name = f"{path.name}.error.txt"
        for folder in (path.parent, self._output.root):
            with suppress(OSError):
                if not why:
                    (folder / name).unlink(missing_ok=True)
                    continue
                with replacing(folder / name) as temporary:
                    temporary.write_text(f"{why}\n", encoding="utf-8")
                return


def _judged(work: _Work, outcome: Outcome, now: float) -> Outcome:
    """Note in `work` what comes next; return the outcome as it is told."""
    work.breaks += outcome.trouble == "work"
    gives_up = outcome.trouble == "work" and work.breaks >= _TRIES_OF_WORK
    work.is_over = outcome.state != "failed" or outcome.trouble == "file" or gives_up
    if gives_up:
        why = f"{outcome.error}; it is not tried again before the file changes or the next start"
        outcome = outcome.model_copy(update={"error": why})
    if not work.is_over:
        work.next_at = now + _AGAIN_S[min(work.tries, len(_AGAIN_S) - 1)]
        work.tries += 1
    work.error = outcome.error
    return outcome


def run_watch(watcher: Watcher, folder: Path, *, every_s: float, check: Callable[[], None]) -> None:
    """Look through a folder whenever something changes there, and every so often anyway.

    Parameters
    ----------
    every_s : float
        For what no message tells of.
    check : callable
        Called at least every half second or so; raises to stop.
    """
    busy, looked = True, 0.0
    for changed in _wakes(folder, watcher):
        check()
        now = time.monotonic()
        if changed or busy or now - looked >= every_s:
            busy, looked = watcher.look(now), now


def _wakes(folder: Path, watcher: Watcher) -> Iterator[bool]:
    """Yield again and again, at once and with True when something has changed."""
    from watchfiles import watch

    yield True
    while True:
        try:
            for changes in watch(
                folder,
                watch_filter=lambda _, path: watcher.is_of_interest(Path(path)),
                rust_timeout=round(1000 * _STEP_S),
                yield_on_timeout=True,
                raise_interrupt=False,
            ):
                yield bool(changes)
        except (OSError, RuntimeError):
            pass  # no more watches, or a share that went away: look by the clock
        time.sleep(_STEP_S)
        yield False
