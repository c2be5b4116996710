"""The C code against PyTorch, for every network that the registries allow, and its rules."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from edp.errors import ConfigError, ExportError
from edp.export import TARGETS
from edp.export.c.calls import Calls
from edp.export.c.plan import plan
from edp.export.c.target import CTarget
from edp.export.c.text import number
from edp.export.escape import c_names
from edp.export.golden import SHARE, random_inputs, stream, tolerance
from edp.ir import Graph, Layer
from edp.networks.input_range import LIMIT, usual_range


def differs_by(c, program, predictor, ticks):
    """The largest difference between C and PyTorch over random inputs, as a share of what is allowed."""
    inputs = random_inputs(predictor, ticks, seed=5)
    wanted, found = stream(predictor, inputs), c.stream(program, inputs)
    assert np.isfinite(wanted).all()
    return float((np.abs(found - wanted) / tolerance(predictor, inputs, wanted)).max())


def test_what_is_allowed_is_little(bundle_of):
    """Single precision is far worse than 1e-5 in one cell only, whose layer norm may divide by nearly nothing."""
    assert SHARE == 1e-5
    predictor = bundle_of("hybrid").predictor
    inputs = random_inputs(predictor, 500, seed=5)
    wanted = stream(predictor, inputs)
    sigma = np.tile(predictor.code.width.numpy().ravel(), wanted.shape[1] // predictor.code.width.numel())
    np.testing.assert_allclose(
        tolerance(predictor, inputs, wanted), 1e-5 * (sigma + np.abs(wanted).max(axis=0)), rtol=1e-4
    )


@pytest.mark.covering
def test_c_predicts_what_pytorch_predicts(c, structure, program_of, bundle_of):
    bundle = bundle_of(structure)
    assert differs_by(c, program_of(structure), bundle.predictor, 2_000) < 1


@pytest.mark.slow
def test_c_follows_pytorch_for_a_long_time(c, structure, program_of, bundle_of):
    bundle = bundle_of(structure)
    program = program_of(structure, "gcc", "-O2")
    assert differs_by(c, program, bundle.predictor, 100_000) < 1
    assert b"all tests passed" in c.run(program)


@pytest.mark.parametrize("network", ["hybrid+all", "tcn+quantiles"])
def test_the_rules_of_the_header_hold(c, network, program_of):
    """The program's own test: golden predictions, checksum, bad inputs, missed ticks, restarts; under sanitisers."""
    program = program_of(network, "gcc", "-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    assert b"all tests passed" in c.run(program)


def test_every_optimisation_level_and_compiler_gives_the_same_bits(c, program_of, bundle_of):
    inputs = random_inputs(bundle_of("lstm").predictor, 500, seed=2)
    first = c.stream(program_of("hybrid+all", "gcc", "-O0"), inputs)
    for level in ("-O2", "-O3"):
        np.testing.assert_array_equal(c.stream(program_of("hybrid+all", "gcc", level), inputs), first)
    c.need("clang")
    np.testing.assert_array_equal(c.stream(program_of("hybrid+all", "clang", "-O2"), inputs), first)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 3.4e38, -3.4e38, 1e30])
def test_no_input_makes_a_prediction_that_is_not_finite(c, bad, program_of, bundle_of):
    program = program_of("hybrid+all", "gcc", "-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    inputs = random_inputs(bundle_of("hybrid+all").predictor, 120, seed=3)
    inputs[20:22, 0] = bad
    inputs[40:60] = bad
    found = c.stream(program, inputs)
    assert np.isfinite(found).all()
    assert not np.array_equal(found[19], found[21])  # held ticks go on
    np.testing.assert_array_equal(found[45:60], np.tile(found[45], (15, 1)))  # no prediction: the last one stays
    fresh = c.stream(program, inputs[60:])
    np.testing.assert_array_equal(found[60:], fresh)  # good inputs start it anew


def test_inputs_at_their_limits_are_predicted(c, program_of, bundle_of):
    predictor = bundle_of("hybrid+all").predictor
    centre, spread = usual_range(predictor)
    signs = np.random.default_rng(1).choice([-0.99, 0.99], size=(200, len(centre)))
    found = c.stream(program_of("hybrid+all"), (centre + signs * LIMIT * spread).astype(np.float32))
    assert np.isfinite(found).all()
    assert len(np.unique(found[:, 0])) > 100


def test_headers_say_what_an_engineer_needs(c, bundle_of, tmp_path):
    bundle = bundle_of("hybrid+quantiles")
    files = CTarget().write(bundle, "arm_model", tmp_path)
    header = files[0].read_text()
    assert files[0].name == "arm_model.h"
    for words in (
        "RULE FOR MISSED TICKS",
        "ARM_MODEL_IN_CylVels_1 = 0,",
        "ARM_MODEL_OUT_CylVels_3 = 1,",
        "10 ms",
        "90 %",
    ):
        assert words in header
    assert "CylVels_1 * /" in header  # a comment in a description does not end the header's
    made = {file.name: file.read_bytes() for file in files}
    CTarget().write(bundle, "arm_model", tmp_path)
    assert {file.name: file.read_bytes() for file in files} == made  # the same model gives the same bytes
    c.need("gcc")
    c.run("gcc", *c.flags, "-c", "example_task.c", folder=tmp_path)


def test_its_cmake_file_builds_and_its_test_passes(c, bundle_of, tmp_path):
    c.need("cmake", "gcc")
    CTarget().write(bundle_of("hybrid"), "predictor", tmp_path)
    build = tmp_path / "build"
    c.run("cmake", "-S", tmp_path, "-B", build)
    c.run("cmake", "--build", build)
    assert b"100% tests passed" in c.run("ctest", "--test-dir", build)


def test_deviations_from_misra_are_the_ones_that_the_docs_list(c, bundle_of, tmp_path):
    c.need("cppcheck")
    found = set()
    for whole in (False, True):
        folder = tmp_path / str(whole)
        CTarget().write(bundle_of("hybrid", whole), "predictor", folder)
        found |= rules_of(c, folder)
    listed = Path(__file__).parents[2] / "docs/howto/deploy_c.md"
    rules = "".join(line for line in listed.read_text().splitlines() if line.startswith("| ") and "." in line[:8])
    assert found == set(re.findall(r"(?<=[ |])\d{1,2}\.\d{1,2}(?=[ ,|])", rules))


def rules_of(c, folder):
    """Rules of MISRA C:2012 from which an exported folder deviates."""
    options = ("--std=c99", "--addon=misra", "--enable=style", "--quiet", "--output-file=found.txt")
    c.run("cppcheck", *options, *c.sources(folder), folder=folder)
    return set(re.findall(r"\[misra-c2012-([\d.]+)\]", (folder / "found.txt").read_text()))


@pytest.mark.covering
@pytest.mark.parametrize("whole", [False, True])
def test_values_do_not_lie_over_values_that_are_still_read(structure, whole, bundle_of):
    predictor = bundle_of(structure, whole).predictor
    graph = predictor.integers if whole else predictor.graph()
    made = plan(graph)
    last = {name: at for at, layer in enumerate(graph.layers) for name in layer.inputs}
    last |= dict.fromkeys(graph.results.values(), len(graph.layers))
    owner: dict[tuple[str, int], str] = {}
    for at, layer in enumerate(graph.layers):
        for name in layer.inputs:
            if name in made.values:
                start, kind = made.values[name], graph.layer(name).number
                assert {owner[kind, i] for i in range(start, start + graph.width_of(name))} == {name}
        if layer.width:
            start = made.values[layer.name]
            taken = [(layer.number, i) for i in range(start, start + layer.width)]
            assert all(last.get(owner.get(i, ""), -1) < at for i in taken)
            owner |= dict.fromkeys(taken, layer.name)
    assert sum(made.sizes.values()) <= sum(layer.width for layer in graph.layers) + 4000


def test_what_cannot_be_written_is_refused_by_name(bundle_of, tmp_path):
    class Strange(Layer):
        @property
        def width(self):
            return 1

    graph = Graph(1, (Strange(name="odd.one", inputs=("input",)),), {"prediction": "odd.one"})
    with pytest.raises(ExportError, match=r"layer 'odd\.one' is a Strange, .* these have: Gather"):
        Calls(graph, plan(graph)).translate(graph.layers[0])
    for name in ("Arm", "2arm", "for", "edp_arm", "a-b", "", "a" * 40):
        with pytest.raises(ExportError, match="--name"):
            CTarget().write(bundle_of("lstm"), name, tmp_path)
    with pytest.raises(ConfigError, match="simulink"):
        TARGETS["simulynk"]
    assert not list(tmp_path.iterdir())


def test_numbers_survive_as_text():
    values = np.float32([0.1, 1e-30, -3.4e38, 1.0, 123456789, 2**-140, 0.0])
    assert [np.float32(number(v).removesuffix("f")) for v in values] == list(values)
    assert all(number(v).endswith("f") and ("." in number(v) or "e" in number(v)) for v in values)
    assert c_names(["a b", "a-b", "a_b"], 40) == ["a_b", "a_b_1", "a_b_2"]
