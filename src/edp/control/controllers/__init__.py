"""Controllers of the levers; one file and one registration each."""

from edp.control.base import CONTROLLERS, Controller, ControllerSpec
from edp.control.controllers.inversion import ModelInversion as ModelInversion
from edp.control.controllers.nmpc import PredictiveControl as PredictiveControl
from edp.control.controllers.pi import ProportionalIntegral as ProportionalIntegral

__all__ = ["CONTROLLERS", "Controller", "ControllerSpec"]
