"""Oil leaves a chamber or its line, as from a hose that has burst or a seal of the rod."""

from __future__ import annotations

from edp.settings.bounds import span
from edp.sim.faults.base import AXES, CHAMBERS, FAULTS, FLOW, MachineFault, MachineNumbers
from edp.sim.machine import layout as at

REFERENCE_PRESSURE = 200e5
"""Pa across the gap at which a leak has its size, at 40 degC."""


class ExternalLeak(MachineFault):
    """A laminar gap from one chamber to the pressure of the tank: its flow goes with 1 / viscosity."""

    text = "oil leaves a chamber or its hose"
    part = "{axis} cylinder"
    words = "the {site} of the cylinder or its hose leaks outward: {size} at 200 bar"
    grave = True
    sites = CHAMBERS
    units = FLOW
    ladder = (0.3, 1.0, 3.0, 10.0)
    bound = span(0.0, 100.0)

    def change(self, numbers: MachineNumbers, site: str, size: float) -> None:
        """See `MachineFault.change`."""
        axis, side = site.split("_")
        column = at.HEAD_LEAK if side == "head" else at.ROD_LEAK
        numbers.axes[AXES.index(axis), column] += size / REFERENCE_PRESSURE


FAULTS.register("external_leak")(ExternalLeak())
