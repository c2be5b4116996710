"""Complete regression trees: what they compute, what they refuse, and how fitted trees become such tables."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.ensemble import HistGradientBoostingRegressor

from edp.ir import Graph
from edp.ir.descent import find_leaves, summed
from edp.ir.layers import NEVER, BinaryOperation, Dense, Elementwise, Gather, Standardise, TreeSums
from edp.ir.reference import Reference
from edp.ir.w8a16 import Formats, quantise
from edp.ir.w8a16.balance import balanced
from edp.ir.w8a16.quantise import halves
from edp.networks import trees as trees_file
from edp.networks.trees import Trees
from edp.training.tree_tables import complete_tables, round_down_to_single, stack_tables

SIZES = st.tuples(st.integers(1, 6), st.integers(1, 3), st.integers(1, 5), st.integers(1, 4))
"""Width, outputs, trees, depth."""
CASES = settings(max_examples=60, deadline=None, database=None, derandomize=True)


def drawn(sizes, seed):
    """Tables whose thresholds are numbers of the rows too, so that equality is met; and rows."""
    width, outputs, trees, depth = sizes
    draw = np.random.default_rng(seed)
    values = draw.normal(size=7).astype(np.float32)
    nodes = (outputs, trees, 2**depth - 1)
    threshold = np.where(draw.random(nodes) < 0.2, np.float32(NEVER), draw.choice(values, nodes))
    leaf = draw.normal(size=(outputs, trees, 2**depth)).astype(np.float32)
    return draw.integers(0, width, nodes), threshold, leaf, draw.choice(values, (11, width))


def walked(feature, threshold, leaf, row):
    """One row, node by node."""
    sums = []
    for columns, limits, ends in zip(feature, threshold, leaf, strict=True):
        total = np.float32(0)
        for column, limit, end in zip(columns, limits, ends, strict=True):
            at = 0
            while at < len(column):
                at = 2 * at + (2 if row[column[at]] > limit[at] else 1)
            total = total + end[at - len(column)]
        sums.append(total)
    return sums


def module_of(sizes, feature, threshold, leaf):
    module = Trees(*sizes)
    module.set_tables(feature, threshold, leaf)
    return module


@CASES
@given(sizes=SIZES, seed=st.integers(0, 2**31))
def test_a_tick_goes_from_node_to_node(sizes, seed):
    feature, threshold, leaf, rows = drawn(sizes, seed)
    wanted = np.array([walked(feature, threshold, leaf, row) for row in rows])
    leaves = find_leaves(feature.astype(np.uint16), threshold, leaf, rows)
    np.testing.assert_array_equal(summed(leaves), wanted)
    module, x = module_of(sizes, feature, threshold, leaf), torch.from_numpy(rows)[None]
    torch.testing.assert_close(module(x, ())[0][0], torch.from_numpy(wanted), rtol=1e-6, atol=1e-6)
    double = module.double()(x.double(), ())[0][0]
    torch.testing.assert_close(double.float(), torch.from_numpy(wanted), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("block", [1, 12, 70])
def test_blocks_and_chunks_change_no_number(block, monkeypatch):
    module, x = module_of((6, 3, 4, 3), *drawn((6, 3, 4, 3), 1)[:3]), torch.randn(2, 9, 6)
    whole, _ = module(x, ())
    ticks = [module(x[:, at : at + 1], ())[0] for at in range(9)]
    torch.testing.assert_close(torch.cat(ticks, dim=1), whole, rtol=0, atol=1e-6)
    monkeypatch.setattr(trees_file, "BLOCK", block)
    torch.testing.assert_close(module(x, ())[0], whole, rtol=0, atol=1e-6)


def test_trees_that_are_not_fitted_give_zero_whatever_comes():
    x = torch.tensor([[[0.0, 3e38, -3e38, NEVER]]])
    assert torch.equal(Trees(4, 3, 7, 4)(x, ())[0], torch.zeros(1, 1, 3))


def test_no_gradient_passes_and_no_table_is_a_parameter():
    module = module_of((6, 3, 4, 3), *drawn((6, 3, 4, 3), 1)[:3])
    x = torch.randn(1, 5, 6, requires_grad=True)
    assert not list(module.parameters())
    assert not module(x, ())[0].requires_grad


REFUSED = {
    "a node reads column 2; 0 to 1 must hold": {"feature": np.full((1, 1, 3), 2)},
    "a node reads column -1": {"feature": np.full((1, 1, 3), -1)},
    "columns are integers": {"feature": np.zeros((1, 1, 3))},
    r"'feature' is \(1, 1, 7\); \(1, 1, 3\) must hold": {"feature": np.zeros((1, 1, 7), int)},
    r"'leaf' is \(1, 4\)": {"leaf": np.zeros((1, 4))},
    "'threshold' holds a number that is not finite": {"threshold": np.full((1, 1, 3), np.nan)},
    "'leaf' holds a number that is not finite": {"leaf": np.full((1, 1, 4), 1e39)},
}


@pytest.mark.parametrize("reason", REFUSED)
def test_tables_that_cannot_be_are_refused_and_change_nothing(reason):
    good = {"feature": np.ones((1, 1, 3), int), "threshold": np.zeros((1, 1, 3)), "leaf": np.ones((1, 1, 4))}
    module = module_of((2, 1, 1, 2), **good)
    with pytest.raises(ValueError, match=reason):
        module.set_tables(**(good | {"leaf": np.zeros((1, 1, 4))} | REFUSED[reason]))
    assert torch.equal(module.leaf, torch.ones(1, 1, 4))


@CASES
@given(st.floats(-1e30, 1e30), st.integers(-3, 3))
def test_single_precision_compares_as_the_fitted_threshold(threshold, steps):
    x = np.float32(threshold)
    for _ in range(abs(steps)):
        x = np.nextafter(x, np.float32(np.copysign(np.inf, steps)))
    assert (x > round_down_to_single(threshold)) == (float(x) > threshold)


def test_a_threshold_beyond_single_precision_is_never_exceeded_or_refused():
    assert round_down_to_single(np.inf) == round_down_to_single(1e300) == np.float32(NEVER)
    with pytest.raises(ValueError, match="single precision does not hold"):
        round_down_to_single(-1e300)


@pytest.fixture(scope="module")
def fitted():
    """A model, and inputs in single precision, some of them exactly on its thresholds."""
    draw = np.random.default_rng(0)
    x = draw.normal(size=(800, 6)).astype(np.float32)
    y = 3.0 + np.sin(2 * x[:, 0]) + x[:, 1] * x[:, 2] + 0.1 * draw.normal(size=800)
    model = HistGradientBoostingRegressor(max_depth=4, max_leaf_nodes=None, max_iter=30).fit(x, y)
    more = draw.normal(size=(300, 6)).astype(np.float32)
    limits = complete_tables(model, 4)[1].ravel()
    more[:200] = draw.choice(limits[limits < NEVER], (200, 6))
    return model, more


@pytest.mark.parametrize("depth", [4, 6])
def test_fitted_trees_predict_the_same_as_tables(fitted, depth):
    model, x = fitted
    feature, threshold, leaf = stack_tables([complete_tables(model, depth)], 33)
    assert feature.shape == (1, 33, 2**depth - 1)
    wanted = model.predict(x)
    module = module_of((6, 1, 33, depth), feature, threshold, leaf)
    # 30 leaves, each rounded once: a comparison that went the other way would show by a hundredth.
    np.testing.assert_allclose(module(torch.from_numpy(x)[None], ())[0][0, :, 0], wanted, rtol=0, atol=2e-6)


def test_trees_that_do_not_fit_into_the_tables_are_refused(fitted):
    model, _ = fitted
    with pytest.raises(ValueError, match="deeper than 3; grow trees with max_depth = 3"):
        complete_tables(model, 3)
    with pytest.raises(ValueError, match="an output has 30 trees; at most 29"):
        stack_tables([complete_tables(model, 4)], 29)
    draw = np.random.default_rng(1)
    x, y = draw.integers(0, 4, (200, 1)), draw.normal(size=200)
    by_category = HistGradientBoostingRegressor(categorical_features=[0], max_iter=2).fit(x, y + (x[:, 0] == 2))
    with pytest.raises(ValueError, match="splits by categories"):
        complete_tables(by_category, 8)


@CASES
@given(threshold=st.floats(-40, 40), frac=st.integers(8, 14), seed=st.integers(0, 2**31))
def test_integer_thresholds_split_the_grid_as_the_real_one(threshold, frac, seed):
    """Whatever 16-bit number comes: beyond the range of the format, too."""
    limit = np.float32(threshold)
    tables = {"feature": np.zeros((1, 1, 1), np.uint16), "leaf": np.float32([[[0, 1]]])}
    layer = TreeSums(name="sums", inputs=("scaled",), threshold=np.full((1, 1, 1), limit), **tables)
    chosen = integer_layer(layer, frac, 3)
    q = np.append(np.random.default_rng(seed).integers(-32767, 32768, 50), [-32767, 32767, 0])
    q = np.append(q, np.clip(np.floor(float(limit) * 2.0**frac) + np.arange(-1, 2), -32767, 32767)).astype(np.int64)
    found = find_leaves(chosen.feature, chosen.threshold, chosen.leaf, q[:, None])[:, 0, 0] > 0
    np.testing.assert_array_equal(found, q * 2.0**-frac > float(limit))


def test_a_node_that_never_splits_does_not_in_integers_either():
    layer = TreeSums(
        name="sums",
        inputs=("scaled",),
        feature=np.zeros((1, 1, 1), np.uint16),
        threshold=np.full((1, 1, 1), NEVER, np.float32),
        leaf=np.float32([[[0.25, 1]]]),
    )
    chosen = integer_layer(layer, 12, 10)
    assert chosen.threshold.item() == 32767
    assert chosen.right == halves(layer.leaf)[1] - 10
    assert chosen.leaf[0, 0, 0] * 2.0 ** -(chosen.frac + chosen.right) == 0.25


def integer_layer(layer, frac, own):
    """A layer in integers that reads a value of `frac` fractional bits, between scaled inputs and a dense layer."""
    ones = np.ones(1, np.float32)
    scaled = Standardise(name="scaled", inputs=("input",), offset=0 * ones, scale=ones)
    dense = Dense(name="dense", inputs=("sums",), weight=ones[None], bias=0 * ones)
    graph = Graph(1, (scaled, layer, dense), {"prediction": "dense"})
    return quantise(graph, Formats({"scaled": frac, "sums": own, "dense": 8})).layer("sums")


def joined(weight, *more):
    """Trees of two outputs beside what they read, before a dense layer; further layers behind it."""
    feature, threshold, leaf, _ = drawn((3, 2, 4, 2), 5)
    ones = np.ones(3, np.float32)
    scaled = Standardise(name="scaled", inputs=("input",), offset=0 * ones, scale=ones)
    tables = {"feature": feature.astype(np.uint16), "threshold": threshold, "leaf": leaf}
    trees = TreeSums(name="sums", inputs=("scaled",), **tables)
    join = Gather(name="join", inputs=("scaled", "sums"), columns=(0, 3, 1, 2, 4))
    dense = Dense(name="dense", inputs=("join",), weight=np.float32(weight), bias=np.float32([1, 2]))
    return Graph(3, (scaled, trees, join, dense, *more), {"prediction": "dense"})


def twice(value, size):
    return Elementwise(name="twice", inputs=(value, value), operation=BinaryOperation.ADD, size=size)


HEAVY = [[0.02, 1.0, -0.03, 0.1, 0.0], [0.01, 0.0, 0.05, -0.03, 0.9]]


def test_heavy_trees_are_balanced_without_a_change_of_any_bit():
    graph = joined(HEAVY)
    light = balanced(graph)
    weight = light.layer("dense").weight
    np.testing.assert_array_equal(weight[:, [0, 2, 3]], np.float32(HEAVY)[:, [0, 2, 3]])
    assert 1.0 <= np.abs(weight[:, [1, 4]]).max() / 0.1 < 2.0
    np.testing.assert_array_equal(light.layer("sums").leaf, 8 * graph.layer("sums").leaf)
    for row in drawn((3, 2, 4, 2), 6)[3]:
        first, second = (Reference(each, np.float32).results(row)["prediction"] for each in (graph, light))
        np.testing.assert_array_equal(first, second)
    again = balanced(light)
    np.testing.assert_array_equal(again.layer("dense").weight, weight)


@pytest.mark.parametrize(
    "graph",
    [
        joined(np.float32(HEAVY) * [1, 0.05, 1, 1, 0.05]),
        joined(np.float32(HEAVY) * [0, 1, 0, 0, 1]),
        joined(HEAVY, twice("sums", 2)),
        joined(HEAVY, twice("join", 5)),
    ],
    ids=["light", "alone", "trees are read elsewhere", "the join is read elsewhere"],
)
def test_other_trees_stay_as_they_are(graph):
    for layer, same in zip(graph.layers, balanced(graph).layers, strict=True):
        for name, values in layer.tensors().items():
            np.testing.assert_array_equal(same.tensors()[name], values)
