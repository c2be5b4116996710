"""One training of a search: plain order in, plain record out."""

import dataclasses
import json

import numpy as np
import pytest

from edp.config.experiment import load_experiment
from edp.errors import ConfigError, DataError
from edp.jobs.processes import LocalPool
from edp.storage.ledger import Ledger
from edp.workflows.search.arms import Arm
from edp.workflows.search.engine import Dispatcher
from edp.workflows.search.jobs import job_of
from edp.workflows.search.trainings import SCORES, TrainingRequest, experiment_of, train_part

CHANGES = (
    'task.features={name="tiny", channels=["lever", "speed"]}',
    'task.targets=["speed"]',
    "task.horizons=[1, 3]",
    'model.backbone={kind="lstm", units=4}',
    "model.blocks=[]",
    "model.window=5",
    "training.threads=1",
    "training.chunks={length=20, batch=4, burn_in=5}",
)


@pytest.fixture(scope="module")
def source(lever_sessions):
    return lever_sessions


@pytest.fixture(scope="module")
def order(source):
    settings = Arm.from_experiment(load_experiment(None, "quick", CHANGES)).tables
    return TrainingRequest(settings, source.to_dict(), ("s0", "s1", "s2"), ("s3", "s4"), seed=1, updates=12)


@pytest.fixture(scope="module")
def record(order):
    return train_part(order).result


def test_an_order_goes_through_json_and_equal_orders_give_equal_records(order, record):
    plain = json.loads(json.dumps(order.to_json()))
    assert TrainingRequest.from_json(plain) == order
    assert train_part(TrainingRequest.from_json(plain)).result == record
    assert json.loads(json.dumps(record)) == record


def test_a_record_has_every_judging_session_and_their_means(record):
    assert set(record["sessions"]) == {"s3", "s4"}
    assert set(record["sessions"]["s3"]) == {"1", "3"}
    for name in SCORES:
        values = [record["sessions"][s][k][name] for s in ("s3", "s4") for k in ("1", "3")]
        assert record["scores"][name] == pytest.approx(np.mean(values))
    assert record["parameters"] > 0
    assert record["train_loss"] > 0


def test_another_seed_and_another_fold_give_other_records(order, record):
    other = train_part(dataclasses.replace(order, seed=2)).result
    assert other["scores"] != record["scores"]
    fold = train_part(dataclasses.replace(order, train=("s0", "s1", "s4"), judged=("s3",))).result
    assert set(fold["sessions"]) == {"s3"}
    assert fold["sessions"]["s3"] != record["sessions"]["s3"]


def test_sessions_that_judge_have_no_say_in_training(order, record):
    fewer = train_part(dataclasses.replace(order, judged=("s3",))).result
    assert fewer["sessions"]["s3"] == record["sessions"]["s3"]


def test_nothing_is_chosen_in_a_training(order):
    made = experiment_of(order)
    assert (made.training.epochs, made.training.updates, made.training.patience) == (1, 12, 0)


def test_settings_that_an_order_decides_are_not_part_of_its_key():
    one = load_experiment(None, "quick", [*CHANGES, "training.epochs=3", "training.seed=5", "evaluation.baselines=[]"])
    other = load_experiment(None, "quick", [*CHANGES, "training.epochs=9", "training.updates=7"])
    assert Arm.from_experiment(one) == Arm.from_experiment(other)
    assert Arm.from_experiment(one) != Arm.from_experiment(
        load_experiment(None, "quick", [*CHANGES, "training.clip_norm=2.0"])
    )


def test_orders_that_cannot_be_are_refused(order):
    with pytest.raises(ConfigError, match="s2 would train and judge"):
        dataclasses.replace(order, judged=("s2", "s4"))
    with pytest.raises(ConfigError, match="3 sessions train, 0 judge"):
        dataclasses.replace(order, judged=())
    with pytest.raises(ConfigError, match="updates = 0"):
        dataclasses.replace(order, updates=0)
    with pytest.raises(DataError, match="has no session s9; the data changed"):
        train_part(dataclasses.replace(order, judged=("s9",)))
    with pytest.raises(DataError, match="two training sessions or more"):
        train_part(dataclasses.replace(order, train=("s0",)))


def test_a_process_of_a_pool_does_an_order_to_the_same_bits(order, record, tmp_path):
    job = job_of(order, "digest of the data")
    told = []
    moved = dataclasses.replace(order, source={**order.source, "path": "elsewhere"})
    assert job_of(moved, "digest of the data").key == job.key
    others = [dataclasses.replace(order, **change) for change in ({"seed": 2}, {"updates": 13}, {"judged": ("s4",)})]
    assert (
        len({job.key, job_of(order, "other").key, *(job_of(other, "digest of the data").key for other in others)}) == 5
    )
    with LocalPool(1) as pool, Ledger(tmp_path) as ledger:
        do = Dispatcher(ledger, pool, "digest of the data", on_record=lambda *row: told.append(row[-1]))
        bad = dataclasses.replace(order, train=("s0", "s9"))
        outcomes = do([order, bad, order])
        assert [outcome.order for outcome in outcomes] == [order, bad, order]
        assert [outcome.status for outcome in outcomes] == ["done", "failed", "done"]
        assert "has no session s9" in outcomes[1].message
        assert outcomes[0].result == record
        assert do([order]) == outcomes[:1]
        assert told == [True, True, False]
