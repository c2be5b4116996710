"""Names by which `gymnasium.make` finds the tasks."""

from __future__ import annotations

from edp.control.tasks import TASKS
from edp.sim.environment.library import gymnasium
from edp.sim.machine.machine_files import machine_names

ENTRY, VECTOR_ENTRY = "edp.control.learning:TaskEnvironment", "edp.control.learning:VectorTaskEnvironment"


def register_tasks() -> None:
    """Register ``edp/Grade-M22-v0`` etc., one per task and built-in machine; repeated calls are allowed."""
    for task in TASKS:
        for machine in machine_names():
            name = f"edp/{task.title()}-{machine}-v0"
            if name not in gymnasium.registry:
                kwargs = {"task": task, "machine": machine}
                gymnasium.register(id=name, entry_point=ENTRY, vector_entry_point=VECTOR_ENTRY, kwargs=kwargs)
