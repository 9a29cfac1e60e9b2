"""A result that looks like one, from a made-up print: for reports, pages and the API's tests."""

from __future__ import annotations

import math
import random

from stillpath.gcode.slicers.features import feature_title
from stillpath.pipeline.result import (
    Channel,
    ErrorFigures,
    GroupFigures,
    LayerView,
    PutBack,
    Result,
    StageTime,
    Track,
)

LABELS = {
    "before": "As it came",
    "after": "Compensated",
    "shaper": "Best shaper (ei 38.2 / 31.0 Hz)",
}
LEVEL = {"before": 21.0, "after": 0.9, "shaper": 8.4}


def make_result(
    *, channels: tuple[str, ...] = ("before", "after", "shaper"), layers: int = 40, seed: int = 1
) -> Result:
    rng = random.Random(seed)

    def figures(level: float) -> ErrorFigures:
        return ErrorFigures(
            contour_rms_um=level,
            contour_max_um=level * 7.3,
            tracking_rms_um=level * 2.4,
            tracking_max_um=level * 14,
        )

    track = {
        name: [LEVEL[name] * (1 + 0.5 * math.sin(k / 9) * rng.random()) for k in range(400)]
        for name in channels
    }
    track[channels[0]][50] = float("nan")
    return Result(
        version="0.1.0",
        machine="ender3",
        machine_title="Creality Ender 3",
        machine_revision="e3f4ce4e15d5",
        settings={"method": "fbf", "basis": "ce-opt", "tolerance_um": 2.0},
        source_name="gear <24 teeth> & hub.gcode",
        channels=[
            Channel(
                name=name,
                label=LABELS[name],
                extruding=figures(LEVEL[name]),
                all_motion=figures(LEVEL[name] * 1.4),
                residual_rms_um=LEVEL[name] * 0.3,
            )
            for name in channels
        ],
        best_shaper="ei at 38.2 Hz (X), mzv at 31.0 Hz (Y)",
        original_time_s=2713.2,
        time_s=2714.9,
        original_bytes=645_932,
        written_bytes=6_213_044,
        segments=214_332,
        segments_per_s=79.0,
        peak_segments_per_s=412.0,
        peak_velocity_mm_s=182.0,
        peak_accel_mm_s2=11_800.0,
        emission_rms_um=1.24,
        emission_max_um=6.1,
        filament_error_mm=0.00002,
        compensated_s=2690.0,
        extruding_s=2211.0,
        pieces=48,
        put_back=[
            PutBack(
                line_first=12_011,
                line_last=12_480,
                seconds=21.2,
                extruding_seconds=17.4,
                reason="missed its command by 13.1 µm at line 12 204; 10 µm are allowed",
            )
        ],
        put_back_extruding_share=0.0079,
        warnings=["The firmware's shaper is off after the print: the model does not state it."],
        layers=[
            GroupFigures(
                name=str(k) if k else "before the first layer",
                title=str(k) if k else "before the first layer",
                seconds=60 + 10 * rng.random(),
                contour_rms_um={n: LEVEL[n] * (0.8 + 0.4 * rng.random()) for n in channels},
            )
            for k in range(layers)
        ],
        features=[
            GroupFigures(
                name=name,
                title=feature_title(name),
                seconds=seconds,
                contour_rms_um={n: LEVEL[n] * factor for n in channels},
            )
            for name, seconds, factor in (
                ("External perimeter", 700.0, 0.7),
                ("Internal infill", 900.0, 1.3),
                ("Solid infill", 400.0, 1.1),
                ("Top solid infill", 41.0, 0.9),
            )
        ],
        track=Track(bin_s=6.8, contour_rms_um=track),
        layer_views=[_gear(k, channels, rng) for k in range(0, layers, 2)],
        stages=[
            StageTime(stage="read and plan", cpu_s=0.61),
            StageTime(stage="compensate", cpu_s=0.42),
            StageTime(stage="write", cpu_s=0.97),
            StageTime(stage="read back and measure", cpu_s=0.88),
        ],
    )


def _gear(layer: int, channels: tuple[str, ...], rng: random.Random) -> LayerView:
    """Three gear outlines and a zigzag; the error rings after each corner."""
    points: list[tuple[float, float, bool]] = []
    for inset in (0.0, 0.45, 0.9):
        for k in range(24 * 8 + 1):
            angle = 2 * math.pi * k / (24 * 8)
            radius = (28 if k % 8 < 4 else 24) - inset
            points.append((110 + radius * math.cos(angle), 110 + radius * math.sin(angle), k > 0))
    for row in range(60):
        y = 92 + 0.6 * row
        half = math.sqrt(max(22**2 - (y - 110) ** 2, 0))
        ends = (110 - half, 110 + half) if row % 2 else (110 + half, 110 - half)
        span = ends[1] - ends[0]
        points += [(ends[0] + span * step / 12, y, step > 0) for step in range(13)]
    ring = [math.exp(-(k % 13) / 3) * abs(math.sin(k % 13 + 1)) for k in range(len(points))]
    return LayerView(
        layer=layer,
        z_mm=0.2 * (layer + 1),
        x_mm=[p[0] for p in points],
        y_mm=[p[1] for p in points],
        extruding=[p[2] for p in points],
        line=[1000 * layer + k for k in range(len(points))],
        contour_um={
            name: [LEVEL[name] * 2.6 * r * (0.8 + 0.4 * rng.random()) for r in ring]
            for name in channels
        },
    )
