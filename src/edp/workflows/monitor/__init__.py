"""From runs and healthy logs to a monitor, and from a monitor and logs to alarms."""

from edp.workflows.monitor.fit_monitor import FittedMonitor, fit_monitor, fit_to_recordings
from edp.workflows.monitor.run_monitor import MonitorRun, run_monitor

__all__ = ["FittedMonitor", "MonitorRun", "fit_monitor", "fit_to_recordings", "run_monitor"]
