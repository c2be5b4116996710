"""A spool moves more slowly, as with cold or dirty oil."""

from __future__ import annotations

from edp.settings.bounds import span
from edp.sim.faults.base import FACTOR, FAULTS, SPOOLS, MachineFault, MachineNumbers
from edp.sim.physics import valve


class SlowSpool(MachineFault):
    """The natural frequency of one spool falls by a factor; its pilot stays."""

    text = "a spool moves more slowly, by a factor"
    part = "{axis} valve"
    words = "the {site} spool moves slowly: by a factor of {size}"
    sites = SPOOLS
    units = FACTOR
    ladder = (1.25, 1.5, 2.0, 3.0)
    bound = span(1.0, 20.0)
    neutral = 1.0

    def change(self, numbers: MachineNumbers, site: str, size: float) -> None:
        """See `MachineFault.change`."""
        if size == 1.0:
            # Computed anew, a sound spool's numbers might differ by rounding.
            return
        j, valves = SPOOLS.index(site), numbers.machine.valves
        frequency = (*valves.spool_frequency, *valves.conflux_spool_frequency)[j] / size
        for filters, step_s in zip((numbers.coarse, numbers.fine), numbers.half_steps_s, strict=True):
            filters[j, 1] = valve.oscillator(frequency, valve.SPOOL_DAMPING, step_s)


FAULTS.register("slow_spool")(SlowSpool())
