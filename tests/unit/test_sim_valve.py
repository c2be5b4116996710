import dataclasses

import numpy as np
import pytest
from scipy.linalg import expm

from edp.sim import load_machine
from edp.sim.physics import valve


@pytest.mark.parametrize("step_s", [1e-4, 5e-4, 1e-3])
def test_filters_are_the_matrix_exponential(step_s):
    machine = load_machine("M22")
    filters = valve.spool_filters(machine, step_s)
    frequencies = [
        machine.valves.pilot_frequency * 2,
        machine.valves.spool_frequency + machine.valves.conflux_spool_frequency,
    ]
    for j in range(6):
        for stage, damping in enumerate((0.9, 1.0)):
            w = 2 * np.pi * frequencies[stage][j]
            expected = expm(np.array([[0.0, 1.0], [-w * w, -2 * damping * w]]) * step_s)
            np.testing.assert_allclose(filters[j, stage].reshape(2, 2), expected, rtol=1e-9, atol=1e-12)


def test_conflux_waits_longer():
    machine = load_machine("M22")
    slow = dataclasses.replace(machine, valves=dataclasses.replace(machine.valves, conflux_extra_dead_time=0.02))
    np.testing.assert_allclose(valve.dead_times(slow)[3:] - valve.dead_times(slow)[:3], 0.02)
