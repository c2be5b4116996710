"""Faults of the machine and of its sensors, for scenarios and environments; each kind is a file and a registration."""

from edp.sim.faults.base import FAULTS, FaultKind, FaultSpec, MachineFault, SensorFault, at_site, ladder
from edp.sim.faults.machine import attachment_mass as attachment_mass
from edp.sim.faults.machine import check_leak as check_leak
from edp.sim.faults.machine import cooler as cooler
from edp.sim.faults.machine import dead_band as dead_band
from edp.sim.faults.machine import external_leak as external_leak
from edp.sim.faults.machine import free_air as free_air
from edp.sim.faults.machine import friction as friction
from edp.sim.faults.machine import internal_leak as internal_leak
from edp.sim.faults.machine import main_relief as main_relief
from edp.sim.faults.machine import port_relief as port_relief
from edp.sim.faults.machine import power_limit as power_limit
from edp.sim.faults.machine import pump_efficiency as pump_efficiency
from edp.sim.faults.machine import return_line as return_line
from edp.sim.faults.machine import slow_spool as slow_spool
from edp.sim.faults.machine import spool_play as spool_play
from edp.sim.faults.machine import stuck_spool as stuck_spool
from edp.sim.faults.machine import valve_delay as valve_delay
from edp.sim.faults.machine import worn_edges as worn_edges
from edp.sim.faults.notation import fault_text, faults_of, parse_fault
from edp.sim.faults.sensors import head_rod_swapped as head_rod_swapped
from edp.sim.faults.sensors import pilot_bias as pilot_bias
from edp.sim.faults.sensors import pressure_bias as pressure_bias
from edp.sim.faults.sensors import pressure_dropouts as pressure_dropouts
from edp.sim.faults.sensors import pressure_lag as pressure_lag
from edp.sim.faults.sensors import pressure_noise as pressure_noise
from edp.sim.faults.sensors import pressure_scale as pressure_scale
from edp.sim.faults.sensors import pressure_stuck as pressure_stuck
from edp.sim.faults.sensors import pump_pressure_bias as pump_pressure_bias
from edp.sim.faults.sensors import stroke_bias as stroke_bias
from edp.sim.faults.sensors import stroke_scale as stroke_scale
from edp.sim.faults.sensors import stroke_stuck as stroke_stuck
from edp.sim.faults.sensors import temperature_offset as temperature_offset
from edp.sim.faults.sensors import velocities_swapped as velocities_swapped
from edp.sim.faults.sensors import velocity_bias as velocity_bias
from edp.sim.faults.sensors import velocity_delay as velocity_delay
from edp.sim.faults.sensors import velocity_dropouts as velocity_dropouts
from edp.sim.faults.sensors import velocity_noise as velocity_noise
from edp.sim.faults.sensors import velocity_scale as velocity_scale
from edp.sim.faults.sensors import velocity_stuck as velocity_stuck

__all__ = [
    "FAULTS",
    "FaultKind",
    "FaultSpec",
    "MachineFault",
    "SensorFault",
    "at_site",
    "fault_text",
    "faults_of",
    "ladder",
    "parse_fault",
]
