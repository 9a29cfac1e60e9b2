"""What docs/running.md says of settings, commands and figures is so."""

from __future__ import annotations

import re
from pathlib import Path

from stillpath.applications.machines.settings import ENV_PREFIX
from stillpath.service.settings import Settings

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "docs" / "running.md").read_text()


def test_every_setting_is_there_with_its_default():
    rows = dict(re.findall(r"^\| `STILLPATH_(\w+)` \| ([^|]+) \|", TEXT, re.MULTILINE))
    assert set(rows) == {name.upper() for name in Settings.model_fields}
    for name, field in Settings.model_fields.items():
        said = rows[name.upper()].strip().strip("`")
        if field.default_factory is not None:
            assert said == "the user's folder for data"
        elif isinstance(field.default, bool):
            assert said == str(field.default).lower()
        elif isinstance(field.default, int | float):
            assert float(said) == field.default, name
        elif field.default not in (None, []):
            assert said == str(field.default)


def test_no_variable_is_made_up():
    known = {ENV_PREFIX + name.upper() for name in Settings.model_fields}
    known |= {"STILLPATH_SERVER", "STILLPATH_KEY"}
    assert set(re.findall(r"STILLPATH_[A-Z_]+", TEXT)) <= known


def test_commands_exist():
    from typer.main import get_command

    from stillpath.cli.main import app

    commands = get_command(app).commands
    named = set(
        re.findall(r"\bstillpath ([a-z]+)", "\n".join(re.findall(r"```.*?```", TEXT, re.S)))
    )
    assert named <= set(commands)


def test_metrics_exist():
    source = (ROOT / "service" / "api" / "metrics.py").read_text()
    for name in set(re.findall(r"stillpath_[a-z_]+", TEXT)):
        assert re.sub(r"_(total|bucket)$", "", name) in source, name
