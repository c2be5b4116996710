import numpy as np
import pytest
from sklearn.linear_model import Ridge

from edp.data.ridge import ridge_solution
from edp.data.series import Series
from edp.errors import ConfigError, DataError
from edp.evaluation.baselines import BASELINES, Baseline, BaselineTask, RidgeArx

AHEAD = BaselineTask(horizons=(1, 3), present=(2, None), history=12, seed=5)
NAMES = [pytest.param(name, marks=pytest.mark.processes) if name == "boosted_trees" else name for name in BASELINES]
NOW = BaselineTask(horizons=(0,), present=(None, None), history=12, seed=5)


def linear_series(seed: int, samples: int = 900, noise: float = 0.0) -> Series:
    """Two delayed linear filters of two excitations; column 2 holds target 0, column 3 is dead."""
    rng = np.random.default_rng(seed)
    drive = rng.normal(size=(samples, 2)) * [1.0, 200.0] + [0.5, 1e4]
    drive = drive.astype(np.float32).astype(np.float64)
    one, two = np.zeros(samples), np.zeros(samples)
    for t in range(4, samples):
        one[t] = 0.6 * one[t - 1] + 0.3 * drive[t - 3, 0] + 2e-4 * drive[t - 4, 1]
        two[t] = 5.0 + 1.5 * drive[t - 3, 0] - 1e-3 * drive[t - 4, 1]
    targets = np.stack([one, two], axis=1) + noise * rng.normal(size=(samples, 2))
    inputs = np.column_stack([drive, targets[:, 0], np.full(samples, 7.0)])
    return Series(f"linear {seed}", inputs.astype(np.float32), targets.astype(np.float32))


def make(name: str, task: BaselineTask) -> Baseline:
    small = {"boosted_trees": {"trees": 20}, "small_mlp": {"epochs": 3}}
    return BASELINES[name](task, **small.get(name, {}))


def fitted(name: str, task: BaselineTask) -> Baseline:
    baseline = make(name, task)
    baseline.fit([linear_series(1), linear_series(2, 500)], [linear_series(3, 400)])
    return baseline


def squared_error(baseline: Baseline, series: Series, task: BaselineTask) -> np.ndarray:
    prediction = baseline.predict(series)
    errors = []
    for index, horizon in enumerate(task.horizons):
        end = series.samples - horizon
        errors.append(np.mean((prediction[30:end, index] - series.targets[30 + horizon :]) ** 2, axis=0))
    return np.array(errors)


def test_all_four_are_registered():
    assert set(BASELINES) == {"persistence", "ridge_arx", "boosted_trees", "small_mlp"}


@pytest.mark.parametrize("task", [AHEAD, NOW], ids=["ahead", "now"])
@pytest.mark.parametrize("name", NAMES)
class TestEveryBaseline:
    def test_shape_type_and_warm_up_ticks(self, name, task):
        prediction = fitted(name, task).predict(linear_series(4, 60))
        assert prediction.shape == (60, len(task.horizons), 2)
        assert prediction.dtype == np.float32
        assert np.isnan(prediction[: task.history - 1]).all()
        assert np.isfinite(prediction[task.history - 1 :]).all()

    def test_a_series_shorter_than_the_history_is_all_nan(self, name, task):
        assert np.isnan(fitted(name, task).predict(linear_series(4, 11))).all()

    def test_later_rows_and_targets_do_not_change_a_prediction(self, name, task):
        baseline, series, tick = fitted(name, task), linear_series(4, 120), 70
        changed = series.inputs.copy()
        changed[tick + 1 :] = np.random.default_rng(0).normal(size=changed[tick + 1 :].shape) * 100.0
        other = Series("changed", changed, np.full_like(series.targets, 1e6))
        before, after = baseline.predict(series), baseline.predict(other)
        np.testing.assert_array_equal(after[: tick + 1], before[: tick + 1])
        short = baseline.predict(Series("short", series.inputs[: tick + 1], series.targets[: tick + 1]))
        np.testing.assert_allclose(short, before[: tick + 1], rtol=1e-6, atol=1e-6)

    def test_rows_before_the_history_do_not_matter(self, name, task):
        baseline, series = fitted(name, task), linear_series(4, 80)
        tail = baseline.predict(Series("tail", series.inputs[-task.history :], series.targets[-task.history :]))
        np.testing.assert_allclose(tail[-1], baseline.predict(series)[-1], rtol=1e-6, atol=1e-6)

    def test_the_same_seed_gives_the_same_predictions(self, name, task):
        series = linear_series(4, 200)
        np.testing.assert_array_equal(fitted(name, task).predict(series), fitted(name, task).predict(series))

    def test_it_fits_without_validation(self, name, task):
        baseline = make(name, task)
        baseline.fit([linear_series(1, 300)], [])
        assert np.isfinite(baseline.predict(linear_series(4, 50))[task.history :]).all()

    def test_an_unpredictable_target_shows_no_leak(self, name, task):
        """White noise cannot be foreseen: an error clearly below its deviation would mean a look at the answer."""

        def noise(seed: int) -> Series:
            rng = np.random.default_rng(seed)
            targets = rng.normal(size=(1500, 2)).astype(np.float32)
            inputs = rng.normal(size=(1500, 4)).astype(np.float32)
            inputs[:, 2] = targets[:, 0] if task is AHEAD else inputs[:, 2]
            return Series("noise", inputs, targets)

        baseline = make(name, task)
        baseline.fit([noise(1)], [noise(2)])
        assert (squared_error(baseline, noise(3), task) > 0.9).all()

    def test_refusals_say_where(self, name, task):
        baseline, series = make(name, task), linear_series(1, 100)
        with pytest.raises(ConfigError, match="call fit before predict"):
            baseline.predict(series)
        with pytest.raises(DataError, match="10 ticks; history"):
            baseline.fit([linear_series(1, 10)], [])
        broken = series.inputs.copy()
        broken[17, 1] = np.nan
        with pytest.raises(DataError, match="row 17 of input column 1"):
            baseline.fit([Series("broken", broken, series.targets)], [])
        with pytest.raises(DataError, match="targets of shape"):
            baseline.fit([Series("narrow", series.inputs, series.targets[:, :1])], [])
        with pytest.raises(DataError, match="4 input columns"):
            baseline.fit([series, Series("other", series.inputs[:, :3], series.targets)], [])


def test_persistence_holds_the_present_or_the_mean():
    series, train = linear_series(4, 60), linear_series(1)
    baseline = make("persistence", AHEAD)
    baseline.fit([train], [])
    prediction = baseline.predict(series)[11:]
    np.testing.assert_array_equal(prediction[:, :, 0], np.repeat(series.inputs[11:, 2:3], 2, axis=1))
    np.testing.assert_allclose(prediction[:, :, 1], train.targets[:, 1].mean(), rtol=1e-5)


@pytest.mark.parametrize("task", [AHEAD, NOW], ids=["ahead", "now"])
def test_ridge_recovers_a_linear_system(task):
    """Up to the delay of 3 samples all is a linear function of the past, so little more than rounding is left."""
    baseline = RidgeArx(task)
    baseline.fit([linear_series(1, 3000)], [linear_series(2)])
    test = linear_series(3)
    assert (squared_error(baseline, test, task) < 1e-8 * test.targets.var(axis=0)).all()


def test_ridge_reaches_the_noise_floor():
    baseline = RidgeArx(AHEAD)
    baseline.fit([linear_series(1, 6000, noise=0.05)], [linear_series(2, 2000, noise=0.05)])
    error = squared_error(baseline, linear_series(3, 2000, noise=0.05), AHEAD)
    # Target 1 is a function of noise-free inputs: only its own measurement noise may be left.
    np.testing.assert_allclose(error[:, 1], 0.05**2, rtol=0.1)


def lagged(inputs: np.ndarray, history: int, ticks: np.ndarray) -> np.ndarray:
    return np.concatenate([inputs[ticks - lag] for lag in range(history)], axis=1)


@pytest.mark.parametrize("history", [1, 2, 7])
def test_ridge_equals_a_direct_solution_over_several_series(history):
    task = BaselineTask(horizons=(2, 5), present=(2, None), history=history, seed=0)
    train = [linear_series(seed, samples, noise=0.3) for seed, samples in ((1, 400), (2, 9), (3, 3), (4, 20))]
    penalty = 1e-2
    got = ridge_solution(train, task, penalties=[penalty], histories=[history])
    every = np.concatenate([one.inputs for one in train]).astype(np.float64)
    centre, scale = every.mean(axis=0), every.std(axis=0)
    scale[3] = 1.0
    rows, outputs = [], []
    for one in train:
        ticks = np.arange(history - 1, max(history - 1, one.samples - 5))
        rows.append(lagged((one.inputs - centre) / scale, history, ticks))
        changes = [one.targets[ticks + k] - np.array([1.0, 0.0]) * one.inputs[ticks][:, [2, 2]] for k in (2, 5)]
        outputs.append(np.concatenate(changes, axis=1))
    x, y = np.concatenate(rows), np.concatenate(outputs).astype(np.float64)
    reference = Ridge(alpha=penalty * len(x), solver="svd").fit(x, y)
    test = linear_series(5, 50, noise=0.3)
    ticks = np.arange(history - 1, 50)
    expected = reference.predict(lagged((test.inputs - centre) / scale, history, ticks)).reshape(-1, 2, 2)
    expected[:, :, 0] += test.inputs[ticks][:, [2]]
    np.testing.assert_allclose(got.predict(test.inputs), expected, rtol=1e-6, atol=1e-6)


def test_ridge_weights_are_in_physical_units():
    task = BaselineTask(horizons=(3,), present=(None, None), history=12, seed=0)
    baseline = RidgeArx(task)
    baseline.fit([linear_series(1, 3000)], [linear_series(2)])
    assert baseline.weights.shape == (12, 4, 1, 2)
    assert baseline.intercept.shape == (1, 2)
    # two[t + 3] = 5 + 1.5 drive0[t] - 1e-3 drive1[t - 1]
    assert baseline.weights[0, 0, 0, 1] == pytest.approx(1.5, rel=1e-4)
    assert baseline.weights[1, 1, 0, 1] == pytest.approx(-1e-3, rel=1e-4)
    assert baseline.intercept[0, 1] == pytest.approx(5.0, abs=1e-2)
    series = linear_series(3, 100)
    by_hand = baseline.intercept + np.einsum("hi,hiko->ko", series.inputs[39:27:-1].astype(float), baseline.weights)
    np.testing.assert_allclose(baseline.predict(series)[39], by_hand, rtol=1e-5)


def test_validation_chooses_a_strong_penalty_when_there_is_nothing_to_learn():
    rng = np.random.default_rng(0)

    def noise(samples: int) -> Series:
        return Series("noise", *(rng.normal(size=(samples, width)).astype(np.float32) for width in (6, 1)))

    task = BaselineTask(horizons=(1,), present=(None,), history=12, seed=0)
    got = ridge_solution([noise(150)], task, [noise(2000)])
    assert got.penalty.item() >= 1.0


def test_copies_of_an_input_do_not_break_ridge():
    series = [linear_series(seed, 400) for seed in (1, 2)]
    doubled = [Series(one.name, np.tile(one.inputs, (1, 2)), one.targets) for one in series]
    baseline = RidgeArx(AHEAD)
    baseline.fit(doubled[:1], doubled[1:])
    assert np.isfinite(baseline.weights).all()
    assert (squared_error(baseline, doubled[1], AHEAD) < 1e-6 * series[1].targets.var(axis=0)).all()


def test_a_penalty_of_nothing_on_copied_inputs_is_refused():
    train = linear_series(1, 200)
    doubled = Series("doubled", np.tile(train.inputs, (1, 2)), train.targets)
    with pytest.raises(ConfigError, match=r"ridge penalty .* too small"):
        ridge_solution([doubled], AHEAD, penalties=[0.0])


@pytest.mark.parametrize("name", [name for name in NAMES if name not in ("persistence", "ridge_arx")])
def test_nonlinear_learners_beat_the_linear_map_on_a_dead_band(name):
    def plant(seed: int) -> Series:
        rng = np.random.default_rng(seed)
        lever = np.repeat(rng.uniform(-1, 1, 500), 6).astype(np.float32)
        speed = np.sign(lever) * np.maximum(np.abs(lever) - 0.5, 0.0)
        speed = np.concatenate([np.zeros(2), speed[:-2]]).astype(np.float32)
        return Series("dead band", np.stack([lever, speed], axis=1), speed[:, None])

    task = BaselineTask(horizons=(1,), present=(1,), history=8, seed=1)
    errors = {}
    for tried in (name, "ridge_arx"):
        baseline = BASELINES[tried](task)
        baseline.fit([plant(1)], [plant(2)])
        errors[tried] = squared_error(baseline, plant(3), task).item()
    assert errors[name] < 0.3 * errors["ridge_arx"]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (((), (None,), 5, 0), "horizons"),
        (((1, 1), (None,), 5, 0), "distinct"),
        (((-1,), (None,), 5, 0), "horizons"),
        (((1,), (), 5, 0), "no targets"),
        (((1,), (None,), 0, 0), "history is 0"),
        (((0, 1), (None, 4), 5, 0), "input column 4 holds it"),
    ],
)
def test_tasks_that_cannot_be_are_refused(values, message):
    with pytest.raises(ConfigError, match=message):
        BaselineTask(*values)
