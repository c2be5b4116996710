"""Committees trained on folds: left-out predictions are honest, and the network says what the sum of its parts says."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.optimize import nnls
from sklearn.linear_model import Ridge

import edp.training.bagging.table
from edp.config.experiment import build
from edp.data.features import FeatureSet
from edp.data.fold_ridge import MIN_GAIN, PENALTIES, fold_ridge
from edp.data.folds import make_block_folds, recording_folds
from edp.data.prepared import prepare
from edp.data.splits import ByRecording, ByTime
from edp.data.task import TargetMode, Task
from edp.errors import ConfigError, DataError
from edp.ir.reference import Reference
from edp.networks.backbones import CommitteeSpec, HybridSpec
from edp.networks.heads import LinearHead, MlpHead
from edp.networks.lag_bank import LagBank
from edp.networks.predictor import ModelSpec, build_model
from edp.networks.radial import RadialFeatures
from edp.networks.running import stream_predictions
from edp.recording import Recording
from edp.signals import Channel, Kind
from edp.testing.streaming import check_graph
from edp.training.bagging.boosting import TreeLearner
from edp.training.bagging.fit import fit_bagged
from edp.training.bagging.spec import BaggingSpec
from edp.training.bagging.stacking import stacking_weights
from edp.training.bagging.table import table_of
from edp.training.fit import fit
from edp.training.spec import TrainingSpec, check_fitted_parts

pytestmark = pytest.mark.long

RATE = 50.0
CHANNELS = (Channel("u", Kind.GENERIC), Channel("y", Kind.GENERIC))


def recording(ticks=1500, seed=0, name="log"):
    """A saturated first-order plant: what is left after a line is a curve."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-2, 2, ticks // 10 + 1), 10)[:ticks]
    y = np.zeros(ticks)
    for tick in range(1, ticks):
        y[tick] = 0.9 * y[tick - 1] + 0.3 * np.tanh(2 * u[tick - 1]) + 0.01 * rng.normal()
    values = np.stack([u, y], axis=1).astype(np.float32)
    return Recording(name=name, rate_hz=RATE, channels=CHANNELS, values=values, source="test")


def data_of(*recordings, horizons=(1, 4), mode=TargetMode.DELTA, window=10):
    task = Task(FeatureSet("two", ("u", "y")), ("y",), horizons, mode, RATE)
    return prepare(list(recordings), task, ByTime(), window)


MODEL = ModelSpec(
    backbone=CommitteeSpec(lags=(1, 2, 4, 8), members=4, units=16), head=LinearHead(), blocks=(), window=10
)


def spec(**bagging):
    return TrainingSpec(
        loss=build(TrainingSpec, {"loss": {"kind": "mse"}}, "test").loss,
        ensemble=BaggingSpec(**{"folds": 4, "steps": 200, "batch": 64, "validations": 4, **bagging}),
    )


@pytest.fixture(scope="module")
def bagged():
    return fit_bagged(data_of(recording()), MODEL, spec(steps=600, learning_rate=1e-2))


def test_members_lower_the_error_of_rows_that_they_did_not_see(bagged):
    error = np.sqrt(np.square(bagged.left_out - bagged.table.targets).mean(axis=0))
    linear = np.sqrt(np.square(bagged.linear - bagged.table.targets).mean(axis=0))
    assert error[0] < 0.8 * linear[0]  # four ticks ahead the unknown input rules
    assert error[1] < linear[1]


def test_the_network_predicts_the_test_part_as_well_as_it_promised(bagged):
    data, net = data_of(recording()), bagged.fitted.predictor
    (predicted,) = stream_predictions(net, data.test)
    part, scale = data.test[0], net.code.width.numpy()
    for place, k in enumerate(data.task.horizons):
        error = (predicted[10 : part.samples - k, place] - part.targets[10 + k :]) / scale[place]
        promised = np.sqrt(np.square(bagged.left_out - bagged.table.targets).mean(axis=0))[place]
        assert np.sqrt(np.square(error).mean()) < 1.3 * promised


PARTS = {
    "perceptrons of two losses": ({"members": 8}, {"huber_delta": 0.1}),
    "radial": ({"activations": (), "centres": 100}, {}),
    "radial on few columns": ({"activations": (), "centres": 100, "local_lags": (0, 1)}, {}),
    "trees": ({"activations": (), "trees": 60}, {}),
    "trees that leave out two folds at a time": ({"activations": (), "trees": 60}, {"tree_folds": 2}),
    "deep trees of few leaves": ({"activations": (), "trees": 60, "tree_depth": 7}, {"tree_max_leaves": 12}),
    "one tree": ({"activations": (), "trees": 1}, {}),
    "all": ({"members": 8, "centres": 100, "trees": 60}, {"huber_delta": 0.1}),
}


def committee(**parts):
    backbone = CommitteeSpec(**{"lags": (1, 2, 4, 8), "members": 4, "units": 16, **parts})
    return ModelSpec(backbone=backbone, head=LinearHead(), blocks=(), window=10)


@pytest.mark.parametrize("name", PARTS)
def test_every_kind_of_learner_lowers_the_error_and_keeps_its_promise(name):
    parts, settings = PARTS[name]
    data = data_of(recording())
    outcome = fit_bagged(data, committee(**parts), spec(steps=300, learning_rate=1e-2, **settings))
    promise = np.sqrt(np.square(outcome.left_out - outcome.table.targets).mean(axis=0))
    linear = np.sqrt(np.square(outcome.linear - outcome.table.targets).mean(axis=0))
    assert (promise <= linear).all()
    assert promise[0] < (1.0 if name == "one tree" else 0.9) * linear[0]
    part, net = data.test[0], outcome.fitted.predictor
    (predicted,) = stream_predictions(net, data.test)
    for output, k in enumerate(data.task.horizons):
        error = (predicted[10 : part.samples - k, output] - part.targets[10 + k :]) / net.code.width.numpy()[output]
        assert np.sqrt(np.square(error).mean()) < 1.3 * promise[output]


def test_the_network_computes_the_weighted_sum_of_its_learners():
    """On rows that all models were fitted to: the linear model, the centres and the trees, put together by hand."""
    data = data_of(recording(), horizons=(1,), mode=TargetMode.ABSOLUTE)
    model = committee(activations=(), centres=40, local_lags=(2,), trees=20)
    outcome = fit_bagged(data, model, spec())
    net, table = outcome.fitted.predictor, outcome.table
    backbone, columns = net.backbone, torch.from_numpy(table.columns)
    weights = net.heads.weights[0].detach().double().numpy()[0, :, 0]
    near = []
    for functions, read in ((backbone.radial, range(10)), (backbone.near[0], [0, 1, 4, 5])):  # lags 1, 2, 4, 8 of two
        # Limits are those of these very rows: none of them is held back.
        situation = columns[:, list(read)] * functions.gain
        distance = torch.cdist(situation, functions.weight[:, :-1].detach())
        near.append(torch.sigmoid(-(distance**2) / 2).double().numpy())
    sums = backbone.trees(columns[None], ())[0][0].double().numpy()
    by_hand = np.concatenate([table.columns, *near, sums], axis=1) @ weights + float(net.heads.biases[0][0, 0].detach())
    part = data.train[0]
    (predicted,) = stream_predictions(net, [part])
    count = part.samples - 1 - table.starts[0][1]
    scaled = (predicted[table.starts[0][1] :][:count, 0, 0] - net.code.offset.numpy()[0, 0]) / net.code.width.numpy()[
        0, 0
    ]
    np.testing.assert_allclose(scaled, by_hand[:count], atol=2e-3)


def test_where_rows_are_few_what_reads_few_columns_errs_less():
    """What a line leaves depends on the present input alone; ten columns of 600 rows hide it from what reads all."""
    rng = np.random.default_rng(5)
    u = rng.uniform(-2, 2, 600)
    y = np.concatenate([[0.0], np.sin(3 * u[:-1])]) + 0.02 * rng.normal(size=600)
    values = np.stack([u, y], axis=1).astype(np.float32)
    log = Recording(name="log", rate_hz=RATE, channels=CHANNELS, values=values, source="test")
    data = data_of(log, horizons=(1,), mode=TargetMode.ABSOLUTE)
    errors = []
    for near in ((), (0,)):
        outcome = fit_bagged(data, committee(activations=(), centres=100, local_lags=near), spec())
        (predicted,) = stream_predictions(outcome.fitted.predictor, data.test)
        errors.append(np.square(predicted[10:-1, 0, 0] - data.test[0].targets[11:, 0]).mean() ** 0.5)
    assert errors[1] < 0.6 * errors[0]


def test_basis_functions_on_few_columns_read_no_others():
    functions, x = RadialFeatures(6, 3, (1, 4)), torch.randn(1, 5, 6)
    functions.set_centres(torch.randn(3, 2))
    other, own = x.clone(), x.clone()
    other[..., [0, 2, 3, 5]] += 1.0
    own[..., 4] += 1.0
    assert torch.equal(functions(other, ())[0], functions(x, ())[0])
    assert not torch.equal(functions(own, ())[0], functions(x, ())[0])


def test_few_columns_count_no_further_than_they_were_recorded():
    """Beyond the recorded range nothing changes, in the network and in its list of layers."""
    outcome = fit_bagged(data_of(recording(600)), committee(activations=(), centres=30, local_lags=(0, 2)), spec())
    net, columns = outcome.fitted.predictor, torch.from_numpy(outcome.table.columns)
    functions = net.backbone.near[0]
    far = columns.clone()
    far[:, 0] = columns[:, 0].max() + torch.linspace(0, 100, len(columns))
    at_limit = far.clone()
    at_limit[:, 0] = columns[:, 0].max()
    assert torch.equal(functions(far, ())[0], functions(at_limit, ())[0])
    check_graph(net.double())


@pytest.mark.parametrize("near", [(3,), (2, 1), (0, 0), (-1,)])
def test_impossible_spans_of_few_columns_are_refused(near):
    with pytest.raises(ConfigError, match="local_lags"):
        CommitteeSpec(lags=(1, 2, 4), centres=10, local_lags=near)


def test_few_columns_without_centres_are_refused():
    with pytest.raises(ConfigError, match="centres = 0"):
        CommitteeSpec(local_lags=(0,))


def test_trees_that_predict_the_target_take_their_share_from_the_linear_model():
    """A step that no line follows: the trees of the target carry the prediction, and it stays within the recordings."""
    rng = np.random.default_rng(3)
    u = np.repeat(rng.uniform(-1, 1, 200), 10)
    y = np.concatenate([[0.0], np.where(u[:-1] > 0, 1.0, -1.0)]) + 0.01 * rng.normal(size=len(u))
    values = np.stack([u, y], axis=1).astype(np.float32)
    log = Recording(name="log", rate_hz=RATE, channels=CHANNELS, values=values, source="test")
    data = data_of(log, horizons=(1,), mode=TargetMode.ABSOLUTE)
    outcome = fit_bagged(data, committee(activations=(), trees=60), spec())
    promise = np.sqrt(np.square(outcome.left_out - outcome.table.targets).mean())
    assert promise < 0.5 * np.sqrt(np.square(outcome.linear - outcome.table.targets).mean())


def test_no_threshold_of_a_tree_lies_between_values_that_differ_by_rounding():
    """An encoder that stands still most of the time: its changes are zero or some thousandths, but for rounding."""
    data = data_of(recording())
    for part in (*data.train, *data.validation):
        part.inputs[:, 1] = np.round(part.inputs[:, 1], 1)
    outcome = fit_bagged(data, committee(activations=(), trees=60), spec())
    trees, columns = outcome.fitted.predictor.backbone.trees, outcome.table.columns
    thresholds = trees.threshold[trees.threshold < 1e30].numpy()
    features = trees.feature[trees.threshold < 1e30].numpy()
    distance = [np.abs(columns[:, column] - value).min() for column, value in zip(features, thresholds, strict=True)]
    quantised = (features % 2 == 1)[: len(distance)]
    assert quantised.any()
    assert np.min(np.array(distance)[quantised]) > 1e-5


@pytest.mark.parametrize("parts", [2, 3, 4, 9])
def test_trees_see_no_row_that_they_are_judged_by(parts, monkeypatch):
    """Nor one beside it: each run of trees is grown on rows that every fold of its part trains on."""
    grown = []
    kept = TreeLearner._grow_trees

    def grow(self, rows, target, rounds, judged):
        grown.append((rows, judged))
        return kept(self, rows, target, rounds, judged)

    monkeypatch.setattr(TreeLearner, "_grow_trees", grow)
    outcome = fit_bagged(data_of(recording()), committee(activations=(), trees=1), spec(tree_folds=parts))
    folds = outcome.table.folds
    assert len(grown) == min(parts, folds.count) * outcome.table.targets.shape[1]
    for rows, judged in grown:
        for fold in np.unique(folds.owner[judged]):
            assert set(rows) <= set(folds.training[fold])
    judged_rows = np.concatenate([judged for _, judged in grown])
    assert np.array_equal(np.bincount(judged_rows), np.full(len(folds.owner), outcome.table.targets.shape[1]))


def test_a_tree_has_as_many_leaves_as_the_settings_say():
    outcome = fit_bagged(
        data_of(recording()),
        committee(activations=(), trees=20, tree_depth=6),
        spec(tree_max_leaves=5, tree_min_leaf_rows=5),
    )
    trees = outcome.fitted.predictor.backbone.trees
    splits = (trees.threshold < 1e30).sum(dim=-1)
    assert splits.max() == 4
    with pytest.raises(ConfigError, match="a tree of one leaf splits nothing"):
        BaggingSpec(tree_max_leaves=1)


def test_a_learner_of_noise_gets_no_share():
    rng = np.random.default_rng(1)
    log = Recording(
        name="log", rate_hz=RATE, channels=CHANNELS, values=rng.normal(size=(1500, 2)).astype(np.float32), source="test"
    )
    outcome = fit_bagged(data_of(log), committee(activations=(), centres=50, trees=20), spec())
    error = np.sqrt(np.square(outcome.left_out - outcome.table.targets).mean(axis=0))
    linear = np.sqrt(np.square(outcome.linear - outcome.table.targets).mean(axis=0))
    np.testing.assert_allclose(error, linear, rtol=0.01)


def test_further_learners_must_earn_their_place():
    """One that lowers the error by chance gets nothing, one that knows more does."""
    rng = np.random.default_rng(8)
    truth, noise = rng.normal(size=(500, 1)), rng.normal(size=(4, 500, 1))
    owner = np.arange(500) * 5 // 500
    usual = [truth + noise[0], truth + 2 * noise[1]]
    alone = stacking_weights(usual, truth, owner, [False, False])
    by_chance = stacking_weights([*usual, noise[2]], truth, owner, [False, False, True])
    np.testing.assert_array_equal(by_chance, [*alone, [0.0]])
    better = stacking_weights([*usual, truth + noise[3]], truth, owner, [False, False, True])
    assert better[2, 0] > 0.1
    assert stacking_weights([], truth, owner, []).shape == (0, 1)


def test_the_liveliest_fold_does_not_choose_for_all():
    rng = np.random.default_rng(3)
    owner = np.repeat(np.arange(5), 200)
    size = np.where(owner == 4, 5.0, 1.0)[:, None]
    truth = size * rng.normal(size=(1000, 1))
    # The first model is right to a tenth but in the lively fold, the second one to a fifth everywhere.
    first = truth + size * np.where(owner == 4, 0.4, 0.1)[:, None] * rng.normal(size=(1000, 1))
    second = truth + size * 0.2 * rng.normal(size=(1000, 1))
    by_squares = nnls(np.hstack([first, second]), truth[:, 0])[0]
    shares = stacking_weights([first, second], truth, owner, [False, False])[:, 0]
    assert shares[0] > 1.2 * by_squares[0]
    assert shares.sum() == pytest.approx(1.0, abs=0.1)
    # A fold that stands still counts little, and nothing is divided by nothing.
    still = np.where(owner[:, None] == 0, 0.0, 1.0)
    assert np.isfinite(stacking_weights([still * first, still * second], still * truth, owner, [False, False])).all()
    zeros = np.zeros((1000, 1))
    assert (stacking_weights([zeros], zeros, owner, [False]) == 0.0).all()


def test_members_of_two_losses_are_a_multiple_of_twice_the_folds():
    with pytest.raises(ConfigError, match="twice the folds"):
        fit(data_of(recording(600)), MODEL, spec(huber_delta=0.1))


def test_trees_without_folds_are_refused():
    with pytest.raises(ConfigError, match=r"no gradient reaches trees; train on folds"):
        check_fitted_parts(committee(trees=10), TrainingSpec())
    check_fitted_parts(committee(trees=10), spec())
    check_fitted_parts(committee(), TrainingSpec())


def test_the_same_seed_gives_the_same_bits_and_another_one_others():
    data = data_of(recording(600))
    first, again, other = (
        fit(data, MODEL, spec_of).predictor.state_dict()
        for spec_of in (spec(steps=20), spec(steps=20), TrainingSpec(**{**vars(spec(steps=20)), "seed": 1}))
    )
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert any(not torch.equal(first[name], other[name]) for name in first)


def test_without_members_it_is_the_linear_model_of_the_folds():
    data = data_of(recording(), mode=TargetMode.ABSOLUTE)
    linear = ModelSpec(
        backbone=CommitteeSpec(lags=(1, 2), members=4, activations=()), head=LinearHead(), blocks=(), window=10
    )
    found = fit_bagged(data, linear, spec())
    np.testing.assert_allclose(found.left_out, found.linear)
    net, part = found.fitted.predictor, data.train[0]
    (predicted,) = stream_predictions(net, [part])
    (_, tick), *_ = found.table.starts
    rows = found.table.columns[: part.samples - data.task.max_horizon - tick].astype(np.float64)
    predicted = predicted[tick:]
    weights = net.heads.weights[0].detach().double().numpy()[0]
    wanted = rows @ weights + net.heads.biases[0].detach().double().numpy()[0]
    scaled = (predicted[: len(rows), :, 0] - net.code.offset.numpy()[:, 0]) / net.code.width.numpy()[:, 0]
    np.testing.assert_allclose(scaled, wanted, atol=1e-4)


def test_folds_leave_out_pieces_as_long_as_what_tests():
    def pieces_of(*recordings, **bagging):
        data = data_of(*recordings)
        # Nothing but how long the parts are that test may be looked at.
        data = replace(data, test=[replace(one, inputs=one.inputs * np.nan) for one in data.test])
        table = table_of(build_model(data.task, MODEL, data.scaler(), 0), data, BaggingSpec(folds=4, **bagging))
        return (np.count_nonzero(np.diff(table.folds.owner)) + 1) / 4

    # A single log is divided as it was; of four logs of which each one's end tests, a fold leaves out a piece of each.
    assert pieces_of(recording()) == 1
    logs = [recording(600, seed, f"log{seed}") for seed in range(4)]
    assert pieces_of(*logs) == 4
    assert pieces_of(*logs, max_rows=800) == 4


def by_recording(*recordings, test):
    """Prepared data of which whole recordings test."""
    task = Task(FeatureSet("two", ("u", "y")), ("y",), (1, 4), TargetMode.DELTA, RATE)
    return prepare(list(recordings), task, ByRecording(validation=("log1",), test=test), 10)


def test_where_whole_recordings_test_folds_leave_whole_ones_out():
    logs = [recording(ticks, seed, f"log{seed}") for seed, ticks in enumerate((300, 200, 250, 220, 180, 210))]
    data = by_recording(*logs, test=("log5",))
    table = table_of(build_model(data.task, MODEL, data.scaler(), 0), data, BaggingSpec(folds=3))
    lengths = np.diff([*(first for first, _ in table.starts), len(table.columns)])
    ends = np.cumsum(lengths)
    owners = [set(table.folds.owner[end - length : end]) for end, length in zip(ends, lengths, strict=True)]
    assert [len(own) for own in owners] == [1] * 5
    assert set().union(*owners) == {0, 1, 2}
    for fold in range(3):
        # Nothing lies beside a whole recording: all others train.
        assert len(table.folds.left_out(fold)) + len(table.folds.training[fold]) == len(table.columns)
    # Two recordings, or one that has nearly all rows, would leave nothing to learn from.
    assert recording_folds([100, 100], ["a", "b"], 5) is None
    assert recording_folds([1000, 100, 100], ["a", "b", "c"], 5) is None
    found = recording_folds([50, 100, 50, 100], ["a", "b", "a", "c"], 5)
    assert found is not None
    assert found.count == 3
    assert set(found.left_out(found.owner[0])) == {*range(50), *range(150, 200)}


def test_an_axis_that_rested_in_training_moves_no_prediction_far(monkeypatch):
    """An encoder at rest shows a few steps of noise: a line through them would answer the axis in motion at random."""
    log = recording()
    # By chance the steps go with the machine.
    steps = 1e-3 * np.clip(np.round(log.values[:, 0]), -1, 1)
    channels = (*CHANNELS, Channel("angle", Kind.GENERIC))
    log = replace(log, values=np.column_stack([log.values, steps]).astype(np.float32), channels=channels)
    task = Task(FeatureSet("three", ("u", "y", "angle")), ("y",), (1, 4), TargetMode.DELTA, RATE)
    data = prepare([log], task, ByTime(), 10)
    part = data.test[0]
    moving = part.inputs.copy()
    moving[:, 2] = np.sin(np.arange(len(moving)) / 20)

    def moved_by() -> float:
        net = fit_bagged(data, committee(clip_inputs=True), spec(steps=20)).fitted.predictor
        rest, motion = (stream_predictions(net, [replace(part, inputs=x)])[0] for x in (part.inputs, moving))
        return float(np.abs(motion - rest).max())

    held = moved_by()
    monkeypatch.setattr(edp.training.bagging.table, "FEW_LEVELS", 0)
    assert held < 0.5 * moved_by()


def test_long_recordings_are_thinned_out_evenly():
    found = fit_bagged(data_of(recording()), MODEL, spec(max_rows=300, steps=10))
    assert 250 < len(found.table.columns) <= 310
    assert found.table.stride > 1
    data = data_of(recording())
    truth = [np.zeros((part.samples - 4, 2)) for part in (*data.train, *data.validation)]
    assert [len(one) for one in found.predict_all(truth)] == [len(one) for one in truth]


def test_a_channel_that_never_moved_moves_no_prediction_later():
    column = Recording(
        name="still",
        channels=(*recording().channels, Channel("idle", Kind.GENERIC)),
        rate_hz=RATE,
        values=np.column_stack([recording().values, np.full(recording().samples, 3.7)]).astype(np.float32),
    )
    task = Task(FeatureSet("three", ("u", "y", "idle")), ("y",), (1, 4), TargetMode.DELTA, RATE)
    data = prepare([column], task, ByTime(), 10)
    net = fit_bagged(data, MODEL, spec(steps=60)).fitted.predictor
    other = replace(data.test[0], inputs=data.test[0].inputs + np.float32([0, 0, 1]))
    assert np.abs(stream_predictions(net, [other])[0] - stream_predictions(net, data.test)[0]).max() < 1e-6


@pytest.mark.parametrize("parts", [{}, {"centres": 30, "trees": 10}])
def test_what_is_far_outside_of_what_trained_is_held_at_limits(parts):
    """A sensor that jumps far off moves no prediction further than one at the limits does, as a graph just as well."""
    data = data_of(recording())
    nets = [fit_bagged(data, committee(clip_inputs=b, **parts), spec()).fitted.predictor for b in (False, True)]
    usual = replace(data.test[0], inputs=data.test[0].inputs[:200])
    spread = np.ptp(data.train[0].inputs[:, 0])

    def moved_by(jump):
        """The largest change of any prediction, of each network."""
        inputs = usual.inputs.copy()
        inputs[100:, 0] += jump
        far = replace(usual, inputs=inputs)
        return [np.abs(stream_predictions(net, [far])[0] - stream_predictions(net, [usual])[0]).max() for net in nets]

    np.testing.assert_array_equal(*(stream_predictions(net, [usual])[0] for net in nets))
    free, held = moved_by(1e3 * spread)
    free_further, held_further = moved_by(1e5 * spread)
    assert free_further > 10 * free
    assert held_further == pytest.approx(held, rel=1e-3)
    assert held < 0.1 * free
    far = np.concatenate([usual.inputs, 1e3 * usual.inputs])
    (expected,) = stream_predictions(nets[1], [replace(usual, inputs=far)])
    graph = Reference(nets[1].double().graph())
    rows = [graph.results(row)["prediction"] for row in far.astype(np.float64)]
    np.testing.assert_allclose(np.reshape(rows, expected.shape), expected, rtol=1e-3, atol=1e-4)


def test_limits_that_nothing_sets_are_refused():
    with pytest.raises(ConfigError, match=r"clip_inputs = true.*training on folds sets limits"):
        check_fitted_parts(committee(clip_inputs=True), TrainingSpec())
    check_fitted_parts(committee(clip_inputs=True), spec())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"backbone": HybridSpec()}, "committee"),
        ({"head": MlpHead()}, "linear"),
        ({"backbone": CommitteeSpec(members=3)}, "multiple of the folds"),
    ],
)
def test_what_cannot_be_trained_on_folds_is_refused(change, message):
    model = ModelSpec(**{**{field: getattr(MODEL, field) for field in ("backbone", "head", "blocks")}, **change})
    with pytest.raises(ConfigError, match=message):
        fit(data_of(recording(600)), model, spec())


def test_too_few_rows_for_the_folds_are_refused():
    with pytest.raises(DataError, match="fewer folds"):
        fit(data_of(recording(100), horizons=(1,), window=1), MODEL, spec(folds=4))


@pytest.mark.parametrize("pieces", [1, 2, 3])
def test_a_fold_leaves_its_rows_and_their_neighbours_out(pieces):
    folds = make_block_folds([100, 60], 4, gap=5, pieces=pieces)
    assert [len(folds.left_out(fold)) for fold in range(4)] == pytest.approx([40] * 4, abs=2)
    # Unbroken pieces, which the folds take in turn.
    assert np.count_nonzero(np.diff(folds.owner)) == 4 * pieces - 1
    assert sorted(row for fold in range(4) for row in folds.left_out(fold)) == list(range(160))
    for fold in range(4):
        judged, trained = set(folds.left_out(fold)), set(folds.training[fold])
        for row in judged:
            same = range(100) if row < 100 else range(100, 160)
            assert not trained & {near for near in range(row - 5, row + 6) if near in same}


def test_fold_ridge_leaves_useless_columns_out():
    rng = np.random.default_rng(0)
    table = rng.normal(size=(400, 30))
    targets = table[:, :2] @ np.array([[1.0], [-2.0]]) + 0.5 * rng.normal(size=(400, 1))
    found = fold_ridge(table, targets, make_block_folds([400], 5, 0), [np.arange(2), np.arange(30)])
    assert np.abs(found.mean()[0][2:]).max() == 0
    np.testing.assert_allclose(found.mean()[0][:2, 0], [1.0, -2.0], atol=0.1)


@pytest.mark.parametrize("of_fold", [False, True])
def test_fold_ridge_is_the_ridge_regression_of_each_fold(of_fold):
    """Against scikit-learn's on the rows of each fold, gaps left out, with the penalty of the least left-out error."""
    rng = np.random.default_rng(3)
    table = (rng.normal(size=(300, 12)) @ rng.normal(size=(12, 12)) + rng.normal(size=12)).astype(np.float32)
    targets = table[:, :3] @ np.ones((3, 1)) + 3.0 * rng.normal(size=(300, 1)) + 7.0
    if of_fold:
        targets = np.stack([targets + 0.1 * fold for fold in range(4)])
    folds = make_block_folds([180, 120], 4, 7)
    assert any(len(folds.training[fold]) + len(folds.left_out(fold)) < 300 for fold in range(4))
    own = targets if of_fold else np.stack([targets] * 4)
    best, wanted = np.inf, np.zeros((300, 1))
    for penalty in sorted(PENALTIES, reverse=True):
        found = np.zeros((300, 1))
        for fold, rows in enumerate(folds.training):
            model = Ridge(alpha=penalty * len(rows)).fit(table[rows].astype(float), own[fold][rows])
            left = folds.left_out(fold)
            found[left] = model.predict(table[left].astype(float)).reshape(-1, 1)
        truth = np.concatenate([own[fold][folds.left_out(fold)] for fold in range(4)])
        guess = np.concatenate([found[folds.left_out(fold)] for fold in range(4)])
        error = np.mean(np.square(guess - truth))
        if error < best * (1.0 - MIN_GAIN):
            best, wanted = error, found
    np.testing.assert_allclose(fold_ridge(table, targets, folds, [np.arange(12)]).left_out, wanted, rtol=1e-8)


def test_where_rows_are_taken_at_a_distance_logs_show_different_ticks_of_their_starts():
    data = data_of(*(recording(600, seed, f"log{seed}") for seed in range(4)))
    table = table_of(build_model(data.task, MODEL, data.scaler(), 0), data, BaggingSpec(folds=4, max_rows=800))
    assert table.stride > 1
    firsts = [first for _, first in table.starts]
    assert {first - min(firsts) for first in firsts} == set(range(table.stride))
    ends = [*(row for row, _ in table.starts), len(table.targets)]
    assert all(stop > start for start, stop in pairwise(ends))


def test_the_bank_gives_changes_over_its_spans():
    bank, x = LagBank(2, (1, 3, 4)), torch.randn(1, 12, 2, dtype=torch.float64)
    y, _ = bank(x, bank.initial_state(1, x))
    for tick in range(4, 12):
        wanted = [x[0, tick], *(x[0, tick] - x[0, tick - lag] for lag in (1, 3, 4))]
        torch.testing.assert_close(y[0, tick], torch.cat(wanted), rtol=0, atol=1e-12)
    assert not y[0, 0, 2:].any()


def test_the_bank_gives_changes_of_means_over_its_smoothed_spans():
    bank, x = LagBank(2, (1, 2, 3, 4), (2, 4)), torch.randn(1, 12, 2, dtype=torch.float64)
    y, _ = bank(x, bank.initial_state(1, x))
    assert (y.shape[-1], bank.columns, bank.reach) == (14, 14, 7)
    for tick in range(bank.reach, 12):
        means = [x[0, tick - m + 1 : tick + 1].mean(0) - x[0, tick - 2 * m + 1 : tick - m + 1].mean(0) for m in (2, 4)]
        torch.testing.assert_close(y[0, tick, 10:], torch.cat(means), rtol=0, atol=1e-12)
    assert not y[0, 0, 2:].any()
    stays, _ = bank(torch.ones_like(x), bank.initial_state(1, x))
    assert not stays[..., 2:].any()


@pytest.mark.parametrize("smoothed", [(1,), (3,), (4, 2), (2, 2)])
def test_impossible_smoothed_spans_are_refused(smoothed):
    with pytest.raises(ConfigError, match="smoothed"):
        CommitteeSpec(lags=(1, 2, 4), smoothed=smoothed)


@pytest.mark.parametrize("lags", [(), (0, 1), (2, 1), (1, 1), (5000,)])
def test_impossible_spans_are_refused(lags):
    with pytest.raises(ConfigError, match="lags"):
        CommitteeSpec(lags=lags)
