"""Search, on excerpts, for the fastest paces within a budget of contour error.

All classes are raised together, each as far as its own error leaves room. If that was too much,
those above the budget come down until all keep it, and from there all are raised again. Classes
disturb each other, so only trials count: of those within the budget, the fastest wins.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

from stillpath.gcode.pacing import TRAVEL
from stillpath.pipeline.pacing.pace_trials import Factors, Tried

__all__ = ["PaceChoice", "allowed_um", "search"]

_TRIALS = 10
_AIM, _WITHIN, _ROOM = 0.95, 0.98, 0.92
"""Ratios of error to bound: the target, the largest accepted, and below which a class is raised."""
_NO_WORSE = 1.1
"""Factor by which a class that hardly keeps the budget at its own pace may become worse because of
others; it is not raised itself."""
_LANDING = 2.0
"""Multiple of the budget allowed right after travel; the feature as a whole keeps the budget."""
_LEAP = 8.0
"""Largest factor by which one step raises a class."""
_STEEPEST, _FLATTEST = 2.5, 0.2
"""Bounds of p in error ~ acceleration^p, as estimated from two trials."""
_SHAKEN = 0.7
"""The p assumed for the error that a class causes in the classes printed after it."""
_SAME = 1.02
_WORTH = 0.002
"""Share of the time that a raise must save for another to be tried."""

Trial = Callable[[Factors], Tried]


def allowed_um(one: int, budget_um: float) -> float:
    """Return the error that a class may have within a budget."""
    return _LANDING * budget_um if one == TRAVEL else budget_um


@dataclass(frozen=True, slots=True)
class PaceChoice:
    """Paces of a file.

    Attributes
    ----------
    factors : dict
        Ratios of accelerations by class; 1: as the file has it.
    bounds_um : dict
        Error allowed to each class: the budget, or its error at its own pace if larger.
    reached : bool
        Whether any trial kept all bounds.
    """

    factors: Factors
    bounds_um: dict[int, float] = field(default_factory=dict)
    reached: bool = True


def search(trial: Trial, least: float, most: Factors, budget_um: float) -> PaceChoice:
    """Find the fastest paces within a budget.

    Parameters
    ----------
    trial : callable
    least : float
        Smallest factor, at most 1.
    most : dict
        Largest factor of every class.
    """
    factors = dict.fromkeys(most, 1.0)
    tried = trial(factors)
    bounds = {one: allowed_um(one, budget_um) for one in most}
    if least == 1.0:
        for one in bounds:
            own_um = _NO_WORSE * tried.errors[one].rms_um if one in tried.errors else 0.0
            if own_um > bounds[one]:
                bounds[one] = own_um
                most = most | {one: 1.0}
    climb = _Climb(least, most)
    best: Factors | None = None
    seconds = math.inf
    for _ in range(_TRIALS):
        over = {
            one: math.inf if one in tried.unfit else tried.errors[one].rms_um / bounds[one]
            for one in bounds
            if one in tried.errors or one in tried.unfit
        }
        climb.learn(factors, over)
        if all(ratio <= _WITHIN for ratio in over.values()):
            gained = seconds - tried.seconds
            if gained > 0.0:
                best, seconds = factors, tried.seconds
            if gained <= _WORTH * tried.seconds:
                break
            wanted = climb.higher(factors, over)
        else:
            wanted = climb.lower(factors, over, best or dict.fromkeys(most, least))
        if all(wanted[one] == factors[one] for one in most):
            break
        factors = wanted
        tried = trial(factors)
    return PaceChoice(best or factors, bounds, reached=best is not None)


class _Climb:
    """Chooses the next paces from how errors followed those tried so far."""

    def __init__(self, least: float, most: Factors) -> None:
        self._least, self._most = least, most
        self._power = dict.fromkeys(most, 1.0)
        self._unfit = dict.fromkeys(most, math.inf)
        self._blamed = dict.fromkeys(most, math.inf)
        self._last: tuple[Factors, dict[int, float]] | None = None

    def learn(self, factors: Factors, over: dict[int, float]) -> None:
        """Learn from a trial; `over` is the ratio of error to bound by class."""
        for one, ratio in over.items():
            if math.isinf(ratio):
                self._unfit[one] = min(self._unfit[one], factors[one])
        if self._last is not None:
            before, was = self._last
            for one, ratio in over.items():
                step = math.log(factors[one] / before[one])
                known = 0.0 < was.get(one, 0.0) < math.inf and 0.0 < ratio < math.inf
                if known and abs(step) > math.log(_SAME):
                    power = math.log(ratio / was[one]) / step
                    self._power[one] = min(max(power, _FLATTEST), _STEEPEST)
        self._last = factors, over

    def higher(self, factors: Factors, over: dict[int, float]) -> Factors:
        """Return higher factors for the classes that have room."""
        wanted = dict(factors)
        for one, factor in factors.items():
            ratio = max(over.get(one, 0.0), 1e-6)
            if ratio >= _ROOM:
                continue
            power = max(self._power[one], _SHAKEN)
            raised = factor * min((_AIM / ratio) ** (1.0 / power), _LEAP)
            too_high = max(min(self._unfit[one], self._blamed[one]), factor)
            if math.isfinite(too_high):
                raised = min(raised, math.sqrt(factor * too_high))
            raised = min(raised, self._most[one])
            wanted[one] = raised if raised > _SAME * factor else factor
        return wanted

    def lower(self, factors: Factors, over: dict[int, float], good: Factors) -> Factors:
        """Return lower factors for classes above their bounds; `good` are factors that keep all."""
        wanted = dict(factors)
        helpless = 0.0
        for one, ratio in over.items():
            if ratio <= _WITHIN:
                continue
            factor = factors[one]
            if factor <= self._least * _SAME:
                helpless = max(helpless, ratio)
            elif math.isinf(ratio):
                wanted[one] = _between(min(good[one], factor), factor)
            else:
                wanted[one] = self._less(factor, ratio, self._power[one])
        if helpless:
            # A class at its lowest is disturbed by what precedes it: travel first, then the others.
            blamed = [TRAVEL] if factors.get(TRAVEL, 0.0) > good.get(TRAVEL, 0.0) else [*factors]
            for one in blamed:
                if factors[one] > good[one]:
                    self._blamed[one] = min(self._blamed[one], factors[one])
                    less = self._less(factors[one], helpless, _SHAKEN)
                    wanted[one] = max(min(wanted[one], less), good[one])
        return wanted

    def _less(self, factor: float, ratio: float, power: float) -> float:
        """Return a lower factor that should bring a ratio to the target."""
        less = float((_AIM / ratio) ** (1.0 / power))
        return max(factor * min(less, 1.0 / _SAME), self._least)


def _between(low: float, high: float) -> float:
    middle = math.sqrt(low * high)
    return middle if middle > _SAME * low else low
