"""The edges through which a spool lets oil out are worn."""

from __future__ import annotations

from edp.settings.bounds import span
from edp.sim.faults.base import AXES, FACTOR, FAULTS, MachineFault, MachineNumbers
from edp.sim.machine import layout as at


class WornEdges(MachineFault):
    """The openings from both chambers to the tank grow by a factor, and the load falls or runs ahead faster."""

    text = "the meter-out edges of a spool are worn, and let out more by a factor"
    part = "{axis} valve"
    words = "the meter-out edges of the {axis} spool let out more: by a factor of {size}"
    units = FACTOR
    ladder = (1.1, 1.2, 1.4, 1.6)
    bound = span(1.0, 5.0)
    neutral = 1.0

    def change(self, numbers: MachineNumbers, site: str, size: float) -> None:
        """See `MachineFault.change`."""
        i = AXES.index(site)
        numbers.axes[i, at.OUT_EXTEND] *= size
        numbers.axes[i, at.OUT_RETRACT] *= size


FAULTS.register("worn_edges")(WornEdges())
