"""Many files, one summary."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, wait

from stillpath.cli.batch.items import Item
from stillpath.cli.batch.output import Outcome, OutputFolder
from stillpath.cli.batch.worker_pool import WorkerPool

__all__ = ["run_batch"]

_LOOK_S = 0.2


def run_batch(
    worker_pool: WorkerPool,
    output: OutputFolder,
    items: Sequence[Item],
    *,
    tell: Callable[[Outcome], None] = lambda _: None,
    check: Callable[[], None] = lambda: None,
) -> list[Outcome]:
    """Do all items, whatever becomes of single ones.

    What was done before with the same input, machine, options and version, and still lies where it
    was put, is not done again. Large files come first, so that the last ones to run are short and
    no process waits long for another.

    Parameters
    ----------
    tell : callable, optional
        Is given every outcome as it comes.
    check : callable, optional
        Called now and then; may raise to stop the work.

    Returns
    -------
    list of Outcome
        In the order of `items`.
    """

    def is_done(_: Item, now: Outcome, known: Outcome) -> bool:
        return known.state == "done" and known.key == now.key and output.is_there(known)

    by_size = sorted(items, key=lambda item: -_size(item))
    futures = {worker_pool.add(item, is_done): item for item in by_size}
    outcomes: dict[int, Outcome] = {}
    waiting = set(futures)
    while waiting:
        done, waiting = wait(waiting, timeout=_LOOK_S, return_when=FIRST_COMPLETED)
        for future in done:
            outcome = future.result()
            outcomes[id(futures[future])] = outcome
            tell(outcome)
        check()
    return [outcomes[id(item)] for item in items]


def _size(item: Item) -> int:
    try:
        return item.source.stat().st_size
    except OSError:
        return 0
