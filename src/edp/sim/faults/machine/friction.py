"""Seals, guides or pins of an axis rub more."""

from __future__ import annotations

from edp.settings.bounds import span
from edp.sim.faults.base import AXES, FACTOR, FAULTS, MachineFault, MachineNumbers
from edp.sim.machine import layout as at


class MoreFriction(MachineFault):
    """Coulomb, static and viscous friction of one cylinder grow by a factor."""

    text = "an axis rubs more, by a factor"
    part = "{axis} cylinder"
    words = "the {axis} rubs more: by a factor of {size}"
    units = FACTOR
    ladder = (1.3, 2.0, 4.0)
    bound = span(1.0, 20.0)
    neutral = 1.0

    def change(self, numbers: MachineNumbers, site: str, size: float) -> None:
        """See `MachineFault.change`."""
        for column in (at.COULOMB, at.STATIC, at.VISCOUS):
            numbers.axes[AXES.index(site), column] *= size


FAULTS.register("friction")(MoreFriction())
