"""Names by which `gymnasium.make` finds the environments."""

from __future__ import annotations

from edp.sim.environment.library import gymnasium
from edp.sim.machine.machine_files import machine_names

ENTRY, VECTOR_ENTRY = "edp.sim.environment:ExcavatorEnv", "edp.sim.environment:VectorExcavatorEnv"


def register() -> None:
    """Register ``edp/Excavator-M22-v0`` etc., one per built-in machine; repeated calls are allowed."""
    for machine in machine_names():
        name = f"edp/Excavator-{machine}-v0"
        if name not in gymnasium.registry:
            gymnasium.register(id=name, entry_point=ENTRY, vector_entry_point=VECTOR_ENTRY, kwargs={"machine": machine})
