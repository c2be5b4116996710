"""A spool opens later than it should, as after wear of its edges or of its centring."""

from __future__ import annotations

from edp.settings.bounds import span
from edp.sim.faults.base import AXES, FAULTS, SHARE, SPOOLS, MachineFault, MachineNumbers
from edp.sim.machine import layout as at


class DeadBand(MachineFault):
    """The dead band of one spool grows to both sides, to 95 % of the travel at most."""

    text = "a spool opens too late; the size is added to its dead band, in shares of travel"
    part = "{axis} valve"
    words = "the {site} spool opens late: {size} of its travel are added to the dead band"
    sites = SPOOLS
    units = SHARE
    ladder = (2.0, 4.0, 8.0, 16.0)
    bound = span(0.0, 80.0)

    def change(self, numbers: MachineNumbers, site: str, size: float) -> None:
        """See `MachineFault.change`."""
        i, conflux = SPOOLS.index(site) % len(AXES), SPOOLS.index(site) >= len(AXES)
        first = at.CONFLUX_DEAD_BAND_EXTEND if conflux else at.DEAD_BAND_EXTEND
        # Behind the band there must be some travel left: the opening divides by it.
        for column in (first, first + 1):
            numbers.axes[i, column] = min(numbers.axes[i, column] + size, 0.95)


FAULTS.register("dead_band")(DeadBand())
