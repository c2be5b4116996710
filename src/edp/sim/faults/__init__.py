"""Machine faults and sensor faults for scenarios and environments; each kind is a row of a table."""

from edp.sim.faults import machine_faults as machine_faults
from edp.sim.faults import sensor_faults as sensor_faults
from edp.sim.faults.base import FAULTS, FaultKind, FaultSpec, MachineFault, SensorFault, insert_site, ladder
from edp.sim.faults.notation import fault_text, faults_of, parse_fault

__all__ = [
    "FAULTS",
    "FaultKind",
    "FaultSpec",
    "MachineFault",
    "SensorFault",
    "fault_text",
    "faults_of",
    "insert_site",
    "ladder",
    "parse_fault",
]
