"""Machines on the page: plants over frequency, revisions, measurements."""

from __future__ import annotations

import json
import re
from pathlib import Path

from playwright.sync_api import expect

from stillpath.applications.identification.page import interval_text
from stillpath.reports.pages import um_text
from tests.applications.test_machine_config_g import CONFIG_G
from tests.applications.test_machine_m503 import M503
from tests.models.identification.recordings import QUICK_QUERY, quick_raw
from tests.web.machines import put
from tests.web.served import Service
from tests.web.visitor import Visitor


def test_machines_are_listed_and_found(visitor: Visitor, service: Service):
    put(service, "listed")
    page = visitor.open("#/machines")
    expect(page.get_by_role("link", name="My printer").first).to_be_visible()
    search = page.get_by_role("searchbox", name="Find a machine")
    search.fill("prusa")
    expect(page.locator("main")).to_contain_text("No machine has such a name.")
    search.fill("voron 2")
    expect(page.locator(".cards .card")).to_have_count(1)
    visitor.shoot(page, "machines")
    page.get_by_role("link", name=re.compile("Voron 2.4")).click()
    expect(page.get_by_role("heading", name="X axis")).to_be_visible()
    expect(page.get_by_role("region", name="Modes of the X axis")).to_contain_text("65.29 ± 0.60")
    expect(page.locator(".plot canvas")).to_have_count(2)
    visitor.shoot(page, "machine-builtin")


def test_revisions_are_compared_approved_and_brought_back(visitor: Visitor, service: Service):
    put(service, "changed")
    page = visitor.open("#/machines/changed")
    page.get_by_role("button", name="Show differences").click()
    expect(page.get_by_role("region", name="Differences from 1 to 2")).to_contain_text(
        "4321 (-13.6 %)"
    )
    expect(page.get_by_role("cell", name="-13.6 %", exact=True)).to_be_visible()
    page.get_by_role("button", name="Approve revision 2").click()
    dialog = page.get_by_role("dialog")
    dialog.get_by_label("Your name").fill("clara")
    visitor.shoot(page, "machine-approve")
    dialog.get_by_role("button", name="Approve").click()
    revisions = page.get_by_role("region", name="Revisions, newest first")
    expect(revisions).to_contain_text("clara")
    expect(page.locator("h1")).to_be_focused()
    page.get_by_role("button", name="Go back to revision 1").click()
    page.get_by_role("dialog").get_by_role("button", name="Go back").click()
    expect(revisions).to_contain_text("Back to 1")
    expect(page.locator("h1")).to_be_focused()
    page.get_by_text("Travel and limits").click()
    expect(page.locator("dl.facts")).to_contain_text("Max accel")
    expect(page.locator("dl.facts")).not_to_contain_text("4321")
    history = service.api.get("/v1/machines/changed/revisions").json()["revisions"]
    assert [r["restored"] for r in history] == [None, None, 1]
    assert history[1]["approval"]["author"] == "clara"
    visitor.shoot(page, "machine-own")


def test_a_measurement_is_tried_then_kept(visitor: Visitor, service: Service, tmp_path: Path):
    put(service, "measured")
    recording = quick_raw()
    file = tmp_path / recording.name
    file.write_bytes(recording.content)
    page = visitor.open("#/machines/measured")
    page.locator("form", has_text="Choose measurements").locator(
        "input[type=file]"
    ).set_input_files(file)
    page.get_by_text("How the test was run").click()
    expect(page.get_by_text("only what lies between From and To is fitted")).to_be_visible()
    expect(page.get_by_label("To, Hz")).to_have_attribute("placeholder", "135 (133.3)")
    for name, value in QUICK_QUERY.items():
        page.locator(f"#test-{name}").fill(str(value))
    page.get_by_label("The frame does not move").check()
    with page.expect_request("**/measurements?*") as sent:
        page.get_by_role("button", name="Look at the fit").click()
    assert "frame_firm=true" in sent.value.url
    assert "sensor_turned" not in sent.value.url
    expect(page.get_by_role("heading", name="The fit")).to_be_focused()
    modes = page.get_by_role("region", name="Modes of the X axis").last
    expect(modes).to_contain_text(re.compile(r"4[12]\.\d\d ± 0\.\d\d"))
    visitor.shoot(page, "machine-fit")
    assert len(service.api.get("/v1/machines/measured/revisions").json()["revisions"]) == 2
    page.get_by_role("button", name="Keep as the next revision").click()
    expect(page.get_by_role("heading", name="Measured and fitted")).to_be_visible()
    assert len(service.api.get("/v1/machines/measured/revisions").json()["revisions"]) == 3
    visitor.shoot(page, "machine-identified")


def test_a_fit_is_kept_under_the_name_it_was_looked_at(
    visitor: Visitor, service: Service, tmp_path: Path
):
    recording = quick_raw()
    file = tmp_path / recording.name
    file.write_bytes(recording.content)
    page = visitor.open("#/machines/ender3")
    page.locator("input[type=file]").set_input_files(file)
    page.get_by_label("Name of your machine").fill("looked-at")
    page.get_by_text("How the test was run").click()
    for name, value in QUICK_QUERY.items():
        page.locator(f"#test-{name}").fill(str(value))
    page.get_by_role("button", name="Look at the fit").click()
    keep = page.get_by_role("button", name="Keep as looked-at")
    expect(keep).to_be_visible()
    page.get_by_label("Name of your machine").fill("another")
    page.locator("#test-max_freq").fill("7")
    keep.click()
    expect(page.get_by_role("heading", name="Measured and fitted")).to_be_visible()
    assert page.url.endswith("#/machines/looked-at")
    assert service.api.get("/v1/machines/looked-at").status_code == 200
    assert service.api.get("/v1/machines/another").status_code == 404


def test_figures_are_written_as_by_command_line_and_reports(visitor: Visitor):
    page = visitor.open()
    module = page.locator("script[type=module]").get_attribute("src") or ""
    intervals = [(47.0, None, 2), (46.9996, 0.0002, 2), (46.9996, 1e-9, 2), (0.0612, 0.0007, 4)]
    micrometres = [0.0, 0.994, 9.994, 9.996, 10.04, 99.94, 99.96, 100.4, 1234.6]
    shown = page.evaluate(
        "async ([from, intervals, sizes]) => { const { interval, um } = await import(from);"
        " return [intervals.map((c) => interval(...c)), sizes.map(um)]; }",
        [f"/{module.replace('app.js', 'lib/format.js')}", intervals, micrometres],
    )
    assert shown[0] == [interval_text(*case) for case in intervals]
    assert shown[1] == [um_text(size) for size in micrometres]


def test_a_measurement_that_cannot_be_used_is_named(visitor: Visitor, tmp_path: Path):
    file = tmp_path / "raw_data_x_broken.csv"
    file.write_text("#time,accel_x,accel_y,accel_z\n0,1,2\n")
    visitor.expected = {422}
    page = visitor.open("#/machines/ender3")
    page.locator("input[type=file]").set_input_files(file)
    page.get_by_label("Name of your machine").fill("mine")
    fold = page.get_by_text("How the test was run")
    fold.click()
    page.locator("#test-min_freq").fill("-5")
    fold.click()
    page.get_by_role("button", name="Look at the fit").click()
    expect(page.locator("#test-min_freq")).to_be_focused()
    page.locator("#test-min_freq").fill("")
    page.get_by_role("button", name="Look at the fit").click()
    expect(page.get_by_role("alert")).to_contain_text("raw_data_x_broken.csv")
    expect(page.get_by_role("alert")).to_contain_text("Identification not possible")


def test_a_machine_is_made_of_what_marlin_answers(visitor: Visitor, tmp_path: Path):
    file = tmp_path / "m503.txt"
    file.write_text(M503)
    page = visitor.open("#/machines", viewport={"width": 390, "height": 844})
    form = page.locator("form", has_text="M503")
    expect(page.get_by_label("How far X, Y and Z reach")).to_be_hidden()
    form.locator("input[type=file]").set_input_files(file)
    form.get_by_label("Name of your machine").fill("of-m503")
    page.get_by_label("How far X, Y and Z reach").fill("235x235x250")
    visitor.shoot(page, "machine-settings")
    page.get_by_role("button", name="Make the machine").click()
    expect(page.get_by_role("heading", name="of-m503")).to_be_visible()
    expect(page.locator("p.lead")).to_contain_text("marlin")
    file.write_text(M503.replace("P510", "P900"))
    again = page.locator("form", has_text="M503")
    again.locator("input[type=file]").set_input_files(file)
    page.get_by_role("button", name="Keep the settings as the next revision").click()
    expect(page.get_by_role("button", name="Show differences")).to_be_visible()
    visitor.shoot(page, "machine-of-m503")


def test_a_machine_is_brought_up_to_date_by_its_printer_cfg(visitor: Visitor, tmp_path: Path):
    file = tmp_path / "printer.cfg"
    config = "[printer]\nkinematics: cartesian\nmax_velocity: 300\nmax_accel: 3000\n" + "".join(
        f"[stepper_{axis}]\nposition_max: 200\n" for axis in "xyz"
    )
    file.write_text(config)
    page = visitor.open("#/machines", viewport={"width": 390, "height": 844})
    form = page.locator("form", has=page.locator("#settings-name"))
    form.locator("input[type=file]").set_input_files(file)
    form.get_by_label("Name of your machine").fill("of-config")
    page.get_by_role("button", name="Make the machine").click()
    expect(page.get_by_role("heading", name="of-config")).to_be_visible()
    file.write_text(config.replace("3000", "5000"))
    again = page.locator("form", has_text="Choose printer.cfg")
    again.locator("input[type=file]").set_input_files(file)
    page.get_by_role("button", name="Keep the settings as the next revision").click()
    expect(page.get_by_role("button", name="Show differences")).to_be_visible()
    visitor.shoot(page, "machine-of-config")


def test_a_machine_is_made_of_a_config_g(visitor: Visitor, tmp_path: Path):
    """It has Marlin's M92 and M203, too, and says by itself how far the axes reach."""
    file = tmp_path / "config.g"
    file.write_text(CONFIG_G)
    page = visitor.open("#/machines", viewport={"width": 390, "height": 844})
    form = page.locator("form", has=page.locator("#settings-name"))
    form.locator("input[type=file]").set_input_files(file)
    form.get_by_label("Name of your machine").fill("of-duet")
    expect(page.get_by_label("How far X, Y and Z reach")).to_be_hidden()
    page.get_by_role("button", name="Make the machine").click()
    expect(page.get_by_role("heading", name="of-duet")).to_be_visible()
    expect(page.locator("p.lead")).to_contain_text("reprapfirmware")
    file.write_text(CONFIG_G.replace("M201 X6000", "M201 X5200"))
    again = page.locator("form", has_text="Choose config.g")
    again.locator("input[type=file]").set_input_files(file)
    page.get_by_role("button", name="Keep the settings as the next revision").click()
    expect(page.get_by_role("button", name="Show differences")).to_be_visible()
    visitor.shoot(page, "machine-of-config-g")


def test_a_new_machine_takes_nobody_s_place(visitor: Visitor, service: Service):
    put(service, "theirs")
    page = visitor.open("#/machines")
    for form in (page.locator(f"form:has(#{name})") for name in ("settings-name", "new-name")):
        field = form.get_by_label("Name of your machine")
        for name, said in {"theirs": "You have", "ender3": "built in", "theirs2": ""}.items():
            field.fill(name)
            assert said in (complaint := field.evaluate("field => field.validationMessage"))
            assert bool(said) == bool(complaint)


def test_what_no_printer_s_settings_are_is_not_read(visitor: Visitor, tmp_path: Path):
    file = tmp_path / "raw_data_x.csv"
    file.write_bytes(b"#time,accel_x,accel_y,accel_z\n" + b"0.1,1.0,2.0,3.0\n" * 300_000)
    page = visitor.open("#/machines")
    form = page.locator("form:has(#settings-name)")
    form.locator("input[type=file]").set_input_files(file)
    expect(form.get_by_role("alert")).to_contain_text("raw_data_x.csv is larger than 4 MB")
    expect(form.get_by_role("button", name="Make the machine")).to_be_disabled()


def test_a_machine_leads_to_a_job_for_it(visitor: Visitor, service: Service):
    put(service, "zz-last")
    page = visitor.open("#/machines/zz-last")
    page.get_by_role("main").get_by_role("link", name="New job").click()
    expect(page.get_by_role("combobox", name="Machine")).to_have_value("My printer")
    expect(page.locator("#machine-hint")).to_contain_text("zz-last")
    # One's own come first, however many are built in.
    page.get_by_role("combobox", name="Machine").fill("")
    page.get_by_role("combobox", name="Machine").press("ArrowDown")
    origins = page.get_by_role("option").all_inner_texts()
    assert [text.endswith("own") for text in origins] == sorted(
        (text.endswith("own") for text in origins), reverse=True
    )


def test_a_phone_lets_any_file_be_chosen(visitor: Visitor):
    """Phones know no type for .gcode and .cfg: where types are asked for, those are greyed out."""
    for view in ("#/", "#/machines", "#/machines/ender3"):
        fields = visitor.open(view).locator("input[type=file]")
        fields.first.wait_for(state="attached")
        assert not any(field.get_attribute("accept") for field in fields.all())


def test_a_document_is_changed_and_given_back(visitor: Visitor, service: Service, tmp_path: Path):
    visitor.expected.add(422)
    put(service, "edited")
    page = visitor.open("#/machines/edited", viewport={"width": 360, "height": 740})
    with page.expect_download() as download:
        page.get_by_role("link", name="Document (JSON)").click()
    document = json.loads(download.value.path().read_text())
    form = page.locator("form", has=page.get_by_role("link", name="Document (JSON)"))
    keep = form.get_by_role("button", name="Keep the document as the next revision")

    def give(name: str, text: str) -> None:
        (tmp_path / name).write_text(text)
        form.locator("input[type=file]").set_input_files(tmp_path / name)
        keep.click()

    give("another.json", json.dumps(document | {"name": "another"}))
    expect(form.get_by_role("alert")).to_contain_text("make both the same")
    give("printer.cfg", "[printer]\n")
    expect(form.get_by_role("alert")).to_contain_text("not JSON")
    document["travel"]["x"]["min_mm"] = -4.0
    give("edited.json", json.dumps(document))
    expect(page.get_by_role("button", name="Approve revision 3")).to_be_visible()
    assert service.api.get("/v1/machines/edited").json()["travel"]["x"]["min_mm"] == -4.0
    visitor.shoot(page, "machine-document")


def test_a_machine_is_deleted(visitor: Visitor, service: Service):
    put(service, "unwanted")
    page = visitor.open("#/machines/unwanted")
    page.get_by_role("button", name="Delete the machine").click()
    page.get_by_role("dialog").get_by_role("button", name="Keep it").click()
    assert service.api.get("/v1/machines/unwanted").status_code == 200
    page.get_by_role("button", name="Delete the machine").click()
    page.get_by_role("dialog").get_by_role("button", name="Delete").click()
    expect(page.get_by_role("heading", name="Machines", exact=True)).to_be_visible()
    assert service.api.get("/v1/machines/unwanted").status_code == 404
