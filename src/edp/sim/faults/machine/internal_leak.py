"""Oil passes the seals of a piston, from one chamber to the other."""

from __future__ import annotations

from edp.settings.bounds import span
from edp.sim.faults.base import AXES, FAULTS, FLOW, MachineFault, MachineNumbers
from edp.sim.machine import layout as at

REFERENCE_PRESSURE = 200e5
"""Pa across the gap at which a leak has its size, at 40 degC."""


class InternalLeak(MachineFault):
    """Laminar leakage across the piston: the flow is proportional to its pressure difference and to 1 / viscosity."""

    text = "oil passes the seals of the piston"
    part = "{axis} cylinder"
    words = "the {axis} cylinder leaks inside: {size} at 200 bar"
    grave = True
    units = FLOW
    ladder = (0.3, 1.0, 3.0, 10.0)
    bound = span(0.0, 100.0)

    def change(self, numbers: MachineNumbers, site: str, size: float) -> None:
        """See `MachineFault.change`."""
        numbers.axes[AXES.index(site), at.PISTON_LEAK] += size / REFERENCE_PRESSURE


FAULTS.register("internal_leak")(InternalLeak())
