import dataclasses
import math
import sys

import numpy as np
import pytest
import torch

from edp.data.augment import AUGMENTATIONS
from edp.data.chunks import ChunkSpec
from edp.data.series import Series
from edp.errors import ConfigError, DataError
from edp.networks.losses import LOSSES, TERMS, AdaptiveWeights, MeanSquared
from edp.networks.outputs import OUTPUTS
from edp.networks.predictor import build_model
from edp.networks.running import stream_predictions
from edp.storage.runs import KeyedRun, Run
from edp.training.averages import NoAverage, Stochastic
from edp.training.fit import Diverged, TrainingError, TrainingSpec, fit, validation_scores
from edp.training.objective import Objective
from edp.training.optimizers import OPTIMIZERS, AdamW
from edp.training.schedules import SCHEDULES, Constant
from edp.training.spec import thread_count

pytestmark = pytest.mark.long


def weights(fitted):
    return {name: parameter.detach().clone() for name, parameter in fitted.predictor.named_parameters()}


def same(one, other):
    return all(torch.equal(one[name], other[name]) for name in one)


@pytest.fixture(scope="module")
def fitted(tiny, tiny_model, tiny_training):
    events = []
    made = fit(tiny, tiny_model, tiny_training, on_event=events.append)
    return made, events


def test_the_loss_falls_and_every_epoch_has_a_row(fitted, tiny_training):
    made, events = fitted
    losses = [row["train_loss"] for row in made.history]
    scores = [row["validation_score"] for row in made.history]
    assert len(losses) == tiny_training.epochs
    assert losses[-1] < 0.6 * losses[0]
    assert scores[-1] < scores[0]
    assert [row["epoch"] for row in made.history] == [1, 2, 3, 4, 5]
    assert [event.row for event in events if event.row] == made.history
    assert made.resumed_at == 0
    assert not made.predictor.training


def test_the_weights_kept_are_those_of_the_best_epoch(fitted, tiny, tiny_training):
    made, _ = fitted
    score, report, loss = validation_scores(made.predictor, tiny.validation, tiny_training, tiny)
    best = min(made.history, key=lambda row: row["validation_score"])
    assert best["best"]
    assert score == pytest.approx(best["validation_score"], rel=1e-6)
    assert report == pytest.approx(best["validation_mae"], rel=1e-6)
    assert loss == pytest.approx(best["validation_loss"], rel=1e-6)


def test_validation_scores_are_means_over_ticks_after_the_burn_in(fitted, tiny, tiny_training):
    predictor, part = fitted[0].predictor, tiny.validation[0]
    predicted = stream_predictions(predictor, [part])[0]
    errors = []
    for row, k in enumerate((1, 3)):
        future = part.targets[20 + k : part.samples - 3 + k]
        errors.append(np.abs(predicted[20 : part.samples - 3, row] - future).mean(axis=0, dtype=np.float64))
    score, report, _ = validation_scores(predictor, [part], tiny_training, tiny)
    assert report == pytest.approx(1000 * np.mean(errors), rel=1e-5)  # mm/s
    assert score == pytest.approx(np.mean(errors / predictor.code.width.numpy()), rel=1e-5)


def test_the_same_seed_gives_the_same_bits_and_another_others(fitted, tiny, tiny_model, tiny_training):
    first = weights(fitted[0])
    assert same(first, weights(fit(tiny, tiny_model, tiny_training)))
    assert not same(first, weights(fit(tiny, tiny_model, dataclasses.replace(tiny_training, seed=4))))


def test_training_leaves_the_global_random_state_of_model_building_alone(tiny, tiny_model):
    torch.manual_seed(1)
    before = torch.get_rng_state()
    build_model(tiny.task, tiny_model, tiny.scaler(), seed=9)
    assert torch.equal(torch.get_rng_state(), before)


def test_the_test_part_is_not_touched(fitted, tiny, tiny_model, tiny_training):
    other = dataclasses.replace(tiny, test=[])
    assert same(weights(fitted[0]), weights(fit(other, tiny_model, tiny_training)))


@pytest.mark.parametrize("schedule", list(SCHEDULES))
@pytest.mark.parametrize("optimizer", list(OPTIMIZERS))
def test_every_optimizer_and_schedule_trains_with_either_regime(schedule, optimizer, tiny, tiny_bypass):
    for regime, length in (("chunk", 32), ("window", 10)):
        spec = TrainingSpec(
            chunks=ChunkSpec(regime=regime, length=length, batch=8, burn_in=20),
            loss=MeanSquared(),
            weight_power=1.0,
            optimizer=OPTIMIZERS[optimizer](),
            schedule=SCHEDULES[schedule](),
            epochs=2,
            updates=12,
            average=NoAverage(),
            device="cpu",
        )
        made = fit(tiny, tiny_bypass, spec)
        assert made.history[-1]["updates"] == 24
        assert np.isfinite(made.history[-1]["validation_score"])


@pytest.mark.parametrize("regime", ["chunk", "window"])
@pytest.mark.parametrize(("loss", "output"), [(loss, output) for loss in LOSSES for output in LOSSES[loss].outputs])
def test_every_loss_and_output_trains_with_all_terms_and_augmentations(loss, output, regime, tiny, tiny_bypass):
    chunks = {
        "chunk": ChunkSpec(length=32, batch=4, burn_in=20),
        "window": ChunkSpec(regime="window", length=10, batch=9),
    }
    spec = TrainingSpec(
        chunks=dataclasses.replace(chunks[regime], consecutive=3 if regime == "window" else 1),
        augmentations=tuple(AUGMENTATIONS[name]() for name in AUGMENTATIONS),
        loss=LOSSES[loss](),
        terms=tuple(TERMS[name]() for name in TERMS),
        weight_power=0.5,
        horizon_decay=0.9,
        adaptive=AdaptiveWeights(blend=0.3),
        average=Stochastic(fraction=0.5),
        epochs=2,
        updates=4,
        device="cpu",
    )
    made = fit(tiny, dataclasses.replace(tiny_bypass, output=OUTPUTS[output]()), spec)
    assert all(np.isfinite(list(row.values())).all() for row in made.history)
    assert all(torch.isfinite(value).all() for value in made.predictor.state_dict().values())


def test_a_by_pass_starts_better_than_a_network_alone(fitted, tiny, tiny_bypass, tiny_training):
    made = fit(tiny, tiny_bypass, dataclasses.replace(tiny_training, epochs=1))
    assert made.history[0]["validation_score"] < fitted[0].history[0]["validation_score"]


def test_a_by_pass_that_is_not_trained_stays(tiny, tiny_bypass, tiny_training):
    fixed = dataclasses.replace(tiny_bypass.blocks[1], trainable=False)
    model = dataclasses.replace(tiny_bypass, blocks=(fixed,))
    short = fit(tiny, model, dataclasses.replace(tiny_training, epochs=1)).predictor.bypass
    longer = fit(tiny, model, dataclasses.replace(tiny_training, epochs=2)).predictor.bypass
    assert short.weight.abs().sum() > 0
    assert torch.equal(short.weight, longer.weight)


def test_patience_stops_a_training_that_does_not_get_better(tiny, tiny_model, tiny_training):
    # At this rate no weight moves, so the first epoch stays the best but for rounding.
    still = AdamW(learning_rate=1e-30, weight_decay=0.0)
    spec = dataclasses.replace(tiny_training, optimizer=still, patience=2, epochs=9, average=NoAverage())
    assert [row["best"] for row in fit(tiny, tiny_model, spec).history] == [True, False, False]


def test_a_loss_that_is_not_finite_is_a_training_error(tiny, tiny_model, tiny_training):
    wild = dataclasses.replace(tiny_training, optimizer=AdamW(learning_rate=1e38), schedule=Constant())
    with pytest.raises(TrainingError, match=r"loss is (nan|inf) at update \d+ .epoch 1.: .* Lower the learning rate"):
        fit(tiny, tiny_model, wild)


def poisoned(tiny, rows):
    """The tiny data set with infinite levers in a training recording, which the readers of logs would refuse."""
    inputs = tiny.train[0].inputs.copy()
    inputs[rows, 3] = np.inf
    return dataclasses.replace(tiny, train=[Series("poisoned", inputs, tiny.train[0].targets), *tiny.train[1:]])


def test_an_infinite_input_diverges_in_the_epoch_that_meets_it(tmp_path, tiny, tiny_model, tiny_training, monkeypatch):
    # The scaler is that of the clean data, as if the value had come later; the epoch's batches meet it in any order.
    clean = tiny.scaler()
    monkeypatch.setattr(type(tiny), "scaler", lambda self: clean)
    with Run(tmp_path) as folder:
        with pytest.raises(Diverged, match=r"no epoch was finished before, so nothing is kept") as caught:
            fit(poisoned(tiny, slice(300, 302)), tiny_model, tiny_training, KeyedRun(folder, "k"))
        assert caught.value.fitted is None
        assert caught.value.facts["kept_epoch"] is None
        assert not folder.file("checkpoint.safetensors").exists()


def test_a_training_that_diverges_later_hands_over_the_best_weights_and_keeps_its_history(
    tmp_path, tiny, tiny_model, tiny_training, fitted, monkeypatch
):
    real, calls = Objective.evaluate, []

    def evaluate(self, *parts):
        calls.append(1)
        return real(self, *parts) * (math.inf if len(calls) == 70 else 1.0)

    monkeypatch.setattr(Objective, "evaluate", evaluate)
    with Run(tmp_path) as folder, pytest.raises(Diverged) as caught:
        fit(tiny, tiny_model, tiny_training, KeyedRun(folder, "k"))
    end, history = caught.value, fitted[0].history[:2]
    assert (end.facts["epoch"], end.facts["update"]) == (3, 70)
    best = min(history, key=lambda row: row["validation_score"])
    assert end.facts["kept_epoch"] == best["epoch"]
    assert f"is inf at update 70 (epoch 3): the training diverged; the weights of epoch {best['epoch']}" in str(end)
    score, _, _ = validation_scores(end.fitted.predictor, tiny.validation, tiny_training, tiny)
    assert score == pytest.approx(best["validation_score"], rel=1e-6)
    assert len((tmp_path / "history.jsonl").read_text().splitlines()) == 2


def test_a_start_from_a_regression_is_kept_where_the_first_epoch_diverges(tiny, tiny_bypass, tiny_training):
    wild = dataclasses.replace(tiny_training, optimizer=AdamW(learning_rate=1e38), schedule=Constant())
    with pytest.raises(Diverged, match="the weights of the start are kept") as caught:
        fit(tiny, tiny_bypass, wild)
    assert caught.value.facts["kept_epoch"] == 0
    score, _, _ = validation_scores(caught.value.fitted.predictor, tiny.validation, tiny_training, tiny)
    assert 0 < score < 1


def test_weights_that_break_in_the_last_update_of_an_epoch_are_not_kept(tiny, tiny_model, tiny_training, monkeypatch):
    def scores(*parts):
        return math.nan, math.nan, math.nan

    monkeypatch.setattr(sys.modules[fit.__module__], "validation_scores", scores)
    with pytest.raises(Diverged, match=r"the validation score is nan at update 30 \(epoch 1\)"):
        fit(tiny, tiny_model, tiny_training)


def test_swa_waits_for_its_average(tiny, tiny_model, tiny_training):
    still = AdamW(learning_rate=1e-30, weight_decay=0.0)
    spec = dataclasses.replace(tiny_training, optimizer=still, patience=1, epochs=5, average=Stochastic())
    assert len(fit(tiny, tiny_model, spec).history) == 5


def test_recordings_shorter_than_the_burn_in_are_refused(tiny, tiny_model, tiny_training):
    def cut(part, samples):
        return Series(part.name, part.inputs[:samples], part.targets[:samples])

    short = dataclasses.replace(tiny, train=[*tiny.train, cut(tiny.train[0], 23)])
    with pytest.raises(DataError, match="'linear 1' has 23 samples, shorter than the burn-in of 20"):
        fit(short, tiny_model, tiny_training)
    short = dataclasses.replace(tiny, validation=[cut(tiny.validation[0], 23)])
    with pytest.raises(DataError, match="validation recording 'linear 3' has 23 samples"):
        fit(short, tiny_model, tiny_training)


@pytest.mark.parametrize(
    "options",
    [
        {"epochs": 0},
        {"updates": -1},
        {"patience": -1},
        {"clip_norm": 0.0},
        {"horizon_decay": 0.0},
        {"horizon_decay": 1.5},
        {"threads": -1},
        {"device": "tpu"},
    ],
)
def test_settings_out_of_range_are_refused(options):
    with pytest.raises(ConfigError, match="must hold"):
        TrainingSpec(**options)


def test_zero_threads_means_all_cores():
    assert thread_count(TrainingSpec(threads=0)) >= 1
    assert thread_count(TrainingSpec(threads=3)) == 3


@pytest.mark.skipif(torch.cuda.is_available(), reason="asks for a device that is there")
def test_a_missing_device_is_named(tiny, tiny_model, tiny_training):
    with pytest.raises(ConfigError, match="no CUDA device is present"):
        fit(tiny, tiny_model, dataclasses.replace(tiny_training, device="cuda"))


def test_a_refit_trains_on_all_stretches_for_the_epochs_that_were_best(tiny, tiny_model, tiny_training):
    spec = dataclasses.replace(tiny_training, epochs=2)
    first = fit(tiny, tiny_model, spec)
    best = max(row["epoch"] for row in first.history if row["best"])
    events = []
    again = fit(tiny, tiny_model, dataclasses.replace(spec, refit="best"), on_event=events.append)
    assert again.history == [dict(row, seconds=again.history[i]["seconds"]) for i, row in enumerate(first.history)]
    assert {event.epochs for event in events if event.refit} == {best}
    assert all(event.row is None for event in events if event.refit)
    # The same as a training on all stretches with the scaler of the first; the tiny task gets better with each epoch.
    assert best == spec.epochs
    joined = dataclasses.replace(tiny, train=[*tiny.train, *tiny.validation])
    object.__setattr__(joined, "scaler", tiny.scaler)
    for mine, theirs in zip(
        again.predictor.parameters(), fit(joined, tiny_model, spec).predictor.parameters(), strict=True
    ):
        assert torch.equal(mine, theirs)
    for mine, theirs in zip(again.predictor.parameters(), first.predictor.parameters(), strict=True):
        assert not torch.equal(mine, theirs)


@pytest.mark.parametrize("refit", ["best", "whole"])
def test_a_refit_of_the_best_epoch_or_to_the_end_of_the_schedule(refit, tiny, tiny_model, tiny_training):
    # A rate that spoils the weights soon: the first training stops early.
    spec = dataclasses.replace(tiny_training, epochs=9, patience=1, refit=refit, optimizer=AdamW(learning_rate=1.0))
    events = []
    fitted = fit(tiny, tiny_model, spec, on_event=events.append)
    best = max(row["epoch"] for row in fitted.history if row["best"])
    assert best < len(fitted.history) < spec.epochs
    epochs = {"best": best, "whole": spec.epochs}[refit]
    assert {event.epochs for event in events if event.refit} == {epochs}
    assert max(event.epoch for event in events if event.refit) == epochs


def test_a_refit_keeps_the_calibration_of_the_first_training(tiny, tiny_model, tiny_training):
    model = dataclasses.replace(tiny_model, output=OUTPUTS["laplace"]())
    spec = dataclasses.replace(tiny_training, epochs=2, loss=LOSSES["heteroscedastic"]())
    first, again = fit(tiny, model, spec), fit(tiny, model, dataclasses.replace(spec, refit="best"))
    held, kept = first.predictor.output.state_dict(), again.predictor.output.state_dict()
    assert held
    assert all(torch.equal(held[name], kept[name]) for name in held)


def test_a_refit_that_diverges_leaves_the_first_training(tiny, tiny_model, tiny_training):
    broken = dataclasses.replace(tiny.validation[0], targets=tiny.validation[0].targets.copy())
    spec = dataclasses.replace(tiny_training, epochs=2, refit="best")
    first = fit(tiny, tiny_model, dataclasses.replace(spec, refit="none"))

    def on_event(event):
        if event.epoch == spec.epochs and event.row is not None:
            broken.targets[50:] = np.inf  # from now on the validation stretch, which the refit trains on, is bad

    with pytest.raises(Diverged, match="this was the refit; the weights of the first training are kept") as end:
        fit(dataclasses.replace(tiny, validation=[broken]), tiny_model, spec, on_event=on_event)
    for mine, theirs in zip(end.value.fitted.predictor.parameters(), first.predictor.parameters(), strict=True):
        assert torch.equal(mine, theirs)
