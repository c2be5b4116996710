"""A snapshot of a simulation, held to what it is for."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from edp.sim import Scenario, Simulation


def check_snapshot(folder: Path, machine: str) -> Simulation:
    """Run a machine file, go back to a moment, and run on to the same log bit by bit; the simulation at its end."""
    path = folder / "mine.toml"
    path.write_text(machine)
    simulation = Simulation(Scenario(machine=str(path), excitation="combined", seed=2))
    simulation.run(150)
    moment = simulation.snapshot()
    first = simulation.run(60).copy()
    speed = simulation.plant.engine_speed
    simulation.restore(moment)
    assert np.array_equal(simulation.run(60), first)
    assert simulation.plant.engine_speed == speed
    return simulation
