"""A spool follows its pilot with play."""

from __future__ import annotations

from edp.settings.bounds import span
from edp.sim.faults.base import AXES, FAULTS, SHARE, SPOOLS, MachineFault, MachineNumbers
from edp.sim.machine import layout as at


class SpoolPlay(MachineFault):
    """The half width of the play between pilot and spool grows."""

    text = "a spool follows its pilot with play; the size is added to the half width, in shares of travel"
    part = "{axis} valve"
    words = "the {site} spool follows its pilot with play: {size} of its travel"
    sites = SPOOLS
    units = SHARE
    ladder = (1.0, 2.0, 4.0, 8.0)
    bound = span(0.0, 50.0)

    def change(self, numbers: MachineNumbers, site: str, size: float) -> None:
        """See `MachineFault.change`."""
        i, conflux = SPOOLS.index(site) % len(AXES), SPOOLS.index(site) >= len(AXES)
        numbers.axes[i, at.CONFLUX_HYSTERESIS if conflux else at.HYSTERESIS] += size


FAULTS.register("spool_play")(SpoolPlay())
