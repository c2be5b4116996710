"""Tangents of the C step against forward-mode differentiation of PyTorch in double precision, and their rules."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from edp.errors import ExportError
from edp.export import make_target
from edp.export.c.model import make_model
from edp.export.c.plan import plan
from edp.export.c.tangents import Tangents
from edp.export.golden import random_inputs
from edp.ir import Graph, Layer
from edp.networks.input_range import usual_range

DRIVER = Path(__file__).with_name("tangent_driver.c")
MISSED = -12345.0
TICKS = 40
pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script:DeprecationWarning")  # PyTorch's own, at jvp
TOLERANCE = 1e-4
"""Of the largest change of each result over the ticks."""
SANITISED = ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")


@pytest.fixture(scope="session")
def tangent_of(c, bundle_of, tmp_path_factory):
    """The program of a network that reads inputs with their changes, and runs it: predictions and changes."""
    runtimes = {}

    def make(structure, *flags):
        c.need("gcc")
        flags = (*c.flags, *(flags or ("-O0",)))
        folder = tmp_path_factory.mktemp("tangent")
        make_target("c", {"tangent": True}).write(bundle_of(structure), "predictor", folder)
        if flags not in runtimes:
            runtimes[flags] = tmp_path_factory.mktemp("runtime")
            sources = [name for name in make_model("predictor", bundle_of(structure), True).runtime if name[-1] == "c"]
            c.run("gcc", *flags, "-c", *(folder / name for name in sources), folder=runtimes[flags])
        objects = sorted(runtimes[flags].glob("*.o"))
        own = ("predictor.c", "predictor_tangent.c", DRIVER)
        c.run("gcc", *flags, "-I", folder, *own, *objects, "-lm", "-o", "program", folder=folder)

        def run(inputs, changes, *more):
            """Changes are ``(tick, direction, input)``; returns ``(tick, number)``, ``(tick, direction, number)``."""
            rows = np.concatenate([inputs[:, None], changes], axis=1).astype(np.float32)
            count = changes.shape[1]
            found = c.run(folder / "program", count, *more, feed=np.ascontiguousarray(rows).tobytes())
            found = np.frombuffer(found, dtype=np.float32).reshape(len(inputs), 1 + count, -1)
            return found[:, 0], found[:, 1:]

        return run

    return make


@pytest.mark.covering
def test_tangents_are_those_of_pytorch(structure, bundle_of, tangent_of, changes_of, torch_changes):
    """A random direction through 40 ticks: inputs, states and rings all take part."""
    predictor = bundle_of(structure).predictor
    inputs, changes = random_inputs(predictor, TICKS, seed=5), changes_of(predictor, TICKS, 1)
    wanted = torch_changes(predictor, inputs, changes[:, 0].astype(np.float32))
    _, found = tangent_of(structure)(inputs, changes)
    assert np.isfinite(wanted).all()
    assert np.abs(wanted).max(axis=0).min() > 0
    error = np.abs(found[:, 0] - wanted).max(axis=0) / np.abs(wanted).max(axis=0)
    assert error.max() < TOLERANCE


@pytest.mark.parametrize("network", ["hybrid+all", "tcn+quantiles"])
def test_several_directions_at_once_are_each_alone(network, bundle_of, tangent_of, changes_of):
    """Held and missed ticks and restarts among them: the driver holds the step itself to `predictor_step`."""
    predictor = bundle_of(network).predictor
    inputs, changes = random_inputs(predictor, 60, seed=6), changes_of(predictor, 60, 3)
    inputs[20], inputs[25, -1], inputs[40:47] = np.nan, np.inf, np.nan
    inputs[30, 0] = MISSED
    run = tangent_of(network, *SANITISED)
    predictions, found = run(inputs, changes)
    assert np.isfinite(predictions).all()
    assert np.isfinite(found).all()
    for direction in range(3):
        np.testing.assert_array_equal(run(inputs, changes[:, direction : direction + 1])[1][:, 0], found[:, direction])
    held = changes.copy()
    held[[20, 25, 30]] = 1e30  # not read: the last accepted inputs' changes are held too
    np.testing.assert_array_equal(run(inputs, held)[1], found)
    np.testing.assert_array_equal(found[45:47], found[44:46])  # no prediction: as it was
    np.testing.assert_array_equal(run(inputs[47:], changes[47:])[1], found[47:])  # cleared with the memory


def test_held_changes_are_those_of_inputs_that_stay(bundle_of, tangent_of, changes_of):
    predictor = bundle_of("hybrid+all").predictor
    inputs, changes = random_inputs(predictor, 30, seed=6), changes_of(predictor, 30, 1)
    lost = inputs.copy()
    lost[20] = np.nan
    inputs[20], changes[20] = inputs[19], changes[19]
    run = tangent_of("hybrid+all")
    np.testing.assert_array_equal(run(lost, changes)[1], run(inputs, changes)[1])


def test_the_tick_alone_is_a_column_of_its_jacobian(bundle_of, tangent_of, torch_changes):
    """All inputs at once, each a direction, with the past as it was."""
    predictor = bundle_of("hybrid+all").predictor
    inputs, (_, spread) = random_inputs(predictor, 30, seed=6), usual_range(predictor)
    unit = np.tile(np.diag(spread), (30, 1, 1))
    _, found = tangent_of("hybrid+all")(inputs, unit, "alone")
    for column in (0, len(spread) - 1):
        last = np.zeros_like(inputs)
        last[-1, column] = spread[column]
        wanted = torch_changes(predictor, inputs, last)[-1]
        np.testing.assert_allclose(found[-1, column], wanted, atol=TOLERANCE * np.abs(found[-1]).max())


def test_it_is_plain_c_without_heap_or_globals(c, bundle_of, tmp_path):
    c.need("gcc")
    files = make_target("c", {"tangent": "true"}).write(bundle_of("hybrid+all"), "predictor", tmp_path)
    names = {file.name for file in files}
    assert {"predictor_tangent.h", "predictor_tangent.c", "edp_tangent.h", "edp_tangent.c"} <= names
    sources = [name for name in names if name.startswith("edp_") and name.endswith(".c")]
    sources += ["predictor.c", "predictor_tangent.c"]
    c.run("gcc", *c.flags, "-O2", "-fno-pie", "-c", *sources, folder=tmp_path)
    found = c.run("nm", *tmp_path.glob("*.o")).decode().splitlines()
    kinds = {line.split()[-2]: line.split()[-1] for line in found if len(line.split()) > 1}
    assert not set(kinds) & set("BbDdCGgSs"), "no data that can be written"
    assert not {line.split()[-1] for line in found if line} & {"malloc", "calloc", "realloc", "free"}
    c.need("cmake")
    c.run("cmake", "-S", tmp_path, "-B", tmp_path / "build")
    c.run("cmake", "--build", tmp_path / "build")


def test_what_has_no_tangent_is_refused(bundle_of, tmp_path):
    with pytest.raises(ExportError, match=r"integer arithmetic .* no tangent"):
        make_target("c", {"tangent": True}).write(bundle_of("hybrid", True), "predictor", tmp_path)
    assert not list(tmp_path.iterdir())

    class Strange(Layer):
        @property
        def width(self):
            return 1

    graph = Graph(1, (Strange(name="odd.one", inputs=("input",)),), {"prediction": "odd.one"})
    with pytest.raises(ExportError, match=r"layer 'odd\.one' is a Strange, .* no tangent .* these have: Gather"):
        Tangents(graph, plan(graph), plan(graph)).translate(graph.layers[0])
