from __future__ import annotations

from pathlib import Path

import pytest

from stillpath.models.machine import Machine
from stillpath.models.store import load_machine

GOLDEN = Path(__file__).parents[2] / "examples" / "machines" / "klipper-golden.json"


@pytest.fixture(scope="session")
def golden_machine() -> Machine:
    """Klipper with the limits of the golden plans; X Y Z travel -1000 to 1000 mm."""
    return load_machine(GOLDEN)


@pytest.fixture(scope="session")
def wary_machine(golden_machine: Machine) -> Machine:
    """The same, but unknown commands may be macros and homing leaves the place unknown."""
    firmware = golden_machine.firmware.model_copy(
        update={"unknown_commands": "unknown", "home_mm": None}
    )
    return golden_machine.model_copy(update={"firmware": firmware})
