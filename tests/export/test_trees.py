"""Trees of the C runtime against the references, bit for bit, with random tables."""

from __future__ import annotations

import ctypes
from importlib import resources

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edp.export.c.integer_calls import tables_header
from edp.ir.descent import find_leaves, summed
from edp.ir.layers import NEVER
from edp.ir.w8a16.layers import QTreeSums

SIZES = st.tuples(st.integers(1, 40), st.integers(1, 4), st.integers(1, 60), st.integers(1, 8))
"""Width, outputs, trees, depth."""
CASES = settings(max_examples=60, deadline=None, database=None, derandomize=True)


@pytest.fixture(scope="module")
def runtime(c, tmp_path_factory):
    c.need("gcc")
    folder = tmp_path_factory.mktemp("trees")
    for file in resources.files("edp.export.c").joinpath("runtime").iterdir():
        if "runtime" in file.name or "integer" in file.name:
            (folder / file.name).write_text(file.read_text())
    (folder / "edp_tables.h").write_text(tables_header())
    sources = sorted(folder.glob("*.c"))
    c.run("gcc", *c.flags, "-O2", "-shared", "-fPIC", *sources, "-lm", "-o", folder / "runtime.so")
    return ctypes.CDLL(str(folder / "runtime.so"))


def called(function, rows, tables, numbers, width):
    """What a function of the runtime makes of each row."""
    found = np.zeros((len(rows), width), dtype=rows.dtype)
    for row, y in zip(rows, found, strict=True):
        arrays = [np.ascontiguousarray(array) for array in (row, *tables)]
        result = np.zeros(width, dtype=rows.dtype)
        pointers = [array.ctypes.data_as(ctypes.c_void_p) for array in (*arrays, result)]
        function(*pointers[:-1], *map(ctypes.c_uint32, numbers), pointers[-1])
        y[:] = result
    return found


def test_single_precision_gives_the_bits_of_the_reference(runtime):
    @CASES
    @given(sizes=SIZES, seed=st.integers(0, 2**31))
    def check(sizes, seed):
        width, outputs, trees, depth = sizes
        draw, nodes = np.random.default_rng(seed), (outputs, trees, 2**depth - 1)
        feature = draw.integers(0, width, nodes).astype(np.uint16)
        values = np.append(draw.normal(size=20), [0.0, -0.0, NEVER, -NEVER, 1e-40]).astype(np.float32)
        # Few values, so that numbers often lie exactly on a threshold.
        threshold, rows = draw.choice(values, nodes), draw.choice(values, (5, width))
        leaf = draw.normal(size=(outputs, trees, 2**depth)).astype(np.float32)
        leaf[draw.random(leaf.shape) < 0.1] = -0.0
        found = called(runtime.edp_trees, rows, (feature, threshold, leaf), (outputs, trees, depth), outputs)
        wanted = summed(find_leaves(feature, threshold, leaf, rows))
        np.testing.assert_array_equal(found.view(np.uint32), wanted.view(np.uint32))

    check()


def test_integers_are_those_of_the_reference(runtime):
    @CASES
    @given(sizes=SIZES, right=st.integers(0, 31), seed=st.integers(0, 2**31))
    def check(sizes, right, seed):
        width, outputs, trees, depth = sizes
        draw, nodes = np.random.default_rng(seed), (outputs, trees, 2**depth - 1)
        feature = draw.integers(0, width, nodes).astype(np.uint16)
        values = np.append(draw.integers(-32767, 32768, 20), [0, 32767, -32767]).astype(np.int16)
        threshold = draw.choice(np.append(values, np.int16(-32768)), nodes)
        leaf = draw.integers(-32767, 32768, (outputs, trees, 2**depth)).astype(np.int16)
        rows = draw.choice(values, (5, width))
        layer = QTreeSums(name="t", inputs=(), frac=0, right=right, feature=feature, threshold=threshold, leaf=leaf)
        numbers = (outputs, trees, depth, right)
        found = called(runtime.edp_q_trees, rows, (feature, threshold, leaf), numbers, outputs)
        np.testing.assert_array_equal(found, layer.over_time(None, rows.astype(np.int64)))

    check()


def test_the_most_trees_do_not_overflow_their_sum(runtime):
    """2,000 leaves at the end of their range, which is where a tree of the settings ends."""
    feature, threshold = np.zeros((1, 2000, 1), np.uint16), np.zeros((1, 2000, 1), np.int16)
    leaf = np.full((1, 2000, 2), 32767, dtype=np.int16)
    rows = np.array([[1]], dtype=np.int16)
    found = [
        called(runtime.edp_q_trees, rows, (feature, threshold, sign * leaf), (1, 2000, 1, right), 1).item()
        for sign, right in ((1, 12), (-1, 12), (1, 0))
    ]
    assert found == [2000 * 32767 + 2048 >> 12, -2000 * 32767 + 2048 >> 12, 32767]
