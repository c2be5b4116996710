"""Expressions: their values, their derivatives, and their machine code, against Python's own arithmetic."""

import ctypes
import math

import numpy as np
import pytest

from edp.networks.twin.symbolic.expression import FUNCTIONS, ExpressionGraph
from edp.networks.twin.symbolic.machine_code import CodeModule, digest_of, load, read_or_compile


def compiled(graph, inputs, results):
    """A Python function of an array for results."""
    module = CodeModule(graph, ([], [], inputs))
    module.add("made", [graph.wrap(result) for result in results])
    loaded = load(module.object_code(), module.names)
    call = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 4)(loaded.addresses["made"])

    def function(values):
        values, out, none = np.array(values, float), np.full(len(results), np.nan), np.zeros(1)
        call(*(part.ctypes.data for part in (none, none, values, out)))
        assert loaded.engine is not None
        return out

    return function


def all_operations(graph, x):
    """Expressions that use every operation, and the same in Python."""
    made = [
        x[0] + 2.0 * x[1] - x[2] / (1.5 + x[1] * x[1]),
        -x[0] * (3.0 - x[1]) / 7.0,
        graph.less(x[0], x[1], x[0] * x[2], x[2] - x[1]),
        graph.least(x[0], x[1]) + graph.largest(x[1], x[2]) * graph.absolute(x[2]),
        graph.function("sqrt", x[0] * x[0] + 1.0) * graph.function("exp", -x[1]),
        graph.function("tanh", x[0] * x[2]) + graph.function("sin", x[1]) * graph.function("cos", x[0]),
    ]

    def expected(a, b, c):
        return [
            a + 2.0 * b - c / (1.5 + b * b),
            -a * (3.0 - b) / 7.0,
            a * c if a < b else c - b,
            min(a, b) + max(b, c) * abs(c),
            math.sqrt(a * a + 1.0) * math.exp(-b),
            math.tanh(a * c) + math.sin(b) * math.cos(a),
        ]

    return made, expected


@pytest.mark.parametrize("values", [(0.3, -0.7, 1.2), (2.0, 0.4, -0.9), (-1.5, 3.0, 0.2)])
def test_machine_code_gives_values_and_derivatives(values):
    graph = ExpressionGraph()
    x = graph.inputs("x", 3)
    made, expected = all_operations(graph, x)
    slopes = graph.jacobian(made, x)
    out = compiled(graph, x, [*made, *slopes.values()])(values)
    np.testing.assert_allclose(out[: len(made)], expected(*values), rtol=1e-14)
    by_differences = np.zeros((len(made), 3))
    for k in range(3):
        step = 1e-6 * np.eye(3)[k]
        above, below = expected(*(values + step)), expected(*(values - step))
        by_differences[:, k] = (np.array(above) - below) / 2e-6
    told = np.zeros_like(by_differences)
    for (row, column), slope in zip(slopes, out[len(made) :], strict=True):
        told[row, column] = slope
    np.testing.assert_allclose(told, by_differences, rtol=1e-6, atol=1e-8)


def test_equal_expressions_are_one_and_constants_are_folded():
    graph = ExpressionGraph()
    x, y = graph.inputs("x", 2)
    assert x * y + 1.0 is x * y + 1.0
    assert x * 0.0 is graph.wrap(0.0)
    assert x + 0.0 is x
    assert 1.0 * x is x
    assert graph.wrap(2.0) * 3.0 is graph.wrap(6.0)
    assert all(graph.function(name, 0.5).value == getattr(math, name)(0.5) for name in FUNCTIONS)
    assert graph.jacobian([x * 2.0], [y]) == {}


def test_an_input_that_is_a_function_of_another_has_its_derivatives():
    graph = ExpressionGraph()
    x, value, first, second = graph.inputs("x", 4)
    graph.link([value, first, second], x)
    slopes = graph.jacobian([value * value, first], [x])
    out = compiled(graph, [x, value, first, second], list(slopes.values()))([0.0, 3.0, 5.0, 7.0])
    np.testing.assert_array_equal(out, [2.0 * 3.0 * 5.0, 7.0])


def test_comparisons_with_what_is_no_number_take_the_second_branch():
    graph = ExpressionGraph()
    (x,) = graph.inputs("x", 1)
    function = compiled(graph, [x], [graph.less(x, 1.0, 2.0, x)])
    assert math.isnan(function([math.nan])[0])
    assert function([0.0])[0] == 2.0


def test_machine_code_is_kept_and_named_by_what_it_is_made_of(tmp_path):
    file, made = tmp_path / "code.o", []
    assert read_or_compile(file, lambda: made.append(1) or b"code") == b"code"
    assert read_or_compile(file, lambda: made.append(1) or b"other") == b"code"
    assert made == [1]
    whole = file.read_bytes()
    for damaged in (b"", whole[:-1], whole[:8] + b"x" + whole[9:], whole + b"x"):
        file.write_bytes(damaged)
        assert read_or_compile(file, lambda: b"code") == b"code"
        assert file.read_bytes() == whole
    assert read_or_compile(None, lambda: b"other") == b"other"
    assert read_or_compile(tmp_path / "none" / "code.o", lambda: b"other") == b"other"
    assert digest_of((1, 2), "a") == digest_of((1, 2), "a") != digest_of((1, 2), "b")
