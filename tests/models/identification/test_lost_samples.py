"""Samples that a sensor lost: Klipper's stamps do not tell, but how they come back does."""

from __future__ import annotations

import numpy as np
import pytest

from stillpath.models.arrays import Array
from stillpath.models.identification.readers import read_content
from stillpath.models.identification.readers.lost_samples import restored
from stillpath.models.identification.types import AccelerationLog
from stillpath.models.notes import WarningNote

RATE_HZ = 3266.0
BATCH_S, DECAY, SMOOTH = 0.1, 1.0 / 20.0, 640.0


def counted(*lost: tuple[float, int], until_s: float = 80.0) -> tuple[Array, Array]:
    """Stamps and true times of samples, of which some are lost (when, how many).

    A regression of the number of samples on time that forgets, read a little ahead, as Klipper's
    (klippy/extras/bulk_sensor.py, 2026-08).
    """
    kept = np.ones(int(until_s * RATE_HZ), bool)
    for at_s, count in lost:
        kept[int(at_s * RATE_HZ) :][:count] = False
    true_s = (np.flatnonzero(kept) + 1) / RATE_HZ
    stamps_s = np.zeros(len(true_s))
    mean_s = mean_n = spread = shared = 0.0
    last_n, last_s, done = 0.0, 0.0, 0
    for now_s in np.arange(BATCH_S, until_s, BATCH_S):
        n = int(np.searchsorted(true_s, now_s, "right"))
        away_s, away_n = now_s - mean_s, n + 1 - mean_n
        mean_s, mean_n = mean_s + DECAY * away_s, mean_n + DECAY * away_n
        spread = (1.0 - DECAY) * (spread + DECAY * away_s**2)
        shared = (1.0 - DECAY) * (shared + DECAY * away_s * away_n)
        each_s, base_s, base_n = spread / shared, mean_s, mean_n
        if last_n:
            ahead_s = mean_s + (last_n + SMOOTH - mean_n) * each_s
            each_s, base_s, base_n = (ahead_s - last_s) / SMOOTH, last_s, last_n
        stamps_s[done:n] = base_s + (np.arange(done, n) - base_n) * each_s
        last_n, last_s = n - 1.0, base_s + (n - 1.0 - base_n) * each_s
        done = n
    settled = slice(int(5.0 * RATE_HZ), done)
    return np.round(stamps_s[settled], 6), true_s[settled]


def wrong_s(time_s: Array, true_s: Array) -> Array:
    away = time_s - true_s
    return np.abs(away - np.median(away))


@pytest.mark.parametrize("count", [8, 16, 32])
def test_times_behind_lost_samples_are_put_right(count: int) -> None:
    stamps_s, true_s = counted((42.03, count))
    before_s = wrong_s(stamps_s, true_s)
    time_s, (note,) = restored(stamps_s)
    assert before_s.max() > 0.8 * count / RATE_HZ
    after_s = wrong_s(time_s, true_s)
    # It is not known exactly where in a batch they were lost.
    assert np.count_nonzero(after_s > 0.4e-3) < 0.12 * RATE_HZ
    assert np.all(np.diff(time_s) > 0.0)
    told = int(note.split("lost some ")[1].split(" samples")[0])
    assert told == pytest.approx(count, abs=2)
    assert not note.startswith("warning")


def test_every_place_is_put_right() -> None:
    stamps_s, true_s = counted((20.0, 16), (35.0, 20), (60.0, 12))
    time_s, notes = restored(stamps_s)
    assert len(notes) == 3
    assert np.count_nonzero(wrong_s(time_s, true_s) > 0.6e-3) < 3 * 0.12 * RATE_HZ


def test_samples_that_are_lost_again_and_again_are_warned_of() -> None:
    stamps_s, _ = counted(*((10.0 + 5.0 * k, 12) for k in range(12)))
    _, notes = restored(stamps_s)
    (warning,) = [note for note in notes if isinstance(note, WarningNote)]
    assert warning.startswith("the sensor lost samples at")


@pytest.mark.parametrize("wander_s", [0.0, 50e-6, 300e-6])
def test_times_that_are_right_stay_as_they_are(wander_s: float) -> None:
    """Stamps wander, and Klipper leaves out samples that it could not read."""
    rng = np.random.default_rng(0)
    true_s = np.delete(np.arange(int(80.0 * RATE_HZ)) / RATE_HZ, [50_000, 90_000, 90_002, 130_000])
    batch = np.repeat(rng.normal(0.0, wander_s, 1 + len(true_s) // 300), 300)[: len(true_s)]
    stamps_s = np.sort(true_s + batch + 0.5e-3 * np.sin(2.0 * np.pi * true_s / 20.0))
    time_s, notes = restored(stamps_s)
    np.testing.assert_array_equal(time_s, stamps_s)
    assert notes == ()


def test_a_log_is_read_with_its_times_put_right() -> None:
    stamps_s, true_s = counted((42.03, 32))
    accel = np.random.default_rng(1).normal(0.0, 3000.0, (len(stamps_s), 3))
    rows = "".join(
        f"{t:.6f},{x:.0f},{y:.0f},{z:.0f}\n" for t, (x, y, z) in zip(stamps_s, accel, strict=True)
    )
    content = ("#time,accel_x,accel_y,accel_z\n" + rows).encode()
    (log,) = read_content(content, "raw_data_x_20260101_101010.csv")
    assert isinstance(log, AccelerationLog)
    assert np.count_nonzero(wrong_s(log.time_s, true_s) > 0.4e-3) < 0.12 * RATE_HZ
    assert any("the sensor lost some" in note for note in log.notes)
