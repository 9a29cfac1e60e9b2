"""Which addresses are sent to, and which never."""

from __future__ import annotations

import ipaddress
import socket
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stillpath.service.deliveries.targets import (
    TargetRefused,
    Unresolved,
    addresses_of,
    check_webhook,
    read_url,
)
from stillpath.service.settings import Settings


def settings(*targets: str, secret: str | None = "s" * 16) -> Settings:
    return Settings(data_dir=Path("unused"), webhook_targets=list(targets), webhook_secret=secret)


LISTED = settings("hooks.example", "hub.local:8443", "http://lan.local:8080", "localhost:9000")


@pytest.mark.parametrize(
    "url",
    [
        *("https://hooks.example/x?y=1", "https://HOOKS.example:443/", "https://hooks.example./x"),
        *("https://hub.local:8443", "http://lan.local:8080/a", "http://localhost:9000/"),
        "https://localhost:9000/",
    ],
)
def test_what_is_listed_is_allowed(url: str):
    assert check_webhook(url, LISTED).host in (
        "hooks.example",
        "hub.local",
        "lan.local",
        "localhost",
    )


@pytest.mark.parametrize(
    "url",
    [
        # Not listed: host, port, scheme.
        *("https://other.example/", "https://sub.hooks.example/"),
        *("https://hooks.example.evil.net/", "https://hooks.example:8443/"),
        *("http://hooks.example/", "http://hooks.example:443/", "https://hub.local/"),
        *("https://lan.local:8080/", "http://lan.local/", "http://localhost/"),
        *("http://127.0.0.1:9000/", "http://[::1]:9000/", "http://2130706433:9000/"),
        *("http://0x7f.1:9000/", "http://169.254.169.254/latest/meta-data/"),
        # Told apart by some readers only.
        *("https://user@hooks.example/", "https://hooks.example@evil.net/"),
        *("https://user:pass@hooks.example/", "https://evil.net\\@hooks.example/"),
        *("https://hooks.example\\.evil.net/", "https://hooks.example#@evil.net/"),
        *("https://hooks.example /", "https://hooks.example/\r\nX: y", "https://hooks.example\t/"),
        *("https://höoks.example/", "https://hooks%2eexample/", "https://hooks.example:0/"),
        *("https://hooks.example:99999/", "https://hooks.example:4 43/", "https://[::1/"),
        *("https:///x", "https:hooks.example", "//hooks.example/", "hooks.example"),
        *("ftp://hooks.example/", "file:///etc/passwd", "gopher://hooks.example/"),
        *("javascript:alert(1)", ""),
        "https://hooks.example/" + "a" * 2000,
    ],
)
def test_all_else_is_refused(url: str):
    with pytest.raises(TargetRefused):
        check_webhook(url, LISTED)


def test_nothing_is_allowed_by_default_or_without_a_secret():
    with pytest.raises(TargetRefused, match="WEBHOOK_TARGETS"):
        check_webhook("https://hooks.example/", settings())
    with pytest.raises(TargetRefused, match="WEBHOOK_SECRET"):
        check_webhook("https://hooks.example/", settings("hooks.example", secret=None))


@given(st.text(max_size=80) | st.from_regex(r"https?://[\x00-\xff]{0,30}/", fullmatch=True))
def test_any_text_is_refused_or_is_the_listed_host(url: str):
    try:
        target = check_webhook(url, LISTED)
    except TargetRefused:
        return
    assert str(target) in (
        "https://hooks.example",
        "https://hub.local:8443",
        "http://lan.local:8080",
        "http://localhost:9000",
        "https://localhost:9000",
    )


def stands_for(*addresses: str):
    def resolve(host: str, port: int, **_: object):
        family = {4: socket.AF_INET, 6: socket.AF_INET6}
        return [
            (family[ipaddress.ip_address(a).version], socket.SOCK_STREAM, 6, "", (a, port))
            for a in addresses
        ]

    return resolve


TARGET = read_url("https://hooks.example/")


@pytest.mark.parametrize(
    "address",
    [
        *("127.0.0.1", "127.8.9.10", "::1", "::ffff:127.0.0.1", "64:ff9b::7f00:1", "2002:7f00:1::"),
        *("169.254.169.254", "::ffff:169.254.169.254", "64:ff9b::a9fe:a9fe", "fe80::1"),
        *("fd00:ec2::254", "100.100.100.200", "168.63.129.16", "192.0.0.192", "0.0.0.0", "::"),
        *("224.0.0.251", "ff02::1", "255.255.255.255", "240.0.0.1"),
    ],
)
def test_a_listed_name_does_not_lead_to_a_forbidden_address(address: str):
    with pytest.raises(TargetRefused, match=r"hooks\.example"):
        addresses_of(TARGET, resolve=stands_for(address))


def test_forbidden_addresses_are_left_out():
    found = addresses_of(TARGET, resolve=stands_for("fe80::1", "192.168.1.7", "127.0.0.1"))
    assert found == ["192.168.1.7"]


def test_this_computer_must_be_named_or_meant():
    local = read_url("http://localhost:9000/")
    assert addresses_of(local, resolve=stands_for("127.0.0.1", "::1")) == ["127.0.0.1", "::1"]
    assert addresses_of(TARGET, loopback=True, resolve=stands_for("127.0.0.1")) == ["127.0.0.1"]
    with pytest.raises(TargetRefused):
        addresses_of(TARGET, loopback=True, resolve=stands_for("169.254.169.254"))


def test_an_unknown_name_is_tried_again_later():
    with pytest.raises(Unresolved):
        addresses_of(read_url("https://nobody.invalid/"))
