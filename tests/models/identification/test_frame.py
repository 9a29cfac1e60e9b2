"""What may be the frame on its feet, taken out of plants."""

from __future__ import annotations

import numpy as np
import pytest

from stillpath.models.identification.frame import (
    LIKELY,
    frame_hz_of,
    likely_of,
    shaken,
    without_frame,
)
from stillpath.models.plants import (
    PairsSpec,
    PolePair,
    RelativeMode,
    RelativeModesSpec,
    ZeroPair,
    frequency_response,
)

F = np.linspace(1.0, 150.0, 300)
ALONE = PairsSpec(poles=(PolePair(f_hz=45.0, zeta=0.06), PolePair(f_hz=90.0, zeta=0.05)))


def on_feet(f_hz: float, mu: float, zeta: float = 0.1) -> PairsSpec:
    """What a sensor feels of `ALONE`: 1 - mu s^2/(s^2 + 2 z w s + w^2) times it."""
    low = 1.0 / np.sqrt(1.0 - mu)
    zero = ZeroPair(f_hz=f_hz * low, zeta=zeta * low)
    return PairsSpec(poles=(PolePair(f_hz=f_hz, zeta=zeta), *ALONE.poles), zeros=(zero,))


@pytest.mark.parametrize(("f_hz", "mu"), [(8.0, 0.1), (18.0, 0.06), (25.0, 0.15)])
def test_a_pair_beside_zeros_is_taken_out(f_hz: float, mu: float) -> None:
    felt = on_feet(f_hz, mu)
    s = 2j * np.pi * F
    w = 2 * np.pi * f_hz
    frame = 1 - mu * s**2 / (s**2 + 2 * 0.1 * w * s + w**2)
    np.testing.assert_allclose(
        frequency_response(felt, F), frame * frequency_response(ALONE, F), rtol=1e-9
    )
    assert without_frame(felt) == ALONE


def test_what_rings_most_stays() -> None:
    assert without_frame(ALONE) == ALONE
    near = on_feet(44.0, 0.1)  # no frame: as high as the axis itself
    assert without_frame(near) == near
    one = PairsSpec(poles=(PolePair(f_hz=12.0, zeta=0.06),))
    assert without_frame(one) == one


def test_a_mode_of_small_share_is_taken_out() -> None:
    low, main = (
        RelativeMode(f_hz=14.0, zeta=0.1, share=0.1),
        RelativeMode(f_hz=45.0, zeta=0.06, share=0.9),
    )
    (left,) = without_frame(RelativeModesSpec(modes=(low, main))).modes
    assert (left.f_hz, left.share) == (45.0, pytest.approx(1.0))
    heavy = low.model_copy(update={"share": 0.5}), main.model_copy(update={"share": 0.5})
    assert len(without_frame(RelativeModesSpec(modes=heavy)).modes) == 2


def test_half_of_a_crowd_is_without() -> None:
    felt = on_feet(18.0, 0.06)
    found = shaken([felt] * 200, np.random.default_rng(0), 0.5)
    assert 70 < found.count(ALONE) < 130
    assert found.count(ALONE) + found.count(felt) == 200


def test_a_frame_is_seen_where_most_plants_have_it() -> None:
    def felt(f_hz: float) -> RelativeModesSpec:
        low = RelativeMode(f_hz=f_hz, zeta=0.1, share=0.1)
        return RelativeModesSpec(modes=(low, RelativeMode(f_hz=45.0, zeta=0.06, share=0.9)))

    alone = RelativeModesSpec(modes=(RelativeMode(f_hz=45.0, zeta=0.06, share=1.0),))
    assert frame_hz_of([felt(13.0), felt(14.0), felt(15.0), alone]) == pytest.approx(14.0)
    assert frame_hz_of([felt(14.0), alone]) is None


@pytest.mark.parametrize(
    ("x_hz", "y_hz", "one_frame"),
    [(14.0, 17.0, True), (None, 17.0, True), (None, None, True), (28.9, 17.9, False)],
)
def test_a_frame_shakes_alike_in_x_and_y(
    x_hz: float | None, y_hz: float | None, one_frame: bool
) -> None:
    """The last pair are those of a Voron V0, whose tables its owner published."""
    assert (likely_of([x_hz, y_hz]) == LIKELY) == one_frame
