"""Simulator of an electro-hydraulic excavator front: scenarios in, recordings out."""

from edp.sim.machine import Machine
from edp.sim.machine_files import load_machine, machine_family, machine_names
from edp.sim.operator import EXCITATIONS
from edp.sim.plan import DEFAULT_MIX, over_family, plan_data_set, simulate_many
from edp.sim.simulate import Scenario, SimulationError, simulate

__all__ = [
    "DEFAULT_MIX",
    "EXCITATIONS",
    "Machine",
    "Scenario",
    "SimulationError",
    "load_machine",
    "machine_family",
    "machine_names",
    "over_family",
    "plan_data_set",
    "simulate",
    "simulate_many",
]
