"""The choice between a written file and live printing, from the form to the report."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from tests.service.test_live_api import SOURCE
from tests.web.test_new_job import choose_machine
from tests.web.visitor import Visitor

pytestmark = pytest.mark.slow


def hand_in(page: Page, tmp_path: Path, button: str, machine: str = "ender3") -> None:
    file = tmp_path / "part.gcode"
    file.write_bytes(SOURCE)
    page.locator("input[type=file]").set_input_files(file)
    choose_machine(page, machine)
    if button == "Predict":
        page.get_by_label("Print it live").check()
    page.get_by_role("button", name=button).click()
    page.wait_for_url("**/#/jobs/*")


def test_a_file_is_printed_live(visitor: Visitor, tmp_path: Path) -> None:
    page = visitor.open()
    page.get_by_label("Print it live").check()
    expect(page.get_by_label("Tolerance, µm")).to_be_hidden()
    visitor.shoot(page, "live-form")
    page.get_by_label("Print it as a file").check()
    page.get_by_label("Tolerance, µm").fill("0.1")  # out of bounds, and soon hidden
    hand_in(page, tmp_path, "Predict")
    expect(page.get_by_role("heading", name="How to print it")).to_be_visible()
    visitor.shoot(page, "live-report")
    expect(page.get_by_role("link", name=re.compile("^G-code"))).to_have_count(0)
    expect(page.get_by_role("heading", name="Reverted to the sliced lines")).to_have_count(0)
    with page.expect_download() as download:
        page.get_by_role("button", name="Filter for Klipper").click()
    assert download.value.suggested_filename == "stillpath.json"
    assert json.loads(download.value.path().read_text())["machine"] == "ender3"


def test_a_compensated_file_is_compared_with_live_printing(
    visitor: Visitor, tmp_path: Path
) -> None:
    page = visitor.open()
    hand_in(page, tmp_path, "Compensate")
    expect(page.get_by_role("heading", name="Two ways to print it")).to_be_visible()
    expect(page.get_by_role("heading", name="Print it as a file")).to_be_visible()
    expect(page.get_by_text("Figures are predicted with the central plants")).to_be_visible()
    expect(page.get_by_role("heading", name="Print it live")).to_be_visible()
    expect(page.get_by_role("link", name=re.compile("^G-code"))).to_be_visible()
    visitor.shoot(page, "two-ways")
    phone = {"viewport": {"width": 390, "height": 900}}
    narrow = visitor.open(f"#{page.url.split('#')[1]}", **phone)
    narrow.get_by_role("heading", name="Two ways to print it").wait_for()
    assert narrow.evaluate("document.documentElement.scrollWidth") <= 390
    visitor.shoot(narrow, "two-ways-narrow")
    visitor.shoot(visitor.open(**phone), "live-form-narrow")


def test_a_machine_that_cannot_says_why(visitor: Visitor) -> None:
    page = visitor.open(script=_ENDER3_RUNS_MARLIN)
    choose_machine(page, "ender3")
    expect(page.get_by_label("Print it live")).to_be_disabled()
    expect(page.get_by_text("It cannot be printed live: it runs marlin.")).to_be_visible()
    choose_machine(page, "voron v0")
    expect(page.get_by_label("Print it live")).to_be_enabled()


_ENDER3_RUNS_MARLIN = """
const ask = window.fetch;
window.fetch = async (address, asking) => {
  const answer = await ask(address, asking);
  if (!String(address).endsWith("v1/machines")) return answer;
  const machines = await answer.json();
  for (const one of machines) if (one.name === "ender3") one.live_refusal = "it runs marlin";
  return Response.json(machines);
};
"""
