"""A Ray cluster at which anybody may run code is not used without a word."""

from __future__ import annotations

import pytest

from edp.errors import ConfigError
from edp.jobs import cluster
from edp.workflows.search.runner import Resources


@pytest.mark.parametrize(
    "address", ["10.0.0.1:6379", "auto", "somewhere", "[2001:db8::1]:6379", "0.0.0.0:6379", "127.evil.example:1"]
)
@pytest.mark.parametrize("mode", [None, "", "disabled"])
def test_an_open_cluster_is_refused_before_anything_is_sent(address, mode, monkeypatch):
    monkeypatch.delenv("RAY_AUTH_MODE", raising=False)
    if mode is not None:
        monkeypatch.setenv("RAY_AUTH_MODE", mode)
    monkeypatch.setattr(cluster, "_ray", lambda: pytest.fail("Ray was reached"))
    with pytest.raises(ConfigError, match=r"without a token.*RAY_AUTH_MODE=token.*--open-cluster"):
        Resources(cluster=address).open()


class Reached(Exception):
    pass


def reached() -> None:
    raise Reached


@pytest.mark.parametrize(
    ("address", "mode", "allowed"),
    [
        ("10.0.0.1:6379", "token", False),
        ("10.0.0.1:6379", None, True),
        ("127.0.0.1:6379", None, False),
        ("localhost:6379", None, False),
        ("[::1]:6379", None, False),
    ],
)
def test_a_token_loopback_or_a_word_opens_the_way(address, mode, allowed, monkeypatch):
    monkeypatch.delenv("RAY_AUTH_MODE", raising=False)
    if mode is not None:
        monkeypatch.setenv("RAY_AUTH_MODE", mode)
    monkeypatch.setattr(cluster, "_ray", reached)
    with pytest.raises(Reached):
        Resources(cluster=address, open_cluster=allowed).open()
