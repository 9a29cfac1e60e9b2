"""The report: what stands in it, that it asks nobody, and that a name cannot become code."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from pathlib import Path

import pytest

from stillpath.cli.console import budget_line
from stillpath.pipeline.result import BudgetFigures, Result
from stillpath.reports import headline_figures, render_report, write_report
from tests.service.synthetic import make_result


@pytest.fixture(scope="module")
def result() -> Result:
    return make_result(layers=6)


@pytest.fixture(scope="module")
def page(result: Result) -> str:
    return render_report(result)


def embedded(page: str) -> dict:
    (text,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', page)
    return json.loads(text)


def test_both_files_are_written_whole(result: Result, tmp_path: Path):
    write_report(result, tmp_path / "a" / "b")
    write_report(result, tmp_path / "a" / "b")  # a second time: replaced
    assert sorted(path.name for path in (tmp_path / "a" / "b").iterdir()) == [
        "report.html",
        "report.json",
    ]
    text = (tmp_path / "a" / "b" / "report.json").read_text().replace("null", '"nan"')
    optional = ("contour_range_um", "contour_friction_um", "contour_rubbing_um", "selected_rms_um")
    for name in optional:
        text = text.replace(f'"{name}":"nan"', f'"{name}":null')
    read = Result.model_validate(
        json.loads(text) | {"budget": None, "advice": None, "last_check": None}
    )
    assert read.channels == result.channels
    assert read.put_back == result.put_back


def test_a_name_that_is_not_utf8_can_be_written(result: Result, tmp_path: Path):
    name = b"T\xfcr \xc3\xa4.gcode".decode("utf-8", "surrogateescape")
    write_report(Result(**{**dict(result), "source_name": name}), tmp_path)
    for file in ("report.json", "report.html"):
        assert "T?r ä.gcode" in (tmp_path / file).read_text("utf-8")


def test_headline_and_table(page: str):
    assert "23 times smaller" in page
    assert "153" in page
    assert "+0.06 % against the original" in page
    assert "missed its command by 13.1 µm" in page
    assert "The firmware&#39;s shaper is off" in page


def test_a_set_of_plants_says_a_range(result: Result):
    ranges = {"before": (120.0, 190.0), "after": (4.21, 17.3), "shaper": (20.0, 41.0)}
    channels = [c.model_copy(update={"contour_range_um": ranges[c.name]}) for c in result.channels]
    page = render_report(result.model_copy(update={"channels": channels}))
    assert "4.21 to 17.3" in page
    assert "20.0 to 41.0" in page
    assert "all plants that explain" in page
    assert "times smaller" not in page
    assert "if guides rub" not in page


def test_what_guides_that_rub_would_do_stands_beside_the_range(result: Result):
    most = {"before": 191.2, "after": 27.4, "shaper": 45.6}
    channels = [
        c.model_copy(update={"contour_range_um": (4.21, 17.3), "contour_rubbing_um": most[c.name]})
        for c in result.channels
    ]
    page = render_report(result.model_copy(update={"channels": channels}))
    assert "up to 27.4 (191 as sliced)" in page
    assert "up to 45.6 if guides rub" in page


def test_nothing_is_fetched(page: str):
    assert "default-src 'none'" in page
    references = re.findall(r"https?://[^\s\"'<>]+", page)
    assert set(references) <= {"http://www.w3.org/2000/svg"}  # a namespace, not an address
    assert re.findall(r"(?:src|href)=(?!\"data:)|@import|url\(|fetch\(", page) == []
    assert re.findall(r"\sstyle=|\son\w+=", page) == []  # the policy would block them


@pytest.mark.parametrize("element", ["style", "script"])
def test_the_policy_knows_its_own_code(page: str, element: str):
    (code,) = re.findall(rf"<{element}>(.*?)</{element}>", page, re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(code.encode()).digest()).decode()
    assert f"{element}-src 'sha256-{digest}'" in page


def test_names_cannot_become_code(result: Result):
    evil = "</script><script>alert(1)</script><!--"
    changed = result.model_copy(
        update={
            "source_name": evil,
            "warnings": [evil],
            "layers": [group.model_copy(update={"name": evil}) for group in result.layers],
            "features": [group.model_copy(update={"name": evil}) for group in result.features],
            "channels": [c.model_copy(update={"label": evil}) for c in result.channels],
        }
    )
    page = render_report(changed)
    assert "<script>alert" not in page
    assert embedded(page)["layers"][0]["name"] == evil
    assert embedded(page)["channels"][0]["label"] == evil.split(" (")[0]


def test_the_scale_is_shared_and_round(page: str, result: Result):
    data = embedded(page)
    worst = max(max(view.contour_um["before"]) for view in result.layer_views)
    assert 0.3 * worst < data["scale_um"] <= 2 * worst
    assert data["scale_um"] in {s * 10**p for s in (1, 1.5, 2, 3, 4, 5, 6, 8) for p in (0, 1, 2)}


def test_gaps_stay_gaps(page: str):
    assert embedded(page)["track"]["values"]["before"][50] is None


def test_a_simulation_promises_nothing():
    page = render_report(make_result(channels=("before", "shaper"), layers=1))
    assert '<p class="note">as sliced</p>' in page
    for word in ("times smaller", "Put back", "The written file", "Compensated"):
        assert word not in page


def test_a_result_without_motion_still_renders(result: Result):
    empty = result.model_copy(
        update={
            "layers": [],
            "features": [],
            "layer_views": [],
            "stages": [],
            "time_s": 0.0,
            "original_time_s": 0.0,
            "put_back": [],
            "pieces": 0,
        }
    )
    assert "Nothing: no piece of the file was to be compensated" in render_report(empty)


def test_a_budget_says_whether_the_shaper_is_quicker(result: Result):
    budget = BudgetFigures(
        budget_um=10.0,
        saved_share=0.3,
        shaper_time_s=408.9,
        saved_share_against_shaper=-0.018,
        classes=[],
    )
    for share, words in (
        (-0.018, "1.8 % more than with"),
        (0.018, "1.8 % less than with"),
        (-0.0002, "the same as with"),
    ):
        found = budget.model_copy(update={"saved_share_against_shaper": share})
        assert words in render_report(result.model_copy(update={"budget": found}))
        assert words in budget_line(found)
        # Where nothing could be quicker, waits of the firmware make the file a little slower.
        found = budget.model_copy(update={"saved_share": share})
        words = words.replace("with", "the sliced file")
        assert words in render_report(result.model_copy(update={"budget": found}))
        assert words in budget_line(found)


@pytest.mark.parametrize(
    ("where", "of"), [("visible", "visible surfaces"), ("walls", "outer walls")]
)
def test_a_part_that_is_compensated_is_compared_with_itself(result: Result, where: str, of: str):
    """Not with the whole print as sliced, as the list of jobs did."""
    selected = {"before": 13.2, "after": 0.84, "shaper": 2.66}
    channels = [
        c.model_copy(update={"selected_rms_um": selected[c.name], "contour_range_um": (0.84, 10.1)})
        for c in result.channels
    ]
    figures = headline_figures(channels)
    assert (figures["before"], figures["after"], figures["range"]) == (13.2, 0.84, (0.84, 10.1))
    settings = {**result.settings, "where": where}
    part = result.model_copy(update={"channels": channels, "settings": settings})
    assert f"Contour error of {of}, rms" in render_report(part)


def test_features_have_the_names_of_people_in_both_files(result: Result, page: str):
    titles = {f["title"] for f in json.loads(result.model_dump_json())["features"]}
    assert "outer wall (External perimeter)" in titles
    assert all(title in page for title in titles)
