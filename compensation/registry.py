"""The list of compensators by name.

Each is imported on demand: importing all takes about a second.
"""

from __future__ import annotations

from typing import Any

from stillpath.compensation.base import Compensator, DesignError
from stillpath.models.machine import Machine

__all__ = ["COMPENSATORS", "INVERSIONS", "compensator"]

INVERSIONS = ("npz-ignore", "zmetc", "zpetc", "ebzpetc", "ts")
COMPENSATORS = ("fbf", *INVERSIONS, "shaper:zv", "shaper:mzv", "shaper:ei", "shaper:2hump_ei",
                "shaper:3hump_ei")  # fmt: skip
_RIPPLE = "+ripple"


def compensator(name: str, machine: Machine, dt_s: float, **settings: Any) -> Compensator:
    """Make the compensator `name` for a machine, at the sampling time `dt_s`.

    ``NAME+ripple`` and ``none+ripple`` compensate the machine's ripple too (`compensation.ripple`).
    With ``fbf``, dry friction is compensated if the machine has any (`compensation.friction`). For
    a machine with schedules the compensator follows the plants (`compensation.scheduled`).

    Raises
    ------
    DesignError
        If there is no such compensator or it cannot be designed for this machine.
    """
    if name.endswith(_RIPPLE):
        from stillpath.compensation.ripple import PassThrough, RippleCompensator

        within = name.removesuffix(_RIPPLE)
        plain = within == "none"
        inner = PassThrough() if plain else compensator(within, machine, dt_s, **settings)
        return RippleCompensator(inner, machine, dt_s)
    if name == "fbf" and any(machine.friction_mm):
        from stillpath.compensation.friction import FrictionCompensator

        inner = compensator(name, machine.without_friction(), dt_s, **settings)
        return FrictionCompensator(inner, machine, dt_s)
    if machine.schedules:
        from stillpath.compensation.scheduled import ScheduledCompensator

        return ScheduledCompensator(
            machine, lambda then: compensator(name, then, dt_s, **settings), dt_s
        )
    if name == "fbf":
        from stillpath.compensation.cautious import CautiousFbf
        from stillpath.compensation.fbf import PreviewFbf

        caution = settings.pop("caution", None)
        exact = PreviewFbf(machine, dt_s, **settings)
        return exact if caution is None else CautiousFbf(exact, machine, dt_s, caution)
    if name in INVERSIONS:
        from stillpath.compensation.inverting import InversionCompensator

        return InversionCompensator(machine, dt_s, kind=name, **settings)
    if name.startswith("shaper:"):
        from stillpath.compensation.shapers import ShaperCompensator

        shaper = name.removeprefix("shaper:")
        return ShaperCompensator(machine, dt_s, shaper=shaper, **settings)
    raise DesignError(f"no compensator is called {name!r}; there are {', '.join(COMPENSATORS)}")
