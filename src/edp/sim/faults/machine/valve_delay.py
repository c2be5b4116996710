"""The command of a spool arrives late."""

from __future__ import annotations

from edp.settings.bounds import span
from edp.sim.faults.base import FAULTS, SPOOLS, TIME, MachineFault, MachineNumbers


class ValveDelay(MachineFault):
    """The dead time of one spool grows."""

    text = "the command of a spool arrives late"
    part = "{axis} valve"
    words = "the command of the {site} spool arrives {size} late"
    sites = SPOOLS
    units = TIME
    ladder = (10.0, 20.0, 50.0, 100.0)
    bound = span(0.0, 500.0)

    def change(self, numbers: MachineNumbers, site: str, size: float) -> None:
        """See `MachineFault.change`."""
        numbers.delays[SPOOLS.index(site)] += size * numbers.rate_hz

    def dead_time_s(self, size: float) -> float:
        """See `MachineFault.dead_time_s`."""
        return size


FAULTS.register("valve_delay")(ValveDelay())
