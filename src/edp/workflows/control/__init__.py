"""Closed loops: a controller drives a plant along tasks; gains are tuned on one plant and evaluated on another."""

from edp.control.plants import is_fmu as is_fmu
from edp.workflows.control.bench import ControlBench, ControlSources
from edp.workflows.control.export_controller import export_controller
from edp.workflows.control.run_control import ControlRun, control_loops
from edp.workflows.control.tune_gains import Tuning, TuningSpec, tune_gains

__all__ = [
    "ControlBench",
    "ControlRun",
    "ControlSources",
    "Tuning",
    "TuningSpec",
    "control_loops",
    "export_controller",
    "tune_gains",
]
