"""The report says how a file can be printed: as a file, live, or why not live."""

from __future__ import annotations

import re

from stillpath.pipeline.result import PrintWay, Result
from stillpath.reports.report import render_report
from tests.service.synthetic import make_result


def way(name: str, rms_um: float, range_um: tuple[float, float] | None = None) -> PrintWay:
    return PrintWay(
        name=name,
        contour_rms_um=rms_um,
        contour_range_um=range_um,
        contour_max_um=9.0,
        time_s=600.0,
        file_bytes=645_932,
        needs=["a printer <really>"],
        lacks=["It does not fly"],
    )


def text_of(result: Result) -> str:
    body = render_report(result).split("<main>")[1].split("<script")[0]
    return " ".join(re.sub(r"<[^>]+>", " ", body).split())


def test_both_ways_stand_side_by_side() -> None:
    ways = [way("file", 0.92, (0.92, 11.0)), way("live", 1.23)]
    result = make_result().model_copy(update={"ways": ways})
    said = text_of(result)
    assert "Two ways to print it Print it as a file" in said
    assert "0.92 µm; all plants 0.92 to 11.0 µm Largest 9.00 µm Print time 10 min 00 s" in said
    assert "1.23 µm Largest" in said
    assert "0.65 MB You need a printer &lt;really&gt; What it does not do It does not fly" in said


def test_a_live_report_tells_of_no_written_file() -> None:
    live = {"ways": [way("live", 1.23)], "settings": {"method": "live"}}
    said = text_of(make_result().model_copy(update=live))
    assert "How to print it Print it live" in said
    assert "Print it as a file" not in said
    assert "written file" not in said
    assert "Reverted to the sliced lines" not in said
    assert "filtered as the extra inside Klipper does it" in said


def test_what_cannot_be_printed_live_has_one_line() -> None:
    said = text_of(make_result().model_copy(update={"not_live": "machine m runs marlin"}))
    assert "It cannot be printed live: machine m runs marlin." in said
    assert "Print it" not in said
    assert "printed live" not in text_of(make_result())
