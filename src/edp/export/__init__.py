"""Writes a trained network in a form that runs without EDP: one file or folder a target, entered in `TARGETS`."""

from edp.export.base import TARGETS, ExportTarget, make_target
from edp.export.c import CTarget as CTarget
from edp.export.casadi import CasadiTarget as CasadiTarget
from edp.export.fmu import FmuTarget as FmuTarget
from edp.export.onnx import OnnxTarget as OnnxTarget
from edp.export.ros2 import Ros2Target as Ros2Target
from edp.export.simulink import SimulinkTarget as SimulinkTarget

__all__ = [
    "TARGETS",
    "ExportTarget",
    "make_target",
]
