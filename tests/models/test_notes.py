"""Notes, and the warnings among them."""

from __future__ import annotations

from stillpath.models.notes import WarningNote, by_file, parted


def test_warnings_are_told_apart_by_what_they_are() -> None:
    plain = by_file([("a.csv", "20 Hz taken"), ("warning: b.csv", "20 Hz taken")])
    warned = by_file([("a.csv", WarningNote("its range ended")), ("a.csv", "its range")])
    notes, warnings = parted([*plain, *warned])
    assert notes == ("a.csv, warning: b.csv: 20 Hz taken", "a.csv: its range")
    assert warnings == ("a.csv: its range ended",)
    assert type(warnings[0]) is str
