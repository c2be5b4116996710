"""Fault: bucket or attachment is heavier than the machine's parameters state."""

from __future__ import annotations

from edp.settings.bounds import span
from edp.sim.faults.base import FAULTS, MASS, MachineFault, MachineNumbers
from edp.sim.machine import layout as at
from edp.sim.physics import terramechanics


class AttachmentMass(MachineFault):
    """Mass and inertia of the bucket grow in proportion; its centre stays."""

    text = "the attachment is heavier than it is known to be"
    part = "attachment"
    words = "the attachment is {size} heavier than it is known to be"
    sites = ()
    units = MASS
    ladder = (100.0, 300.0, 900.0)
    bound = span(0.0, 5000.0)

    def change(self, numbers: MachineNumbers, site: str, size: float) -> None:
        """See `MachineFault.change`."""
        axes, soil = numbers.axes, numbers.soil
        factor = 1.0 + size / numbers.machine.bodies.mass[2]
        axes[2, at.MASS] *= factor
        axes[2, at.INERTIA] *= factor
        # In soil, mass and inertia follow at each tick from those of the empty bucket and of its load.
        soil[terramechanics.BUCKET_MASS] *= factor
        soil[terramechanics.BUCKET_INERTIA] *= factor


FAULTS.register("attachment_mass")(AttachmentMass())
