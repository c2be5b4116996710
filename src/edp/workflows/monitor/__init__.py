"""From runs and healthy logs to a monitor, from a monitor and logs to alarms, and from alarms to a page."""

from edp.workflows.monitor.dictionary import build_dictionary
from edp.workflows.monitor.fit_monitor import FittedMonitor, fit_monitor, fit_to_recordings
from edp.workflows.monitor.report_monitor import report_monitor
from edp.workflows.monitor.run_monitor import MonitorRun, run_monitor

__all__ = [
    "FittedMonitor",
    "MonitorRun",
    "build_dictionary",
    "fit_monitor",
    "fit_to_recordings",
    "report_monitor",
    "run_monitor",
]
