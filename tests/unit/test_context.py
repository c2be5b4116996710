"""Errors by the time since reset: held to a network that is stepped tick by tick."""

import dataclasses

import numpy as np
import pytest

from edp.errors import ConfigError, DataError
from edp.evaluation.context import context_errors
from edp.networks.predictor import build_model
from edp.networks.stream import Stream
from edp.signals import Kind

pytestmark = pytest.mark.long

KINDS = [Kind.VELOCITY] * 3


@pytest.fixture(scope="module")
def network(tiny, tiny_model):
    task = dataclasses.replace(tiny.task, rate_hz=20.0)  # blocks of 10 ticks every 100
    return build_model(task, tiny_model, tiny.scaler(), seed=2).eval()


def test_errors_are_those_of_streams_that_were_reset_before_each_block(network, tiny):
    series = [
        dataclasses.replace(tiny.train[0], machine="a"),
        dataclasses.replace(tiny.train[1], machine="a"),
        dataclasses.replace(tiny.validation[0], machine="b"),
    ]
    found = context_errors(network, series, KINDS, (1.0, 4.0))
    assert found.machines == ("a", "b")
    blocks = [(part, at) for part in series for at in range(80, part.samples - 10 - 3 + 1, 100)]
    assert found.ticks == 10 * len(blocks)
    for c, context in enumerate((20, 80)):
        errors = {"a": [], "b": []}
        for part, at in blocks:
            stream = Stream(network)
            for t in range(at - context, at + 10):
                said = stream.step(part.inputs[t]).prediction
                if t >= at:
                    truth = np.stack([part.targets[t + k] for k in (1, 3)])
                    errors[part.machine].append(1e3 * np.abs(said - truth))
        for m, name in enumerate(found.machines):
            np.testing.assert_allclose(found.errors[c, m], np.mean(errors[name], axis=0), rtol=1e-4)
    each = found.errors[:, :, 0].mean(axis=2)
    gain = each[1] / each[0] - 1
    np.testing.assert_allclose(found.gain()[1], [gain.mean(), gain.std(ddof=1) / np.sqrt(2)])
    rows = found.unseen_errors().contexts
    assert [row.seconds for row in rows] == [1.0, 4.0]
    assert rows[0].change == 0.0


def test_contexts_that_are_too_long_are_dropped_and_said(network, tiny):
    found = context_errors(network, tiny.validation, KINDS, (1.0, 60.0))
    assert found.seconds == (1.0,)
    assert found.dropped == (60.0,)
    assert found.unseen_errors().contexts[0].change_error is None
    with pytest.raises(DataError, match=r"allows a context of 19.35 s"):
        context_errors(network, tiny.validation, KINDS, (60.0,))


@pytest.mark.parametrize("seconds", [(), (0.0, 1.0)])
def test_contexts_must_be_positive(network, tiny, seconds):
    with pytest.raises(ConfigError, match="must hold"):
        context_errors(network, tiny.validation, KINDS, seconds)
