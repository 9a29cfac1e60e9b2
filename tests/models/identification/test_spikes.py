"""Samples that a sensor's cable garbled."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from stillpath.models.arrays import Array
from stillpath.models.errors import ModelError
from stillpath.models.identification.identify import Measured, identify
from stillpath.models.identification.readers import ReadSettings, read_content
from stillpath.models.identification.readers.spikes import sound_samples
from stillpath.models.identification.types import AccelerationLog
from tests.models.identification.recordings import QUICK_SETTINGS, one_mode, quick_log, raw_file

SETTINGS = ReadSettings.model_validate(QUICK_SETTINGS)


def garbled(log: AccelerationLog, share: float, side_by_side: int = 1) -> Array:
    """Readings of which some are anything between -16 and 16 g."""
    rng = np.random.default_rng(5)
    accel = log.accel_mm_s2.copy()
    count = int(share * len(accel) / side_by_side)
    first = rng.choice(len(accel) - side_by_side, count, replace=False)
    for k in range(side_by_side):
        accel[first + k] = rng.uniform(-156_906.0, 156_906.0, (count, 3))
    return accel


def read(log: AccelerationLog, accel_mm_s2: Array) -> AccelerationLog:
    file = raw_file(AccelerationLog(log.time_s, accel_mm_s2, "x"))
    (found,) = read_content(file.content, file.name)
    assert isinstance(found, AccelerationLog)
    return found


@pytest.mark.parametrize(("share", "side_by_side"), [(0.001, 1), (0.01, 1), (0.01, 2)])
def test_a_log_with_garbled_samples_tells_what_it_would_without(
    share: float, side_by_side: int
) -> None:
    log = quick_log("x", one_mode(42.0, 0.06))
    spoilt = read(log, garbled(log, share, side_by_side))
    (note,) = [note for note in spoilt.notes if "spikes" in note]
    # At the top of a sharp peak, a good sample beside a spike may go with it.
    assert 1.0 <= int(note.split()[0]) / int(share * len(log.time_s)) < 1.5
    for one in (read(log, log.accel_mm_s2), spoilt):
        fit = identify([Measured(one)], SETTINGS)["x"].fit
        assert fit is not None
        assert [mode.f_hz for mode in fit.modes] == pytest.approx([42.0], rel=0.005)
        assert [mode.zeta for mode in fit.modes] == pytest.approx([0.06], rel=0.03)
        assert fit.gain == pytest.approx(1.0, abs=0.02)


def test_a_log_of_which_much_is_garbled_is_refused() -> None:
    log = quick_log("x")
    with pytest.raises(ModelError, match=r"at most 2% may be; the sensor's cable.*measure again"):
        read(log, garbled(log, 0.04))


TIME_S = np.arange(0.0, 20.0, 1.0 / 1600.0)


@pytest.mark.parametrize(
    "motion",
    [
        lambda t: np.zeros(len(t)),
        lambda t: 20e3 * np.sin(2 * np.pi * 135.0 * t),
        # Steps of a stiff axis, and knocks that ring near half the rate of the sensor.
        lambda t: 8e3 * np.sign(np.sin(2 * np.pi * 20.0 * t)),
        lambda t: 30e3 * np.exp(-60.0 * (t % 0.05)) * np.sin(2 * np.pi * 600.0 * t),
    ],
)
def test_what_a_machine_does_is_no_spike(motion: Callable[[Array], Array]) -> None:
    noise = np.random.default_rng(2).normal(0.0, 60.0, (len(TIME_S), 3))
    accel = noise + motion(TIME_S)[:, None]
    sound, notes = sound_samples(TIME_S, accel, "log")
    assert (len(sound), notes) == (len(TIME_S), ())
