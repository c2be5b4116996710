"""Values and names at the edges of what a damaged log can hold: no warning, no name under another's."""

from __future__ import annotations

import numpy as np

from edp.errors import brief
from edp.logs.formats.base import RawSignal
from edp.logs.formats.names import only, told_apart
from edp.logs.quality.measures import spikes


def _signal(name: str) -> RawSignal:
    return RawSignal(name, "", np.arange(3.0), np.arange(3.0))


def test_the_largest_numbers_are_searched_for_spikes_without_a_warning():
    values = np.sin(np.arange(9000) / 9.0)
    values[50] = np.finfo(np.float64).max
    values[70] = -np.finfo(np.float64).max
    assert spikes(values, 0.0).tolist() == [50, 70]


def test_a_numbered_name_never_hides_a_column_of_that_very_name():
    signals, _, repeated = told_apart([("p", _signal("p")), ("p", _signal("p")), ("p#2", _signal("p#2"))])
    assert len(signals) == 3
    assert signals["p#2"].name == "p#2"
    assert "p#2" not in repeated["p"]


def test_names_that_are_left_out_are_no_longer_told_as_repeated():
    signals, _, repeated = told_apart([("a.p", _signal("p")), ("b.p", _signal("p")), ("q", _signal("q"))])
    kept, among = only(["q", *repeated["p"][:1]], signals, repeated)
    assert set(kept) == {"q", repeated["p"][0]}
    assert among == {}


def test_what_a_library_says_is_one_bounded_line():
    assert brief(ValueError("a\nb")) == "a b"
    assert brief(ValueError()) == "ValueError"
    assert len(brief("x" * 10_000)) < 400
