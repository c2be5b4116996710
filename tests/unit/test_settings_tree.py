"""The builder of settings: what pydantic would coerce without a word is refused, with the place and the rule."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import pytest

from edp.config.experiment import SETTINGS, Experiment
from edp.errors import ConfigError
from edp.settings.tree import SettingsTree

Pair = tuple[float, float]


@dataclass(frozen=True)
class Inner:
    count: int = 1


@dataclass(frozen=True)
class Outer:
    on: bool = False
    rates: tuple[float, ...] = ()
    pair: Pair = (0.0, 1.0)
    rows: tuple[Pair, ...] = ()
    shares: Mapping[str, float] = field(default_factory=dict)
    inner: Inner = Inner()


TREE = SettingsTree(what="test file", positions={Pair: ("low", "high")})


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"on": 1}, "on = 1: write true or false"),
        ({"on": "yes"}, "on = 'yes': write true or false"),
        ({"rates": [1.0, "2.0"]}, "rates = .1.0, '2.0'.: a text is no number"),
        ({"pair": ["0.1", 0.2]}, r"pair\[low\] = '0.1': a text is no number"),
        ({"pair": [0.1, True]}, r"pair\[high\] = True: true and false are no numbers"),
        ({"pair": [0.1]}, r"pair = \[0.1\] lists 1; a list of 2 must hold \(low, high\)"),
        ({"pair": 0.1}, r"pair = 0.1: a list must hold, in brackets such as \[1, 2\]"),
        ({"shares": {"a": "1"}}, "shares.a = '1': a text is no number"),
        ({"shares": 3}, "shares = 3: a table must hold"),
        ({"inner": {"count": 1.5}}, "inner.count = 1.5: an integer must hold"),
        ({"inner": {"cuont": 1}}, "unknown key 'inner.cuont'; did you mean 'count'"),
    ],
)
def test_wrong_values_are_named_with_place_and_rule(table, message):
    with pytest.raises(ConfigError, match=message) as caught:
        TREE.build(Outer, table, "'a.toml'")
    assert str(caught.value).startswith("test file 'a.toml': 1 problem")


def test_plain_values_come_back_as_they_were_built():
    table = {"on": True, "rates": [1, 2.5], "pair": [0, 2], "rows": [[1, 2]], "shares": {"a": 1}, "inner": {"count": 3}}
    built = TREE.build(Outer, table, "'a.toml'")
    assert built == Outer(True, (1.0, 2.5), (0.0, 2.0), ((1.0, 2.0),), {"a": 1.0}, Inner(3))
    assert TREE.build(Outer, TREE.to_dict(built), "'a.toml'") == built


def test_earlier_keys_of_a_part_are_renamed_unless_its_kind_is_unknown():
    """An unknown kind may be that of a plug-in that is not loaded yet; its keys are its own."""
    for kind in ({"kind": "committee"}, {}):
        renamed = SETTINGS.renamed(Experiment, {"model": {"backbone": {**kind, "near": [1]}}})
        assert renamed == {"model": {"backbone": {**kind, "local_lags": [1]}}}
    foreign = {"model": {"backbone": {"kind": "of_a_plug_in", "near": [1]}}}
    assert SETTINGS.renamed(Experiment, foreign) == foreign
