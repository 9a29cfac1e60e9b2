"""What variables of the environment may hold."""

from __future__ import annotations

import pytest

from stillpath.applications.machines.settings import ENV_PREFIX, MachineSettings
from stillpath.cli.own_machines import service_settings
from stillpath.models.errors import ModelError
from stillpath.service.settings import Settings


@pytest.mark.parametrize(
    ("text", "read"),
    [
        ("a.example", ["a.example"]),
        ("a.example, b.example,", ["a.example", "b.example"]),
        (' ["a.example", "b.example"]', ["a.example", "b.example"]),
        ("*", ["*"]),
        ("", []),
    ],
)
def test_a_list_may_be_json_or_have_commas(
    monkeypatch: pytest.MonkeyPatch, text: str, read: list[str]
):
    for name in ("ALLOWED_HOSTS", "WEBHOOK_TARGETS"):
        monkeypatch.setenv(f"STILLPATH_{name}", text)
    monkeypatch.setenv("STILLPATH_TRUSTED_PROXIES", "127.0.0.1,10.0.0.0/8")
    settings = service_settings()
    assert settings.allowed_hosts == settings.webhook_targets == read
    assert settings.trusted_proxies == ["127.0.0.1/32", "10.0.0.0/8"]


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("ALLOWED_HOSTS", "['a']", 'write for instance a,b or ["a", "b"]'),
        ("TRUSTED_PROXIES", "nginx", "is not an address or network"),
        ("WEBHOOK_SECRET", "hunter2", "has 7 characters, which can be guessed; give 16 or more"),
    ],
)
def test_what_cannot_be_meant_is_named(
    monkeypatch: pytest.MonkeyPatch, name: str, text: str, said: str
):
    monkeypatch.setenv(f"STILLPATH_{name}", text)
    with pytest.raises(ModelError) as caught:
        service_settings()
    assert str(caught.value).startswith(f"STILLPATH_{name}: ")
    assert said in str(caught.value)
    assert "hunter2" not in str(caught.value)


def test_an_empty_variable_is_none(monkeypatch: pytest.MonkeyPatch):
    """Compose passes some on: nothing is signed with a key that everybody knows, nothing is kept
    in whatever folder the service was started in.
    """
    names = [f"{ENV_PREFIX}{field.upper()}" for field in Settings.model_fields]
    for name in names:
        monkeypatch.delenv(name, raising=False)
    expected = service_settings(), MachineSettings.from_environment()
    for name in names:
        monkeypatch.setenv(name, "")
    assert (service_settings(), MachineSettings.from_environment()) == expected


def test_what_workers_elsewhere_cannot_reach_is_named_with_its_value(
    monkeypatch: pytest.MonkeyPatch,
):
    """The message said to set the variable that was set, to a folder."""
    monkeypatch.setenv("STILLPATH_SCHEDULER", "tcp://10.0.0.1:8786")
    monkeypatch.setenv("STILLPATH_STORAGE_URL", "file:///mnt/jobs")
    with pytest.raises(ModelError) as refused:
        service_settings()
    said = str(refused.value)
    assert "STILLPATH_DATABASE_URL is not set (postgresql://...)" in said
    assert "STILLPATH_STORAGE_URL is file:///mnt/jobs (s3://bucket/prefix)" in said
