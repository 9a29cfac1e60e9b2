"""Linear advance: what the firmware's own does in a stream, and what the filament does instead."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stillpath.gcode.firmware.marlin._encoder_kernels import spread_advance
from stillpath.gcode.firmware.marlin.limits import advance_speed_mm_s, initial_limits
from stillpath.gcode.firmware.marlin.planner import Planner
from stillpath.gcode.firmware.marlin.stream_commands import MarlinStreamCommands
from stillpath.gcode.firmware.marlin.stream_limits import stream_limits
from stillpath.gcode.sampler import sample_phases
from stillpath.models.firmware import Marlin
from stillpath.models.firmware.marlin import PerAxis
from stillpath.models.machine import CommandLimits, Machine
from stillpath.models.store import load_machine
from stillpath.pipeline.compensated_piece import Unfit
from tests.gcode.cutting import HEAD, MARLIN_PLANNER, compensated, pieces_of

K_S = 0.05
PER_MM = 80.0
PRINTED = "G1 X90 E2 F6000\nG1 X90 Y60 E1\nG1 X20 E3.5 F3000\nG1 Y20 E2\n"


# The filament


def spread(wanted: Any, end_s: Any, fastest: float, keeps: Any = None, group: Any = None) -> Any:
    n = len(wanted)
    lead = np.zeros(n)
    groups = np.zeros(n, np.int64) if group is None else np.asarray(group)
    starts = np.array([0.0, *np.asarray(end_s)[np.flatnonzero(np.diff(groups))]])
    still = np.zeros(n, np.bool_) if keeps is None else np.asarray(keeps)
    spread_advance(
        np.asarray(wanted), still, np.full(n, fastest), np.asarray(end_s), groups, starts, lead
    )
    return lead


def test_the_lead_is_built_up_kept_and_given_back() -> None:
    end_s = 0.01 * np.arange(1, 9)
    wanted = [0.03, 0.03, 0.03, 0.03, 0.0, 0.0, 0.0, 0.0]
    keeps = [False] * 4 + [True] * 4
    assert spread(wanted, end_s, 1.0, keeps) == pytest.approx(
        [0.01, 0.02, 0.03, 0.03, 0.03, 0.02, 0.01, 0.0]
    )
    group = [0] * 4 + [1] * 4
    assert spread([0.03] * 8, end_s, 2.0, None, group) == pytest.approx(
        [0.02, 0.03, 0.02, 0.0, 0.02, 0.03, 0.02, 0.0]
    )


@given(st.integers(0, 2**32 - 1), st.floats(0.5, 50.0))
@settings(max_examples=50)
def test_the_lead_is_never_faster_than_the_extruder_may(seed: int, fastest: float) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 80))
    lasts = rng.uniform(1e-4, 2e-2, n)
    group = np.sort(rng.integers(0, 3, n))
    group -= group[0]
    _, group = np.unique(group, return_inverse=True)
    wanted, keeps = rng.uniform(0.0, 0.3, n), rng.random(n) < 0.3
    lead = spread(wanted, np.cumsum(lasts), fastest, keeps, group)
    fresh = np.append(True, np.diff(group) != 0)
    change = lead - np.where(fresh, 0.0, np.append(0.0, lead[:-1]))
    assert np.all(np.abs(change) <= fastest * lasts + 1e-12)
    assert np.all((lead >= -1e-12) & (lead <= np.max(wanted) + 1e-12))
    assert np.all(lead[np.append(fresh[1:], True)] == 0.0)


def machine_of(**changes: Any) -> Machine:
    firmware = Marlin(
        min_steps_per_segment=1,
        home_mm=(0.0, 0.0, 0.0),
        steps_per_mm=PerAxis(x=80.0, y=80.0, z=400.0, e=400.0),
        planner=MARLIN_PLANNER,
    )
    own = firmware.model_copy(update={"linear_advance": True, **changes})
    return load_machine("ender3").model_copy(update={"firmware": own})


def test_the_filament_holds_what_the_firmware_has_switched_off() -> None:
    _, made = compensated(HEAD + PRINTED, machine_of(linear_advance_k_s=K_S))
    t = made.timeline.dt_s * np.arange(made.command_mm.shape[1])
    # From rest the first step takes 1/120 s, and everything is later by that.
    delay_s = made.encoded.group_start_s[0] - made.timeline.start_s[0]
    executed, _ = sample_phases(made.encoded.phases, t + delay_s)
    planned = made.command_mm[3]
    wanted = planned + K_S * np.gradient(planned, made.timeline.dt_s)
    # It reaches K v = .05 * 100 * .067 = .33 mm, and is kept to some hundredths of that.
    assert np.max(wanted - planned) > 0.15
    assert np.sqrt(np.mean((executed[3] - wanted) ** 2)) < 1e-2
    # In whole steps, so that it does not matter where the printer counts E from.
    fed = np.diff(made.encoded.position[:, 3], prepend=made.encoded.begin[3])[:-1] * 400e-6
    assert np.max(np.abs(fed - np.round(fed))) < 1e-3
    # It is given back, and places and times are those of a stream without it.
    _, plain = compensated(HEAD + PRINTED, machine_of(linear_advance_k_s=0.0))
    assert made.encoded.position[-1, 3] == plain.encoded.position[-1, 3]
    gap = executed[:2] - made.command_mm[:2]
    assert np.quantile(np.hypot(*gap)[made.extruding], 0.99) <= 5e-3 + 1.0 / PER_MM


def test_where_nobody_says_that_there_is_advance_nothing_is_slower_for_it() -> None:
    # K .2 s, .1 of E per mm, 2000 mm/s2: 40 mm/s of the extruder; its jerk is 15.5 mm/s.
    with pytest.raises(Unfit, match=r"M900 K0\.2.*15\.5 mm/s.*linear_advance true"):
        compensated(HEAD + PRINTED, machine_of(linear_advance=None, linear_advance_k_s=0.2))
    _, made = compensated(HEAD + PRINTED, machine_of(linear_advance=None, linear_advance_k_s=0.07))
    assert made.encoded.limits[-1].advance_in_filament == 1.0  # type: ignore[attr-defined]


# Words and plans


def test_advance_is_off_in_a_stream_and_in_its_rests() -> None:
    firmware = Marlin(linear_advance=True, linear_advance_k_s=K_S)
    own, stream_commands = initial_limits(firmware), MarlinStreamCommands(firmware)
    stream = stream_limits(own, CommandLimits())
    assert stream_commands.limits(own).splitlines()[-1] == b"M900 K0.05"
    assert stream_commands.limits(stream).splitlines()[-1] == b"M900 K0"
    assert stream_commands.limits(stream_commands.in_stream(own)).splitlines()[-1] == b"M900 K0"
    # The extruder must be free for twice the feed and the advance.
    assert stream.feedrate_e_mm_s > 2.0 * own.feedrate_e_mm_s + advance_speed_mm_s(
        own, classic_jerk=False
    )
    for none in (Marlin(linear_advance=True), Marlin(linear_advance=False)):
        limits = initial_limits(none)
        assert b"M900" not in MarlinStreamCommands(none).limits(
            stream_limits(limits, CommandLimits())
        )


def test_a_stream_is_not_slowed_down_by_advance() -> None:
    firmware = Marlin(linear_advance=True, linear_advance_k_s=1.0, junction="classic_jerk")
    own = initial_limits(firmware)
    piece = pieces_of(HEAD + PRINTED, machine_of(linear_advance_k_s=1.0))[1]
    durations = []
    for limits in (own, stream_limits(own, CommandLimits())):
        planner = Planner(firmware)
        tables = [limits] * len(piece.limits)
        planner.push_moves(piece.moves, tables)
        planner.flush()
        durations.append(planner.time_s)
    assert durations[1] < 0.8 * durations[0]
