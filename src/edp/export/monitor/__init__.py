"""Monitors as C99 without heap: residuals, chain and alarms along with the predictor, and a self-test."""

from edp.export.monitor.fmu import write_monitor_fmu
from edp.export.monitor.golden import drawn_rows
from edp.export.monitor.parts import (
    BalancePart,
    ChainPart,
    FlowChamber,
    FlowPart,
    GoldenChain,
    GoldenResiduals,
    MonitorParts,
    NetworkPart,
    SourcePart,
    TwinPart,
    WatchPart,
)
from edp.export.monitor.ros2 import write_monitor_ros2
from edp.export.monitor.write import DETECTORS, monitor_files, write_monitor

__all__ = [
    "DETECTORS",
    "BalancePart",
    "ChainPart",
    "FlowChamber",
    "FlowPart",
    "GoldenChain",
    "GoldenResiduals",
    "MonitorParts",
    "NetworkPart",
    "SourcePart",
    "TwinPart",
    "WatchPart",
    "drawn_rows",
    "monitor_files",
    "write_monitor",
    "write_monitor_fmu",
    "write_monitor_ros2",
]
