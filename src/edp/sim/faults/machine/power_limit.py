"""The engine or the regulator of the pumps gives less power."""

from __future__ import annotations

from edp.settings.bounds import span
from edp.sim.faults.base import FAULTS, SHARE, MachineFault, MachineNumbers
from edp.sim.machine import layout as at


class PowerLimit(MachineFault):
    """The common power limit of the pumps decreases by a fraction."""

    text = "the power limit of the pumps is too low; the size is the share that is lost"
    part = "pump control"
    words = "the power limit of the pumps is {size} too low"
    sites = ()
    units = SHARE
    ladder = (5.0, 10.0, 20.0, 40.0)
    bound = span(0.0, 95.0)

    def change(self, numbers: MachineNumbers, site: str, size: float) -> None:
        """See `MachineFault.change`."""
        numbers.plant[at.POWER_LIMIT] *= 1.0 - size


FAULTS.register("power_limit")(PowerLimit())
