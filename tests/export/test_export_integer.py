"""C code in integers against the integer reference, bit for bit."""

from __future__ import annotations

import numpy as np
import pytest

from edp.export.c.integer_calls import INTEGER_CALLS
from edp.export.golden import random_inputs, stream
from edp.ir import Layer
from edp.ir.w8a16 import layers

EXTREME = 30.0
"""Standard widths: far beyond the range of the formats."""


def outputs_of(c, program, predictor, ticks, wide=1.0):
    inputs = wide * random_inputs(predictor, ticks, seed=5)
    return c.stream(program, inputs), stream(predictor, inputs)


@pytest.mark.covering
def test_c_gives_the_bits_of_the_reference(c, structure, program_of, bundle_of):
    bundle = bundle_of(structure, whole=True)
    program = program_of(structure, whole=True)
    found, wanted = outputs_of(c, program, bundle.predictor, 200)
    np.testing.assert_array_equal(found, wanted)
    found, wanted = outputs_of(c, program, bundle.predictor, 100, wide=EXTREME)
    assert np.isfinite(found).all()
    np.testing.assert_array_equal(found, wanted)


@pytest.mark.parametrize("network", ["hybrid", "gru+all", "tcn+quantiles"])
def test_the_rules_of_the_header_hold(c, network, program_of):
    flags = ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    assert b"all tests passed" in c.run(program_of(network, "gcc", *flags, whole=True))


@pytest.mark.parametrize("network", ["hybrid", "tcn+all"])
def test_every_optimisation_level_and_compiler_gives_the_same_bits(c, network, program_of, bundle_of):
    inputs = random_inputs(bundle_of(network).predictor, 300, seed=2)
    first = c.stream(program_of(network, "gcc", "-O0", whole=True), inputs)
    for level in ("-O2", "-O3"):
        np.testing.assert_array_equal(c.stream(program_of(network, "gcc", level, whole=True), inputs), first)
    c.need("clang")
    np.testing.assert_array_equal(c.stream(program_of(network, "clang", "-O2", whole=True), inputs), first)


def test_every_integer_layer_has_a_c_function():
    kinds = {kind for kind in vars(layers).values() if isinstance(kind, type) and issubclass(kind, Layer)}
    kinds = {kind for kind in kinds if kind.__module__ == layers.__name__ and kind.over_time is not Layer.over_time}
    assert set(INTEGER_CALLS) == kinds


def test_words_for_layers_in_exported_hashes_stay():
    """A state that a controller saved bears the hash, so a renamed class keeps the word that it was hashed under."""
    words = {object.__new__(kind).kind for kind in INTEGER_CALLS}
    assert words >= {"Quantise", "Dequantise", "WGather", "WSum", "WMultiply", "WScaleShift", "WActivate", "WGlu"}
    assert words >= {"WDense", "WGroupedDense", "WConvolution", "WLstm", "WGru", "WMinGru", "WRotation", "WDifference"}
    assert words >= {"WTrailingMean", "WAttentionPool"}
