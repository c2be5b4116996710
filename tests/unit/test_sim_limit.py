"""The limit of predictability."""

import dataclasses

import numpy as np
import pytest
from noted_progress import NotedProgress

from edp.errors import ConfigError
from edp.jobs import IN_PROCESS, Workers
from edp.sim import DataSetSpec, load_machine
from edp.sim.data_set import SimulationOrder, find_data_set_limit, simulate_data_set
from edp.sim.predictability import LimitSpec, find_limit, least_mae, plan_limit

pytestmark = pytest.mark.processes

SMALL = LimitSpec(horizons=(1, 10, 40), moments=8, branches=8)
NOISE_MAE = 1e3 * np.sqrt(2 / np.pi)


def spec_of(**changes):
    return DataSetSpec(**{"minutes": 1.2, "recordings": 4, "seed": 2, "mix": {"combined": 1.0}, **changes})


@pytest.mark.parametrize(("draw", "true"), [("normal", np.sqrt(2 / np.pi)), ("laplace", 1.0), ("random", 0.25)])
@pytest.mark.parametrize("branches", [8, 32])
def test_the_estimate_of_few_branches_is_not_biased(draw, true, branches):
    values = getattr(np.random.default_rng(1), draw)(size=(branches, 40_000))
    own = np.abs(values - np.median(values, axis=0)).mean()
    assert own < 0.99 * true
    assert least_mae(values).mean() == pytest.approx(true, rel=0.02)


def test_least_mae_is_the_mean_of_own_and_left_out_medians():
    values = np.random.default_rng(0).exponential(size=(6, 5))
    own = np.abs(values - np.median(values, axis=0)).mean(axis=0)
    left = np.mean([np.abs(values[i] - np.median(np.delete(values, i, 0), axis=0)) for i in range(6)], axis=0)
    np.testing.assert_allclose(least_mae(values), 0.5 * (own + left))


@pytest.fixture(scope="module")
def found():
    return find_limit(spec_of().scenarios(), SMALL)


def test_with_commands_known_only_sensors_are_left_in_free_air(found):
    noise = NOISE_MAE * load_machine("M22").sensors.velocity
    known = np.array(found.commands_known.mae)
    assert known.shape == (3, 4)
    np.testing.assert_allclose(known.mean(), noise, rtol=0.1)
    # The valves answer after more than 10 samples: until then nothing that is commanded later can be felt.
    np.testing.assert_allclose(np.array(found.commands_unknown.mae)[0, 3], noise, rtol=0.2)


def test_the_limit_rises_and_lies_below_persistence(found):
    unknown, persistence = (np.array(getattr(found, kind).mae)[:, 3] for kind in ("commands_unknown", "persistence"))
    assert (unknown < persistence).all()
    assert unknown[2] > 5 * unknown[0]
    low, high = (np.array(getattr(found.commands_unknown, key))[:, 3] for key in ("low", "high"))
    assert ((low <= unknown) & (unknown <= high)).all()
    assert found.targets == ("CylVels_1", "CylVels_2", "CylVels_3")
    assert (found.moments, found.recordings, found.unit) == (8, 4, "mm/s")


def test_the_same_for_any_number_of_workers_and_none_without_noise(found):
    assert find_limit(spec_of().scenarios(), SMALL, workers=Workers(count=2)) == found
    quiet = find_limit(spec_of(sensor_noise=False, recordings=2, minutes=0.4).scenarios(), SMALL)
    assert np.abs(quiet.commands_known.mae).max() < 1e-9


def test_soil_is_not_known_beforehand():
    soil = spec_of(mix={"dig": 1.0}, materials={"gravel": 1.0}, sensor_noise=False, minutes=2.0)
    known = np.array(find_limit(soil.scenarios(), SMALL).commands_known.mae)
    assert known[2, 3] > 0.1


def test_it_is_kept_beside_the_logs_until_something_changes(tmp_path):
    order = SimulationOrder(minutes=0.4, recordings=2, seed=1)
    simulate_data_set(tmp_path, order, workers=IN_PROCESS)
    told = NotedProgress()
    first = find_data_set_limit(tmp_path, order, SMALL, IN_PROCESS, told)
    assert told.steps == [1, 2]
    assert find_data_set_limit(tmp_path, order, SMALL, IN_PROCESS, told) == first
    assert len(told.steps) == 2
    assert not (tmp_path / "units").exists()
    other = find_data_set_limit(tmp_path, order, dataclasses.replace(SMALL, seed=5), IN_PROCESS)
    assert other.commands_unknown != first.commands_unknown


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"horizons": (5, 2)}, r"horizons = \[5, 2\] must rise"),
        ({"horizons": ()}, "horizons has 0 entries"),
        ({"horizons": (0, 2)}, "1 <= horizons <= 2,000"),
        ({"recordings": 0}, "recordings = 0"),
        ({"seed": -1}, "seed = -1"),
        ({"branches": 7}, "branches = 7 must be even"),
        ({"moments": 1}, "moments = 1"),
    ],
)
def test_bad_settings_are_refused(change, message):
    with pytest.raises(ConfigError, match=message):
        LimitSpec(**change)


def test_recordings_too_short_are_refused():
    with pytest.raises(ConfigError, match="has 50 samples, too few"):
        plan_limit(spec_of(minutes=0.5 / 60, recordings=1).scenarios(), SMALL)
