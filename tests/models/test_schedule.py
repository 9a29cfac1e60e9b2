"""Plants that follow mass and position: the law of masses, grids, and what documents must say."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.signal import cont2discrete

from stillpath.models.errors import ModelError
from stillpath.models.machine import Machine
from stillpath.models.plants import (
    FirSpec,
    Mode,
    ModesSpec,
    PairsSpec,
    PlantSpec,
    PolePair,
    TfSpec,
    ZeroPair,
    ZpkSpec,
    frequency_response,
)
from stillpath.models.schedule import (
    AxisSchedule,
    GridNode,
    GridSchedule,
    MassSchedule,
    OperatingPoint,
    moving_mass_from_two_runs,
    resonances_hz,
)
from stillpath.models.store import load_machine, read_machine

F_HZ = np.linspace(1.0, 120.0, 240)
M0, K, C = 0.8, 0.8 * (2 * np.pi * 35.0) ** 2, 2 * 0.08 * 0.8 * 2 * np.pi * 35.0
MASS = MassSchedule(moving_mass_kg=M0)


def oscillator(mass_kg: float, *, damped_by_belt: bool) -> NDArray[np.complex128]:
    """M x'' + c x' + k x = k u, or c (x' - u') where the damper is in the belt."""
    s = 2j * np.pi * F_HZ
    drive = K + C * s if damped_by_belt else K
    return np.asarray(drive / (mass_kg * s**2 + C * s + K))


def pole(mass_kg: float) -> complex:
    return complex(np.roots([mass_kg, C, K])[0])


def as_kind(kind: str) -> PlantSpec:
    s = pole(M0)
    both = ((s.real, s.imag), (s.real, -s.imag))
    if kind == "modes":
        return ModesSpec(modes=(Mode(f_hz=35.0, zeta=0.08),))
    if kind == "pairs":
        return PairsSpec(poles=(PolePair(f_hz=35.0, zeta=0.08),))
    if kind == "zpk":
        return ZpkSpec(poles=both)
    return TfSpec(num=(K,), den=(M0, C, K))


@pytest.mark.parametrize("kind", ["modes", "pairs", "zpk", "tf"])
@pytest.mark.parametrize("mass_kg", [0.0, 0.05, 0.5, 3.0])
def test_mass_as_in_first_principles(kind: str, mass_kg: float) -> None:
    loaded = MASS.loaded(as_kind(kind), mass_kg)
    expected = oscillator(M0 + mass_kg, damped_by_belt=False)
    np.testing.assert_allclose(frequency_response(loaded, F_HZ), expected, rtol=1e-9)


def test_damper_in_the_belt_keeps_its_zero() -> None:
    plant = PairsSpec(poles=(PolePair(f_hz=35.0, zeta=0.08),), real_zero_tau_s=C / K)
    expected = oscillator(M0 + 0.5, damped_by_belt=True)
    np.testing.assert_allclose(
        frequency_response(MASS.loaded(plant, 0.5), F_HZ), expected, rtol=1e-9
    )


def test_discrete_plant_moves_as_the_continuous_one() -> None:
    dt_s = 1e-3
    made = [cont2discrete(([K], [m, C, K]), dt_s, "zoh") for m in (M0, M0 + 0.5)]
    before, after = (
        TfSpec(num=tuple(np.ravel(num)), den=tuple(den), dt_s=dt_s) for num, den, _ in made
    )
    loaded = MASS.loaded(before, 0.5).roots().poles
    np.testing.assert_allclose(np.sort_complex(loaded), np.sort_complex(after.roots().poles), 1e-9)


def test_bed_on_a_heavy_frame() -> None:
    """Bed and frame on springs: the bed's mode falls as the law says, the frame's hardly moves."""
    frame_kg, frame_k, frame_c = 12.0, 12.0 * (2 * np.pi * 90.0) ** 2, 400.0

    def exact(bed_kg: float) -> PlantSpec:
        # y = bed - frame; both masses feel the belt's force, the frame its own spring too.
        belt, ground = np.array([C, K]), np.array([frame_kg, frame_c, frame_k])
        both = np.polyadd(ground, [bed_kg, 0.0, 0.0])
        den = np.polyadd(np.polymul([bed_kg, 0, 0], ground), np.polymul(belt, both))
        return TfSpec(num=tuple(np.polymul(belt, both)), den=tuple(den))

    empty = exact(M0)
    loaded = MASS.loaded(empty, 0.5)
    np.testing.assert_allclose(resonances_hz(loaded), resonances_hz(exact(M0 + 0.5)), rtol=0.02)
    assert resonances_hz(loaded)[1] == pytest.approx(resonances_hz(empty)[1], rel=1e-12)
    response = frequency_response(loaded, F_HZ)
    fixed, law = (
        np.abs(g - frequency_response(exact(M0 + 0.5), F_HZ)).max()
        for g in (frequency_response(empty, F_HZ), response)
    )
    assert law < 0.1 * fixed


def test_zeros_go_with_the_nearest_resonance() -> None:
    plant = PairsSpec(
        poles=(PolePair(f_hz=90.0, zeta=0.05), PolePair(f_hz=35.0, zeta=0.08)),
        zeros=(ZeroPair(f_hz=86.0, zeta=0.04), ZeroPair(f_hz=40.0, zeta=-0.1)),
    )
    by = MASS.factor(0.5)
    loaded = MASS.loaded(plant, 0.5)
    assert isinstance(loaded, PairsSpec)
    assert [p.f_hz for p in loaded.poles] == pytest.approx([90.0, 35.0 * by])
    assert [(z.f_hz, z.zeta) for z in loaded.zeros] == [
        pytest.approx((86.0, 0.04)), pytest.approx((40.0 * by, -0.1 * by)),
    ]  # fmt: skip
    assert frequency_response(loaded, [0.0])[0] == pytest.approx(1.0, abs=1e-12)


def test_half_a_kilogram_on_eight_hundred_grams() -> None:
    """The example of the reference: f falls by 21.6 %."""
    assert MASS.factor(0.5) == pytest.approx(1 - 0.216, abs=5e-4)


@given(m0=st.floats(0.05, 5.0), dm=st.floats(0.05, 5.0), f0=st.floats(10.0, 120.0))
def test_two_runs_find_the_mass(m0: float, dm: float, f0: float) -> None:
    found = moving_mass_from_two_runs(f0, f0 / np.sqrt(1 + dm / m0), dm)
    assert found.mass_kg == pytest.approx(m0, rel=1e-6)
    assert found.sd_kg == 0.0


def test_two_runs_propagate_their_scatter() -> None:
    f1 = 35.0 * MASS.factor(0.5)
    found = moving_mass_from_two_runs(35.0, f1, 0.5, f0_sd_hz=0.1, f1_sd_hz=0.15)
    rng = np.random.default_rng(5)
    n = 200_000
    a, b = rng.normal(35.0, 0.1, n), rng.normal(f1, 0.15, n)
    drawn = 0.5 / ((a / b) ** 2 - 1)
    assert found.mass_kg == pytest.approx(0.8, rel=1e-9)
    assert found.sd_kg == pytest.approx(np.std(drawn), rel=0.03)


@pytest.mark.parametrize(
    ("runs", "message"),
    [
        ((35.0, 35.2, 0.5), "not below the 35 Hz"),
        ((35.0, 30.0, 0.0), "added_kg is 0"),
        ((-1.0, 30.0, 0.5), "f0_hz is -1"),
        ((35.0, float("nan"), 0.5), "f1_hz is nan"),
    ],
)
def test_two_runs_that_cannot_be(runs: tuple[float, float, float], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        moving_mass_from_two_runs(*runs)


def test_two_runs_too_alike() -> None:
    with pytest.raises(ModelError, match="take a heavier weight"):
        moving_mass_from_two_runs(35.0, 34.9, 0.01, f0_sd_hz=0.1, f1_sd_hz=0.1)


def pairs(f_hz: float, zero_hz: float = 60.0, zeta: float = 0.05) -> PairsSpec:
    return PairsSpec(
        poles=(PolePair(f_hz=f_hz, zeta=zeta), PolePair(f_hz=90.0, zeta=0.08)),
        zeros=(ZeroPair(f_hz=zero_hz, zeta=-0.1),),
    )


def test_grid_between_its_nodes() -> None:
    grid = GridSchedule(
        nodes=(
            GridNode(z_mm=0.0, plant=pairs(50.0, 60.0, 0.04)),
            GridNode(z_mm=100.0, plant=pairs(40.0, 50.0, 0.06)),
        )
    )
    assert grid.plant(OperatingPoint(z_mm=0.0)) == pairs(50.0, 60.0, 0.04)
    assert grid.plant(OperatingPoint(z_mm=250.0)) == pairs(40.0, 50.0, 0.06)
    middle = grid.plant(OperatingPoint(z_mm=50.0))
    assert isinstance(middle, PairsSpec)
    assert middle.poles[0].f_hz == pytest.approx(np.sqrt(50.0 * 40.0))
    assert middle.poles[0].zeta == pytest.approx(np.sqrt(0.04 * 0.06))
    assert middle.zeros[0].zeta == pytest.approx(-0.1)
    assert frequency_response(middle, [0.0])[0] == pytest.approx(1.0, abs=1e-12)


def test_grid_of_two_coordinates_and_modes() -> None:
    def node(x_mm: float, y_mm: float, f_hz: float) -> GridNode:
        modes = (Mode(f_hz=f_hz, zeta=0.05, gain=0.7), Mode(f_hz=80.0, zeta=0.05, gain=0.3))
        return GridNode(x_mm=x_mm, y_mm=y_mm, plant=ModesSpec(modes=modes))

    grid = GridSchedule(
        nodes=(node(0, 0, 40.0), node(0, 9, 44.0), node(9, 0, 44.0), node(9, 9, 48.4))
    )
    assert grid.coordinates_mm("x") == (0.0, 9.0)
    assert grid.coordinates_mm("z") == ()
    point = OperatingPoint(x_mm=4.5, y_mm=4.5, z_mm=7.0)
    assert resonances_hz(grid.plant(point))[0] == pytest.approx(44.0)
    on_edge = OperatingPoint(x_mm=9.0, y_mm=4.5)
    assert resonances_hz(grid.plant(on_edge))[0] == pytest.approx(np.sqrt(44.0 * 48.4))


def bedslinger(schedules: dict[str, Any], **changes: Any) -> Machine:
    document = load_machine("generic-bedslinger").model_dump(mode="json")
    document |= {"schedules": schedules, **changes}
    return read_machine(json.dumps(document))


def test_document_travels() -> None:
    node = pairs(40.0).model_dump()
    machine = bedslinger(
        {
            "y": {"mass": {"moving_mass_kg": 0.8}},
            "x": {"grid": {"nodes": [{"z_mm": z, "plant": node} for z in (0, 200)]}},
        }
    )
    assert read_machine(machine.model_dump_json()) == machine
    assert machine.revision != load_machine("generic-bedslinger").revision
    assert machine.schedules["y"].mass == MASS


def test_no_schedule_leaves_the_revision() -> None:
    assert bedslinger({}).revision == load_machine("generic-bedslinger").revision


NODE = {"z_mm": 0.0, "plant": pairs(40.0).model_dump()}
OTHER = ModesSpec(modes=(Mode(f_hz=40.0, zeta=0.1),)).model_dump()


@pytest.mark.parametrize(
    ("schedule", "message"),
    [
        ({}, "needs `mass`, `grid` or both"),
        ({"mass": {"moving_mass_kg": 1, "filament_density_g_cm3": 1240}}, "filament_density"),
        ({"mass": {"moving_mass_kg": 1, "modes": [1]}}, "names resonance 1, but the plant"),
        ({"mass": {"moving_mass_kg": 1, "modes": []}}, "modes"),
        ({"grid": {"nodes": [NODE]}}, "nodes"),
        ({"grid": {"nodes": [NODE, NODE]}}, "1 nodes lie where another one does"),
        ({"grid": {"nodes": [NODE, {"plant": NODE["plant"]}]}}, "node 1 lacks z_mm"),
        ({"grid": {"nodes": [{"plant": NODE["plant"]}] * 2}}, "a grid needs positions"),
        ({"grid": {"nodes": [NODE, {"z_mm": 9, "plant": OTHER}]}}, "another structure"),
        ({"grid": {"nodes": [NODE, {**NODE, "z_mm": 1e308}]}}, "z_mm"),
        (
            {"grid": {"nodes": [{"x_mm": x, "y_mm": x, "plant": OTHER} for x in (0, 9)]}},
            "no node at x 0, y 9 mm",
        ),
    ],
)
def test_documents_that_cannot_be(schedule: dict[str, Any], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        bedslinger({"y": schedule})


def test_mass_needs_a_bed_that_moves() -> None:
    mass = {"y": {"mass": {"moving_mass_kg": 0.8}}}
    with pytest.raises(ModelError, match="bed of a corexy machine does not move"):
        bedslinger(mass, kinematics="corexy")


def test_one_filament() -> None:
    masses = [{"moving_mass_kg": 0.8, "filament_density_g_cm3": d} for d in (1.24, 1.04)]
    with pytest.raises(ModelError, match="there is one filament"):
        bedslinger({"x": {"mass": masses[0]}, "y": {"mass": masses[1]}})


def test_listed_members_carry_the_mass_but_no_grid() -> None:
    spec = load_machine("generic-bedslinger").axes["y"]
    listed = spec.model_copy(update={"members": spec.weighted_members()})
    carried = AxisSchedule(mass=MASS).plants(listed, OperatingPoint(mass_kg=0.5))
    for before, after in zip(listed.weighted_members(), carried.weighted_members(), strict=True):
        ratio = resonances_hz(after.plant) / resonances_hz(before.plant)
        assert ratio == pytest.approx(MASS.factor(0.5))
    grid = GridSchedule(nodes=tuple(GridNode(z_mm=z, plant=pairs(40.0)) for z in (0.0, 100.0)))
    with pytest.raises(ModelError, match="do not follow a grid"):
        AxisSchedule(grid=grid).check(listed)


def test_taps_have_no_resonance() -> None:
    with pytest.raises(ModelError, match="kind fir"):
        MASS.check(FirSpec(taps=(0.5, 0.5), dt_s=1e-3))
