"""Air in the oil, as from a leaking suction line."""

from __future__ import annotations

from edp.settings.bounds import span
from edp.sim.faults.base import FAULTS, SHARE, MachineFault, MachineNumbers
from edp.sim.machine import layout as at


class FreeAir(MachineFault):
    """The fraction of free air increases, and the oil becomes softer."""

    text = "there is more free air in the oil"
    part = "oil"
    words = "there is {size} more free air in the oil"
    sites = ()
    units = SHARE
    ladder = (1.0, 3.0, 6.0, 12.0)
    bound = span(0.0, 50.0)

    def change(self, numbers: MachineNumbers, site: str, size: float) -> None:
        """See `MachineFault.change`."""
        numbers.plant[at.AIR] += size


FAULTS.register("free_air")(FreeAir())
