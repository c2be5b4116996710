"""A port relief valve opens too early."""

from __future__ import annotations

from edp.settings.bounds import span
from edp.sim.faults.base import AXES, CHAMBERS, FAULTS, PRESSURE, MachineFault, MachineNumbers
from edp.sim.machine import layout as at


class PortRelief(MachineFault):
    """Its setting falls, though not below the pressure of the tank."""

    text = "a port relief valve opens too early; the size is the fall of its setting"
    part = "{axis} valve"
    words = "the port relief valve of {site} opens {size} too early"
    grave = True
    sites = CHAMBERS
    units = PRESSURE
    ladder = (100.0, 150.0, 200.0, 250.0)
    bound = span(0.0, 350.0)

    def change(self, numbers: MachineNumbers, site: str, size: float) -> None:
        """See `MachineFault.change`."""
        axis, side = site.split("_")
        i, column = AXES.index(axis), at.RELIEF_HEAD if side == "head" else at.RELIEF_ROD
        numbers.axes[i, column] = max(numbers.axes[i, column] - size, numbers.plant[at.TANK])


FAULTS.register("port_relief")(PortRelief())
