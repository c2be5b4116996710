"""Twins in compiled C: free, measured and mixed; their tangents through the feedback edge; hostile names."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from edp.errors import ConfigError, ExportError
from edp.export import make_target
from edp.export.c.tangents import differentiable
from edp.export.golden import grown_tolerance, random_inputs, stream
from edp.ir.reference import Reference
from edp.networks.input_range import usual_range
from edp.networks.twin import TWINS, Twin
from edp.networks.twin.recurrent import Recurrent
from edp.testing.twins import sample_actuators, sample_twin
from edp.training.twin_bundle import TwinBundle, plant_bundle
from edp.workflows.deployment import quantise_twin

DRIVER = Path(__file__).with_name("tangent_driver.c")
SANITISED = ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
HOSTILE = ('x*/ int y; /*"\\', "??/\n#error no", "%n ${name} `id`", "speed_1_measured")
STEP = 1e-6


ON_A_MAP = "recurrent on a map"
SPECS = {"recurrent": Recurrent(units=5), ON_A_MAP: Recurrent(units=6, members=3, valve_map=True)}
# 12 s hardly tell the states of n4sid apart: what rounding makes of them would differ from machine to machine.
TICKS = {"n4sid": 2400}


def in_layers(name: str) -> bool:
    """Whether a formulation says what its layers are."""
    spec = SPECS.get(name) or TWINS[name]()
    kind = type(sample_twin(spec)[0])
    return kind.lower is not Twin.lower or kind.lower_answers is not Twin.lower_answers


LOWERED = [ON_A_MAP, *(name for name in TWINS if in_layers(name))]
EQUATIONS = ("greybox", "residual")
NO_INTEGERS = ("n4sid", "elements", *EQUATIONS)


def twin_of(name, hostile=False):
    spec = SPECS.get(name) or TWINS[name]()
    twin, _, _ = sample_twin(spec, sample_actuators(TICKS.get(name, 600)))
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
    tangent = differentiable(bundle.predictor.graph())
    make_target("c", {"tangent": tangent}).write(bundle, "predictor", folder)
    own = [*c.sources(folder), *(["predictor_tangent.c"] if tangent else []), program]
    c.run("gcc", *c.flags, *flags, "-I", folder, *dict.fromkeys(own), "-lm", "-o", "program", folder=folder)
    return folder / "program"


@pytest.mark.parametrize("name", LOWERED)
def test_c_answers_what_the_twin_answers(c, name, tmp_path):
    bundle = twin_of(name)
    plant = bundle.predictor
    program = built(c, bundle, tmp_path, "host_test.c", "-O1")
    rows = random_inputs(plant, 400, seed=6)
    rows[:, : plant.required] *= 2.0  # bounds and end stops act
    expected = stream(plant, rows)
    apart = np.abs(c.stream(program, rows) - expected)
    assert (apart <= grown_tolerance(plant, rows, expected)).all()
    assert b"all tests passed" in c.run(program)


class Recordings:
    """Stands for logs."""

    def read(self):
        return [sample_actuators(seed=seed) for seed in (3, 4)]


def test_a_state_space_model_has_no_integers():
    with pytest.raises(ExportError, match=r"'cell\.kept' multiplies what a feedback edge hands on.*export in float32"):
        quantise_twin(twin_of("n4sid"), Recordings())


@pytest.mark.parametrize("name", EQUATIONS)
def test_equations_have_neither_integers_nor_tangents(name, tmp_path):
    with pytest.raises(ExportError, match=r"HydraulicTick.*integer arithmetic; its equations need double precision"):
        quantise_twin(twin_of(name), Recordings())
    with pytest.raises(ExportError, match=r"'cell\.machine' is a HydraulicTick, which has no tangent in C"):
        make_target("c", {"tangent": True}).write(twin_of(name), "predictor", tmp_path)


@pytest.mark.parametrize("name", [name for name in LOWERED if name not in NO_INTEGERS])
def test_integers_are_those_of_the_reference(c, name, tmp_path):
    bundle = twin_of(name)
    whole = quantise_twin(bundle, Recordings())
    c.need("gcc")
    make_target("c").write(whole, "predictor", tmp_path)
    own = [*c.sources(tmp_path), "host_test.c"]
    c.run("gcc", *c.flags, "-O1", "-I", tmp_path, *own, "-lm", "-o", "program", folder=tmp_path)
    rows = random_inputs(whole.predictor, 200, seed=9)
    expected = stream(whole.predictor, rows)
    assert np.array_equal(c.stream(tmp_path / "program", rows), expected)
    assert b"all tests passed" in c.run(tmp_path / "program")
    measured = slice(0, whole.predictor.window)
    apart = np.abs(expected - stream(bundle.predictor, rows))[measured] / bundle.predictor.twin.scales.answer_width
    # Weights of ARX cancel, lag by lag: eight bits are few for them.
    assert apart.max() < (0.1 if name != "arx" else 0.5), apart.max()


def test_integers_of_a_network_are_made_by_edp_quantise(bundle_of):
    with pytest.raises(ConfigError, match="edp compress quantise"):
        quantise_twin(bundle_of("lstm"), Recordings())


def test_names_of_channels_stay_text_and_the_fuzzer_finds_nothing(c, tmp_path):
    bundle = twin_of("recurrent", hostile=True)
    built(c, bundle, tmp_path, "fuzz.c", "-DREPLAY", *SANITISED)
    (tmp_path / "bytes").write_bytes(np.random.default_rng(0).bytes(4000))
    assert b"every rule held" in c.run(tmp_path / "program", tmp_path / "bytes")


def test_tangents_go_round_the_feedback_edge(c, tmp_path):
    bundle = twin_of("recurrent")
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
