"""What is designed before the first piece of a job: reference shaper, mixture, compensator."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from stillpath.compensation.cautious import Caution
from stillpath.compensation.defaults import DT_S
from stillpath.models.machine import Machine
from stillpath.pipeline.caution import Mixture, caution_for
from stillpath.pipeline.clock import StageClock
from stillpath.pipeline.measuring.reference_shaper import BestShaper, cached_shaper
from stillpath.pipeline.options import Options
from stillpath.pipeline.piece_compensator import PieceCompensator

__all__ = ["JobDesign", "design_job"]


@dataclass(frozen=True, slots=True)
class JobDesign:
    """A job's design.

    Attributes
    ----------
    shaper : BestShaper
        The firmware's shaper, tuned for the machine: what the job is compared with.
    piece_compensator : PieceCompensator or None
        None: the file is only measured.
    caution, mixture : Caution, Mixture or None
        The mixture with a shaper that was chosen for the machine's set, and its errors, if any.
    """

    shaper: BestShaper
    piece_compensator: PieceCompensator | None
    caution: Caution | None
    mixture: Mixture | None


def design_job(
    machine: Machine,
    options: Options,
    cache_dir: Path,
    clock: StageClock,
    say: Callable[[str, float], None],
) -> JobDesign:
    """Tune the reference shaper and design the command.

    Parameters
    ----------
    say : callable
        Is told the stage, and the share of the job that is done.

    Raises
    ------
    DesignError
        The method cannot be designed for this machine.
    """
    designed = None
    # Design first: a design error should show before the slow tuning of the shaper.
    tuned_first = options.method.startswith("shaper:")
    if options.method != "none" and not tuned_first:
        say("designing", 0.0)
        with clock.stage("design"):
            designed = PieceCompensator(machine, options)
    say("tuning the shaper to compare with", 0.0)
    with clock.stage("reference shaper"):
        shaper = cached_shaper(machine, cache_dir, DT_S)
        chosen = caution_for(machine, options, shaper, cache_dir, DT_S)
    caution, mixture = chosen or (None, None)
    if tuned_first or caution is not None:
        designed = PieceCompensator(machine, options, shaper, caution)
    return JobDesign(shaper, designed, caution, mixture)
