"""Parts that contradict the task or one another are refused with the reason; every part that can refuse is here."""

from dataclasses import replace

import numpy as np
import pytest

from edp.data.features import FeatureSet
from edp.data.scaling import Scaler
from edp.data.task import TargetMode, Task
from edp.errors import ConfigError
from edp.networks.activations import ACTIVATIONS
from edp.networks.backbones import BACKBONES
from edp.networks.blocks import BLOCKS
from edp.networks.blocks.base import HasConflicts
from edp.networks.heads import HEADS
from edp.networks.outputs import OUTPUTS
from edp.networks.physics import PHYSICS
from edp.networks.physics.base import SPEEDS
from edp.networks.predictor import ModelSpec, build_model, check_combination

REGISTRIES = (BACKBONES, HEADS, OUTPUTS, ACTIVATIONS, BLOCKS, PHYSICS)
TASK = Task(FeatureSet("two", ("v_1", "v_2")), ("v_1", "v_2"), (1,), TargetMode.ABSOLUTE, 100.0)
PLAIN = ModelSpec()


def with_blocks(*names):
    return replace(PLAIN, blocks=tuple(BLOCKS[name]() for name in names))


def with_physics(name, *blocks):
    return replace(with_blocks(*blocks), physics=PHYSICS[name]())


def reads(name):
    """A task that feeds a physics base what it reads."""
    extra = tuple(channel for channel in PHYSICS[name]().channels() if channel not in SPEEDS)
    return replace(TASK, features=FeatureSet("speeds", SPEEDS), targets=SPEEDS[:2], physics=extra)


# The part that refuses, the task, the network, and words of the reason.
REFUSED = [
    (
        "velocity_skip",
        replace(TASK, mode=TargetMode.DELTA),
        with_blocks("velocity_skip"),
        "mode = 'delta' does already",
    ),
    ("velocity_skip", replace(TASK, features=FeatureSet("one", ("v_1",))), with_blocks("velocity_skip"), "v_2 is not"),
    ("velocity_skip", reads("force"), with_physics("force", "velocity_skip"), "physics base adds the velocity already"),
    ("cross_cylinder_attention", replace(TASK, targets=("v_1",)), with_blocks("cross_cylinder_attention"), "has one"),
    (
        "linear",
        TASK,
        replace(with_blocks("cross_cylinder_attention"), head=HEADS["linear"]()),
        "no hidden features for the block CrossCylinderAttention",
    ),
    (
        "kinematic",
        replace(reads("kinematic"), physics=()),
        with_physics("kinematic"),
        "reads JointAngle_1, .*JointVel_3",
    ),
    (
        "force",
        replace(TASK, physics=PHYSICS["force"]().channels()),
        with_physics("force"),
        "predicts CylVels_1.*targets are v_1, v_2",
    ),
    (
        "linear",
        TASK,
        replace(with_blocks("cross_cylinder_attention"), head=HEADS["linear"]()),
        "no hidden features for the block CrossCylinderAttention",
    ),
    (
        "committee",
        replace(TASK, features=FeatureSet("many", ("v_1", "v_2", *(f"x_{n}" for n in range(9_998))))),
        ModelSpec(backbone=BACKBONES["committee"](trees=1)),
        "would read 70,000 columns",
    ),
    ("hybrid", reads("hybrid"), with_physics("hybrid", "linear_bypass"), "init = 'zero'"),
]
ALONE = {name: make() for registry in REGISTRIES for name, make in registry.items() if issubclass(make, HasConflicts)}


def test_every_part_that_can_refuse_is_refused_here():
    assert {name for name, *_ in REFUSED} == set(ALONE)


@pytest.mark.parametrize(("name", "task", "model", "reason"), REFUSED)
def test_contradictions_are_refused_with_the_reason(name, task, model, reason):
    with pytest.raises(ConfigError, match=reason) as refused:
        check_combination(task, model)
    assert name in str(refused.value)
    features = len(task.features.features)
    blank = Scaler(np.zeros(features), np.ones(features), np.zeros((1, 2)), np.ones((1, 2)))
    with pytest.raises(ConfigError, match=reason):
        build_model(task, model, blank, 0)


def test_all_reasons_are_given_at_once():
    task = replace(TASK, targets=("v_1",), mode=TargetMode.DELTA)
    with pytest.raises(ConfigError, match=r"velocity_skip.*; cross_cylinder_attention"):
        check_combination(task, with_blocks("velocity_skip", "cross_cylinder_attention"))


@pytest.mark.parametrize("name", list(BLOCKS))
def test_the_same_block_twice_is_refused(name):
    backbone = next(
        spec() for spec in BACKBONES.values() if BLOCKS[name].slot in (*spec().slots(), "gate", "mix", "bypass")
    )
    with pytest.raises(ConfigError, match=f"blocks {name}, {name} share the slot"):
        ModelSpec(backbone=backbone, blocks=(BLOCKS[name](), BLOCKS[name]()))


def test_two_blocks_of_one_slot_are_refused_unless_it_takes_several():
    with pytest.raises(ConfigError, match="blocks linear_bypass, velocity_skip share the slot 'bypass'; keep one"):
        with_blocks("linear_bypass", "velocity_skip")
    with_blocks("squeeze_excitation", "attention_bridge", "temporal_difference", "global_average_pooling")
