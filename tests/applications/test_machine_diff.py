"""What revisions differ in, in words and figures, and whether a machine has drifted."""

from __future__ import annotations

from datetime import UTC, date, datetime, timedelta

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stillpath.applications.machines.diff import diff
from stillpath.applications.machines.drift import drift
from stillpath.applications.machines.revision import Revision
from stillpath.applications.machines.store import MachineStore
from stillpath.models.machine import Machine
from tests.service.machines import make_machine, make_plants, with_accel

MARCH = datetime(2026, 3, 2, 12, 0, tzinfo=UTC)


def test_diff_speaks_of_limits_and_modes():
    old = make_machine(axes={"x": make_plants(52.3, 0.05), "y": make_plants(40.0)})
    new = with_accel(old, 4000.0).model_copy(
        update={"axes": {"x": make_plants(49.8, 0.061), "y": make_plants(40.0)}}
    )
    texts = [change.text for change in diff(old, new)]
    assert texts == [
        "firmware.planner.max_accel_mm_s2: 5000 -> 4000 (-20.0 %)",
        "X mode 52.3 -> 49.8 Hz (-4.8 %), zeta 0.050 -> 0.061",
    ]


def test_diff_finds_new_and_lost_modes_and_zeros():
    one = {"kind": "pairs", "poles": [{"f_hz": 50.0, "zeta": 0.05}]}
    two = {
        "kind": "pairs",
        "poles": [{"f_hz": 51.0, "zeta": 0.05}, {"f_hz": 95.0, "zeta": 0.06}],
        "zeros": [{"f_hz": 70.0, "zeta": 0.03}],
    }
    plants = make_plants().model_dump()
    old = make_machine(axes={"x": plants | {"nominal": one}, "y": plants})
    new = make_machine(axes={"x": plants | {"nominal": two}, "y": plants})
    assert [change.text for change in diff(old, new)] == [
        "X mode 50.0 -> 51.0 Hz (+2.0 %), zeta 0.050 -> 0.050",
        "X mode at 95.0 Hz (zeta 0.060) is new",
        "X zero at 70.0 Hz (zeta 0.030) is new",
    ]
    assert "X mode at 95.0 Hz (zeta 0.060) is gone" in [c.text for c in diff(new, old)]


plants_drawn = st.builds(
    make_plants,
    st.floats(5.0, 200.0),
    st.floats(0.005, 0.9),
    kind=st.sampled_from(["raw log", "spectrum", "typed in"]),
    on=st.none() | st.dates(date(2020, 1, 1), date(2030, 1, 1)),
)
machines_drawn = st.builds(
    lambda x, y, accel, slope: with_accel(
        make_machine(axes={"x": x, "y": y}, mesh_slope=slope), accel
    ),
    plants_drawn,
    plants_drawn,
    st.floats(1.0, 1e5),
    st.floats(0.0, 0.1),
)


@given(machines_drawn, machines_drawn)
@settings(max_examples=60)
def test_diff_is_empty_for_equal_machines_only(one: Machine, other: Machine):
    assert diff(one, one) == ()
    assert (diff(one, other) == ()) == (one == other)
    assert {c.place for c in diff(one, other)} == {c.place for c in diff(other, one)}


@given(st.lists(machines_drawn, min_size=2, max_size=4), st.data())
@settings(max_examples=15)
def test_rollback_then_diff_is_empty(
    tmp_path_factory: pytest.TempPathFactory, machines: list[Machine], data: st.DataObject
):
    store = MachineStore(tmp_path_factory.mktemp("store"))
    for machine in machines:
        store.add_revision("mine", machine, author="anna")
    before = store.history("mine")
    number = data.draw(st.integers(1, len(before)))
    store.roll_back("mine", number, author="bob")
    assert diff(before[number - 1].machine, store.current("mine").machine) == ()
    assert store.history("mine")[: len(before)] == before


@pytest.mark.parametrize(
    "nominal",
    [
        {"kind": "fir", "taps": [0.25, 0.5, 0.25], "dt_s": 1e-3},
        {"kind": "tf", "num": [0.1], "den": [1.0, -0.9], "dt_s": 1e-3},
        {"kind": "zpk", "poles": [[-300.0, 0.0]]},
    ],
)
def test_plants_without_modes_are_compared_and_do_not_drift(nominal: dict):
    plants = make_plants().model_dump() | {"nominal": nominal, "members": ()}
    old = make_machine(axes={"x": make_plants(), "y": make_plants()})
    new = make_machine(axes={"x": plants, "y": make_plants()})
    assert diff(old, new)
    assert diff(new, old)
    assert drift([revision(1, make_plants()), revision(2, plants)]) == ()


def test_documents_are_told_in_words():
    scales = {"frequency_scale": [0.98, 1.0, 1.02], "damping_scale": [0.8, 1.0, 1.2]}
    listed = [{"plant": {"kind": "modes", "modes": [{"f_hz": 52.0, "zeta": 0.05}]}, "weight": 1.0}]
    plants = make_plants().model_dump()
    old, new = (
        make_machine(axes={"x": plants | {"members": members}, "y": make_plants()})
        for members in (scales, listed)
    )
    told = "frequency_scale 0.98, 1, 1.02; damping_scale 0.8, 1, 1.2 -> 1 entries"
    assert f"axes.x.members: {told}" in [change.text for change in diff(old, new)]


def revision(number: int, x: object, *, when: datetime = MARCH, y: object = None) -> Revision:
    axes = {"x": x, "y": y or make_plants(45.0)}
    return Revision.of(make_machine(axes=axes), number=number, when=when, author="anna")


def measured(f_hz: float, day: date) -> object:
    return make_plants(f_hz, on=day)


def test_drift_over_months():
    history = [
        revision(1, measured(52.3, date(2026, 3, 2))),
        revision(2, measured(51.9, date(2026, 4, 2))),
        revision(3, measured(49.8, date(2026, 9, 2))),
    ]
    (found,) = drift(history)
    assert (found.axis, found.since, found.until) == ("x", date(2026, 3, 2), date(2026, 9, 2))
    assert found.percent == pytest.approx(-4.78, abs=0.005)
    assert found.text == (
        "X fell from 52.3 to 49.8 Hz (-4.8 %) since 2026-03-02: belts looser? heavier head?"
    )
    assert drift(history[:2]) == ()
    assert drift(history, since=date(2026, 8, 1)) == ()


def test_the_middle_of_a_grid_is_not_compared():
    nodes = [
        {"z_mm": z, "plant": {"kind": "modes", "modes": [{"f_hz": f, "zeta": 0.05}]}}
        for z, f in ((0.0, 52.0), (240.0, 46.0))
    ]
    axes = {"x": measured(49.0, date(2026, 9, 2)), "y": make_plants(45.0)}
    placed = make_machine(axes=axes, schedules={"x": {"grid": {"nodes": nodes}}})
    later = Revision.of(placed, number=2, when=MARCH, author="anna")
    assert drift([revision(1, measured(52.0, date(2026, 3, 2))), later]) == ()


def test_scatter_is_no_drift():
    """The repeats of one Voron 2.4: 64.8, 65.3 Hz in a session; 66 to 68 Hz over weeks."""
    day = date(2026, 3, 2)
    later = day + timedelta(weeks=3)
    assert not drift([revision(1, measured(64.85, day)), revision(2, measured(65.3, day))])
    assert not drift([revision(1, measured(66.7, day)), revision(2, measured(68.0, later))])
    assert drift([revision(1, measured(64.8, day)), revision(2, measured(65.8, day))])
    # The Annex K3 in a year: 95 to 76 Hz.
    (found,) = drift([revision(1, measured(95.0, day)), revision(2, measured(75.8, later))])
    assert "fell from 95.0 to 75.8" in found.text


def test_drift_follows_the_same_mode_and_ignores_guesses():
    def two(first: float, second: float, zeta: float) -> object:
        plants = make_plants(on=date(2026, 3, 2)).model_dump()
        poles = [{"f_hz": first, "zeta": 0.05}, {"f_hz": second, "zeta": zeta}]
        zeros = [{"f_hz": 52.0, "zeta": 0.05}]
        return plants | {"nominal": {"kind": "pairs", "poles": poles, "zeros": zeros}}

    # The second mode leads later, but the first is where it was.
    assert drift([revision(1, two(44.0, 80.0, 0.3)), revision(2, two(44.1, 80.0, 0.01))]) == ()
    guess = make_plants(80.0, kind="typed in")
    assert drift([revision(1, guess), revision(2, measured(50.0, date(2026, 3, 2)))]) == ()
