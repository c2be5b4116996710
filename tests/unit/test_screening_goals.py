"""The goals of the screening in small: it sees through decoys on simulated logs, and the benchmarks read it rightly."""

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest

from edp.data.screening import ForestSpec, ScreeningSpec, screen
from edp.sim import simulate
from edp.sim.data_set import SimulationOrder

pytestmark = pytest.mark.slow
FOLDER = Path(__file__).parents[2] / "benchmarks"
TARGETS = ("CylVels_1", "CylVels_2", "CylVels_3")


@pytest.fixture(scope="module")
def bench():
    """The benchmark scripts as modules, by name."""
    sys.path.insert(0, str(FOLDER))
    try:
        yield importlib.import_module
    finally:
        sys.path.remove(str(FOLDER))


@pytest.fixture(scope="module")
def plan():
    return SimulationOrder(minutes=4.2, recordings=14, seed=2).scenarios()


@pytest.fixture(scope="module")
def recordings(plan, bench):
    return [bench("screening_thesis").only_table_a1(simulate(scenario)) for scenario in plan]


@pytest.fixture(scope="module")
def laid(recordings, bench):
    return bench("decoys").lay_decoys(recordings, each=4, seed=1)


@pytest.fixture(scope="module")
def found(laid):
    forest = ForestSpec(trees=10, samples=4_000, test_samples=2_000)
    few = {"information_samples": 1_500, "rank_samples": 1_000}
    return screen(laid[0], ScreeningSpec(targets=TARGETS, max_lag=60, forest=forest, **few))


def test_decoys_are_seen_through(plan, recordings, laid, found, bench):
    truth = bench("m22_truth").causes(plan, recordings, moments=2)
    league = bench("screening_decoys")
    result = league.judged(found, laid[1], truth)
    assert result["needed lost"] == []
    assert result["leaks not flagged"] == {}
    assert not [text for text in result["leak flags on others"].values() if "Table A.1" in text]
    assert len(result["decoys kept"]) <= 2
    names = [verdict.title for verdict in league.goals(result, laid[1], truth)]
    assert names[:3] == ["needed channels of FG1 retained", "decoys dropped", "leaks flagged by name"]


def test_lags_stand_beside_table_4_2(found, bench):
    thesis = bench("screening_thesis")
    rows = {row["group"]: row for row in thesis.lag_rows(found)}
    assert list(rows) == list(thesis.TABLE_4_2)
    low, high = rows["pilot pressure"]["leading"]
    assert -25 <= low <= high <= -8
    lag = thesis.lag_of(found, "BmDwn", "CylVels_1")
    assert lag.led == pytest.approx(-lag.value, abs=1e-6)
    assert lag.leading == lag.best
    statements = thesis.of_the_lags(found, list(rows.values())) + thesis.of_the_correlations(thesis.Figures(found))
    statements += thesis.of_the_information(thesis.Figures(found))
    assert all(0.0 <= statement.met <= 1.0 for statement in statements)
    assert np.mean([statement.met for statement in statements]) > 0.5
