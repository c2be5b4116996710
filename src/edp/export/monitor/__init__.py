"""Monitors as C99 without heap: residuals, chain and alarms along with the predictor, and a self-test."""

from edp.export.monitor.fmu import write_monitor_fmu
from edp.export.monitor.golden import drawn_rows
from edp.export.monitor.parts import (
    GoldenChain,
    GoldenResiduals,
    MonitorParts,
    NetworkPart,
    SourcePart,
    TwinPart,
    WatchCode,
)
from edp.export.monitor.ros2 import write_monitor_ros2
from edp.export.monitor.write import monitor_files, write_monitor

__all__ = [
    "GoldenChain",
    "GoldenResiduals",
    "MonitorParts",
    "NetworkPart",
    "SourcePart",
    "TwinPart",
    "WatchCode",
    "drawn_rows",
    "monitor_files",
    "write_monitor",
    "write_monitor_fmu",
    "write_monitor_ros2",
]
