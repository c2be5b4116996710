"""A monitor of the small rig, fitted once."""

import pytest

from edp.config.monitor import load_monitor_experiment
from edp.testing.monitor import rig_sessions
from edp.workflows.monitor import FittedMonitor, fit_to_recordings

TICKS = 3000
SESSIONS = 24
EXPERIMENT = load_monitor_experiment(None, (), {"hours_per_false_alarm": 0.11, "minutes": 0.05})


@pytest.fixture(scope="session")
def healthy():
    return rig_sessions(SESSIONS, TICKS, seed=1)


@pytest.fixture(scope="session")
def fresh():
    """Healthy sessions that no fit has seen."""
    return rig_sessions(8, TICKS, seed=1, first=SESSIONS)


@pytest.fixture(scope="session")
def fitted(healthy) -> FittedMonitor:
    return fit_to_recordings(healthy, EXPERIMENT)
