"""Every view for everybody: axe-core in both themes, narrow screens, keys only, themes, proxies."""

from __future__ import annotations

from collections.abc import Callable
from itertools import cycle
from typing import Any

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Page, Route, expect

from tests.web.machines import put
from tests.web.served import PART, Service
from tests.web.visitor import Visitor

PHONE = {"width": 390, "height": 844}
VIEWS = ["new", "jobs", "job", "machines", "machine", "own", "help"]


@pytest.fixture(scope="module")
def show(service: Service, gear: dict[str, Any]) -> Callable[..., Page]:
    """Open a view and wait until all of it is there."""
    put(service, "shown")
    views = {
        "new": ("#/", "form"),
        "jobs": ("#/jobs", ".job-row"),
        "job": (f"#/jobs/{gear['id']}", ".stage[data-renderer]:not([aria-busy])"),
        "machines": ("#/machines", ".cards"),
        "machine": ("#/machines/annex-k3", ".plot canvas"),
        "own": ("#/machines/shown", ".row-actions"),
        "help": ("help/running", ".help table"),
    }

    def opened(visitor: Visitor, view: str, **options: Any) -> Page:
        address, there = views[view]
        page = visitor.open(address, **options)
        page.locator(there).first.wait_for()
        page.wait_for_load_state("networkidle")
        return page

    return opened


@pytest.mark.parametrize("view", VIEWS)
def test_axe_finds_nothing(visitor: Visitor, show: Callable[..., Page], view: str):
    page = show(visitor, view, color_scheme="light")
    for details in page.locator("main details > summary").all():
        details.click()
    for theme in ("light", "dark"):
        page.emulate_media(color_scheme=theme)
        visitor.shoot(page, f"{view}-{theme}")
        found = Axe().run(page).response["violations"]
        serious = [
            (v["id"], [node["html"] for node in v["nodes"]][:3])
            for v in found
            if v["impact"] in ("serious", "critical")
        ]
        assert serious == [], theme


@pytest.mark.parametrize(
    ("view", "theme"), list(zip(VIEWS, cycle(("light", "dark")), strict=False))
)
def test_a_phone_needs_no_sideways_scrolling(
    visitor: Visitor, show: Callable[..., Page], view: str, theme: str
):
    page = show(visitor, view, viewport=PHONE, color_scheme=theme, has_touch=True, is_mobile=True)
    visitor.shoot(page, f"{view}-phone-{theme}")
    wide, inner = page.evaluate("[document.documentElement.scrollWidth, innerWidth]")
    assert wide <= inner == PHONE["width"]


def test_large_letters_need_no_sideways_scrolling(visitor: Visitor, service: Service):
    large = """addEventListener("DOMContentLoaded", () => {
        document.documentElement.style.fontSize = "200%";
    })"""
    small = {"width": 360, "height": 740}
    job = service.finished(service.submit(PART, "gear.gcode", compare_live="true"))
    page = visitor.open("#/", viewport=small, script=large, has_touch=True, is_mobile=True)
    assert page.evaluate("getComputedStyle(document.body).fontSize") == "32px"
    for view, there in (
        ("#/", "form"),
        ("#/jobs", ".job-row"),
        ("#/machines", ".cards"),
        (f"#/jobs/{job['id']}", "text=Filter for Klipper"),
        ("help/dialects", ".help table"),
    ):
        page.goto(f"{visitor.url}/{view}")
        page.locator(there).first.wait_for()
        wide, inner = page.evaluate("[document.documentElement.scrollWidth, innerWidth]")
        assert wide <= inner == small["width"], view


CUT_OFF = """() => [...document.querySelectorAll(".figure .big")].filter((line) => {
    const text = document.createRange();
    text.selectNodeContents(line);
    const end = line.closest(".figure").getBoundingClientRect().right;
    return text.getBoundingClientRect().right > end;
}).map((line) => line.textContent)"""


@pytest.mark.parametrize("kind", ["report", "design"])
def test_axe_finds_nothing_in_reports(visitor: Visitor, gear: dict[str, Any], kind: str):
    report = gear["links"]["report"].removeprefix("/")
    address = report if kind == "report" else "v1/machines/ender3/design.html?axis=x"
    page = visitor.open(address, viewport=PHONE)
    for details in page.locator("main details > summary").all():
        details.click()
    found = Axe().run(page).response["violations"]
    assert [v["id"] for v in found if v["impact"] in ("serious", "critical")] == []


@pytest.mark.parametrize("kind", ["page", "report", "design"])
def test_the_headline_is_whole_at_every_width(visitor: Visitor, gear: dict[str, Any], kind: str):
    """A figure that lost its end would be another one."""
    page = visitor.open(
        {
            "page": f"#/jobs/{gear['id']}",
            "report": gear["links"]["report"].removeprefix("/"),
            "design": "v1/machines/ender3/design.html?axis=x",
        }[kind]
    )
    page.locator(".figure .big").first.wait_for()
    for width in range(320, 1281, 40):
        page.set_viewport_size({"width": width, "height": 800})
        assert page.evaluate(CUT_OFF) == [], width
        # Charts are drawn anew a moment later.
        page.wait_for_function("document.documentElement.scrollWidth <= innerWidth", timeout=20_000)


def test_the_theme_follows_the_system_and_the_switch(visitor: Visitor, show: Callable[..., Page]):
    page = show(visitor, "new", color_scheme="dark")
    ground = "getComputedStyle(document.body).backgroundColor"
    dark = page.evaluate(ground)
    page.emulate_media(color_scheme="light")
    light = page.evaluate(ground)
    assert light != dark
    switch = page.get_by_role("button", name="Theme")
    switch.click()
    expect(switch).to_have_accessible_name("Theme: light")
    switch.click()
    expect(switch).to_have_accessible_name("Theme: dark")
    assert page.evaluate(ground) == dark
    page.reload()
    page.locator("h1").wait_for()
    assert page.evaluate(ground) == dark  # remembered
    page.get_by_role("button", name="Theme").click()
    assert page.evaluate(ground) == light  # as the system


def test_tapping_the_path_reads_it(visitor: Visitor, show: Callable[..., Page]):
    page = show(visitor, "job", viewport=PHONE, has_touch=True, is_mobile=True)
    page.get_by_role("button", name="Worst point of this layer").tap()
    page.locator(".stage").focus()
    # Focus may have scrolled.
    spot = page.locator(".stage .mark:visible").first.bounding_box()
    assert spot is not None
    page.keyboard.press("Escape")
    page.touchscreen.tap(spot["x"] + 8, spot["y"] + 8)
    expect(page.locator(".layers .readout")).to_contain_text("Line ")


def test_everything_can_be_reached_by_keyboard(visitor: Visitor, show: Callable[..., Page]):
    page = show(visitor, "new")
    page.locator("body").click(position={"x": 2, "y": 2})
    reached = []
    for _ in range(16):
        page.keyboard.press("Tab")
        reached.append(page.evaluate("(e => e.id || e.textContent.trim())(document.activeElement)"))
    wanted = {
        "New job",
        "Jobs",
        "Machines",
        "theme",
        "machine",
        "method",
        "tolerance",
        "More options",
    }
    assert wanted <= set(reached), reached
    page.get_by_role("link", name="Skip to content").focus()
    page.keyboard.press("Enter")
    assert page.evaluate("document.activeElement.id") == "main"


def test_the_page_works_below_a_path_of_a_proxy(
    visitor: Visitor, service: Service, gear: dict[str, Any]
):
    page = visitor.open("#/")
    below = f"{service.url}/prints"

    def pass_on(route: Route) -> None:
        url = route.request.url
        if url.startswith(f"{below}/"):
            route.fulfill(response=route.fetch(url=url.replace(below, service.url, 1)))
        else:
            route.fulfill(status=404, body="another program")

    page.route("**/*", pass_on)
    page.goto(f"{below}/#/jobs/{gear['id']}")
    page.locator(".stage[data-renderer]:not([aria-busy])").wait_for()
    links = page.locator("a[download], .downloads a[target=_blank]")
    for link in links.evaluate_all("links => links.map(a => a.href)"):
        assert link.startswith(f"{below}/v1/jobs/{gear['id']}/"), link
    for link in page.get_by_role("link", name="docs/").evaluate_all(
        "links => links.map(a => a.href)"
    ):
        assert link.startswith(f"{below}/help/"), link
    with page.expect_download() as download:
        page.get_by_role("link", name="G-code").click()
    assert download.value.url == f"{below}/v1/jobs/{gear['id']}/result"
    page.goto(f"{below}/#/machines/annex-k3")
    page.locator(".plot canvas").first.wait_for()
