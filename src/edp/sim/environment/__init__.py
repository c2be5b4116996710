"""The simulator as an environment of Gymnasium: lever positions in, what sensors show out."""

from edp.sim.environment.library import gymnasium as _gymnasium  # noqa: F401  refuses first where it is missing
from edp.sim.environment.registration import register
from edp.sim.environment.single import ExcavatorEnv
from edp.sim.environment.spec import EnvironmentSpec
from edp.sim.environment.truth import Truth

__all__ = ["EnvironmentSpec", "ExcavatorEnv", "Truth", "register"]
register()
