"""Balances of flow of an exported monitor: the bits of Python, missing inputs among them."""

from __future__ import annotations

import numpy as np
import pytest

from edp.config.monitor import load_monitor_experiment
from edp.evaluation.monitor_footprint import FLOW_COSTS, chain_cycles, flow_cycles
from edp.export.monitor import write_monitor
from edp.sim import Scenario, simulate
from edp.workflows.monitor import fit_to_recordings
from edp.workflows.monitor.export_monitor import monitor_parts

FLAGS = ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")


@pytest.fixture(scope="module")
def excavator():
    """A monitor of balances alone, and a session."""
    sessions = [simulate(Scenario(duration_s=20.0, seed=seed, excitation="aprbs")) for seed in range(10)]
    changes = [
        *(
            "chain.block_s=0.4",
            "chain.settle_s=1.0",
            "chain.folds=2",
            "train_fraction=0.3",
            'dictionary.machine="none"',
        ),
        'chain.watches=[{detector={kind="cusum",slack=0.5},memory_s=0.4}]',
        'residuals=[{kind="flow_balances",trials=3,rows=10000,least=0.0},{kind="balances"}]',
    ]
    experiment = load_monitor_experiment(None, changes, {"hours_per_false_alarm": 0.01, "minutes": 0.02})
    return fit_to_recordings(sessions, experiment).monitor, sessions[0]


def test_balances_of_flow_have_the_bits_of_python(c, excavator, tmp_path):
    monitor, session = excavator
    assert sum(name.startswith("flow:") for name in monitor.residual_names) == 6
    write_monitor(monitor_parts(monitor), "watch", tmp_path)
    files = sorted(path.name for path in tmp_path.glob("*.c") if path.name != "example_task.c")
    c.run("gcc", *c.flags, *FLAGS, *files, "-lm", "-o", "program", folder=tmp_path)
    assert "all tests passed" in c.run(tmp_path / "program").decode()
    rows = session.select(monitor.inputs).copy()
    rows[300:310, 1] = np.nan
    rows[700, monitor.inputs.index("AmIn")] = np.nan
    # Oil that was not learned, and a thermometer that fails while it is hot.
    rows[900:950, monitor.inputs.index("OilTemperature")] += 40.0
    rows[930:940, monitor.inputs.index("OilTemperature")] = np.nan
    found = c.run(tmp_path / "program", "stream", feed=np.ascontiguousarray(rows, np.float32).tobytes())
    count = len(monitor.residual_names)
    residuals = np.frombuffer(found, np.float32).reshape(len(rows), -1)[:, :count]
    expected, _ = monitor.residuals(rows, monitor.initial_state())
    np.testing.assert_array_equal(residuals, expected)
    flows = [name.startswith("flow:") for name in monitor.residual_names]
    assert np.isnan(residuals[900:950][:, flows]).all()
    assert np.isfinite(residuals[950:960][:, flows]).all()


def test_their_cycles_count(excavator):
    parts = monitor_parts(excavator[0], golden=False)
    # Six spools, six chambers, two pumps at either spool and four ways besides.
    assert flow_cycles(parts) == 6 * FLOW_COSTS["spool"] + 6 * FLOW_COSTS["chamber"] + 48 * FLOW_COSTS["path"]
    assert chain_cycles(parts).mean > flow_cycles(parts)
