"""Where a document is named, the page and the reports lead to it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from playwright.sync_api import Page, expect

from tests.web.served import Service
from tests.web.visitor import Visitor

NAMED = re.compile(r"docs/[a-z-]+\.md")
HEADING = "A model of your machine"
"""Of docs/identification.md, which the report of the gear names."""


def test_a_job_leads_to_documents_in_a_tab_of_their_own(visitor: Visitor, gear: dict[str, Any]):
    page = visitor.open(f"#/jobs/{gear['id']}")
    named = page.locator("main a", has_text="docs/identification.md").first
    expect(named).to_have_accessible_name("docs/identification.md (new tab)")
    with page.expect_popup() as opened:
        named.click()
    expect(opened.value.get_by_role("heading", level=1)).to_have_text(HEADING)


def test_a_report_leads_to_documents_where_a_service_has_them(
    visitor: Visitor, service: Service, gear: dict[str, Any], tmp_path: Path
):
    page = visitor.open(gear["links"]["report"].removeprefix("/"))
    assert named_outside_of_links(page) == []
    page.get_by_role("link", name="docs/identification.md").first.click()
    expect(page.get_by_role("heading", level=1)).to_have_text(HEADING)
    saved = tmp_path / "report.html"
    saved.write_bytes(service.api.get(gear["links"]["report"]).content)
    page.goto(saved.as_uri())
    assert page.get_by_role("link").count() == 0
    expect(page.locator("main")).to_contain_text("docs/identification.md")


def test_a_page_of_a_machine_leads_to_documents(visitor: Visitor):
    page = visitor.open("v1/machines/ender3/design.html?axis=x")
    assert named_outside_of_links(page) == []
    page.get_by_role("link", name="docs/method.md").click()
    expect(page.get_by_role("heading", level=1)).to_have_text("How it works")


def test_help_is_part_of_the_page(visitor: Visitor):
    page = visitor.open("#/machines")
    page.get_by_role("navigation", name="Main").get_by_role("link", name="Help").click()
    expect(page.get_by_role("heading", level=1)).to_have_text("Start here")
    expect(page.get_by_role("link", name="Help").first).to_have_attribute("aria-current", "page")
    page.get_by_role("button", name="Theme").click()
    expect(page.locator("html")).to_have_attribute("data-theme", "light")
    page.get_by_role("link", name="The service in Docker").first.click()
    expect(page.locator("html")).to_have_attribute("data-theme", "light")
    page.locator(".help img").first.scroll_into_view_if_needed()
    page.wait_for_function("[...document.images].every(image => image.naturalWidth > 0)")
    page.get_by_role("navigation", name="Main").get_by_role("link", name="Jobs").click()
    expect(page.get_by_role("heading", level=1)).to_have_text("Jobs")
    page.go_back()
    expect(page.get_by_role("heading", level=1)).to_have_text("The service in Docker")


def named_outside_of_links(page: Page) -> list[str]:
    """Return what a reader could not follow."""
    words = page.locator("main").evaluate(
        """main => {
            const copy = main.cloneNode(true);
            copy.querySelectorAll("a").forEach(link => link.remove());
            return copy.textContent;
        }"""
    )
    return NAMED.findall(words)
