"""compose.yaml is what Compose and the service understand."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from psycopg.pq import Conninfo

from stillpath.applications.machines.settings import ENV_PREFIX
from stillpath.service.database.engine import database_url
from stillpath.service.settings import Settings

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "compose.yaml").read_text()
COMPOSE: dict[str, Any] = yaml.safe_load(TEXT)
SERVICES: dict[str, dict[str, Any]] = COMPOSE["services"]
DEFAULT = re.compile(r"\$\{\w+:-([^}]*)\}")


def environment(service: dict[str, Any]) -> dict[str, str | None]:
    found = service.get("environment", {})
    return {name: DEFAULT.sub(r"\1", value) if value else value for name, value in found.items()}


def ours() -> list[str]:
    return [name for name, service in SERVICES.items() if service["image"] == "stillpath:local"]


@pytest.mark.parametrize("name", ours())
def test_variables_are_settings_with_good_values(name, monkeypatch):
    known = {ENV_PREFIX + field.upper() for field in Settings.model_fields}
    given = environment(SERVICES[name])
    for variable, value in given.items():
        assert variable in known or variable.startswith(("AWS_", "PG")), variable
        if value is not None:
            monkeypatch.setenv(variable, value)
    Settings()


@pytest.mark.parametrize("name", ["api-1", "api-2", "worker"])
def test_the_database_takes_any_password(name, monkeypatch):
    """PGPASSWORD is read by the driver: in an address, part of a password would be the host."""
    for variable, value in SERVICES[name]["environment"].items():
        if value is not None:
            filled = value.replace("${POSTGRES_PASSWORD:-stillpath}", "p@ss/w:rd")
            monkeypatch.setenv(variable, DEFAULT.sub(r"\1", filled))
    url = database_url(Settings())
    assert (url.username, url.password, url.host) == ("stillpath", None, "database")
    read = {option.keyword: option.val for option in Conninfo.get_defaults()}
    assert read[b"password"] == b"p@ss/w:rd"


def test_profiles():
    of_profile = {
        profile: {name for name, service in SERVICES.items() if profile in service["profiles"]}
        for profile in ("one", "scaled")
    }
    assert of_profile["one"] == {"stillpath"}
    assert of_profile["one"] | of_profile["scaled"] == set(SERVICES)
    assert {"api-1", "api-2", "worker", "scheduler", "database", "bucket"} <= of_profile["scaled"]
    assert "COMPOSE_PROFILES=one" in (ROOT / ".env").read_text()


def test_what_is_named_exists():
    for service in SERVICES.values():
        assert set(service.get("networks", ())) <= set(COMPOSE["networks"])
        assert set(service.get("depends_on", ())) <= set(SERVICES)
        for volume in service.get("volumes", ()):
            assert volume.split(":")[0] in COMPOSE["volumes"]


def test_only_loopback_is_published_and_the_scheduler_stays_inside():
    published = [port for service in SERVICES.values() for port in service.get("ports", ())]
    assert len(published) == len(set(published)) + 1  # one node, or the first API
    assert all(port.startswith("127.0.0.1:") for port in published)
    assert COMPOSE["networks"]["inside"] == {"internal": True}
    for name in ("scheduler", "worker", "database", "bucket"):
        assert SERVICES[name]["networks"] == ["inside"]


@pytest.mark.parametrize("name", ours())
def test_least_privilege(name):
    service = SERVICES[name]
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert service["tmpfs"] == ["/tmp"]


@pytest.mark.parametrize("name", list(SERVICES))
def test_memory_and_processes_are_limited(name):
    service = SERVICES[name]
    assert re.fullmatch(r"\d+[mg]", DEFAULT.sub(r"\1", str(service["mem_limit"])))
    assert 64 <= service["pids_limit"] <= 1024


@pytest.mark.parametrize("name", ["scheduler", "worker"])
def test_commands_exist(name):
    from typer.main import get_command

    from stillpath.cli.main import app

    program, command, *arguments = SERVICES[name]["command"]
    assert program == "stillpath"
    found = get_command(app).commands[command]
    options = {option for parameter in found.params for option in parameter.opts}
    assert {argument for argument in arguments if argument.startswith("-")} <= options
