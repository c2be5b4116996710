"""Simulator of an electro-hydraulic excavator front: scenarios in, recordings out."""

from edp.sim.excitation import EXCITATIONS
from edp.sim.machine.machine import Machine
from edp.sim.machine.machine_files import load_machine, machine_family, machine_names
from edp.sim.physics.snapshot import Snapshot
from edp.sim.plan import DEFAULT_MIX, DataSetSpec, distribute_over_family, plan_data_set, simulate_many
from edp.sim.scenario import Scenario, SimulationError
from edp.sim.scenario_file import read_scenario_file
from edp.sim.simulate import Simulation, simulate

__all__ = [
    "DEFAULT_MIX",
    "EXCITATIONS",
    "DataSetSpec",
    "Machine",
    "Scenario",
    "Simulation",
    "SimulationError",
    "Snapshot",
    "distribute_over_family",
    "load_machine",
    "machine_family",
    "machine_names",
    "plan_data_set",
    "read_scenario_file",
    "simulate",
    "simulate_many",
]
