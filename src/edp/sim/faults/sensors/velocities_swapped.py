"""Two joints' sensors are interchanged."""

from __future__ import annotations

from edp.sim.faults.base import FAULTS, NO_UNIT, SensorFault
from edp.sim.sensors import alterations, chain

PAIRS = {"boom_arm": (0, 1), "boom_bucket": (0, 2), "arm_bucket": (1, 2)}


class VelocitiesSwapped(SensorFault):
    """Velocities of two cylinders change places, and with them their accelerations."""

    text = "velocities of two cylinders are interchanged"
    part = "sensors of velocities"
    words = "velocities of {pair} are interchanged"
    sites = tuple(PAIRS)
    units = NO_UNIT
    operation = alterations.SWAP

    def channels(self, site: str) -> tuple[int, ...]:
        """See `SensorFault.channels`."""
        first, second = PAIRS[site]
        return chain.VELOCITIES + first, chain.VELOCITIES + second


FAULTS.register("velocities_swapped")(VelocitiesSwapped())
