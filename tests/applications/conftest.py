"""Compensated coupons, each made once: they take long."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache as once
from pathlib import Path

import pytest

from stillpath.applications.proof.coupon import write_coupon
from stillpath.applications.proof.halves import ProofPrint
from stillpath.models.store import load_machine


@pytest.fixture(scope="session")
def coupon_of(
    tmp_path_factory: pytest.TempPathFactory, cache: Path
) -> Callable[[str], tuple[Path, ProofPrint]]:
    """Give a built-in machine's coupon: its file, and what is said of it."""
    folder = tmp_path_factory.mktemp("coupons")

    @once
    def made(name: str) -> tuple[Path, ProofPrint]:
        file = folder / f"{name}.gcode"
        return file, write_coupon(load_machine(name), file, cache_dir=cache)

    return made
