"""From logs to a machine file of the simulator, and the machine compared with held-out logs."""

from edp.workflows.identify.identify import Identified, identify

__all__ = ["Identified", "identify"]
