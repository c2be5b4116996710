"""Logs of a few machines, small enough to be looked at by every kind of executor."""

import pytest

from edp.jobs import IN_PROCESS, Workers
from edp.sim.data_set import SimulationOrder, simulate_data_set


@pytest.fixture(scope="session")
def small_order():
    return SimulationOrder(minutes=0.6, recordings=4, seed=3, family=2)


@pytest.fixture(scope="session")
def small_logs(small_order, tmp_path_factory):
    folder = tmp_path_factory.mktemp("fleet") / "logs"
    simulate_data_set(folder, small_order, workers=IN_PROCESS)
    return folder


@pytest.fixture
def here():
    """Units in this process: the same path as on a cluster, without its processes."""
    return Workers()
