"""Students of committees begin with what their teacher knows in closed form, and learn the rest by gradient."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from edp.config.experiment import build
from edp.data.chunks import ChunkSpec
from edp.data.features import FeatureSet
from edp.data.prepared import prepare
from edp.data.scaling import feature_matrix
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
from edp.training.bagging.table import bank_rows
from edp.training.compression.committee import committee_start
from edp.training.compression.distillation import DistillationSpec
from edp.training.compression.imitation import CommitteeImitation, move_rows, predict_rows
from edp.training.compression.pruning import check_pruning
from edp.training.compression.qat import RoundingSpec
from edp.training.fit import fit
from edp.training.spec import TrainingSpec, to_gradient_training
from edp.training.warm_start import WarmStart
from edp.workflows.compression.bench import CompressionRequest

pytestmark = pytest.mark.long
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
    spec = TrainingSpec(
        loss=loss, ensemble=BaggingSpec(folds=4, steps=600, batch=64, validations=4, learning_rate=1e-2)
    )
    return fit_bagged(data, model, spec).fitted.predictor


@pytest.fixture(scope="module")
def teacher(data):
    return teacher_of(data, centres=40, trees=20)


def error(net, data):
    (predicted,) = stream_predictions(net, data.test)
    part = data.test[0]
    return float(np.sqrt(np.square(predicted[10:-HORIZON, 0, 0] - part.targets[10 + HORIZON :, 0]).mean()))


def test_a_student_begins_with_the_linear_model_and_silent_perceptrons(data, teacher):
    model = CompressionRequest(name="student", units=8).model(teacher.spec)
    assert (model.backbone.trees, model.backbone.centres, model.backbone.members) == (0, 0, 1)
    start = committee_start(teacher, model, data)
    columns = teacher.backbone.bank.columns
    hidden = 2 * 8  # two activations, eight units
    assert torch.equal(start.heads.weights[0][:, :columns], teacher.heads.weights[0][:, :columns])
    assert torch.equal(start.heads.weights[0][:, columns:], torch.zeros(1, hidden, 1))
    assert torch.equal(start.backbone.bank.gain, teacher.backbone.bank.gain)


def test_rows_of_the_bank_say_what_the_stream_says(data, teacher):
    part = data.test[0]
    on_rows = predict_rows(teacher, torch.from_numpy(bank_rows(teacher, part)))
    (streamed,) = stream_predictions(teacher, data.test)
    expected = teacher.code.encode(torch.from_numpy(streamed), torch.from_numpy(feature_matrix(data.task, part)))
    np.testing.assert_allclose(on_rows, expected.flatten(1), atol=1e-4)


def test_a_student_learns_on_rows_what_its_committee_says(data, teacher):
    order = CompressionRequest(name="student", units=16)
    model = order.model(teacher.spec)
    fitted = fit(data, model, TrainingSpec(), strategy=CommitteeImitation(teacher, steps=600))
    assert sum(p.numel() for p in fitted.predictor.parameters()) < 0.4 * sum(p.numel() for p in teacher.parameters())
    begun, taught, wanted = (
        error(net, data) for net in (committee_start(teacher, model, data), fitted.predictor, teacher)
    )
    assert begun - taught > 0.7 * (begun - wanted)
    assert [row["best"] for row in fitted.history] == [False] * 9 + [True]
    assert fitted.history[-1]["updates"] == 600


def test_moved_rows_combine_what_was_never_recorded_together():
    """Two places, of which only one moves: a moved row is a place with the motion of the other one."""
    ticks = torch.arange(400.0)
    moving = torch.stack([torch.full((400,), 5.0), torch.sin(ticks / 5)], dim=1)
    rows = torch.cat([moving, torch.zeros(400, 2)])
    moved = move_rows(rows, 2000, torch.Generator().manual_seed(0))
    at_rest = moved[moved[:, 0].abs() < 1e-6]
    assert moved.shape == (2000, 2)
    assert at_rest[:, 1].abs().max() > 1.0
    assert moved[:, 1].abs().max() < 3.0 + 1e-6  # never further than a place and a whole motion


def test_a_student_with_an_objective_learns_in_chunks(data, teacher):
    order = CompressionRequest(name="student", units=16, distillation=DistillationSpec(target_weight=0.2))
    assert not order.on_rows([teacher])
    training = replace(order.training(TrainingSpec(ensemble=BaggingSpec())), epochs=4, updates=60)
    model = order.model(teacher.spec)
    student = fit(data, model, training, strategy=order.strategy([teacher], data, None)).predictor
    begun, taught, wanted = (error(net, data) for net in (committee_start(teacher, model, data), student, teacher))
    assert begun - taught > 0.3 * (begun - wanted)


def test_without_an_objective_orders_of_committees_are_taught_on_rows(data, teacher):
    order = CompressionRequest(name="student", units=4)
    assert isinstance(order.strategy([teacher], data, None), CommitteeImitation)
    assert not replace(order, rounding=RoundingSpec()).on_rows([teacher])
    assert not order.on_rows([teacher, teacher])


def test_equal_seeds_give_equal_students(data, teacher):
    model = CompressionRequest(name="student", units=4).model(teacher.spec)
    one, same, other = (
        fit(data, model, TrainingSpec(seed=seed), strategy=CommitteeImitation(teacher, steps=10)) for seed in (0, 0, 1)
    )
    weights = [each.predictor.heads.weights[0] for each in (one, same, other)]
    assert torch.equal(weights[0], weights[1])
    assert not torch.equal(weights[0], weights[2])


def test_further_recordings_count_without_truth(data, teacher):
    model = CompressionRequest(name="student", units=4).model(teacher.spec)
    further = [replace(data.test[0], targets=np.full_like(data.test[0].targets, np.nan))]
    plain, more = (
        fit(data, model, TrainingSpec(), strategy=CommitteeImitation(teacher, others, steps=10))
        for others in ((), further)
    )
    assert all(np.isfinite(row["validation_mae"]) for row in more.history)
    assert not torch.equal(plain.predictor.heads.weights[0], more.predictor.heads.weights[0])


def test_fewer_updates_than_reports_are_refused(teacher):
    with pytest.raises(ConfigError, match="9 updates; 10 or more"):
        CommitteeImitation(teacher, steps=9)


def test_a_committee_without_perceptrons_has_no_student(data):
    teacher = teacher_of(data, activations=(), centres=40)
    with pytest.raises(ConfigError, match=r"without perceptrons .* has no width"):
        CompressionRequest(name="student", units=8).model(teacher.spec)


def test_a_committee_trains_on_by_gradient_and_keeps_its_trees(data, teacher):
    spec = TrainingSpec(ensemble=BaggingSpec())
    adapted = fit(data, teacher.spec, replace(spec, epochs=1, updates=5), strategy=WarmStart(teacher)).predictor
    assert torch.equal(adapted.backbone.trees.leaf, teacher.backbone.trees.leaf)
    assert error(adapted, data) < 1.2 * error(teacher, data)


def test_training_by_gradient_obeys_all_settings_that_were_given():
    spec = TrainingSpec(ensemble=BaggingSpec(), epochs=3, patience=2)
    plain = to_gradient_training(spec)
    assert plain.ensemble is None
    assert (plain.epochs, plain.patience) == (3, 2)
    assert plain.updates > 0
    assert plain.chunks.burn_in == 0
    own = replace(spec, chunks=ChunkSpec(length=32), updates=7)
    assert to_gradient_training(own) == replace(own, ensemble=None)
    assert to_gradient_training(plain) is plain


def test_committees_and_heads_without_hidden_features_are_not_pruned():
    model = ModelSpec(backbone=CommitteeSpec(members=4), head=LinearHead(), blocks=(), window=10)
    with pytest.raises(ConfigError, match="no rule for the backbone 'committee'; the head 'linear'; distil"):
        check_pruning(model, model)
