"""Declared arrays of files: what does not fit its declaration is one message with array, value and expectation."""

import numpy as np
import pytest

from edp.storage.arrays import POSITIVE, ArrayRule, arrays_under, checked_arrays

RULES = {
    "scale": ArrayRule(("inputs",), np.float32, low=POSITIVE),
    "place": ArrayRule(("rows",), np.int64, low=-1, high="inputs"),
    "matrix": ArrayRule(("rows", "inputs", 2)),
    "share": ArrayRule((), low=0.0, high=1.0),
    "trace": ArrayRule(("ticks",), is_finite=False),
    "weight": ArrayRule((2,), np.float32, is_exact=True),
}


def good():
    return {
        "scale": np.full(3, 1e-40, np.float32),
        "place": np.array([-1, 2], np.int32),
        "matrix": np.zeros((2, 3, 2), np.float32),
        "share": np.array(0.5),
        "trace": np.array([np.nan]),
        "weight": np.zeros(2, np.float32),
    }


def test_arrays_come_in_the_types_of_their_rules():
    checked = checked_arrays(good(), RULES, "the file", {"inputs": 3})
    assert {name: values.dtype for name, values in checked.items()} == {
        name: np.dtype(rule.dtype) for name, rule in RULES.items()
    }
    assert all(np.array_equal(values, good()[name], equal_nan=True) for name, values in checked.items())


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("scale", None, r"got no array, expected float32 of shape \(inputs = 3\), finite, above 0$"),
        ("more", np.zeros(1), r"got float64 of shape \(1,\), expected no array of this name$"),
        ("scale", np.ones(4), r"got float64 of shape \(4,\), expected float32 of shape \(inputs = 3\)"),
        ("scale", np.ones(3, int), "got int64"),
        ("scale", np.array([1.0, 0.0, 1.0]), r"got 0.0 at \(1,\), expected .* above 0"),
        ("matrix", np.full((2, 3, 2), np.inf), r"got inf at \(0, 0, 0\), .*\(rows = 2, inputs = 3, 2\), finite"),
        ("matrix", np.zeros((3, 3, 2)), r"got float64 of shape \(3, 3, 2\), expected .*rows = 2"),
        ("place", np.array([-1, 3]), r"got 3 at \(1,\), expected .* at least -1, below inputs$"),
        ("place", np.array([0.0, 1.0]), "got float64"),
        ("share", np.array(2.0), r"got 2.0 at \(\), expected .* at least 0, at most 1$"),
        ("trace", np.zeros((1, 1)), r"got float64 of shape \(1, 1\), expected float64 of shape \(ticks = 1\)$"),
        ("weight", np.zeros(2), "got float64 .*, expected float32"),
    ],
)
def test_what_does_not_fit_is_one_message(name, values, message):
    arrays = good() | {name: values}
    if values is None:
        del arrays[name]
    with pytest.raises(ValueError, match=rf"^the file: array '{name}': {message}"):
        checked_arrays(arrays, RULES, "the file", {"inputs": 3})


def test_arrays_under_a_prefix_have_the_rest_of_their_names():
    assert list(arrays_under({"a.b": np.zeros(1), "ab": np.zeros(1), "a.c.d": np.zeros(1)}, "a.")) == ["b", "c.d"]
