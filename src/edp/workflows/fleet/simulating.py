"""`edp simulate` by many processes or nodes: a unit a recording, which whoever simulates it writes."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from edp.errors import ConfigError, StorageError
from edp.jobs import Workforce
from edp.jobs.units import UnitResult, WorkUnit, run_units
from edp.logs import WriteOptions, write_recording
from edp.sim.data_set import Simulated, SimulationOrder, simulate_data_set
from edp.sim.scenario import Scenario, plain
from edp.sim.simulate import simulate
from edp.storage.ledger import TrainingIdentity
from edp.storage.paths import full_path, is_folder_at, is_there


def simulate_with(
    workforce: Workforce,
    out: str | Path,
    order: SimulationOrder,
    on_done: Callable[[Simulated, bool], None] | None = None,
) -> list[Path]:
    """As `edp.sim.data_set.simulate_data_set`, by a workforce.

    Logs do not depend on who writes them: each scenario carries its own seed. One whose writer was killed is written
    by another; what is in the folder stays.

    Args:
        workforce: who simulates; nodes see the folder under the same path.
        out: folder.
        order: what to simulate.
        on_done: called with each recording and whether it was there already.

    Raises:
        StorageError: as `simulate_data_set`, or the nodes do not see the folder.
    """

    def elsewhere(missing: Sequence[Scenario], folder: Path, wrote: Callable[[Simulated], None]) -> None:
        units = [_unit(scenario, folder, order) for scenario in missing]
        by_name = {scenario.name: scenario for scenario in missing}

        def note(unit: WorkUnit, result: UnitResult, done: int) -> None:
            scenario = by_name[str(result.values["name"])]
            if not is_there(folder / f"{scenario.name}{order.suffix}"):
                raise StorageError(
                    f"'{scenario.name}' was written on another node, and is not in '{full_path(folder)}' here; give a "
                    "folder that all nodes see under the same path"
                )
            wrote(scenario)

        run_units(units, workforce, on_done=note)

    return simulate_data_set(out, order, on_done=on_done, elsewhere=elsewhere)


def _unit(scenario: Scenario, folder: Path, order: SimulationOrder) -> WorkUnit:
    arguments = {"scenario": plain(scenario), "suffix": order.suffix, "files": asdict(order.files())}
    where = {"folder": str(full_path(folder))}
    return WorkUnit(f"{__name__}:write_one", f"recording '{scenario.name}'", arguments, _machine(scenario), where)


def _machine(scenario: Scenario) -> str:
    """Hash of the machine's numbers, which a file may hold."""
    return hashlib.blake2b(repr(scenario.load()).encode(), digest_size=16).hexdigest()


def write_one(identity: TrainingIdentity, where: Mapping[str, Any]) -> dict[str, Any]:
    """Simulate a recording and write its log, unless somebody has: the folder is bound to one order."""
    scenario = Scenario(**identity.config["scenario"])
    if _machine(scenario) != identity.data:
        raise ConfigError(
            f"machine '{scenario.machine}' has other numbers on this node; all nodes must see the same file there"
        )
    folder = Path(where["folder"])
    if not is_folder_at(folder):
        raise StorageError(f"'{folder}' is not on this node; give a folder that all nodes see under the same path")
    path = folder / f"{scenario.name}{identity.config['suffix']}"
    if not is_there(path):
        write_recording(simulate(scenario), path, WriteOptions(**identity.config["files"]))
    return {"name": scenario.name}
