"""Twins in compiled C: free, measured and mixed; their tangents through the feedback edge; hostile names."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from edp.export import make_target
from edp.export.golden import grown_tolerance, random_inputs, stream
from edp.ir.reference import Reference
from edp.networks.input_range import usual_range
from edp.networks.twin import TWINS
from edp.networks.twin.recurrent import Recurrent
from edp.testing.twins import sample_twin
from edp.training.twin_bundle import TwinBundle, plant_bundle

DRIVER = Path(__file__).with_name("tangent_driver.c")
SANITISED = ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
HOSTILE = ('x*/ int y; /*"\\', "??/\n#error no", "%n ${name} `id`", "speed_1_measured")
STEP = 1e-6


def bundle_of(name, hostile=False):
    spec = Recurrent(units=5) if name == "recurrent" else TWINS[name]()
    twin, _, _ = sample_twin(spec)
    if hostile:
        commands = tuple(replace(c, name=text) for c, text in zip(twin.channels.commands, HOSTILE[:2], strict=True))
        first, second = (
            replace(c, name=text, description=text)
            for c, text in zip(twin.channels.pressures, HOSTILE[2:], strict=True)
        )
        twin.channels = replace(twin.channels, commands=commands, pressures=(first, second))
    return plant_bundle(TwinBundle(spec, twin))


def built(c, bundle, folder, program, *flags):
    c.need("gcc")
    make_target("c", {"tangent": True}).write(bundle, "predictor", folder)
    own = [*c.sources(folder), "predictor_tangent.c", program]
    c.run("gcc", *c.flags, *flags, "-I", folder, *dict.fromkeys(own), "-lm", "-o", "program", folder=folder)
    return folder / "program"


@pytest.mark.parametrize("name", list(TWINS))
def test_c_answers_what_the_twin_answers(c, name, tmp_path):
    bundle = bundle_of(name)
    plant = bundle.predictor
    program = built(c, bundle, tmp_path, "host_test.c", "-O1")
    rows = random_inputs(plant, 400, seed=6)
    rows[:, : plant.required] *= 2.0  # bounds and end stops act
    expected = stream(plant, rows)
    apart = np.abs(c.stream(program, rows) - expected)
    assert (apart <= grown_tolerance(plant, rows, expected)).all()
    assert b"all tests passed" in c.run(program)


def test_names_of_channels_stay_text_and_the_fuzzer_finds_nothing(c, tmp_path):
    bundle = bundle_of("recurrent", hostile=True)
    built(c, bundle, tmp_path, "fuzz.c", "-DREPLAY", *SANITISED)
    (tmp_path / "bytes").write_bytes(np.random.default_rng(0).bytes(4000))
    assert b"every rule held" in c.run(tmp_path / "program", tmp_path / "bytes")


def test_tangents_go_round_the_feedback_edge(c, tmp_path):
    bundle = bundle_of("recurrent")
    plant = bundle.predictor
    program = built(c, bundle, tmp_path, DRIVER, "-O0")
    rows = random_inputs(plant, 60, seed=7)
    _, spread = usual_range(plant)
    changes = np.random.default_rng(1).normal(size=rows.shape) * spread
    changes[:, -plant.sizes[2] :] = 0.0  # a flag is a step, through which nothing is differentiated
    feed = np.stack([rows, changes.astype(np.float32)], axis=1).astype(np.float32)
    found = np.frombuffer(c.run(program, 1, feed=feed.tobytes()), dtype=np.float32).reshape(len(rows), 2, -1)[:, 1]
    ends = [answers(plant, rows + side * STEP * changes) for side in (1.0, -1.0)]
    wanted = (ends[0] - ends[1]) / (2.0 * STEP)
    largest = np.abs(wanted).max(axis=0)
    assert largest.min() > 0.0
    # Where a bound acts on one side only, the difference is no derivative.
    off = np.abs(found - wanted) / largest > 1e-3
    assert off.any(axis=1).mean() < 0.05
    # A change of the last measured tick is still there at the end of the free run.
    assert np.abs(found[plant.window + 10]).max() > 0.0


def answers(plant, rows):
    run = Reference(plant.graph())
    return np.array([run.results(row)["prediction"] for row in rows])
