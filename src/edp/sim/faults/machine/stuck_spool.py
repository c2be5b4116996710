"""A spool sticks before the end of its travel."""

from __future__ import annotations

import math

from edp.settings.bounds import span
from edp.sim.faults.base import AXES, FAULTS, SHARE, SPOOLS, MachineFault, MachineNumbers
from edp.sim.machine import layout as at


class StuckSpool(MachineFault):
    """The travel of one spool beyond its dead band is limited, so that part of its opening is never reached."""

    text = "a spool sticks before it is open; the size is the share of the opening that is lost"
    part = "{axis} valve"
    words = "the {site} spool sticks: {size} of its opening are lost"
    grave = True
    sites = SPOOLS
    units = SHARE
    ladder = (10.0, 25.0, 50.0, 80.0)
    bound = span(0.0, 100.0)

    def change(self, numbers: MachineNumbers, site: str, size: float) -> None:
        """See `MachineFault.change`."""
        if size == 0.0:
            return
        i, conflux = SPOOLS.index(site) % len(AXES), SPOOLS.index(site) >= len(AXES)
        # The opening is r (0.25 + 0.75 r): solved for r, where it is what is left.
        numbers.axes[i, at.CONFLUX_WIDEST if conflux else at.WIDEST] = (
            math.sqrt(0.0625 + 3.0 * (1.0 - size)) - 0.25
        ) / 1.5


FAULTS.register("stuck_spool")(StuckSpool())
