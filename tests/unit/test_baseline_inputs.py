"""Baselines know what the network knows: no more, since a comparison on other inputs says nothing."""

import numpy as np
import pytest

from edp.data.features import Derived, FeatureSet
from edp.data.prepared import prepare
from edp.data.splits import ByTime
from edp.data.task import TargetMode, Task
from edp.evaluation.baselines import BASELINES
from edp.evaluation.judge import JudgeSpec, baseline_predictions, baseline_task
from edp.recording import Recording
from edp.signals import Channel, Kind

BASELINE = BASELINES["ridge_arx"]
SPEC = JudgeSpec(baselines=("ridge_arx",), history=8, warmup_samples=0)


def data_of(offset, hidden):
    """A cart whose velocity is derived from its position: the position itself is hidden from the network, or not."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-1, 1, 60), 10)
    velocity = np.convolve(u, 0.1 * 0.9 ** np.arange(40))[: len(u)]
    # A slow drift makes the position itself worth reading.
    q = np.cumsum(velocity) * 0.01 + offset * np.sin(np.arange(len(u)) / 40)
    channels = (Channel("u", Kind.GENERIC), Channel("q", Kind.POSITION))
    log = Recording(
        name="log", rate_hz=100.0, channels=channels, values=np.stack([u, q], axis=1).astype(np.float32), source="test"
    )
    places = {"hidden": ("q",)} if hidden else {}
    shown = ("u",) if hidden else ("u", "q")
    features = FeatureSet("cart", shown, (Derived("v", "q", "difference", Kind.VELOCITY),), **places)
    return prepare([log], Task(features, ("v",), (2,), TargetMode.DELTA, 100.0), ByTime(), 4)


@pytest.mark.parametrize(("hidden", "columns", "present"), [(True, 2, 1), (False, 3, 2)])
def test_hidden_channels_are_hidden_from_baselines_too(hidden, columns, present):
    data = data_of(1.0, hidden)
    assert baseline_task(data, SPEC).present == (present,)
    _, ridge = baseline_predictions(BASELINE, data, SPEC)
    assert ridge.weights.shape[1] == columns


def test_what_is_derived_from_a_hidden_channel_is_read():
    """The velocity follows its input, so a linear map on both predicts it closely."""
    data = data_of(0.0, hidden=True)
    predict, _ = baseline_predictions(BASELINE, data, SPEC)
    (predicted,) = predict(data)
    truth = data.test[0].targets[:, 0]
    error = predicted[7:-2, 0, 0] - truth[9:]
    assert np.abs(error).mean() < 0.2 * np.abs(truth - truth.mean()).mean()
