"""The tolerance of a chain: what differs between machines of a series is no fault, and what is larger still is one."""

import numpy as np
import pytest

from edp.errors import ConfigError
from edp.monitor.fitting import ChainSpec, fit_chain
from edp.monitor.residuals.base import ResidualSource, SourceParts, residuals_of, sisters_of
from edp.testing.monitor import RIG, rig_sessions

OWN = 8e6 + 5e6 / 0.6
"""Pa s/m of the rig: pressures without their load, over the velocity."""
PROMISED_H = 0.1


class Stiffness(ResidualSource):
    """Pressures of the rig less what its velocity makes of them: it knows one number of the machine."""

    names, units = ("stiffness",), ("Pa",)
    inputs = ("pressure_a", "velocity", "pressure_b")
    judged, reads = (("pressure_a",),), (inputs,)
    middle = np.array([1e7, 0.0, 6e6], np.float32)

    def __init__(self, factor: float = OWN) -> None:
        self.factor = factor

    def adjust_to_sister(self, rng, tolerance):
        return Stiffness(self.factor * (1.0 + rng.uniform(-tolerance, tolerance)))

    def _start(self, streams):
        return None

    def _run(self, rows, there, own):
        rest = rows[..., 0] - 1e7 + (rows[..., 2] - 6e6) / 0.6 - self.factor * rows[..., 1]
        return rest[..., None].astype(np.float32), own

    def parts(self):
        return SourceParts()

    @classmethod
    def from_parts(cls, parts):
        return cls()


@pytest.fixture(scope="module")
def chains():
    sessions = rig_sessions(24, 3000, seed=2)
    return {
        tolerance: fit_chain(ChainSpec(tolerance=tolerance), [Stiffness()], RIG, sessions, PROMISED_H).chain
        for tolerance in (0.0, 0.02)
    }


def alarms(chain, off: float) -> int:
    """On healthy sessions of a machine whose number is off by a share."""
    count = 0
    for session in rig_sessions(8, 3000, seed=2, first=24):
        residuals = residuals_of(Stiffness(OWN * (1.0 + off)), [session])[0]
        verdicts, _ = chain.run(residuals, session.select([c.name for c in RIG]), chain.initial_state())
        count += sum(verdict.alarm is not None for verdict in verdicts)
    return count


@pytest.mark.long
def test_a_sister_within_the_tolerance_raises_few_alarms_and_a_stranger_many(chains):
    assert alarms(chains[0.0], 0.02) >= 8
    assert alarms(chains[0.02], 0.015) <= 2
    assert alarms(chains[0.02], 0.2) >= 8


def test_the_machine_itself_raises_none(chains):
    assert all(alarms(chain, 0.0) <= 1 for chain in chains.values())


def test_sisters_are_drawn_by_number_and_a_tolerance_of_nothing_draws_none():
    source = Stiffness()
    assert sisters_of([source], 0.0, 3) == [source]
    factors = [sisters_of([source], 0.01, number)[0].factor for number in (0, 0, 1)]
    assert factors[0] == factors[1] != factors[2]
    assert max(abs(factor / OWN - 1.0) for factor in factors) <= 0.01


@pytest.mark.parametrize("value", [-0.1, 0.5, float("nan")])
def test_a_tolerance_out_of_bounds_is_refused(value):
    with pytest.raises(ConfigError, match="tolerance"):
        ChainSpec(tolerance=value)
