"""From a file to the finished report, and what may go wrong on the way."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Page, Route, expect

from stillpath.service.api.schemas import JobView
from stillpath.service.compiling import STAGE
from tests.service.deliveries.listeners import octoprint, until, uploads
from tests.web.served import GEAR, PART, Service, running
from tests.web.visitor import Visitor

_SECTIONS = (
    "Error of the nozzle",
    "Layer by layer",
    "Along the print",
    "Spectra at the resonances",
    "By feature",
    "Reverted to the sliced lines",
)
KEY = "sp_" + "0123456789abcdef" * 2
NO_STORE = """
Object.defineProperty(window, "sessionStorage", {
  get() { throw new DOMException("The operation is insecure.", "SecurityError"); },
});
"""

# What a browser tells of a request that the test keeps.
ALL_SENT = """
const send = XMLHttpRequest.prototype.send;
XMLHttpRequest.prototype.send = function (body) {
  send.call(this, body);
  this.upload.dispatchEvent(new ProgressEvent("progress", { loaded: 1, total: 1 }));
};
"""


def choose_machine(page: Page, typed: str) -> None:
    field = page.get_by_role("combobox", name="Machine")
    field.fill(typed)
    page.keyboard.press("Enter")


def hand_in(page: Page, file: Path, machine: str = "ender3") -> None:
    page.locator("input[type=file]").set_input_files(file)
    choose_machine(page, machine)
    page.get_by_role("button", name="Compensate").click()


def test_an_upload_becomes_a_report(visitor: Visitor, tmp_path: Path):
    file = tmp_path / "wheel.gcode"
    file.write_bytes(b"; another file\n" + PART.partition(b";LAYER:4\n")[0])
    page = visitor.open()
    expect(page.get_by_role("button", name="Compensate")).to_be_disabled()
    hand_in(page, file)
    page.wait_for_url("**/#/jobs/*")
    expect(page.locator("h1")).to_have_text("wheel.gcode")
    # A quick computer is done before one looks.
    progress = page.get_by_role("progressbar", name="Progress")
    expect(progress.or_(page.locator(".headline")).first).to_be_visible()
    visitor.shoot(page, "progress")
    expect(page.locator(".headline")).to_contain_text("explain what is known of the machine")
    before, after = (page.locator(f".headline .{name}") for name in ("before", "after"))
    low, high = map(float, after.inner_text().split(" to "))
    assert low < float(before.inner_text()) / 3
    assert low < high
    for title in _SECTIONS:
        expect(page.get_by_role("heading", name=title)).to_be_visible()
    assert page.title() == "wheel.gcode · Stillpath"
    # The heading has the focus, so that reading starts there.
    assert page.evaluate("document.activeElement.tagName") == "H1"
    with page.expect_download() as download:
        page.get_by_role("link", name=re.compile("^G-code")).click()
    assert download.value.suggested_filename == "wheel.stillpath.gcode"
    assert download.value.path().read_bytes().count(b"\n") > 1000
    with page.context.expect_page() as report:
        page.get_by_role("link", name="Report (new tab)").click()
    expect(report.value.locator("h1")).to_have_text("wheel.gcode")


def test_the_machine_is_found_by_typing_and_remembered(visitor: Visitor):
    page = visitor.open()
    field = page.get_by_role("combobox", name="Machine")
    field.fill("voron")
    options = page.get_by_role("listbox").get_by_role("option")
    expect(options).to_have_count(2)
    page.keyboard.press("ArrowDown")
    page.keyboard.press("Enter")
    expect(field).to_have_value(re.compile("Voron"))
    expect(page.get_by_role("listbox")).to_be_hidden()
    chosen = field.input_value()
    field.fill("nothing of that name")
    expect(page.get_by_role("listbox")).to_contain_text("No machine")
    page.keyboard.press("Escape")
    expect(field).to_have_value(chosen)
    # Leaving the field takes what was typed, not the machine before.
    hint = page.locator("#machine-hint")
    field.fill("taz 6")
    page.keyboard.press("Tab")
    expect(hint).to_contain_text("taz6-x ·")
    for typed, said in (("voron", "fits 2 machines"), ("no such", "No machine has")):
        field.fill(typed)
        page.keyboard.press("Tab")
        expect(field).to_have_value(typed)
        expect(hint).to_contain_text(said)


def test_a_finger_scrolls_the_machines_and_chooses_by_tapping(visitor: Visitor):
    page = visitor.open(viewport={"width": 390, "height": 844}, has_touch=True, is_mobile=True)
    field = page.get_by_role("combobox", name="Machine")
    field.tap()
    options = page.get_by_role("listbox")
    before, first = field.input_value(), options.get_by_role("option").nth(2)
    place = first.bounding_box()
    assert place is not None
    x, y = place["x"] + 40, place["y"] + place["height"] / 2
    touch = page.context.new_cdp_session(page)
    for kind, at in [("touchStart", y), *[("touchMove", y - k) for k in range(5, 120, 5)]]:
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": [{"x": x, "y": at}]})
    touch.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    expect(options).to_be_visible()
    assert options.evaluate("list => list.scrollTop") > 0
    assert field.input_value() == before
    options.get_by_role("option").nth(5).tap()
    expect(options).to_be_hidden()
    assert field.input_value() != before


def test_a_file_that_is_no_gcode_is_refused_with_the_reason(visitor: Visitor, tmp_path: Path):
    file = tmp_path / "photo.gcode"
    file.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(range(256)) * 40)
    page = visitor.open()
    hand_in(page, file)
    problem = page.get_by_role("alert")
    expect(problem).to_be_visible()
    assert len(problem.inner_text()) > 60  # what, where and the remedy
    expect(page.locator(".badge[data-state=failed]")).to_be_visible()
    visitor.shoot(page, "failed")


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [("part.gcode", b"", "empty"), ("part.stl", b"solid part", "Slice it first")],
)
def test_files_that_cannot_be_meant_are_not_sent(
    visitor: Visitor, tmp_path: Path, name: str, content: bytes, said: str
):
    file = tmp_path / name
    file.write_bytes(content)
    page = visitor.open()
    hand_in(page, file)
    expect(page.get_by_role("alert")).to_contain_text(said)
    expect(page.get_by_role("button", name="Compensate")).to_be_enabled()


def test_a_wrong_value_that_is_folded_away_is_shown(visitor: Visitor, tmp_path: Path):
    file = tmp_path / "part.gcode"
    file.write_bytes(PART)
    page = visitor.open()
    fold = page.get_by_text("More options")
    fold.click()
    page.get_by_label("Speed budget, µm").fill("0.1")
    fold.click()
    hand_in(page, file)
    expect(page.get_by_label("Speed budget, µm")).to_be_focused()


def test_the_focus_stays_where_an_upload_was_cancelled(visitor: Visitor, tmp_path: Path):
    file = tmp_path / "part.gcode"
    file.write_bytes(PART)
    page = visitor.open()
    page.route(
        "**/v1/jobs?*", lambda route: None if route.request.method == "POST" else route.continue_()
    )
    hand_in(page, file)
    page.get_by_role("button", name="Cancel").focus()
    page.keyboard.press("Enter")
    expect(page.get_by_text("Not sent.")).to_be_visible()
    expect(page.get_by_role("button", name="Compensate")).to_be_focused()


@pytest.mark.parametrize(
    ("script", "said", "choice", "heading"),
    [
        ("", "was on its way", "Choose it again", "New job"),
        (ALL_SENT, "was being stored", "Show the jobs", "Jobs"),
    ],
)
def test_leaving_an_upload_is_told(
    visitor: Visitor, tmp_path: Path, script: str, said: str, choice: str, heading: str
):
    file = tmp_path / "part.gcode"
    file.write_bytes(PART)
    page = visitor.open(script=script)
    # Sent, and never answered.
    page.route(
        "**/v1/jobs?*", lambda route: None if route.request.method == "POST" else route.continue_()
    )
    hand_in(page, file)
    expect(page.get_by_role("progressbar", name="Sent")).to_be_visible()
    with page.expect_event("dialog", timeout=20_000) as question:
        page.evaluate("setTimeout(() => location.reload())")
    assert question.value.type == "beforeunload"
    question.value.dismiss()
    page.get_by_role("link", name="Machines", exact=True).first.click()
    dialog = page.get_by_role("dialog")
    expect(dialog).to_contain_text(f"part.gcode {said}")
    dialog.get_by_role("button", name=choice).click()
    expect(page.locator("h1")).to_have_text(heading)
    page.reload()  # asks nothing any more


def test_a_file_dropped_beside_its_place_opens_nothing(visitor: Visitor):
    page = visitor.open()
    prevented = page.evaluate(
        """["dragover", "drop"].map((kind) => {
          const dataTransfer = new DataTransfer();
          dataTransfer.items.add(new File(["G28"], "part.gcode"));
          const event = new DragEvent(kind, { bubbles: true, cancelable: true, dataTransfer });
          document.querySelector("h1").dispatchEvent(event);
          return event.defaultPrevented;
        })"""
    )
    assert prevented == [True, True]


def test_files_that_are_left_out_are_told(visitor: Visitor):
    page = visitor.open()
    page.locator(".drop").evaluate(
        """(zone) => {
          const dataTransfer = new DataTransfer();
          const files = ["one.gcode", "two.gcode"].map((name) => new File(["G28"], name));
          for (const file of files) dataTransfer.items.add(file);
          const drop = { bubbles: true, cancelable: true, dataTransfer };
          zone.dispatchEvent(new DragEvent("drop", drop));
        }"""
    )
    expect(page.locator(".drop")).to_contain_text("one.gcode")
    expect(page.locator(".drop")).to_contain_text("one file at a time: 1 left out")


def test_a_file_sliced_again_is_to_be_chosen_again(visitor: Visitor, tmp_path: Path):
    """What the page says when nothing comes back; whole uploads of changed files hang Chromium."""
    file = tmp_path / "part.gcode"
    file.write_bytes(PART)
    page = visitor.open()
    module = page.locator("script[type=module]").get_attribute("src") or ""
    page.locator("input[type=file]").set_input_files(file)

    def said() -> str:
        text: str = page.evaluate(
            "async from => { const { silence } = await import(from);"
            " const [file] = document.querySelector('input[type=file]').files;"
            " return (await silence(file)).message; }",
            f"/{module.replace('app.js', 'lib/api.js')}",
        )
        return text

    assert "has changed" not in said()
    file.write_bytes(PART + b"; sliced again\n")
    assert "part.gcode has changed since it was chosen. Choose it again." in said()


@pytest.mark.parametrize("missed", [r"report\.json$", r"/layers$", r"layers/viewer\.js$"])
def test_what_did_not_come_is_fetched_again(visitor: Visitor, gear: dict[str, Any], missed: str):
    visitor.expected = {503}
    page = visitor.open("#/")
    page.route(re.compile(missed), lambda route: route.fulfill(status=503), times=1)
    page.goto(f"{visitor.url}/#/jobs/{gear['id']}")
    expect(page.get_by_role("alert")).to_be_visible()
    page.get_by_role("button", name="Try again").click()
    expect(page.locator(".stage[data-renderer]")).to_be_visible()
    expect(page.get_by_role("alert")).to_have_count(0)


def test_a_view_that_did_not_come_is_fetched_again(visitor: Visitor):
    visitor.expected = {503}
    page = visitor.open("#/")
    page.route("**/views/machines.js", lambda route: route.fulfill(status=503), times=1)
    page.get_by_role("link", name="Machines").click()
    expect(page.get_by_role("alert")).to_contain_text("The service does not answer")
    page.get_by_role("button", name="Try again").click()
    expect(page.locator("h1")).to_have_text("Machines")


def test_a_view_that_some_browsers_never_fetch_again_comes_with_the_page(visitor: Visitor):
    """Firefox before 155 keeps in mind that a module did not come (whatwg/html#6768)."""
    visitor.expected = {503}
    page = visitor.open("#/")
    page.route("**/views/machines.js", lambda route: route.fulfill(status=503), times=2)
    page.get_by_role("link", name="Machines").click()
    page.get_by_role("button", name="Try again").click()
    expect(page.locator("h1")).to_have_text("Machines")


def test_a_page_without_its_script_says_so(visitor: Visitor):
    visitor.expected = {"ERR_FAILED"}
    page = visitor.open("#/")
    page.route("**/app.js", lambda route: route.abort())
    page.reload()
    expect(page.get_by_role("main")).to_contain_text("reload the page")


def test_a_page_from_before_an_update_is_loaded_anew(visitor: Visitor, service: Service):
    """A tab stayed open: its modules are of the old version, and what it fetches is new."""
    page = visitor.open("#/jobs")
    index = service.api.get("/").text
    newer = re.sub(r"assets/\w+/", "assets/0123456789ab/", index)
    asks_for_more = 'import { notYet } from "../lib/dom.js"; export const show = notYet;'
    page.route(f"{visitor.url}/", lambda route: route.fulfill(body=newer), times=1)
    page.route(
        "**/views/machines.js",
        lambda route: route.fulfill(content_type="text/javascript", body=asks_for_more),
        times=1,
    )
    page.get_by_role("link", name="Machines").click()
    expect(page.locator("h1")).to_have_text("Machines")
    expect(page.get_by_role("alert")).to_have_count(0)


def test_a_request_that_is_refused_says_why(visitor: Visitor, tmp_path: Path):
    file = tmp_path / "part.gcode"
    file.write_bytes(PART)
    visitor.expected = {422}
    page = visitor.open()
    page.locator("form").evaluate("form => { form.noValidate = true; }")
    page.get_by_label("Tolerance, µm").fill("900")
    hand_in(page, file)
    expect(page.get_by_role("alert")).to_contain_text("tolerance_um")


def test_warnings_name_the_controls_of_the_page(visitor: Visitor, tmp_path: Path):
    file = tmp_path / "part.gcode"
    moves = b"".join(b"G1 X%d Y10 E%.1f\n" % (x, 0.05 * x) for x in range(10, 20))
    file.write_bytes(b"; gcode_flavor = reprapfirmware\nG28\nG92 E0.45\nG1 X9 Y10 F3000\n" + moves)
    page = visitor.open()
    page.get_by_text("More options").click()
    page.get_by_label("Compensate", exact=True).select_option("walls")
    expect(page.get_by_label("File is written for")).to_be_visible()
    hand_in(page, file)
    told = "written for Klipper (“File is written for”)"
    expect(page.get_by_text(told)).to_be_visible()
    expect(page.get_by_text("“Compensate: Outer walls”: ")).to_be_visible()
    assert "--" not in page.locator("main").inner_text()


def test_a_job_is_cancelled_and_deleted(visitor: Visitor, service: Service):
    # Robust designs take long enough to be stopped in the middle.
    long = b"; to be stopped\n" + GEAR.read_bytes() * 4
    name = "long.gcode"
    job = service.submit(long, name, robust="minimax")
    page = visitor.open(f"#/jobs/{job}")
    page.get_by_role("button", name="Cancel", exact=True).click()
    dialog = page.get_by_role("dialog")
    expect(dialog).to_contain_text("not finished")
    visitor.shoot(page, "cancel")
    dialog.get_by_role("button", name="Let it run").click()
    expect(page.get_by_role("button", name="Cancel", exact=True)).to_be_focused()
    page.get_by_role("button", name="Cancel", exact=True).click()
    page.evaluate("location.hash = '#/jobs'")
    expect(page.get_by_role("dialog")).to_have_count(0)
    page.go_back()
    page.get_by_role("button", name="Cancel", exact=True).click()
    page.get_by_role("dialog").get_by_role("button", name="Cancel the job").click()
    expect(page.locator(".badge[data-state=cancelled]")).to_be_visible()
    assert service.finished(job)["state"] == "cancelled"
    # What had the focus is gone: reading goes on at the heading, not at the top of the window.
    expect(page.locator("h1")).to_be_focused()

    page = visitor.open("#/jobs")
    page.get_by_role("button", name="Cancelled").click()
    row = page.locator(f"[data-job='{job}']")
    delete = row.get_by_role("button", name=f"Delete {name}")
    delete.click()
    with page.expect_response(re.compile(r"/v1/jobs\?")):  # the list is drawn anew
        pass
    page.wait_for_timeout(100)
    page.get_by_role("dialog").get_by_role("button", name="Keep it").click()
    expect(delete).to_be_focused()
    delete.click()
    page.get_by_role("dialog").get_by_role("button", name="Delete").click()
    expect(row).to_have_count(0)
    expect(page.locator("h1")).to_be_focused()
    assert service.api.get(f"/v1/jobs/{job}").status_code == 404


def test_the_list_has_pages_and_states(visitor: Visitor, service: Service, gear: dict[str, str]):
    small = PART[:200]
    made = [service.submit(b"; %d\n" % k + small, f"part{k:02}.gcode") for k in range(28)]
    service.finished(made[-1])
    page = visitor.open("#/jobs")
    rows = page.locator(".job-row")
    expect(rows).to_have_count(25)
    # In the words of the form, not in those of the API.
    expect(rows.first).to_contain_text("compensated")
    first_page = re.compile(r"/v1/jobs\?limit=25$")
    slow: list[Route] = []

    def hold(route: Route) -> None:
        slow.append(route)

    with page.expect_request(first_page):
        page.route(first_page, hold, times=1)
    page.get_by_role("button", name="Older").dblclick()
    expect(page.get_by_role("button", name="Newer")).to_be_enabled()
    expect(page.get_by_role("link", name="part00.gcode")).to_be_visible()
    with page.expect_response(first_page):
        slow[0].continue_()
    page.wait_for_timeout(300)
    # Who looks at a job of the second page comes back to it.
    page.get_by_role("link", name="part00.gcode").click()
    expect(page.locator("h1")).to_have_text("part00.gcode")
    page.go_back()
    expect(page.get_by_role("link", name="part00.gcode")).to_be_visible()
    page.get_by_role("button", name="Newer").click()
    expect(page.get_by_role("link", name="part27.gcode")).to_be_visible()
    page.get_by_role("button", name="Done", exact=True).click()
    expect(page.get_by_role("link", name="gear.gcode").first).to_be_visible()
    page.get_by_role("link", name="gear.gcode").first.click()
    expect(page.locator("h1")).to_have_text("gear.gcode")
    page.go_back()
    expect(page.get_by_role("button", name="Done", exact=True)).to_have_attribute(
        "aria-pressed", "true"
    )
    for job in made:
        service.api.delete(f"/v1/jobs/{job}")


@pytest.mark.parametrize(
    "options", [{}, {"where": "walls"}, {"method": "none"}, {"budget_um": "25"}]
)
def test_list_page_and_report_say_the_same(
    visitor: Visitor, service: Service, options: dict[str, str]
):
    job = service.finished(service.submit(PART, "gear.gcode", **options))
    page = visitor.open("#/jobs")
    row = page.locator(f"[data-job='{job['id']}'] .figures")
    listed = [row.locator(f".{name}").inner_text() for name in ("before", "after")]
    page.goto(f"{visitor.url}/#/jobs/{job['id']}")
    shown = [page.locator(f".headline .{name}") for name in ("before", "after")]
    assert listed == [figure.inner_text() for figure in shown]
    label = page.locator(".headline .first .label").inner_text()
    assert "–" not in page.locator(".headline").inner_text()  # no figure that is not known
    assert ("of outer walls" in label) is ("where" in options)
    features = page.get_by_role("region", name="Contour error by feature").inner_text()
    assert "Outer wall (WALL-OUTER)" in features
    page.goto(visitor.url + job["links"]["report"])
    expect(page.locator(".figure.main .label")).to_have_text(label, ignore_case=True)
    expect(page.locator(".figure.main .big")).to_have_text(f"{listed[0]} → {listed[1]} µm")
    expect(page.get_by_role("rowheader", name="outer wall (WALL-OUTER)").first).to_be_visible()
    if options.get("method") == "none":
        # Nothing was compensated, and nothing says so.
        expect(page.get_by_role("columnheader", name="as written").first).to_be_visible()
        expect(page.locator("main")).to_contain_text("no piece of the file was to be compensated")


def test_a_job_says_what_became_of_its_delivery(visitor: Visitor, gear: dict[str, Any]):
    """Done is not started: the printer may have refused it. One answer is lost on its way."""
    visitor.expected = {"ERR_FAILED"}
    sending = {"kind": "printer", "target": "left", "state": "sending", "attempts": 1}
    refused = sending | {"state": "failed", "error": "File is loaded; send it again"}
    after = iter([sending | {"error": None}, None, refused])

    def answer(route: Route) -> None:
        job = gear | {"printer": "left", "print": True}
        delivery = next(after) if shown else {}
        shown.append(job)
        if delivery is None:
            route.abort()
            return
        job["deliveries"] = [delivery | {"next_at": None}] if delivery else []
        route.fulfill(body=json.dumps(job), content_type="application/json")

    shown: list[Any] = []
    page = visitor.open("#/")
    page.route(re.compile(rf"/v1/jobs/{gear['id']}$"), answer)
    page.goto(f"{visitor.url}/#/jobs/{gear['id']}")
    sent = page.get_by_role("list", name="Sent on")
    expect(sent).to_have_text("Sending to the printer left failed: File is loaded; send it again")
    expect(page.locator(".headline")).to_be_visible()
    assert len(shown) == 4


def test_a_job_that_is_not_there(visitor: Visitor):
    visitor.expected = {404}
    page = visitor.open("#/nowhere")
    expect(page.locator("h1")).to_have_text("No such page")
    page.goto(f"{visitor.url}/#/jobs/{'0' * 32}")
    expect(page.get_by_role("alert")).to_contain_text("no job")
    page.get_by_role("link", name="All jobs").click()
    expect(page.locator("h1")).to_have_text("Jobs")
    page.goto(f"{visitor.url}/#/machines/nobody")
    # Not the view before it, in the tab's title and to a screen reader.
    expect(page).to_have_title("Unknown machine · Stillpath")
    expect(page.get_by_role("heading", level=1)).to_be_focused()
    page.get_by_role("link", name="All machines").click()
    expect(page.locator("h1")).to_have_text("Machines")
    page.goto(f"{visitor.url}/#/jobs/%E0%A4%A")
    expect(page.locator("h1")).to_have_text("No such page")


@pytest.fixture(scope="module")
def guarded(browser: Browser, tmp_path_factory: pytest.TempPathFactory):
    """A service that asks for a key."""
    folder = tmp_path_factory.mktemp("guarded")
    with running(folder, KEY, STILLPATH_KEYS="true", STILLPATH_FIRST_KEY=KEY) as found:
        yield found


def test_a_key_is_asked_for_and_goes_along(guarded: Service, visitor: Visitor, tmp_path: Path):
    file = tmp_path / "gear.gcode"
    file.write_bytes(PART)
    visitor.expected = {401}
    page = visitor.open(at=guarded.url)
    dialog = page.get_by_role("dialog")
    expect(dialog).to_contain_text("asks for a key")
    visitor.shoot(page, "key")
    expect(page.get_by_label("Key", exact=True)).to_be_focused()
    page.get_by_label("Key", exact=True).fill("sp_01…")  # as a narrow table shows it
    page.get_by_role("button", name="Use this key").click()
    expect(page.locator("#key:invalid")).to_be_visible()
    page.get_by_label("Key", exact=True).fill("sp_" + "wrong" * 8)
    page.get_by_role("button", name="Use this key").click()
    expect(dialog).to_contain_text("asks for a key")
    page.get_by_label("Key", exact=True).fill(KEY)
    page.get_by_role("button", name="Use this key").click()
    hand_in(page, file)
    expect(page.locator(".headline")).to_contain_text("explain what is known of the machine")
    expect(page.locator(".stage:not([aria-busy])")).to_be_visible()
    for width in (320, 641, 700, 1280):  # with the button that forgets it
        page.set_viewport_size({"width": width, "height": 900})
        assert page.locator(".top").evaluate("top => top.scrollWidth <= top.clientWidth"), width
    # The browser fetches it, straight to the disk: a phone has no room for it in memory.
    link = page.get_by_role("link", name=re.compile("^G-code"))
    with page.expect_download() as download:
        link.click()
    assert download.value.suggested_filename == "gear.stillpath.gcode"
    assert re.match(r"http.*/result\?key=.*&signature=", download.value.url)
    assert b"; Processed by stillpath" in Path(download.value.path()).read_bytes()
    expect(link).to_have_text(re.compile(r"^G-code \(.* MB\)$"))
    # What the page fetches itself, it tells how far that is.
    network = page.context.new_cdp_session(page)
    slow = {"offline": False, "latency": 0, "downloadThroughput": 200_000, "uploadThroughput": -1}
    network.send("Network.emulateNetworkConditions", slow)
    link = page.locator(".downloads a", has_text="Report").first
    with page.expect_download() as download:
        link.click()
        expect(link).to_have_text(re.compile(r"^Report: \d+ %$"))
        network.send("Network.emulateNetworkConditions", slow | {"downloadThroughput": -1})
    assert download.value.suggested_filename == "gear.stillpath.report.html"
    expect(link).to_have_text("Report")
    # The key is in the tab and nowhere else: neither in an address nor in lasting storage.
    assert KEY not in page.url
    assert KEY not in page.evaluate("JSON.stringify({...localStorage}) + document.cookie")
    page.get_by_role("button", name="Forget key").click()
    expect(page.get_by_role("dialog")).to_contain_text("asks for a key")


def test_a_key_that_comes_late_sends_nothing(guarded: Service, visitor: Visitor, tmp_path: Path):
    """The upload was left meanwhile, by going back."""
    file = tmp_path / "left.gcode"
    file.write_bytes(PART)
    visitor.expected = {401}
    page = visitor.open(at=guarded.url)
    page.get_by_label("Key", exact=True).fill(KEY)
    page.get_by_role("button", name="Use this key").click()
    page.route(
        re.compile(r"/v1/jobs\?machine"),
        lambda route: route.fulfill(status=401, body='{"detail": "It was revoked."}'),
        times=1,
    )
    hand_in(page, file)
    expect(page.get_by_role("dialog")).to_contain_text("It was revoked.")
    page.evaluate("location.hash = '#/jobs'")
    page.get_by_label("Key", exact=True).fill(KEY)
    page.get_by_role("button", name="Use this key").click()
    expect(page.get_by_role("dialog")).to_contain_text("left.gcode was on its way")
    assert "left.gcode" not in guarded.api.get("/v1/jobs").text


@pytest.mark.parametrize("view", ["#/", "#/jobs"])
def test_who_has_no_key_is_asked_once(guarded: Service, visitor: Visitor, view: str):
    visitor.expected = {401}
    page = visitor.open(view, at=guarded.url)
    page.get_by_role("button", name="Not now").click()
    expect(page.get_by_role("alert")).to_contain_text("This service asks for a key")
    page.wait_for_timeout(2500)  # the list is fetched every two seconds
    expect(page.get_by_role("dialog")).to_have_count(0)
    page.get_by_role("button", name="Enter a key").click()
    page.get_by_label("Key", exact=True).fill(KEY)
    page.get_by_role("button", name="Use this key").click()
    expect(page.get_by_role("alert")).to_have_count(0)
    expect(page.get_by_role("dialog")).to_have_count(0)


def test_a_key_does_where_the_browser_stores_nothing(guarded: Service, visitor: Visitor):
    visitor.expected = {401}
    page = visitor.open(at=guarded.url, script=NO_STORE)
    page.get_by_label("Key", exact=True).fill(KEY)
    page.get_by_role("button", name="Use this key").click()
    expect(page.get_by_role("dialog")).to_have_count(0)
    expect(page.get_by_role("combobox", name="Machine")).to_be_enabled()
    page.get_by_role("button", name="Forget key").click()
    expect(page.get_by_role("dialog")).to_contain_text("asks for a key")


def test_only_a_job_that_is_looked_at_holds_a_connection(visitor: Visitor, service: Service):
    """Browsers have six to a service, for all tabs: the seventh page would not come."""
    hide = """
    Object.defineProperty(document, "hidden", { get: () => window.away === true });
    window.look = (away) => {
      window.away = away;
      document.dispatchEvent(new Event("visibilitychange"));
    };
    """
    # The last one waits for the others.
    jobs = [service.submit(GEAR.read_bytes(), "long.gcode", fresh="true") for _ in range(4)]
    job = jobs[-1]
    with service.api.stream("GET", f"/v1/jobs/{job}/events") as events:
        next(events.iter_raw())  # it is there
        page = visitor.open("#/jobs", script=hide)
        visitor.expected.add("ERR_ABORTED")
        with page.expect_request("**/events"):
            page.goto(f"{visitor.url}/#/jobs/{job}")
        with page.expect_event("requestfailed", lambda failed: failed.url.endswith("/events")):
            page.evaluate("look(true)")
        with page.expect_response(re.compile(rf"/v1/jobs/{job}$")):
            pass  # it is asked for now and then
        with page.expect_request("**/events"):
            page.evaluate("look(false)")
    page.close()
    for job in jobs:
        service.api.delete(f"/v1/jobs/{job}")


def test_a_stream_that_falls_silent_is_left(visitor: Visitor):
    """As on a phone that came into another network: browsers may not notice for minutes."""
    (example,) = JobView.model_config["json_schema_extra"]["examples"]
    shares = iter([0.42, *[0.9] * 100])

    def answer(route: Route) -> None:
        job = example | {"progress": next(shares)}
        route.fulfill(body=json.dumps(job), content_type="application/json")

    page = visitor.open("#/")
    page.clock.install()
    page.route(re.compile(rf"/v1/jobs/{example['id']}$"), answer)
    page.route("**/events", lambda _: None)
    with page.expect_request("**/events"):
        page.goto(f"{visitor.url}/#/jobs/{example['id']}")
    panel = page.get_by_role("region", name="Progress")
    expect(panel).to_contain_text("42 %")
    page.clock.fast_forward(50_000)
    expect(panel).to_contain_text("90 %")


@pytest.mark.parametrize(
    ("job", "said"),
    [
        ({"eta_s": 42.0}, "45 s left"),
        ({"stage": STAGE, "eta_s": None}, "Time left is not known yet"),
        ({"attempt": 2, "losses": 0}, "restarted, because the service was restarted"),
        ({"attempt": 3, "losses": 1}, "restarted, because its worker was lost"),
    ],
)
def test_a_job_says_how_it_is_with_it(visitor: Visitor, job: dict[str, Any], said: str):
    (example,) = JobView.model_config["json_schema_extra"]["examples"]
    running = example | {"eta_s": None} | job

    def answer(route: Route) -> None:
        if route.request.url.endswith("/events"):
            body = f"event: job\ndata: {json.dumps(running)}\n\n"
            route.fulfill(body=body, content_type="text/event-stream")
        else:
            route.fulfill(body=json.dumps(running), content_type="application/json")

    page = visitor.open("#/")
    page.route(re.compile(rf"/v1/jobs/{running['id']}(/events)?$"), answer)
    page.goto(f"{visitor.url}/#/jobs/{running['id']}")
    panel = page.get_by_role("region", name="Progress")
    expect(panel).to_contain_text(said)
    expect(panel).to_contain_text(running["stage"].capitalize())


def test_a_result_is_sent_to_a_printer(visitor: Visitor, tmp_path: Path):
    file = tmp_path / "wheel.gcode"
    file.write_bytes(PART.partition(b";LAYER:2\n")[0])
    with octoprint(key="k") as host:
        listed = tmp_path / "printers.toml"
        listed.write_text(
            f'[printer.left]\nkind = "octoprint"\nurl = "{host.url}/octo"\nmachine = "ender3"\n'
            f'api_key = "k"\n[printer.right]\nkind = "octoprint"\nurl = "{host.url}/octo"\n'
            'machine = "voron-v0"\nstart = true\n'
        )
        with running(tmp_path / "farm", STILLPATH_PRINTERS=str(listed)) as farm:
            page = visitor.open(at=farm.url, viewport={"width": 360, "height": 740})
            goal = page.get_by_label("When it is done")
            expect(goal).to_be_hidden()
            choose_machine(page, "annex-k3")
            expect(goal).to_be_hidden()
            choose_machine(page, "voron-v0")
            expect(goal.get_by_role("option")).to_have_text(
                [re.compile("waits"), "Send it to right", "Send it to right, and print it"]
            )
            goal.select_option("Send it to right")
            choose_machine(page, "ender3")
            expect(goal.get_by_role("option")).to_have_text(
                [re.compile("waits"), "Send it to left"]
            )
            goal.select_option("Send it to left")
            page.locator("input[type=file]").set_input_files(file)
            visitor.shoot(page, "new-job-printer")
            page.get_by_role("button", name="Compensate").click()
            expect(page.get_by_text("the printer left")).to_be_visible()
            until(lambda: uploads(host), 240.0)
            page.close()  # else it would miss the service
        (sent,) = uploads(host)
        assert b"wheel.stillpath.gcode" in sent.body
