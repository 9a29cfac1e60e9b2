"""Identification of jumping tones, and the observer that follows them in a running loop."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stillpath.compensation.base import DesignError
from stillpath.compensation.feedback._adaptive_kernels import track
from stillpath.compensation.feedback.adaptive import AdaptiveFmsdob, FrequencyTracker
from stillpath.models.disturbances import Switched, Tone, sample
from stillpath.models.loops import load_loop
from stillpath.simulation.closed_loop import ClosedLoop, Imperfections

SPEC = load_loop("galvo-10khz")
TS = 1e-4
STEP = 10
Tones = tuple[float, ...]


def follow(
    parts: list[Tones], tones: int, noise: float = 0.0
) -> tuple[np.ndarray, list[Tones], np.ndarray]:
    """Silence, then each part for 0.3 s from 0.5 s on: y, targets per ms, ym."""
    spec = Switched(
        start_s=tuple(0.5 + 0.3 * i for i in range(len(parts))),
        parts=tuple(tuple(Tone(f_hz=f, amplitude=0.1) for f in part) for part in parts),
    )
    d = sample(spec, round((0.5 + 0.3 * len(parts)) / TS), TS)
    observer = AdaptiveFmsdob(SPEC.loops(), tones, floor_rms=max(1e-6, 2 * noise))
    loop = ClosedLoop(
        SPEC.nominal(), observer.blocks, imperfections=Imperfections(noise_rms=noise),
        generator=np.random.default_rng(0),
    )  # fmt: skip
    y, seen, targets = np.empty(len(d)), np.empty(len(d)), []
    for i in range(0, len(d), STEP):
        out = loop.push({"d_out": d[i : i + STEP]}, ("y", "ym", "dhat"))
        y[i : i + STEP], seen[i : i + STEP] = out["y"], out["ym"]
        change = observer.hear(out["dhat"])
        if change is not None:
            loop.retune(change.blocks, reset=change.reset)
        targets.append(observer.targets_hz)
    return y, targets, seen


@pytest.mark.parametrize("lost", [[], [np.nan], [np.inf, 1.0]])
def test_a_sample_that_is_missing_is_got_over(lost: list[float]) -> None:
    tone = np.sin(2 * np.pi * 700 * TS * np.arange(600))
    tracker = FrequencyTracker(1, TS)
    for part in (tone, np.array(lost), tone):
        tracker.push(part)
    assert tracker.push(tone) == pytest.approx((700.0,), abs=0.1)
    observer = AdaptiveFmsdob(SPEC.loops(), 1)
    for part in (tone, np.array(lost), tone, tone):
        observer.hear(part)
    assert observer.targets_hz == pytest.approx((700.0,), abs=0.1)


def test_an_empty_block_changes_nothing() -> None:
    tracker = FrequencyTracker(1, TS)
    assert tracker.push(np.empty(0)) == ()
    found = tracker.push(np.sin(2 * np.pi * 700 * TS * np.arange(600)))
    assert tracker.push(np.empty(0)) == found
    assert not tracker.jumped


@pytest.mark.slow
def test_published_steps() -> None:
    """Paper 000, figures 11 and 12: 500, 1500, 500, 3000, 500 Hz, then silence."""
    parts: list[Tones] = [(500,), (1500,), (500,), (3000,), (500,), ()]
    y, targets, _ = follow(parts, 1)
    for i, part in enumerate(parts[:-1]):
        end = 8000 + 3000 * i
        assert targets[end // STEP - 1] == pytest.approx(part, abs=1e-6)
        assert np.abs(y[end - 100 : end]).max() < 1e-10
        late = np.abs(y[end - 3000 + 400 : end])
        assert late.max() < 0.02 * 0.1
    assert targets[-1] == ()
    assert not any(targets[:49])


@pytest.mark.parametrize(
    "parts",
    [
        [(900, 2000), (1500, 2600), (2100, 3200)],
        [(500, 900, 2000), (1000, 1500, 2600), (500, 900, 2000), (1200, 2100, 3200)],
        [(300,), (330,), (4000,), (1000,), (1050,)],
    ],
)
def test_several_tones_and_small_jumps(parts: list[Tones]) -> None:
    """Paper 000, figure 15; and tones that a loop suppresses or that hardly move."""
    y, targets, _ = follow(parts, len(parts[0]))
    for i, part in enumerate(parts):
        end = 8000 + 3000 * i
        assert targets[end // STEP - 1] == pytest.approx(part, abs=1e-5)
        assert np.abs(y[end - 100 : end]).max() < 1e-9


def test_in_noise_the_residual_is_the_noise() -> None:
    """Table I: residual energy near that of the loop without disturbance."""
    _, targets, seen = follow([(500,), (1500,), (3000,)], 1, noise=0.0108)
    for i, f in ((800, 500), (1100, 1500), (1399, 3000)):
        assert targets[i - 5] == pytest.approx((f,), abs=2.0)
    energy = [np.sum(seen[i : i + 1000] ** 2) for i in (3900, 6900, 9900, 12900)]
    assert np.array(energy[1:]) / energy[0] == pytest.approx(1.0, abs=0.3)


@given(st.floats(0.01, 0.48), st.floats(0.01, 0.48), st.floats(0.001, 100.0), st.floats(0, 6.28))
@settings(max_examples=40)
def test_locks_and_follows_one_jump(first: float, second: float, size: float, phase: float) -> None:
    tracker = FrequencyTracker(1, TS)
    k = np.arange(3000)
    x = size * np.sin(2 * np.pi * np.where(k < 1500, first, second) * k + phase)
    found = [tracker.push(x[i : i + STEP]) for i in range(0, 3000, STEP)]
    assert found[149] == pytest.approx((first / TS,), abs=0.5)
    assert found[-1] == pytest.approx((second / TS,), abs=0.5)


def test_kernel_is_the_textbook_recursion() -> None:
    """Two tones, fixed notch: plain numpy recursive least squares."""
    generator = np.random.default_rng(0)
    x = generator.normal(size=60)
    poles, rho, lam = np.array([-0.5, 0.9]), 0.6, 0.97
    theta, covariance, history = np.zeros(2), 10 * np.eye(2), np.zeros(4)
    track(x, theta, covariance, history, poles, np.array([rho, rho, 1.0]),
          np.array([lam, lam, 1.0]), np.zeros(3))  # fmt: skip
    a = np.array([poles[0] * rho, poles[1] * rho**2, poles[0] * rho**3, rho**4])
    filtered = np.zeros(64)
    estimate, p = np.zeros(2), 10 * np.eye(2)
    for k in range(60):
        now = k + 4
        filtered[now] = x[k] - a @ filtered[now - 4 : now][::-1]
        psi = np.array([filtered[now - 1] + filtered[now - 3], filtered[now - 2]])
        error = filtered[now] + filtered[now - 4] + estimate @ psi
        gain = p @ psi / (lam + psi @ p @ psi)
        estimate = estimate - gain * error
        p = (p - np.outer(gain, psi @ p)) / lam
    assert theta == pytest.approx(estimate, abs=1e-9)
    assert covariance == pytest.approx(p, abs=1e-9)
    assert history == pytest.approx(filtered[-4:][::-1], abs=1e-9)


def test_controller_of_the_present() -> None:
    observer = AdaptiveFmsdob(SPEC.loops(), 1)
    with pytest.raises(DesignError, match="more than floor_rms 1e-06 rms is heard"):
        observer.controller()
    x = np.sin(2 * np.pi * 0.07 * np.arange(2000))
    for i in range(0, 2000, STEP):
        observer.hear(x[i : i + STEP])
    made = observer.controller()
    assert made.settings["targets_hz"] == pytest.approx([700.0], abs=1e-6)
    assert max(made.spectral_radii) < 1


def test_a_target_that_a_member_forbids_is_left_alone() -> None:
    loop = SPEC.nominal()
    observer = AdaptiveFmsdob((loop, loop.varied(delay_samples=1)), 1)
    x = np.sin(2 * np.pi * 0.26 * np.arange(2000))
    changes = [observer.hear(x[i : i + STEP]) for i in range(0, 2000, STEP)]
    assert not any(changes)
    assert observer.targets_hz == ()


def test_tones_are_limited() -> None:
    with pytest.raises(DesignError, match="between 1 and 8"):
        FrequencyTracker(9, TS)
