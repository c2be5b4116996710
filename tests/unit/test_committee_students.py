"""Students of committees begin with what their teacher knows in closed form, and learn the rest by gradient."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from edp.config.experiment import build
from edp.data.chunks import ChunkSpec
from edp.data.features import FeatureSet
from edp.data.prepared import prepare
from edp.data.splits import ByTime
from edp.data.task import TargetMode, Task
from edp.errors import ConfigError
from edp.networks.backbones import CommitteeSpec
from edp.networks.heads import LinearHead
from edp.networks.predictor import ModelSpec
from edp.networks.running import stream_predictions
from edp.recording import Recording
from edp.signals import Channel, Kind
from edp.training.bagging.fit import fit_bagged
from edp.training.bagging.spec import BaggingSpec
from edp.training.fit import fit
from edp.training.spec import TrainingSpec, by_gradient
from edp.training.warm_start import WarmStart
from edp.workflows.compression.bench import CompressionRequest
from edp.workflows.compression.committee import committee_start
from edp.workflows.compression.pruning import check_pruning

pytestmark = pytest.mark.training
HORIZON = 2


@pytest.fixture(scope="module")
def data():
    """A plant whose input saturates."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-2, 2, 300), 10)
    y = np.zeros(len(u))
    for tick in range(1, len(u)):
        y[tick] = 0.9 * y[tick - 1] + 0.3 * np.tanh(2 * u[tick - 1]) + 0.01 * rng.normal()
    channels = (Channel("u", Kind.GENERIC), Channel("y", Kind.GENERIC))
    values = np.stack([u, y], axis=1).astype(np.float32)
    log = Recording(name="log", rate_hz=50.0, channels=channels, values=values, source="test")
    task = Task(FeatureSet("two", ("u", "y")), ("y",), (HORIZON,), TargetMode.DELTA, 50.0)
    return prepare([log], task, ByTime(), 10)


def teacher_of(data, **parts):
    backbone = CommitteeSpec(lags=(1, 2, 4, 8), members=4, units=16, **parts)
    model = ModelSpec(backbone=backbone, head=LinearHead(), blocks=(), window=10)
    loss = build(TrainingSpec, {"loss": {"kind": "mse"}}, "test").loss
    spec = TrainingSpec(loss=loss, bagging=BaggingSpec(folds=4, steps=400, batch=64, checks=4, learning_rate=1e-2))
    return fit_bagged(data, model, spec).fitted.predictor, spec


def error(net, data):
    (predicted,) = stream_predictions(net, data.test)
    part = data.test[0]
    return float(np.sqrt(np.square(predicted[10:-HORIZON, 0, 0] - part.targets[10 + HORIZON :, 0]).mean()))


def test_without_perceptrons_the_student_begins_as_its_teacher(data):
    teacher, _ = teacher_of(data, activations=(), centres=40)
    model = CompressionRequest(name="student", units=8).model(teacher.spec)
    start = committee_start(teacher, model, data)
    (wanted,), (predicted,) = (stream_predictions(net.eval(), data.test) for net in (teacher, start))
    np.testing.assert_allclose(predicted, wanted, atol=1e-5)


def test_the_first_weights_of_a_student_leave_out_what_it_has_to_learn(data):
    teacher, _ = teacher_of(data, centres=40, trees=20)
    model = CompressionRequest(name="student", units=8).model(teacher.spec)
    assert model.backbone.trees == 0
    start = committee_start(teacher, model, data)
    columns = teacher.backbone.bank.columns
    hidden = 2 * 4 * 8  # two activations, four members, eight units
    assert torch.equal(start.heads.weights[0][:, columns : columns + hidden], torch.zeros(1, hidden, 1))
    assert torch.equal(start.backbone.bank.gain, teacher.backbone.bank.gain)


def test_a_student_of_a_committee_learns_from_it_by_gradient(data):
    teacher, spec = teacher_of(data, centres=40, trees=20)
    order = CompressionRequest(name="student", units=8)
    training = replace(spec, epochs=4, updates=60)
    strategy = order.strategy([teacher], data, None)
    student = fit(data, order.model(teacher.spec), training, strategy=strategy).predictor
    assert sum(p.numel() for p in student.parameters()) < 0.6 * sum(p.numel() for p in teacher.parameters())
    assert error(student, data) < 1.3 * error(teacher, data)


def test_a_committee_trains_on_by_gradient_and_keeps_its_trees(data):
    teacher, spec = teacher_of(data, centres=40, trees=20)
    adapted = fit(data, teacher.spec, replace(spec, epochs=1, updates=5), strategy=WarmStart(teacher)).predictor
    assert torch.equal(adapted.backbone.trees.leaf, teacher.backbone.trees.leaf)
    assert error(adapted, data) < 1.2 * error(teacher, data)


def test_training_by_gradient_obeys_all_settings_that_were_given():
    spec = TrainingSpec(bagging=BaggingSpec(), epochs=3, patience=2)
    plain = by_gradient(spec)
    assert plain.bagging is None
    assert (plain.epochs, plain.patience) == (3, 2)
    assert plain.updates > 0
    assert plain.chunks.burn_in == 0
    own = replace(spec, chunks=ChunkSpec(length=32), updates=7)
    assert by_gradient(own) == replace(own, bagging=None)
    assert by_gradient(plain) is plain


def test_committees_and_heads_without_hidden_features_are_not_pruned():
    model = ModelSpec(backbone=CommitteeSpec(members=4), head=LinearHead(), blocks=(), window=10)
    with pytest.raises(ConfigError, match="no rule for the backbone 'committee'; the head 'linear'; distil"):
        check_pruning(model, model)
