"""Any combination of registered parts is a working network or refused with a reason; nothing else happens."""

import re
from dataclasses import fields, replace

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from edp.data.features import FeatureSet
from edp.data.scaling import Scaler
from edp.data.task import TargetMode, Task
from edp.errors import ConfigError
from edp.networks.activations import ACTIVATIONS
from edp.networks.backbones import BACKBONES
from edp.networks.blocks import BLOCKS
from edp.networks.cells import CELLS
from edp.networks.heads import HEADS
from edp.networks.initial import INITIAL_STATES
from edp.networks.outputs import OUTPUTS
from edp.networks.physics import PHYSICS
from edp.networks.plain import model_from_dict, model_to_dict
from edp.networks.predictor import ModelSpec, build_model

FEATURES = FeatureSet("three", ("CylVels_1", "CylVels_2", "lever"))


def one_of(registry):
    return st.sampled_from(list(registry)).map(lambda name: registry[name]())


PARTS = st.fixed_dictionaries(
    {
        "backbone": one_of(BACKBONES),
        "head": one_of(HEADS),
        "output": one_of(OUTPUTS),
        "activation": one_of(ACTIVATIONS),
        "physics": st.one_of(st.none(), one_of(PHYSICS)),
        "blocks": st.lists(one_of(BLOCKS), max_size=6).map(tuple),
    }
)
RECURRENCE = st.fixed_dictionaries(
    {"cell": one_of(CELLS), "initial": one_of(INITIAL_STATES), "zoneout": st.sampled_from([0.0, 0.0, 0.1])}
)
TASKS = st.builds(
    lambda targets, horizons, mode: Task(FEATURES, targets, horizons, mode, 100.0),
    st.sampled_from([("CylVels_1",), ("CylVels_2", "CylVels_1")]),
    st.sampled_from([(1,), (2, 5)]),
    st.sampled_from(list(TargetMode)),
)
built: list[ModelSpec] = []
refusals: list[str] = []


def test_any_combination_is_built_or_refused():
    check()
    assert len(built) >= 20
    assert len(refusals) >= 20
    advice = "keep one of them|remove the block|remove one of them|set zoneout = 0|take a cell"
    for message in refusals:
        assert re.search(advice, message), message


@settings(max_examples=150, deadline=None, database=None, derandomize=True)
@given(parts=PARTS, recurrence=RECURRENCE, task=TASKS)
def check(parts, recurrence, task):
    shape = (len(task.horizons), len(task.targets))
    wanted = parts["physics"].channels() if parts["physics"] else ()
    task = replace(task, physics=tuple(name for name in wanted if name not in FEATURES.inputs))
    try:
        backbone = parts["backbone"]
        offered = {field.name for field in fields(backbone)}
        backbone = replace(backbone, **{name: part for name, part in recurrence.items() if name in offered})
        spec = ModelSpec(**(parts | {"backbone": backbone}))
        predictor = build_model(task, spec, Scaler(np.zeros(3), np.ones(3), np.zeros(shape), np.ones(shape)), 0)
    except ConfigError as error:
        refusals.append(str(error))
        return
    built.append(spec)
    assert model_from_dict(model_to_dict(spec)) == spec
    x = torch.randn(1, 4, len(task.inputs))
    with torch.no_grad():
        found, _ = predictor.predict(x, predictor.initial_state(1, x))
    assert found.shape == (1, 4, *shape)
    assert torch.isfinite(found).all()
    assert sum(row.parameters for row in predictor.costs()) == sum(p.numel() for p in predictor.parameters())
