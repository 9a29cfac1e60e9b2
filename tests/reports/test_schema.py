"""The published schema of report.json."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from stillpath.reports import report_schema
from stillpath.reports.schema import schema_text
from tests.service.synthetic import make_result

PUBLISHED = Path(__file__).parents[2] / "docs" / "report.schema.json"


def test_what_is_published_is_current() -> None:
    assert PUBLISHED.read_text(encoding="utf-8") == schema_text(), (
        "write it anew: python -m stillpath.reports > docs/report.schema.json"
    )


def test_every_field_is_described_with_its_unit() -> None:
    schema = report_schema()
    units = {"_um": "um", "_s": "s]", "_mm": "mm", "_hz": "Hz", "_bytes": "bytes", "_s2": "mm/s^2"}
    for model in [schema, *schema["$defs"].values()]:
        assert model["description"]
        for name, field in model["properties"].items():
            assert field.get("description"), name
            for suffix, unit in units.items():
                if name.endswith(suffix) and not name.endswith("_per_s"):
                    assert unit in field["description"], name


def test_reports_follow_it() -> None:
    document: dict[str, Any] = json.loads(make_result().model_dump_json())
    document["track"]["contour_rms_um"]["before"][50] = 0.0  # no pipeline writes a gap
    schema = report_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    validator = jsonschema.Draft202012Validator(schema)
    validator.validate(document)
    with pytest.raises(jsonschema.ValidationError):
        validator.validate(document | {"pieces": "many"})
