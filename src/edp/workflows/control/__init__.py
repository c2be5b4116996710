"""Closed loops: a controller on a plant along tasks, with a page."""

from edp.workflows.control.run_control import ControlRun, control_loops

__all__ = ["ControlRun", "control_loops"]
