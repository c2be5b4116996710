"""Distillation: what a student learns from teachers, with truth and without."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from edp.config.experiment import load_experiment
from edp.data.augment import TimeWarp
from edp.data.chunks import ChunkSampler, ChunkSpec
from edp.data.series import Series
from edp.data.unlabelled import unlabelled
from edp.errors import ConfigError, DataError
from edp.networks.backbones import CommitteeSpec, HybridSpec, LstmSpec, TcnSpec
from edp.networks.heads import MlpHead
from edp.networks.losses import MeanSquared, Prediction
from edp.networks.narrow import student, width_of
from edp.networks.predictor import ModelSpec, build_model
from edp.networks.running import stream_predictions
from edp.recording import Recording
from edp.signals import Channel, Kind
from edp.storage.runs import KeyedRun, Run
from edp.training.averages import NoAverage
from edp.training.compression.hints import Components, hint_error
from edp.training.fit import fit
from edp.training.objective import Objective
from edp.training.strategy import BatchContext
from edp.training.warm_start import continue_from
from edp.workflows.compression import Distillation, DistillationSpec, SoftmaxDivergence

pytestmark = pytest.mark.long

THESIS = Path(__file__).parents[2] / "examples" / "thesis"


@pytest.fixture(scope="module")
def teacher(tiny, tiny_model):
    """An untrained network with strong opinions: what agrees with it was not learned from the truth."""
    net = build_model(tiny.task, tiny_model, tiny.scaler(), seed=5)
    with torch.no_grad():
        net.heads.weights[-1].mul_(4.0)
    return net.eval()


@pytest.fixture(scope="module")
def small(tiny_model):
    return student(tiny_model, units=4)


@pytest.fixture(scope="module")
def brief(tiny_training):
    """One epoch, which is the best one whatever the truth says of it."""
    return dataclasses.replace(tiny_training, epochs=1, updates=5, average=NoAverage())


def gap(one, other, series):
    """Mean distance of two networks' predictions over the series, SI units."""
    pairs = zip(stream_predictions(one, series), stream_predictions(other, series), strict=True)
    return float(np.mean([np.abs(a - b)[20:].mean() for a, b in pairs]))


def same(one, other):
    return all(torch.equal(a, b) for a, b in zip(one.parameters(), other.parameters(), strict=True))


def test_a_student_of_the_teacher_alone_does_as_it_does_whatever_the_truth_says(tiny, brief, teacher, small):
    spec = dataclasses.replace(brief, updates=150)
    strategy_columns, plain = (
        fit(tiny, small, spec, strategy=strategy).predictor
        for strategy in (Distillation([teacher], DistillationSpec(target_weight=0.0)), None)
    )
    assert gap(strategy_columns, teacher, tiny.test) < 0.5 * gap(plain, teacher, tiny.test)


def test_loss_is_the_dual_objective(tiny, tiny_training, teacher, small):
    net = build_model(tiny.task, small, tiny.scaler(), seed=1).eval()
    training = dataclasses.replace(tiny_training, loss=MeanSquared())
    objective = Objective(training, net.code)

    def loss(truth):
        strategy = Distillation([teacher], DistillationSpec(target_weight=truth, distillation_loss=MeanSquared()))
        strategy_columns = strategy.series(tiny.task, tiny.train)
        batch = next(ChunkSampler(strategy_columns, tiny.task.horizons, training.chunks, 0).epoch(0))
        x = torch.from_numpy(batch.inputs)
        answer, features, hidden, _ = net.forward_features(x, net.initial_state(len(x), x))
        future, valid, said = (torch.from_numpy(part) for part in (batch.future, batch.valid, batch.strategy_columns))
        batch_context = BatchContext(answer, future, features, hidden, valid, said)
        hard = objective.evaluate(answer, future, features, valid)
        goal = objective.code.encode(said[..., 1:].unflatten(-1, (2, 3)), features)
        soft = ((answer.center - goal) ** 2)[valid].mean()
        return [float(value.detach()) for value in (strategy.loss(objective, batch_context), hard, soft)]

    for truth in (0.0, 0.3, 0.9):
        total, hard, soft = loss(truth)
        assert total == pytest.approx(truth * hard + (1 - truth) * soft, rel=1e-5)


def test_what_is_taught_is_the_stream_of_the_mean_teacher(tiny, tiny_model, tiny_training, teacher):
    other = build_model(tiny.task, tiny_model, tiny.scaler(), seed=9)
    strategy_columns = Distillation([teacher, other]).series(tiny.task, tiny.train)
    for part, series in zip(strategy_columns[:1], tiny.train[:1], strict=True):
        alone = [stream_predictions(net, [series])[0] for net in (teacher, other)]
        assert part.strategy_columns.shape == (series.samples, 1 + 6)
        np.testing.assert_allclose(
            part.strategy_columns[:, 1:].reshape(-1, 2, 3), np.mean(alone, axis=0), rtol=1e-5, atol=1e-7
        )
        assert (part.strategy_columns[:, 0] == 1).all()
        assert part.inputs is series.inputs


def test_chunks_and_windows_carry_the_lesson_of_their_own_ticks(tiny, teacher):
    strategy_columns = Distillation([teacher]).series(tiny.task, tiny.train)
    marked = [dataclasses.replace(part, strategy_columns=part.inputs) for part in strategy_columns]
    for spec in (ChunkSpec(length=32, batch=4, burn_in=20), ChunkSpec(regime="window", length=10, batch=8)):
        for batch in ChunkSampler(marked, (1, 3), spec, seed=2, augmentations=(TimeWarp(),)).epoch(1):
            np.testing.assert_array_equal(batch.strategy_columns, batch.inputs)


def test_series_without_truth_teach_without_a_share_in_the_loss_of_the_truth(tiny, brief, teacher, small):
    """Whatever stands in the place of their targets, the bits are the same; scaling is that of what has truth."""
    part = tiny.train[0]
    further = [dataclasses.replace(part, targets=np.full_like(part.targets, value)) for value in (0.5, np.nan)]
    lessons = [Distillation([teacher], further=[part]) for part in further]
    made = [fit(tiny, small, brief, strategy=strategy).predictor for strategy in lessons]
    assert same(*made)
    assert not same(made[0], fit(tiny, small, brief, strategy=Distillation([teacher])).predictor)
    assert torch.equal(made[0].code.width, build_model(tiny.task, small, tiny.scaler(), seed=0).code.width)
    assert [part.strategy_columns[0, 0] for part in lessons[0].series(tiny.task, tiny.train)] == [1, 1, 0]


def test_unlabelled_takes_a_recording_that_has_inputs_only(tiny):
    speeds = (Channel(name, Kind.VELOCITY) for name in ("boom", "arm", "bucket"))
    channels = (*speeds, Channel("lever", Kind.GENERIC))
    values = np.arange(40, dtype=np.float32).reshape(10, 4)
    part = unlabelled(tiny.task, Recording("log", channels, values, 100.0))
    np.testing.assert_array_equal(part.inputs, values)
    assert part.targets.shape == (10, 3)
    with pytest.raises(DataError, match="50 Hz, the task 100 Hz"):
        unlabelled(tiny.task, Recording("log", channels, values, 50.0))
    values[3, 3] = np.nan
    with pytest.raises(DataError, match=r"'lever' has 1 missing or infinite value\(s\), the first at row 3"):
        unlabelled(tiny.task, Recording("log", channels, values, 100.0))


def test_a_lesson_that_was_stopped_goes_on_to_the_same_bits(tiny, tiny_training, teacher, small, tmp_path):
    strategy = Distillation([teacher], DistillationSpec(hint_weight=0.1, components=4))
    spec = dataclasses.replace(tiny_training, epochs=3, updates=4, chunks=ChunkSpec(length=32, batch=8, burn_in=20))
    whole = fit(tiny, small, spec, strategy=strategy).predictor

    class Stop(Exception):
        pass

    def stop(event):
        if event.row and event.epoch == 2:
            raise Stop

    with Run(tmp_path / "run") as run:
        run.claim("key", "")
        with pytest.raises(Stop):
            fit(tiny, small, spec, KeyedRun(run, "key"), stop, strategy)
        again = fit(tiny, small, spec, KeyedRun(run, "key"), strategy=strategy)
    assert again.resumed_at == 2
    assert same(again.predictor, whole)


def test_a_refit_learns_from_the_teacher_too(tiny, tiny_training, teacher, small):
    spec = dataclasses.replace(tiny_training, epochs=1, updates=3, refit="whole")
    strategy = Distillation([teacher], DistillationSpec(target_weight=0.0))
    assert not same(fit(tiny, small, spec).predictor, fit(tiny, small, spec, strategy=strategy).predictor)


def test_the_gradient_of_a_hint_pulls_hidden_features_towards_the_teachers(tiny, teacher, small):
    strategy = Distillation([teacher], DistillationSpec(hint_weight=1.0, components=6))
    part = strategy.series(tiny.task, tiny.train)[0]
    wanted, x = torch.from_numpy(part.strategy_columns[None, :, 7:]), torch.from_numpy(part.inputs[None])
    net = build_model(tiny.task, small, tiny.scaler(), seed=1)
    optimizer = torch.optim.Adam(net.backbone.parameters(), 1e-2)
    errors = []
    for _ in range(15):
        hidden = net.forward_features(x, net.initial_state(1, x))[2]
        loss = hint_error(hidden, wanted, torch.ones(hidden.shape[:2], dtype=torch.bool))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        errors.append(float(loss.detach()))
    assert errors[-1] < 0.8 * errors[0]


def test_hint_error_is_zero_where_a_linear_map_does_it_and_all_there_is_where_none_helps():
    rng = torch.Generator().manual_seed(0)
    hidden = torch.randn(4, 500, 3, generator=rng)
    valid = torch.ones(4, 500, dtype=torch.bool)
    mapped = hidden @ torch.randn(3, 2, generator=rng) + 1.0
    assert float(hint_error(hidden, mapped, valid)) < 1e-3
    noise = torch.randn(4, 500, 2, generator=rng)
    assert float(hint_error(hidden, noise, valid)) == pytest.approx(float(noise.square().mean()), rel=0.01)
    few = torch.zeros_like(valid)
    few[0, :11] = True
    assert float(hint_error(hidden, mapped, few)) == 0.0


def test_components_are_those_of_largest_variance_scaled_to_one():
    rng = np.random.default_rng(0)
    values = (rng.normal(size=(4000, 4)) * [5.0, 0.1, 2.0, 0.1] + 3.0).astype(np.float32)
    found = Components.fitted([values[:1000], values[1000:]], 2).project(values)
    assert np.mean(found**2) == pytest.approx(1.0, rel=1e-3)
    for column, source in enumerate((0, 2)):
        assert abs(np.corrcoef(found[:, column], values[:, source])[0, 1]) > 0.999


def test_softmax_divergence_is_that_of_the_equation_and_blind_to_a_common_shift():
    rng = torch.Generator().manual_seed(0)
    student_z, teacher_z = torch.randn(2, 5, 1, 3, generator=rng), torch.randn(2, 5, 1, 3, generator=rng)
    loss = SoftmaxDivergence(temperature=2.0)
    p, q = (z / 2 for z in (teacher_z, student_z))
    wanted = 4 * torch.nn.functional.kl_div(
        q.log_softmax(-1).flatten(0, 2), p.softmax(-1).flatten(0, 2), reduction="batchmean"
    )
    assert float(loss.evaluate(Prediction(student_z, student_z[..., :0]), teacher_z).mean()) == pytest.approx(
        float(wanted)
    )
    moved = Prediction(teacher_z + 1.0, teacher_z[..., :0])
    assert float(loss.evaluate(moved, teacher_z).abs().max()) < 1e-6


@pytest.mark.parametrize(
    ("teacher_file", "student_file", "units"),
    [
        ("k10_teacher", "k10_student_u64", 64),
        ("k10_teacher", "k10_student_u32", 32),
        ("k1_teacher_p4", "k1_student_u64", 64),
        ("k1_teacher_p4", "k1_student_u32", 32),
        ("k1_teacher_p5", "k1_student_p5_u64", 64),
        ("k1_teacher_p5", "k1_student_p5_u32", 32),
    ],
)
def test_students_are_those_of_the_thesis_but_for_the_output_activation(teacher_file, student_file, units):
    """The thesis's students do without the learned amplitude of some of its teachers."""
    teacher, wanted = (load_experiment(THESIS / f"{name}.toml").model for name in (teacher_file, student_file))
    made = student(teacher, units)
    assert dataclasses.replace(made, activation=wanted.activation) == wanted
    assert width_of(made) == units


def test_students_of_other_backbones():
    lstm = student(ModelSpec(backbone=LstmSpec(units=64), head=MlpHead(hidden=32)), units=16)
    assert (lstm.backbone.units, lstm.head.hidden) == (16, 8)
    tcn = student(ModelSpec(backbone=TcnSpec(channels=(64, 64, 32, 32), kernel=3)), units=8)
    assert tcn.backbone.channels == (8, 8, 4, 4)
    model = ModelSpec(backbone=HybridSpec(channels=(64, 32), units=64))
    assert student(model, 32, levels=2).backbone.channels == (32, 16)
    committee = student(ModelSpec(backbone=CommitteeSpec(units=64, trees=20)), units=16)
    assert (committee.backbone.units, committee.backbone.trees) == (16, 0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: student(m, 0), "units = 0; 1 <= units <= 8"),
        (lambda m: student(m, 9), "units = 9; 1 <= units <= 8"),
        (lambda m: student(m, 4, levels=2), "levels = 2; 1 <= levels <= 1"),
        (lambda m: student(ModelSpec(backbone=LstmSpec(units=8)), 4, levels=1), "has no convolutions"),
        (lambda m: DistillationSpec(target_weight=1.0), "target_weight = 1.0; expected 0 <= target_weight < 1"),
        (lambda m: DistillationSpec(hint_weight=-1.0), "hint_weight = -1.0"),
        (lambda m: SoftmaxDivergence(temperature=0.0), "temperature = 0.0; 0 < temperature"),
        (lambda m: Distillation([]), "no teacher"),
    ],
)
def test_what_cannot_be_is_refused(tiny_model, change, message):
    with pytest.raises(ConfigError, match=message):
        change(tiny_model)


def test_teacher_and_student_must_read_and_predict_the_same(tiny, tiny_model, tiny_training, teacher, small):
    task = dataclasses.replace(tiny.task, horizons=(2,))
    with pytest.raises(ConfigError, match=r"the student and the teacher have horizons \(2,\) and \(1, 3\)"):
        Distillation([teacher]).series(task, tiny.train)
    other = build_model(task, tiny_model, dataclasses.replace(tiny, task=task).scaler(), seed=0)
    with pytest.raises(ConfigError, match="teacher 2 and teacher 1 have horizons"):
        Distillation([teacher, other])
    with pytest.raises(ConfigError, match="other specs"):
        continue_from(build_model(tiny.task, small, tiny.scaler(), seed=0), teacher)


def test_a_batch_too_small_for_a_hint_is_refused(tiny, tiny_training, teacher, small):
    spec = dataclasses.replace(tiny_training, chunks=ChunkSpec(regime="window", length=10, batch=8))
    with pytest.raises(ConfigError, match="a batch has 8 ticks with a loss, too few to compare 8 hidden features"):
        fit(tiny, small, spec, strategy=Distillation([teacher], DistillationSpec(hint_weight=1.0)))


def test_training_begins_with_the_weights_of_a_start(tiny, tiny_model, brief, teacher):
    spec = dataclasses.replace(brief, updates=1, optimizer=dataclasses.replace(brief.optimizer, learning_rate=1e-12))
    made = fit(tiny, tiny_model, spec, strategy=Distillation([teacher], start=teacher)).predictor
    for one, other in zip(made.parameters(), teacher.parameters(), strict=True):
        torch.testing.assert_close(one, other, atol=1e-6, rtol=0)


def test_a_teacher_that_is_not_finite_is_told(tiny, tiny_model):
    net = build_model(tiny.task, tiny_model, tiny.scaler(), seed=0)
    with torch.no_grad():
        net.heads.biases[-1].fill_(math.nan)
    with pytest.raises(DataError, match="a teacher's prediction for 'linear 1' is not finite"):
        Distillation([net]).series(tiny.task, tiny.train)


def test_series_is_plain_without_a_lesson():
    part = Series("x", np.zeros((3, 1), np.float32), np.zeros((3, 1), np.float32))
    assert part.strategy_columns is None
