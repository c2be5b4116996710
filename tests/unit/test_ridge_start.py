import numpy as np
import pytest
import torch

from edp.data.features import Derived, FeatureSet
from edp.data.lags import LagTask
from edp.data.ridge import cross_validate_ridge, ridge_solution
from edp.data.scaling import fit_scaler
from edp.data.series import Series
from edp.data.task import TargetMode, Task
from edp.errors import DataError
from edp.networks.backbones import TcnSpec
from edp.networks.blocks import LinearBypass
from edp.networks.heads import MlpHead
from edp.networks.predictor import ModelSpec, Predictor, build_model
from edp.signals import Kind
from edp.training.ridge_start import start_bypass

pytestmark = pytest.mark.long

TAPS = 6
# Column 3 never moves; the fourth channel is an input only, as the source of a derived feature.
FEATURES = FeatureSet(
    "test",
    ("speed", "lever", "dead", "rod"),
    (Derived("push", "load"), Derived("drate", "lever", "derivative")),
    hidden=("load",),
)


def recording(seed: int, samples: int = 400) -> np.ndarray:
    """A driven first-order lag with noise; columns as the inputs of FEATURES."""
    rng = np.random.default_rng(seed)
    lever, load = rng.normal(size=(2, samples))
    speed = np.zeros(samples)
    for t in range(3, samples):
        speed[t] = 0.8 * speed[t - 1] + 0.2 * lever[t - 2] + 0.05 * load[t - 1]
    speed += 0.01 * rng.normal(size=samples)
    return np.stack([0.1 * speed, 2e6 * lever + 1e7, np.full(samples, 3.0), 4.0 + np.cumsum(speed), load], axis=1)


def series(task: Task, seed: int, samples: int = 400) -> Series:
    values = recording(seed, samples).astype(np.float32)
    derived = np.diff(values[:, 4], prepend=values[0, 4])
    known = {"speed": values[:, 0], "rod": values[:, 3], "push": derived}
    return Series(f"s{seed}", values, np.stack([known[name] for name in task.targets], axis=1).astype(np.float32))


def features_of(part: Series) -> np.ndarray:
    load = part.inputs[:, 4]
    return np.concatenate([part.inputs[:, :4], np.diff(load, prepend=load[0])[:, None]], axis=1)


def start(task: Task, **options: object) -> tuple[Predictor, list[Series], list[Series]]:
    """A predictor in double precision, after the start."""
    train, validation = [series(task, 1), series(task, 2)], [series(task, 3)]
    kinds = (Kind.VELOCITY, Kind.PRESSURE, Kind.GENERIC, Kind.POSITION, Kind.GENERIC, Kind.GENERIC)
    spec = ModelSpec(
        backbone=TcnSpec(channels=(4,)),
        head=MlpHead(hidden=4),
        window=3,
        blocks=(LinearBypass(taps=TAPS, **options),),  # type: ignore[arg-type]
    )
    predictor = build_model(task, spec, fit_scaler(task, train, kinds), seed=0).double().eval()
    start_bypass(predictor, train, validation)
    return predictor, train, validation


@pytest.mark.parametrize("mode", list(TargetMode))
@pytest.mark.parametrize("targets", [("speed",), ("rod", "speed"), ("push", "speed")])
@pytest.mark.parametrize("horizons", [(1,), (2, 5, 9)])
def test_without_its_network_the_predictor_is_the_ridge_regression(mode, targets, horizons):
    task = Task(FEATURES, targets, horizons, mode, 100.0)
    predictor, train, validation = start(task)
    # `drate` follows from the logged lever; `push` comes from a channel that is no feature, so it is read too.
    columns = {"speed": 0, "rod": 3, "push": 4}
    lags = LagTask(horizons, tuple(columns[name] for name in targets), TAPS)

    def known(parts):
        return [Series(part.name, features_of(part), part.targets) for part in parts]

    wanted = ridge_solution(known(train), lags, known(validation))
    test = series(task, 4, 90)
    x = torch.from_numpy(test.inputs).double()[None]
    with torch.no_grad():
        found = predictor.predict(x, predictor.initial_state(1, x))[0][0].numpy()
    spread = test.targets.std(axis=0)
    # The scaler's numbers and the derived feature are float32.
    np.testing.assert_allclose(
        found[TAPS - 1 :] / spread, wanted.predict(features_of(test)) / spread, rtol=1e-5, atol=1e-6
    )


def test_it_beats_persistence_from_the_start():
    task = Task(FEATURES, ("speed",), (3,), TargetMode.DELTA, 100.0)
    predictor, _, _ = start(task)
    test = series(task, 5)
    x = torch.from_numpy(test.inputs).double()[None]
    with torch.no_grad():
        found = predictor.predict(x, predictor.initial_state(1, x))[0][0, :, 0, 0].numpy()
    future = test.targets[TAPS + 3 :, 0]
    ridge = np.mean((found[TAPS:-3] - future) ** 2)
    assert ridge < 0.5 * np.mean((test.targets[TAPS:-3, 0] - future) ** 2)


def test_a_start_from_zero_stays_zero():
    task = Task(FEATURES, ("speed",), (3,), TargetMode.DELTA, 100.0)
    predictor, _, _ = start(task, init="zero")
    assert not predictor.bypass.weight.any()


def test_recordings_shorter_than_the_taps_are_refused():
    task = Task(FEATURES, ("speed",), (3,), TargetMode.DELTA, 100.0)
    predictor, _, _ = start(task)
    with pytest.raises(DataError, match="8 samples, fewer than its 6 taps plus the horizon of 3"):
        start_bypass(predictor, [series(task, 1, 8)], [])


def test_the_crossed_regression_is_the_plain_one_on_all_stretches():
    task = Task(FEATURES, ("speed",), (1, 3), TargetMode.DELTA, 100.0)
    parts = [series(task, 1, 57), series(task, 2, 41)]
    lags = LagTask((1, 3), (0,), 4)
    got = cross_validate_ridge(parts, lags, penalties=[1e-3], histories=[4])
    wanted = ridge_solution(parts, lags, penalties=[1e-3], histories=[4])
    np.testing.assert_allclose(got.predict(parts[0].inputs), wanted.predict(parts[0].inputs), rtol=1e-7)


def test_cross_validation_chooses_penalty_and_history_that_generalise():
    rng = np.random.default_rng(0)
    task = LagTask((1,), (None,), 20)

    def made(samples: int) -> Series:
        x = rng.normal(size=(samples, 3))
        y = np.concatenate([[0.0], x[:-1, 0]]) + 0.5 * rng.normal(size=samples)
        return Series("made", x.astype(np.float32), y[:, None].astype(np.float32))

    got = cross_validate_ridge([made(150)], task, penalties=[1e-6, 1e-2])
    test = made(2000)
    error = np.std(got.predict(test.inputs)[:-1, 0, 0] - test.targets[20:, 0])
    assert got.history[0, 0] == 3
    assert error < 0.56


def test_a_crossed_start_learns_from_validation_too_and_is_kept_whole():
    task = Task(FEATURES, ("speed",), (3,), TargetMode.DELTA, 100.0)
    predictor, train, validation = start(task, init="cross_validated")
    parts = [Series(part.name, features_of(part), part.targets) for part in [*train, *validation]]
    wanted = cross_validate_ridge(parts, LagTask((3,), (0,), TAPS))
    test = series(task, 4, 90)
    x = torch.from_numpy(test.inputs).double()[None]
    with torch.no_grad():
        found = predictor.predict(x, predictor.initial_state(1, x))[0][0].numpy()
    np.testing.assert_allclose(found[TAPS - 1 :], wanted.predict(features_of(test)), rtol=1e-4, atol=1e-6)
