import numpy as np
import pytest

from edp.data.features import FEATURE_SETS, FG1, FG2, Derived, FeatureSet, column, derive, kind_of
from edp.data.scaling import feature_matrix, fit_scaler
from edp.data.series import Series
from edp.data.task import TargetMode, Task
from edp.errors import ConfigError, DataError
from edp.recording import Recording
from edp.signals import KINDS, TABLE_A1, Channel, Kind


def recording(samples=50, seed=0, channels=None, rate_hz=100.0):
    channels = channels or tuple(TABLE_A1.values())
    values = np.random.default_rng(seed).normal(size=(samples, len(channels))).astype(np.float32)
    return Recording("r", tuple(channels), values, rate_hz)


def test_fg2_is_fg1_and_the_pressure_differences_of_eq_3_1():
    assert FG1.features == tuple(TABLE_A1)
    assert FG2.features[:24] == FG1.features
    assert FG2.features[24:] == tuple(f"dCylPressures_{i}" for i in (1, 2, 3, 5, 6, 7))
    assert set(FEATURE_SETS) == {"FG1", "FG2"}
    logged = recording()
    task = Task(FG2, ("CylVels_1",), (1,), TargetMode.DELTA, 100.0)
    matrix = feature_matrix(task, task.series(logged))
    assert matrix.shape == (50, 30)
    np.testing.assert_array_equal(matrix[:, :24], logged.values)
    for row, number in enumerate((1, 2, 3, 5, 6, 7), start=24):
        pressure = logged.column(f"CylPressures_{number}")
        assert matrix[0, row] == 0
        np.testing.assert_array_equal(matrix[1:, row], pressure[1:] - pressure[:-1])


def test_a_derivative_is_a_backward_quotient_per_second():
    entry = Derived("v", "x", "derivative", Kind.VELOCITY)
    np.testing.assert_allclose(derive(entry, np.array([1.0, 1.5, 1.0], np.float32), 50.0), [0.0, 25.0, -25.0])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: FeatureSet("f", ("a", "a")), "names a twice"),
        (lambda: FeatureSet("f", ()), "is empty"),
        (lambda: FeatureSet("f", ("a",), (Derived("d", "b"),)), "reads 'b', which is not an input"),
        (lambda: Derived("d", "a", "diference"), "difference"),
    ],
)
def test_feature_sets_that_cannot_be_are_refused(make, message):
    with pytest.raises(ConfigError, match=message):
        make()


def test_hidden_channels_are_inputs_but_not_features():
    made = FeatureSet("f", ("a",), (Derived("db", "b"),), hidden=("b",))
    assert made.inputs == ("a", "b")
    assert made.features == ("a", "db")


def test_kinds_and_columns_of_derived_channels():
    logged = recording()
    derived = FG2.derived
    assert kind_of("dCylPressures_1", logged, derived) is Kind.PRESSURE
    assert kind_of("CylVels_1", None, ()) is Kind.VELOCITY
    np.testing.assert_array_equal(
        column(logged, "dCylPressures_1", derived), derive(derived[0], logged.column("CylPressures_1"), 100.0)
    )
    with pytest.raises(DataError, match="kind of channel 'odd'"):
        kind_of("odd", None, ())


BASE = FeatureSet("f", ("a", "b"))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"targets": ()}, "no targets"),
        ({"horizons": ()}, "horizons"),
        ({"horizons": (3, 1)}, "increasing"),
        ({"horizons": (-1,)}, "horizons"),
        ({"targets": ("c",)}, "mode = 'delta'.*c is not a feature"),
        ({"horizons": (0, 1), "mode": TargetMode.ABSOLUTE}, "horizon 0 asks for the present value of a"),
        ({"integrate": ("d",)}, "integrate names 'd'"),
        ({"integrate": ("a",)}, "needs horizon 0"),
    ],
)
def test_tasks_that_cannot_be_are_refused(options, message):
    good = {"features": BASE, "targets": ("a",), "horizons": (1,), "mode": TargetMode.DELTA, "rate_hz": 100.0}
    with pytest.raises(ConfigError, match=message):
        Task(**{**good, **options})


def test_a_series_holds_inputs_and_targets_of_the_same_rows():
    channels = (Channel("a", Kind.VELOCITY), Channel("b", Kind.PRESSURE), Channel("c", Kind.GENERIC))
    logged = recording(20, channels=channels)
    task = Task(BASE, ("a", "c"), (2,), TargetMode.ABSOLUTE, 100.0)
    made = task.series(logged, 5, 15)
    np.testing.assert_array_equal(made.inputs, logged.values[5:15, :2])
    np.testing.assert_array_equal(made.targets, logged.values[5:15, [0, 2]])
    assert task.present == (0, None)
    logged.values[7, 2] = np.nan
    with pytest.raises(DataError, match=r"channel 'c' has 1 missing .* row 7"):
        task.series(logged, 5, 15)
    with pytest.raises(DataError, match="has 50 Hz, the task 100 Hz"):
        task.series(recording(20, channels=channels, rate_hz=50.0))


def test_a_derived_target_of_a_part_is_that_of_the_whole():
    """The first row of a stretch has a predecessor in the recording, and its target uses it."""
    channels = (Channel("a", Kind.POSITION), Channel("b", Kind.PRESSURE))
    logged = recording(20, channels=channels)
    task = Task(BASE, ("v",), (1,), TargetMode.ABSOLUTE, 100.0, (Derived("v", "a", "derivative", Kind.VELOCITY),))
    np.testing.assert_array_equal(task.series(logged, 8, 12).targets, task.series(logged).targets[8:12])


MIXED = Task(FeatureSet("mixed", ("speed", "angle", "dead")), ("speed", "angle"), (1, 4), TargetMode.ABSOLUTE, 100.0)
KINDS_OF_MIXED = (Kind.VELOCITY, Kind.ANGLE, Kind.PRESSURE)


def mixed(seed, samples=200):
    rng = np.random.default_rng(seed)
    values = np.stack([rng.normal(2, 3, samples), rng.uniform(-1, 5, samples), np.full(samples, 4e6)], axis=1)
    values = values.astype(np.float32)
    return Series(f"m{seed}", values, values[:, :2].copy())


def test_scalers_are_eq_3_4_and_3_5_over_all_training_rows():
    train = [mixed(1), mixed(2, 77)]
    scaler = fit_scaler(MIXED, train, KINDS_OF_MIXED)
    rows = np.concatenate([part.inputs for part in train]).astype(np.float64)
    scaled = (rows - scaler.feature_offset) / scaler.feature_scale
    assert scaled[:, 0].mean() == pytest.approx(0, abs=1e-6)
    assert scaled[:, 0].std() == pytest.approx(1, rel=1e-6)
    assert (scaled[:, 1].min(), scaled[:, 1].max()) == pytest.approx((-1, 1))


def test_a_channel_that_does_not_move_scales_by_its_nominal_size():
    scaler = fit_scaler(MIXED, [mixed(1)], KINDS_OF_MIXED)
    assert scaler.constant == ("dead",)
    assert scaler.feature_offset[2] == pytest.approx(4e6)
    assert scaler.feature_scale[2] == KINDS[Kind.PRESSURE].nominal


@pytest.mark.parametrize("size", [1e-9, 1.0, 1e9])
def test_a_channel_of_no_kind_moves_by_its_own_size(size):
    task = Task(FeatureSet("plain", ("a", "b")), ("a",), (1,), TargetMode.DELTA, 100.0)
    values = np.column_stack([np.sin(np.arange(200) / 9), np.full(200, 3.7)]).astype(np.float32) * np.float32(size)
    scaler = fit_scaler(task, [Series("log", values, values[:, :1])], (Kind.GENERIC, Kind.GENERIC))
    assert scaler.constant == ("b",)
    assert scaler.feature_scale[0] == pytest.approx(values[:, 0].std(), rel=1e-5)


@pytest.mark.parametrize("mode", list(TargetMode))
def test_target_scales_are_those_of_the_encoded_targets(mode):
    task = Task(MIXED.features, MIXED.targets, MIXED.horizons, mode, 100.0)
    train = [mixed(1), mixed(2, 77)]
    scaler = fit_scaler(task, train, KINDS_OF_MIXED)
    for row, k in enumerate(task.horizons):
        present = [part.targets[:-k] if mode == "delta" else 0.0 for part in train]
        values = np.concatenate([part.targets[k:] - p for part, p in zip(train, present, strict=True)])
        np.testing.assert_allclose(scaler.target_scale[row], values.std(axis=0, dtype=np.float64), rtol=1e-6)
        wanted = 0.0 if mode == "delta" else values.mean(axis=0, dtype=np.float64)
        np.testing.assert_allclose(scaler.target_offset[row], wanted, rtol=1e-6)


def test_the_scaler_does_not_see_other_parts():
    """Prepared data whose validation and test are replaced by something huge keep their scaler."""
    from edp.data.prepared import Prepared

    def prepared(other):
        kinds = KINDS_OF_MIXED
        return Prepared(MIXED, [mixed(1)], [other], [other], (), kinds, kinds[:2], ("", ""), "0" * 32)

    huge = mixed(3)
    huge.inputs[:] *= 1e6
    for name in ("feature_offset", "feature_scale", "target_offset", "target_scale"):
        np.testing.assert_array_equal(
            getattr(prepared(mixed(2)).scaler(), name), getattr(prepared(huge).scaler(), name)
        )
