"""Training on free runs: what is drawn, what is learned, and that a seed settles it."""

from dataclasses import replace

import numpy as np
import pytest

from edp.errors import ConfigError, DataError, StorageError
from edp.evaluation.free_run import FreeRunJudgeSpec, free_run_scores, free_runs
from edp.networks.twin import TWINS, fit_scales
from edp.networks.twin.recurrent import Recurrent
from edp.networks.twin.windows import MeasuredWindows, random_windows
from edp.storage.runs import KeyedRun, Run
from edp.testing.twins import sample_series
from edp.training.free_run import FreeRunDiverged, FreeRunSpec, draw_measured_ports, fit_free_runs
from edp.training.optimizers import AdamW, Soap

SMALL = {"batch": 16, "lengths_s": (0.2, 1.0), "updates": (150, 100), "validate_every": 50, "validation_s": 5.0}
SMALL |= {"optimizer": AdamW(learning_rate=2e-2)}


@pytest.fixture(scope="module")
def data():
    channels, series = sample_series(6)
    return channels, fit_scales(channels, series[:4]), series[:4], series[4:5], series[5:]


def fitted(data, **changes):
    channels, scales, train, validation, _ = data
    twin = Recurrent(units=12, prefix_ticks=10).start(channels, scales, train, seed=0)
    return fit_free_runs(twin, train, validation, FreeRunSpec(**{**SMALL, **changes}))


@pytest.mark.long
def test_free_runs_are_learned_far_better_than_the_static_map(data):
    channels, scales, train, _, test = data
    result = fitted(data, validate_every=25, patience=0)
    floor = TWINS["static"]().start(channels, scales, train, 0)
    errors = [
        free_run_scores(free_runs(twin, test, 8.0, 4), FreeRunJudgeSpec(at_s=(8.0,))).velocity_mae.mean
        for twin in (result.twin, floor)
    ]
    assert errors[0] < 0.6 * errors[1]
    assert [row["update"] for row in result.history] == list(range(25, 251, 25))
    assert result.history[-1]["validation"] < 0.4 * result.history[0]["validation"]


@pytest.mark.long
def test_a_seed_settles_every_bit_and_another_one_changes_them(data):
    short = {"lengths_s": (0.2,), "updates": (20,), "validate_every": 10}
    first, again, other = (fitted(data, seed=seed, **short).twin.arrays() for seed in (0, 0, 1))
    assert all(np.array_equal(first[name], again[name]) for name in first)
    assert not np.array_equal(first["h_weight"], other["h_weight"])


class Stop(Exception):
    """Raised in place of Ctrl-C."""


@pytest.mark.long
@pytest.mark.parametrize("optimizer", [AdamW(learning_rate=1e-2), Soap()], ids=["adamw", "soap"])
def test_a_stopped_training_goes_on_to_the_same_bits(data, tmp_path, optimizer):
    channels, scales, train, validation, _ = data
    stages = {"lengths_s": (0.1, 0.2), "updates": (20, 20), "validate_every": 10, "optimizer": optimizer}
    spec = FreeRunSpec(**{**SMALL, **stages})

    def new():
        return Recurrent(units=6, prefix_ticks=10).start(channels, scales, train, seed=0)

    def stop(event):
        if event.update in (10, 30):
            raise Stop

    whole = fit_free_runs(new(), train, validation, spec)
    for _ in range(2):
        with Run(tmp_path) as folder, pytest.raises(Stop):
            fit_free_runs(new(), train, validation, spec, stop, KeyedRun(folder, "k" * 32))
    with Run(tmp_path) as folder:
        resumed = fit_free_runs(new(), train, validation, spec, run=KeyedRun(folder, "k" * 32))
    first, second = whole.twin.arrays(), resumed.twin.arrays()
    assert all(np.array_equal(first[name], second[name]) for name in first)
    facts = [[{k: v for k, v in row.items() if k != "seconds"} for row in fit.history] for fit in (whole, resumed)]
    assert facts[0] == facts[1]
    with Run(tmp_path) as folder, pytest.raises(StorageError, match="belongs to another run"):
        fit_free_runs(new(), train, validation, spec, run=KeyedRun(folder, "x" * 32))


def test_the_best_validation_is_kept(data, monkeypatch):
    errors = iter([3.0, 1.0, 2.0, 4.0])
    monkeypatch.setattr("edp.training.free_run.FreeRunValidation.error", lambda self: next(errors))
    seen = []
    channels, scales, train, validation, _ = data
    twin = Recurrent(units=4, prefix_ticks=5).start(channels, scales, train, seed=0)
    spec = FreeRunSpec(**{**SMALL, "lengths_s": (0.1,), "updates": (40,), "validate_every": 10})
    result = fit_free_runs(twin, train, validation, spec, lambda e: seen.append((e.best, twin.arrays()["h_weight"])))
    assert [best for best, _ in seen] == [True, True, False, False]
    assert np.array_equal(result.twin.arrays()["h_weight"], seen[1][1])
    assert not np.array_equal(result.twin.arrays()["h_weight"], seen[3][1])


def test_the_last_stage_ends_early_and_no_other_one(data, monkeypatch):
    errors = iter([1.0] + [2.0] * 50)
    monkeypatch.setattr("edp.training.free_run.FreeRunValidation.error", lambda self: next(errors))
    history = fitted(data, lengths_s=(0.1, 0.1), updates=(30, 100), validate_every=5, patience=3).history
    assert [row["update"] for row in history] == [5, 10, 15, 20, 25, 30, 35]


def test_stretches_lie_within_recordings_and_begin_everywhere(data):
    _, _, train, _, _ = data
    short = replace(train[0], inputs=train[0].inputs[:25], targets=train[0].targets[:25])
    windows = random_windows([short, *train], 25, 20_000, np.random.default_rng(0))
    starts = {(next(i for i, part in enumerate(train) if part is window.series), window.first) for window in windows}
    assert starts == {(s, t) for s in range(4) for t in range(600 - 25)}
    measured = MeasuredWindows.read(windows[:3], 25)
    for k, (series, first) in enumerate(windows[:3]):
        assert np.array_equal(measured.commands[k], series.inputs[first : first + 25])
        assert np.array_equal(measured.outputs[k], series.targets[first : first + 26])


def test_ports_are_measured_by_their_shares():
    spec = FreeRunSpec(measured_fraction=0.25, mixed_fraction=0.25)
    ports = draw_measured_ports(spec, (30, 4000, 6), 10, np.random.default_rng(0))
    assert (ports[0] == 1).all()
    later = ports[10:]
    assert (later == later[:1]).all()
    measured, free = (later[0] == 1).all(axis=1).mean(), (later[0] == 0).all(axis=1).mean()
    assert measured == pytest.approx(0.25, abs=0.03)
    assert free == pytest.approx(0.5, abs=0.03)
    mixed = ~((later[0] == 1).all(axis=1) | (later[0] == 0).all(axis=1))
    assert later[0][mixed].mean() == pytest.approx(0.5, abs=0.03)
    assert np.array_equal(ports[1][mixed], later[0][mixed])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"lengths_s": (1.0,)}, r"1 lengths_s and 4 updates; one number"),
        ({"measured_fraction": 0.7, "mixed_fraction": 0.3}, "leave no lane that runs free"),
        ({"batch": 0}, "batch = 0"),
        ({"lengths_s": (0.1, 1.0, 2.0, 1e9)}, "lengths_s"),
    ],
)
def test_settings_that_cannot_be_are_refused(changes, message):
    with pytest.raises(ConfigError, match=message):
        FreeRunSpec(**changes)


def test_recordings_that_are_too_short_are_refused(data):
    channels, scales, train, _, _ = data
    twin = Recurrent(units=4, prefix_ticks=5).start(channels, scales, train, seed=0)
    with pytest.raises(DataError, match=r"no stretch is longer than prefix and free run, 20\.1 s"):
        fit_free_runs(twin, train, train, FreeRunSpec(lengths_s=(20.0,), updates=(1,)))


@pytest.mark.long
def test_a_gradient_that_is_not_finite_ends_the_training(data):
    with pytest.raises(FreeRunDiverged, match=r"the gradient of update \d+ is not finite; lower"):
        fitted(data, optimizer=AdamW(learning_rate=1e38), clip_norm=1e6)
