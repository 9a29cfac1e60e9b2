"""A phone in a workshop: answers that take long or do not come, and a list that follows jobs."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from playwright.sync_api import expect

from tests.web.served import PART, Service
from tests.web.visitor import Visitor

PHONE = {"viewport": {"width": 390, "height": 800}}
COUNT = """
window.alerts = 0;
new MutationObserver((changes) => {
  for (const { addedNodes } of changes) {
    for (const node of addedNodes) {
      if (node.matches?.("[role=alert]") || node.querySelector?.("[role=alert]")) alerts += 1;
    }
  }
}).observe(document, { childList: true, subtree: true });
"""


def test_a_list_that_comes_slowly_is_asked_for_one_at_a_time(
    visitor: Visitor, gear: dict[str, Any]
):
    page = visitor.open("#/jobs", **PHONE)
    expect(page.locator(".job-row").first).to_be_visible()
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    network = page.context.new_cdp_session(page)
    slow = {"offline": False, "latency": 15_000, "downloadThroughput": -1, "uploadThroughput": -1}
    network.send("Network.emulateNetworkConditions", slow)
    page.wait_for_timeout(9_000)
    assert len(asked) <= 2


def test_a_service_that_is_away_is_told_once(visitor: Visitor, gear: dict[str, Any]):
    visitor.expected = {"ERR_INTERNET_DISCONNECTED"}
    page = visitor.open("#/jobs", script=COUNT, **PHONE)
    row = page.locator(".job-row").first
    expect(row).to_be_visible()
    page.context.set_offline(True)
    page.wait_for_timeout(9_000)
    assert page.evaluate("alerts") == 1
    expect(page.get_by_role("alert")).to_contain_text("does not answer")
    expect(row).to_be_visible()
    page.context.set_offline(False)
    expect(page.get_by_role("alert")).to_have_count(0)


def test_a_list_that_follows_its_jobs_leaves_finger_and_focus_where_they_are(
    visitor: Visitor, service: Service, gear: dict[str, Any]
):
    """A running job changes whenever the list is fetched; the others and the pager do not."""
    other = {**gear, "id": "0" * 32, "state": "running", "progress": 0.0}
    answers = [0]

    def answer(route: Any) -> None:
        answers[0] += 1
        jobs = [gear, {**other, "progress": min(0.01 * answers[0], 1.0)}]
        route.fulfill(body=json.dumps({"jobs": jobs, "next": "c"}))

    page = visitor.open("#/", **PHONE)
    page.route("**/v1/jobs?**", answer)
    page.evaluate("location.hash = '#/jobs'")
    bar = page.get_by_role("progressbar")
    expect(bar).to_have_attribute("value", "0.01")
    page.get_by_role("button", name="Older").focus()
    expect(bar).to_have_attribute("value", "0.03")
    expect(page.get_by_role("button", name="Older")).to_be_focused()
    page.get_by_role("button", name="Cancel gear.gcode").focus()
    expect(bar).to_have_attribute("value", "0.04")
    expect(page.get_by_role("button", name="Cancel gear.gcode")).to_be_focused()
    page.get_by_role("button", name="Delete gear.gcode").hover()
    page.mouse.down()
    expect(bar).to_have_attribute("value", "0.06")
    page.mouse.up()
    expect(page.get_by_role("dialog")).to_contain_text("Delete this job?")


def test_a_screen_reader_hears_quarters_of_a_slow_upload(visitor: Visitor, tmp_path: Path):
    """What lives in a live region is spoken whenever it changes."""
    heard = """
    window.heard = [];
    new MutationObserver((changes) => {
      for (const { target } of changes) {
        const at = target instanceof Element ? target : target.parentElement;
        const near = at?.closest("[aria-live]");
        if (near && near.ariaLive !== "off" && target.textContent) heard.push(target.textContent);
      }
    }).observe(document, { childList: true, characterData: true, subtree: true });
    """
    file = tmp_path / "slow.gcode"
    file.write_bytes(PART)
    page = visitor.open("#/", script=heard, **PHONE)
    page.get_by_label(re.compile("Choose a G-code")).set_input_files(file)
    page.get_by_role("combobox", name="Machine").fill("ender3")
    page.keyboard.press("Enter")
    network = page.context.new_cdp_session(page)
    slow = {"offline": False, "latency": 0, "downloadThroughput": -1}
    network.send("Network.emulateNetworkConditions", slow | {"uploadThroughput": len(PART) // 6})
    page.get_by_role("button", name="Compensate").click()
    page.wait_for_url("**/#/jobs/*")
    sending = [text for text in page.evaluate("heard") if text.startswith("Sending: ")]
    assert 1 <= len(sending) <= 5, sending


def test_a_phone_whose_updates_ended_follows_a_job(visitor: Visitor, service: Service):
    """Safari before 17.4, Firefox before 124 and Chrome before 116 have no `AbortSignal.any`."""
    job = service.submit(PART, "old-phone.gcode")
    page = visitor.open(f"#/jobs/{job}", script="delete AbortSignal.any;", **PHONE)
    expect(page.locator(".headline")).to_be_visible()
    expect(page.locator(".stage:not([aria-busy])")).to_be_visible()
    expect(page.get_by_role("alert")).to_have_count(0)


def test_the_focus_stays_on_the_pager_at_the_last_page(visitor: Visitor, gear: dict[str, Any]):
    def answer(route: Any) -> None:
        following = None if "cursor" in route.request.url else "c"
        route.fulfill(body=json.dumps({"jobs": [gear], "next": following}))

    page = visitor.open("#/", **PHONE)
    page.route("**/v1/jobs?**", answer)
    page.evaluate("location.hash = '#/jobs'")
    expect(page.get_by_role("button", name="Older")).to_be_visible()
    page.get_by_role("button", name="Older").press("Enter")
    expect(page.get_by_role("button", name="Newer")).to_be_focused()
    page.keyboard.press("Enter")
    expect(page.get_by_role("button", name="Older")).to_be_focused()


def test_why_a_job_was_not_deleted_stays_to_be_read(visitor: Visitor, gear: dict[str, Any]):
    visitor.expected = {503}
    page = visitor.open("#/jobs", **PHONE)
    said = {"title": "Storage unavailable", "detail": "It is away.", "status": 503}
    page.route(f"**/v1/jobs/{gear['id']}", lambda r: r.fulfill(status=503, body=json.dumps(said)))
    page.locator(f'[data-focus="end-{gear["id"]}"]').click()  # others may have its name
    page.get_by_role("dialog").get_by_role("button", name="Delete").click()
    expect(page.get_by_role("alert")).to_contain_text("It is away.")
    page.wait_for_timeout(5_000)
    expect(page.get_by_role("alert")).to_contain_text("It is away.")
