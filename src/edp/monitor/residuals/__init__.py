"""Residuals of a machine (measured minus expected): one module per source, registered in `RESIDUALS`."""

from edp.monitor.residuals.balances import BalancesSpec as BalancesSpec
from edp.monitor.residuals.base import RESIDUALS, FitMaterial, ResidualSource, ResidualSpec, SourceParts, SourceState
from edp.monitor.residuals.cycles import CyclesSpec as CyclesSpec
from edp.monitor.residuals.flow_balances import FlowBalancesSpec as FlowBalancesSpec
from edp.monitor.residuals.look_ahead import LookAheadSpec as LookAheadSpec
from edp.monitor.residuals.twin_ports import TwinPortsSpec as TwinPortsSpec
from edp.monitor.residuals.virtual_sensors import VirtualSensorsSpec as VirtualSensorsSpec

__all__ = ["RESIDUALS", "FitMaterial", "ResidualSource", "ResidualSpec", "SourceParts", "SourceState"]
