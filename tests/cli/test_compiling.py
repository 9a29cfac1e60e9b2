"""While kernels are compiled, progress says so, and tells no time left that nobody knows."""

from __future__ import annotations

import numba
import pytest

from stillpath.pipeline.progress import Progress, StopWork
from stillpath.service import compiling
from stillpath.service.compiling import STAGE, compiling_reported

HALF = Progress("compensating", 0.5, 30.0, 60.0, 60.0)


def compile_something() -> None:
    inner = numba.njit(lambda x: x + 1)
    outer = numba.njit(lambda x: inner(x) + 1)
    assert outer(1) == 3


def test_nothing_changes_where_nothing_is_compiled():
    told: list[Progress] = []
    with compiling_reported(told.append) as tell:
        tell(HALF)
    assert told == [HALF]


def test_compiling_is_a_stage_and_its_time_says_nothing_of_the_time_left(monkeypatch):
    told: list[Progress] = []
    with compiling_reported(told.append) as tell:
        tell(HALF)
        compile_something()
        tell(HALF)
        monkeypatch.setattr(compiling, "_QUIET_S", 0.0)
        tell(HALF)
    first, *compiled, soon, later = told
    assert first == HALF
    assert {(one.stage, one.fraction, one.eta_s) for one in compiled} == {(STAGE, 0.5, None)}
    assert (soon.stage, soon.eta_s) == ("compensating", None)
    assert later.eta_s is not None
    assert later.eta_s < 60.0  # without what compiling took
    compile_something()  # afterwards nobody listens
    assert told[-1] == later


def test_who_stops_in_the_middle_of_a_compiler_is_heard_after_it():
    def stop(progress: Progress) -> None:
        if progress.stage == STAGE:
            raise StopWork

    with compiling_reported(stop) as tell:
        compile_something()
        with pytest.raises(StopWork):
            tell(HALF)
