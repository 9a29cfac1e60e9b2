"""The layer view of a finished job: slider, keys, pointer, and what it does without WebGL."""

from __future__ import annotations

import json
import re
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Page, Route, expect

from tests.web.served import GEAR, Service
from tests.web.visitor import Visitor

LAYERS, POINTS = 3000, 100_000
NO_WEBGL = """
const get = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, ...rest) {
  return kind.startsWith("webgl") ? null : get.call(this, kind, ...rest);
};
"""


def opened(visitor: Visitor, job: dict[str, Any], **options: Any) -> Page:
    page = visitor.open(f"#/jobs/{job['id']}", **options)
    settled(page)
    page.locator(".stage").scroll_into_view_if_needed()
    return page


def settled(page: Page) -> None:
    expect(page.locator(".stage[data-renderer]:not([aria-busy])")).to_be_visible()


def test_the_slider_shows_layer_after_layer(visitor: Visitor, gear: dict[str, Any]):
    page = opened(visitor, gear)
    slider = page.get_by_role("slider", name="Layer")
    count = int(slider.get_attribute("max") or 0) + 1
    assert count > 5
    before = page.locator(".stage").screenshot()
    slider.focus()
    page.keyboard.press("Home")
    settled(page)
    expect(page.locator(".layers output")).to_contain_text("Before the first layer")
    assert "Layer" in (slider.get_attribute("aria-valuetext") or "")
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowRight")
    settled(page)
    expect(page.locator(".layers output")).to_have_text(re.compile(r"^1\s*z "))
    page.get_by_role("button", name="Layer below").click()
    expect(page.locator(".layers output")).to_have_text(re.compile(r"^0\s*z "))
    settled(page)
    assert page.locator(".stage").screenshot() != before


def test_neighbours_are_fetched_before_they_are_asked_for(visitor: Visitor, gear: dict[str, Any]):
    page = visitor.open("#/")
    asked: list[int] = []
    page.on("request", lambda r: asked.extend(int(n) for n in re.findall(r"/layers/(\d+)$", r.url)))
    page.goto(f"{visitor.url}/#/jobs/{gear['id']}")
    settled(page)
    page.wait_for_load_state("networkidle")
    middle = asked[0]
    assert {middle - 1, middle + 1} <= set(asked)
    assert len(asked) == len(set(asked)) <= 6  # of a long print only what is looked at
    asked.clear()
    page.get_by_role("slider", name="Layer").focus()
    page.keyboard.press("ArrowRight")
    settled(page)
    assert middle + 1 not in asked


@pytest.mark.parametrize("renderer", ["webgl", "canvas"])
def test_the_pointer_reads_line_feature_and_error(
    visitor: Visitor, gear: dict[str, Any], renderer: str
):
    page = opened(visitor, gear, script=NO_WEBGL if renderer == "canvas" else "")
    stage = page.locator(".stage")
    assert stage.get_attribute("data-renderer") == renderer
    visitor.shoot(page, f"layers-{renderer}")
    page.get_by_role("button", name="Worst point of this layer").click()
    readout = page.locator(".layers .readout")
    expect(readout).to_have_text(re.compile(r"Line \d+ · .+ · As sliced .+ µm, Compensated .+ µm"))
    worst = readout.inner_text()
    marks = stage.locator(".mark:visible")
    expect(marks).to_have_count(2)
    spot = marks.first.bounding_box()
    assert spot is not None
    page.mouse.move(5, 5)
    stage.focus()
    page.keyboard.press("Escape")
    expect(readout).to_contain_text("Point at the path")
    page.mouse.move(spot["x"] + 8, spot["y"] + 8, steps=3)
    expect(readout).to_have_text(re.compile(r"Line \d+"))
    assert worst.split(" · ")[1]  # a feature by name


def test_keys_and_wheel_zoom_and_walk(visitor: Visitor, gear: dict[str, Any]):
    page = opened(visitor, gear)
    stage = page.locator(".stage")
    whole = stage.screenshot()
    stage.focus()
    page.keyboard.press("+")
    page.keyboard.press("+")
    page.keyboard.press("ArrowLeft")
    page.wait_for_timeout(200)
    near = stage.screenshot()
    assert near != whole
    page.keyboard.press(".")
    readout = page.locator(".layers .readout")
    first = readout.inner_text()
    assert first.startswith("Line ")
    for _ in range(40):
        page.keyboard.press(".")
    assert readout.inner_text() != first
    page.keyboard.press("Escape")
    page.keyboard.press("0")
    box = stage.bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + box["width"] / 4, box["y"] + box["height"] / 2)
    scrolled = page.evaluate("scrollY")
    page.mouse.wheel(0, -600)
    page.wait_for_timeout(200)
    assert page.evaluate("scrollY") == scrolled  # the picture took the wheel
    layer = page.locator(".layers output")
    before = layer.inner_text()
    page.keyboard.press("]")
    expect(layer).not_to_have_text(before)
    visitor.shoot(page, "layers-zoomed")


def test_one_channel_at_a_time_and_all_layers_as_a_table(visitor: Visitor, gear: dict[str, Any]):
    page = opened(visitor, gear)
    expect(page.locator(".stage .pane")).to_have_count(2)
    choice = page.get_by_role("group", name="What the view shows")
    choice.get_by_role("button", name="As sliced").click()
    expect(page.locator(".stage .pane")).to_have_count(1)
    page.get_by_text("All layers as a table").click()
    table = page.get_by_role("region", name=re.compile(r"^Contour error of \d+ layers"))
    table.get_by_role("button", name="2", exact=True).click()
    expect(page.get_by_role("slider", name="Layer")).to_be_focused()


def test_a_finger_chooses_a_layer_and_sees_it(visitor: Visitor, gear: dict[str, Any]):
    page = opened(
        visitor, gear, viewport={"width": 390, "height": 844}, has_touch=True, is_mobile=True
    )
    stage = page.locator(".stage").bounding_box()
    zoom = page.get_by_role("group", name="Zoom", exact=True).bounding_box()
    assert stage is not None
    assert zoom is not None
    assert zoom["y"] + zoom["height"] <= stage["y"]
    page.get_by_text("All layers as a table").tap()
    button = page.locator(".layers tbody button").last
    button.scroll_into_view_if_needed()
    page.evaluate("document.querySelector('.layers tbody tr:last-child').scrollIntoView(true)")
    size = button.bounding_box()
    assert size is not None
    assert min(size["width"], size["height"]) >= 44
    button.tap()
    settled(page)
    expect(page.locator(".layers output")).to_contain_text(button.inner_text())
    shown = page.locator(".stage").bounding_box()
    assert shown is not None
    assert shown["y"] >= 0
    assert shown["y"] + shown["height"] <= 844


def test_curves_are_read_by_keys_and_as_tables(visitor: Visitor, gear: dict[str, Any]):
    page = opened(visitor, gear)
    plot = page.get_by_role("group", name=re.compile("^Contour error along the print"))
    expect(plot.locator("canvas")).to_be_visible()
    plot.focus()
    page.keyboard.press("End")
    figure = page.locator("figure.chart").filter(has=plot)
    expect(figure.locator(".readout")).to_have_text(re.compile(r"^\d+:\d\d: As sliced .+ µm"))
    figure.get_by_text("Show as a table").click()
    expect(figure.get_by_role("table")).to_contain_text("Compensated")


def long_print() -> tuple[dict[str, Any], bytes]:
    """Index and tile of a print of 6 GB of layer data: a spiral, worst at its end."""
    turn = np.linspace(0, 600 * np.pi, POINTS)
    radius = np.linspace(1, 100, POINTS)
    error = np.linspace(0, 400, POINTS).astype("<u2")
    on = np.ones(POINTS, "u1")
    on[0], error[0] = 0, 65535
    columns = [
        (radius * np.cos(turn)).astype("<f4"),
        (radius * np.sin(turn)).astype("<f4"),
        np.arange(1, POINTS + 1, dtype="<u4"),
        error,
        error // 10,
        np.zeros(POINTS, "u1"),
        on,
    ]
    tile = b"".join(c.tobytes() + bytes(-c.nbytes % 4) for c in columns)
    figures = {"before": 20.0, "after": 2.0}
    layers = [
        {"n": k, "name": str(k), "z_mm": round(0.2 * (k + 1), 3), "points": POINTS, "seconds": 60.0}
        | {"offset": k * len(tile), "bytes": len(tile), "rms_um": figures, "max_um": figures}
        for k in range(LAYERS)
    ]
    index = {"version": 1, "channels": ["before", "after"], "features": ["outer wall"]}
    return index | {"scale_um": 40, "bounds_mm": [-100, -100, 100, 100], "layers": layers}, tile


def test_a_long_print_is_fetched_as_far_as_it_is_looked_at(visitor: Visitor, gear: dict[str, Any]):
    index, tile = long_print()
    asked: list[int] = []

    def answer(route: Route) -> None:
        k = route.request.url.rpartition("/")[2]
        if k == "layers":
            route.fulfill(body=json.dumps(index), content_type="application/json")
            return
        asked.append(int(k))
        route.fulfill(body=tile, content_type="application/octet-stream")

    page = visitor.open("#/")
    page.route(re.compile(r"/layers(/\d+)?$"), answer)
    page.goto(f"{visitor.url}/#/jobs/{gear['id']}")
    settled(page)
    slider = page.get_by_role("slider", name="Layer")
    slider.evaluate(
        """slider => {
          for (let k = 0; k < 1000; k += 1) {
            slider.value = k;
            slider.dispatchEvent(new Event("input"));
          }
        }"""
    )
    settled(page)
    expect(page.locator(".layers output")).to_have_text(re.compile(r"^999\s*z "))
    assert 999 in asked
    assert len(asked) < 30  # not a thousand
    page.get_by_role("button", name="Worst point of this layer").click()
    expect(page.locator(".layers .readout")).to_have_text(
        f"Line {POINTS} · outer wall · As sliced 40.0 µm, Compensated 4.00 µm"
    )
    page.get_by_text("All layers as a table").click()
    assert page.locator(".layers tbody tr").count() <= 100  # the rest when it is asked for


def test_a_computation_that_was_cancelled_is_told(
    visitor: Visitor, service: Service, gear: dict[str, Any]
):
    cancelled = service.submit(b"; cancelled\n" + GEAR.read_bytes() * 4, "long.gcode")
    job = service.api.get(f"/v1/jobs/{cancelled}").json()
    service.api.post(f"/v1/jobs/{cancelled}/cancel")
    asked: list[str] = []

    def answer(route: Route) -> None:
        asked.append(route.request.url)
        route.fulfill(status=202, json=job)

    page = opened(visitor, gear)
    page.route("**/trajectories?*", answer)
    visitor.expected = {202}
    page.get_by_role("button", name="CSV").click()
    page.get_by_role("button", name="Compute and download").click()
    expect(page.get_by_role("alert")).to_contain_text("Job cancelled")
    assert len(asked) == 1


def test_trajectories_are_computed_when_asked_for(visitor: Visitor, gear: dict[str, Any]):
    page = opened(visitor, gear)
    page.get_by_role("button", name="CSV").click()
    expect(page.get_by_label("From, s of the print")).to_be_focused()
    page.get_by_label("From, s of the print").fill("20")
    page.get_by_label("Length, s").fill("0.5")
    with page.expect_download() as download:
        page.get_by_role("button", name="Compute and download").click()
    assert download.value.suggested_filename == "gear.stillpath.20s.csv"
    rows = download.value.path().read_text("utf-8").splitlines()
    assert rows[0].startswith("t_s,")
    assert len(rows) > 400
