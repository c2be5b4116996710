"""Names of the channels that a sensor fault changes."""

from __future__ import annotations

from edp.signals import TABLE_A1
from edp.sim.faults.base import FAULTS, SensorFault
from edp.sim.sensors import alterations, chain
from edp.sim.sensors.sensors import shown_names

# Noise is a fault of what is drawn, not of what is shown: columns of draws that belong to values of the chain.
# Velocities of cylinders come from rates of joints, or have errors of their own.
_DRAWN = (
    {chain.RATE_ERROR + i: chain.VELOCITIES + i for i in range(3)}
    | {chain.VELOCITY_ERROR + i: chain.VELOCITIES + i for i in range(3)}
    | {chain.PRESSURE_ERROR + i: chain.PRESSURES + i for i in range(6)}
)


def list_falsified(kind: str, site: str) -> tuple[str, ...]:
    """Return the channels whose readings a fault changes; empty for machine faults.

    Args:
        kind: name in `FAULTS`.
        site: one of its sites.

    Raises:
        ConfigError: the kind is unknown.
    """
    fault = FAULTS[kind]
    if not isinstance(fault, SensorFault):
        return ()
    columns = fault.channels[site]
    if fault.operation == alterations.NOISE:
        columns = tuple(dict.fromkeys(_DRAWN[column] for column in columns))
    names = {**dict(enumerate(TABLE_A1)), **{column: name for name, column in shown_names().items()}}
    return tuple(names[column] for column in columns)
