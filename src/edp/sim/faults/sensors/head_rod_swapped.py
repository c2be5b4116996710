"""The plugs of a cylinder's two pressure transmitters are interchanged."""

from __future__ import annotations

from edp.sim.faults.base import AXES, FAULTS, NO_UNIT, SensorFault
from edp.sim.sensors import alterations, chain


class HeadRodSwapped(SensorFault):
    """Head and rod pressure of one cylinder change places."""

    text = "head and rod pressure of a cylinder are interchanged"
    part = "sensors of {axis} pressures"
    words = "head and rod pressure of the {axis} are interchanged"
    units = NO_UNIT
    operation = alterations.SWAP

    def channels(self, site: str) -> tuple[int, ...]:
        """See `SensorFault.channels`."""
        head = chain.PRESSURES + AXES.index(site)
        return head, head + len(AXES)


FAULTS.register("head_rod_swapped")(HeadRodSwapped())
