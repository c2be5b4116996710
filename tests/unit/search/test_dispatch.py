"""Phases through ledger and pool: real trainings, and a search that was stopped comes to the same decision."""

import pytest

from edp.config.experiment import load_experiment
from edp.jobs.processes import LocalPool
from edp.storage.ledger import Ledger, TrainingStatus
from edp.workflows.search.arms import Arm
from edp.workflows.search.context import SearchContext
from edp.workflows.search.engine import Dispatcher, run_phases
from edp.workflows.search.settings import IsolationSpec, SearchSpec

CHANGES = (
    'task.targets=["speed"]',
    "task.horizons=[1]",
    'model.backbone={kind="lstm", units=4}',
    "model.blocks=[]",
    "model.window=5",
    "training.chunks={length=20, batch=4, burn_in=5}",
)
SPEC = SearchSpec(
    updates=5, horizon=1, folds=2, isolation=IsolationSpec(runs=4, seeds=2), backbones=("lstm",), features=("all",)
)


class Stop(Exception):
    """Stands for Ctrl-C."""


@pytest.fixture(scope="module")
def context(lever_sessions):
    base = Arm.from_experiment(load_experiment(None, "quick", CHANGES))
    names = tuple(f"s{number}" for number in range(5))
    return SearchContext(SPEC, base, lever_sessions.to_dict(), names[:4], names[4:], ("lever", "speed"))


def test_a_search_that_was_stopped_does_nothing_twice_and_decides_the_same(context, tmp_path):
    trained = []

    def search(on_record):
        with Ledger(tmp_path / "ledger") as ledger, LocalPool(1) as pool:
            do = Dispatcher(ledger, pool, "data", on_record=on_record)
            return run_phases(context, do, until="isolation").decided["isolation"]

    def stop_after_three(record, order, now):
        trained.append(record.key)
        assert now
        if len(trained) == 3:
            raise Stop

    with pytest.raises(Stop):
        search(stop_after_three)
    seen = []
    decision = search(lambda record, order, now: seen.append((record.key, now, record.status)))
    assert sum(not now for _, now, _ in seen) >= 3
    assert len({key for key, _, _ in seen}) == len(seen) == 8
    assert {status for *_, status in seen} == {TrainingStatus.DONE}
    seen.clear()
    again = search(lambda record, order, now: seen.append(now))
    assert not any(seen)
    assert again == decision
    assert decision.facts.arms["lstm all"].seed > 0
