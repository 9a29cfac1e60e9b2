"""The library and what users give instead of it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stillpath.models.errors import ModelError
from stillpath.models.plants import RelativeModesSpec, TfSpec, plant_set
from stillpath.models.repair import repair_rounded
from stillpath.models.store import builtin_machines, load_machine, read_machine

GOLDEN = Path(__file__).parents[2] / "examples" / "machines" / "klipper-golden.json"
FITTED = ("annex-k3", "ender3", "voron-v0", "voron-v24-250")


@pytest.fixture
def document() -> dict[str, Any]:
    return load_machine("ender3").model_dump(mode="json")


def test_the_library_loads() -> None:
    assert {*FITTED, "generic-bedslinger", "generic-corexy", "taz6-x"} == set(builtin_machines())
    for name in builtin_machines():
        machine = load_machine(name)
        assert machine.name == name
        for axis in ("x", "y"):
            plants = plant_set(machine.axes[axis], 1e-3)
            assert all(np.abs(p.poles()).max() < 1 for p in plants.members)
            assert all(abs(p.frequency_response(0.0)[0] - 1) < 1e-9 for p in plants.members)


@pytest.mark.parametrize("name", FITTED)
def test_fitted_printers_hold_what_was_measured(name: str) -> None:
    machine = load_machine(name)
    for axis in ("x", "y"):
        plants = machine.axes[axis]
        members = [m.plant for m in plants.weighted_members()]
        assert all(isinstance(plant, RelativeModesSpec) for plant in (plants.nominal, *members))
        assert 8 <= len(members) <= 16
        assert plants.nominal.delay_s == 0.0  # type: ignore[union-attr]
        assert plants.provenance is not None
        assert plants.provenance.magnitude_only
        assert plants.provenance.sources
    assert machine.travel["x"].min_mm == -10
    assert machine.command.accel_mm_s2 == 20_000
    assert machine.firmware.planner.max_velocity_mm_s == 500


def test_taz_is_the_repaired_print() -> None:
    num, den, _ = repair_rounded(
        (0.0874, -0.3415, 0.5118, -0.3481, 0.09063),
        (1.0, -4.54, 8.283, -7.583, 3.479, -0.639),
        (4, 4, 4, 4, 5),
        (3,) * 6,
    )
    nominal = load_machine("taz6-x").axes["x"].nominal
    assert isinstance(nominal, TfSpec)
    np.testing.assert_allclose(nominal.num, num, rtol=1e-14)
    np.testing.assert_allclose(nominal.den, den, rtol=1e-14)


def test_golden_klipper_facts() -> None:
    firmware = load_machine(GOLDEN).firmware
    assert firmware.unknown_commands == "skip"
    assert firmware.arc_resolution_mm == 0.1
    assert firmware.home_mm == (0, 0, 0)
    assert not firmware.homed_at_start


def test_a_file_of_ones_own(tmp_path: Path, document: dict[str, Any]) -> None:
    path = tmp_path / "mine.json"
    path.write_text(json.dumps(document))
    assert load_machine(path) == load_machine("ender3")
    assert load_machine(str(path)).revision == load_machine("ender3").revision


def test_unknown_names_and_files(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="did you mean voron-v0"):
        load_machine("voron_v0")
    with pytest.raises(ModelError, match="built in are annex-k3"):
        load_machine("zzz")
    with pytest.raises(ModelError, match="cannot read the machine file"):
        load_machine(tmp_path / "none.json")
    with pytest.raises(ModelError, match="cannot read the machine file"):
        load_machine("none.JSON")
    (tmp_path / "bad.json").write_bytes(b"\xff{")
    with pytest.raises(ModelError, match="not JSON"):
        load_machine(tmp_path / "bad.json")


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("travel", "x", "min_mm"), 900.0, "travel.x: min_mm 900.0 must be below"),
        (("axes", "x", "nominal", "kind"), "foo", "axes.x.nominal: .*'foo'"),
        (("axes", "y", "nominal", "modes", 0, "zeta"), -1, r"modes\.0\.zeta: .*given: -1"),
        (("axes", "x", "members", 1, "weight"), -2, r"members\..*\.1\.weight"),
        (("firmware", "planner", "max_accel_mm_s2"), float("nan"), "max_accel_mm_s2: .*finite"),
        (("command", "accel_mm_s2"), 0, "accel_mm_s2: must be more than 0 mm"),
        (("command", "accel_mm_s2"), 1e12, r"accel_mm_s2: 1e\+12 mm/s2 is more .* at most 1e\+07"),
        (("command", "velocity_mm_s"), 1e9, r"command.velocity_mm_s: .*at most 100000 mm/s"),
        (("surprise",), 1, "surprise: is not known here"),
    ],
)
def test_a_wrong_field_is_named(
    document: dict[str, Any], path: tuple[str | int, ...], value: object, message: str
) -> None:
    part: Any = document
    for key in path[:-1]:
        part = part[key]
    part[path[-1]] = value
    with pytest.raises(ModelError, match=message) as raised:
        read_machine(json.dumps(document), "mine.json")
    assert str(raised.value).startswith("mine.json: ")
    assert "\n" not in str(raised.value)


def test_a_name_that_is_there_twice_is_refused(document: dict[str, Any]) -> None:
    """One of the values would be passed over in silence: the limit that was added by hand."""
    document.setdefault("command", {})
    added = json.dumps(document).replace("{", '{"command": {"accel_mm_s2": 3000}, ', 1)
    with pytest.raises(ModelError, match=r"^mine\.json: 'command' is there twice; keep one"):
        read_machine(added, "mine.json")


def test_what_is_no_object_is_told_in_plain_words() -> None:
    with pytest.raises(ModelError, match=r"must be a JSON object$"):
        read_machine(b"[1]")


def test_a_byte_order_mark_of_windows_is_no_fault(document: dict[str, Any]) -> None:
    plain = json.dumps(document)
    assert read_machine(b"\xef\xbb\xbf" + plain.encode()) == read_machine(plain)
    assert read_machine("\ufeff" + plain) == read_machine(plain)


def test_microsteps_that_marlin_cannot_count_are_refused(document: dict[str, Any]) -> None:
    steps = {"x": 80.0, "y": 1e9, "z": 102400.0, "e": 93.0}
    document["firmware"] = {"kind": "marlin", "steps_per_mm": steps}
    words = (
        r"firmware.steps_per_mm.*at most 4000 in X and Y, and is 1e\+09 in Y; state what M92 says"
    )
    with pytest.raises(ModelError, match=words):
        read_machine(json.dumps(document))
    steps["y"] = 3200.0
    read_machine(json.dumps(document))
