"""Files of ours without comments are told from what people and slicers write."""

from __future__ import annotations

import pytest

from stillpath.gcode.firmware.signatures import signed_at

M503 = b"""
M203 X500.00 Y500.00 Z5.00 E25.00
M204 P500.00 R500.00 T500.00
M205 B20000.00 S0.00 T0.00 J0.08
"""
PRUSA_SLICER = b"""
M201 X1000 Y1000 Z200 E5000 ; sets maximum accelerations, mm/sec^2
M203 X200 Y200 Z12 E120
M204 P1250 R1250 T1250
M205 X8.00 Y8.00 Z0.40 E4.50
M205 S0 T0
"""
CONFIG_G = b"""
G1
M201 X1000 Y1000 Z200 E500
M204 P1000 T1000
M566 X600 Y600 Z60 E300
"""
KLIPPER = b"""
SET_VELOCITY_LIMIT VELOCITY=300 ACCEL=3000 MINIMUM_CRUISE_RATIO=0
SET_VELOCITY_LIMIT ACCEL=3000 ACCEL_TO_DECEL=1500 SQUARE_CORNER_VELOCITY=5
"""


@pytest.mark.parametrize("text", [M503, PRUSA_SLICER, CONFIG_G, KLIPPER, b""])
def test_what_others_write_is_not_ours(text: bytes) -> None:
    assert signed_at(text) is None
