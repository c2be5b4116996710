"""Simulator as a Gymnasium environment: actions are lever positions, observations are sensor readings."""

from edp.sim.environment.model import NominalMachine
from edp.sim.environment.registration import register
from edp.sim.environment.single import ExcavatorEnv
from edp.sim.environment.spec import EnvironmentSpec
from edp.sim.environment.truth import Truth
from edp.sim.environment.vector import VectorExcavatorEnv

__all__ = ["EnvironmentSpec", "ExcavatorEnv", "NominalMachine", "Truth", "VectorExcavatorEnv", "register"]
register()
