"""The JSON schema of report.json; docs/report.schema.json is its text."""

from __future__ import annotations

import json
from typing import Any

from stillpath.pipeline.result import Result

__all__ = ["report_schema", "schema_text"]


def report_schema() -> dict[str, Any]:
    """Return the schema (JSON Schema 2020-12) of report.json, every field with its unit."""
    schema = Result.model_json_schema(mode="serialization")
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


def schema_text() -> str:
    """Return the schema as it is published."""
    return json.dumps(report_schema(), indent=2, ensure_ascii=False) + "\n"
