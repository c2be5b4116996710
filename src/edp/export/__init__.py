"""Writes a trained network in a form that runs without EDP: one file or folder a target, entered in `TARGETS`."""

from edp.export.base import TARGETS, ExportTarget, make_target
from edp.export.c import CTarget
from edp.export.casadi import CasadiTarget
from edp.export.fmu import FmuTarget
from edp.export.onnx import OnnxTarget
from edp.export.ros2 import Ros2Target
from edp.export.simulink import SimulinkTarget

__all__ = [
    "TARGETS",
    "CTarget",
    "CasadiTarget",
    "ExportTarget",
    "FmuTarget",
    "OnnxTarget",
    "Ros2Target",
    "SimulinkTarget",
    "make_target",
]
