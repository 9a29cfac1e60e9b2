"""What is designed is stable on every member, or refused."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from stillpath.compensation.feedback.controller import Controller, Refusal
from stillpath.models.loops import Loop
from stillpath.simulation.closed_loop import simulate

__all__ = ["assert_fades", "made_or_refused"]


def made_or_refused(design: Callable[[], Controller], *reasons: str) -> Controller | None:
    """Return the controller; None if it is refused, which must be for one of the reasons."""
    try:
        return design()
    except Refusal as refusal:
        reason = refusal.reason
    assert reason in reasons
    return None


def assert_fades(
    made: Controller,
    loops: Sequence[Loop],
    inputs: dict[str, np.ndarray],
    outputs: tuple[str, ...],
    **options: int,
) -> None:
    """What a kick leaves behind decays as the spectral radii say."""
    assert max(made.spectral_radii) < 1
    size = max(map(len, inputs.values()))
    for loop, radius in zip(loops, made.spectral_radii, strict=True):
        watched = simulate(loop, made.blocks, inputs, outputs, **options)
        early = max(np.abs(x[: size // 10]).max() for x in watched.values())
        late = max(np.abs(x[-size // 10 :]).max() for x in watched.values())
        assert late <= early * max(radius ** (size // 2), 1e-9) * 1e3
