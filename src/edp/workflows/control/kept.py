"""Content of a closed-loop run on its controller; the run alone is enough for an export.

The folder ``controller`` of a run holds the settings' machine as a file, the valve map, the twin, what the plant
measures, and a segment of the first loop with which exported code is compared.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tomli_w
from numpy.typing import NDArray
from safetensors.numpy import load as load_arrays
from safetensors.numpy import save as save_arrays

from edp import __version__
from edp.config.control import ControlExperiment, load_control_experiment
from edp.control.geometry import AXES, TipGeometry
from edp.control.loop import LEVERS, LoopResult
from edp.control.models import ControlModels
from edp.control.plant import PILOTS, PlantInterface
from edp.control.tasks import ControlTask
from edp.control.valve_map import SIDES, ValveMap
from edp.errors import StorageError
from edp.signals import TABLE_A1
from edp.sim.environment import NominalMachine
from edp.sim.machine.machine_checks import MACHINE_FILE
from edp.sim.machine.machine_files import load_machine
from edp.storage import make_folder, write_bytes, write_json
from edp.storage.arrays import ArrayRule, checked_arrays
from edp.storage.paths import is_file_at
from edp.storage.runs import missing_text
from edp.training.bundle import (
    add_plugins,
    channel_from_dict,
    channel_to_dict,
    convert_damage,
    read_arrays,
    remove_old_arrays,
    sealed_header,
    write_arrays,
)
from edp.training.twin_bundle import TwinBundle, load_twin, save_twin

KEPT, HEADER, MACHINE, TWIN = "controller", "controller.json", "machine.toml", "twin"
SCHEMA = 1
GOLDEN_TICKS = 150
"""Stored length of the loop: 1.5 s, in which the machine begins to move."""
ARRAYS = {
    "observed": ArrayRule(("ticks", "channels"), is_finite=False),
    "levers": ArrayRule(("ticks", AXES)),
    "strokes": ArrayRule(("reference ticks", AXES)),
    "tip": ArrayRule(("reference ticks", AXES)),
}
MAP = {"map_levers": ArrayRule((AXES, len(SIDES), "points")), "map_speeds": ArrayRule((AXES, len(SIDES), "points"))}
"""Arrays of a valve map."""
Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class KeptController:
    """A controller as it ran.

    Attributes:
        experiment: its settings.
        plant: interface of the plant for the controller.
        models: valve map and twin.
        twin: the twin with its spec; None without one.
        observed: observations of the first ticks of the first loop, shape (ticks, channel).
        levers: outputs of the controller, shape (ticks, 3).
        strokes: strokes of the reference, m, shape (rows, 3).
        tip: tip poses of the reference, shape (rows, 3).
    """

    experiment: ControlExperiment
    plant: PlantInterface
    models: ControlModels
    twin: TwinBundle | None
    observed: Array
    levers: Array
    strokes: Array
    tip: Array


def keep_controller(
    run: Path, plant: PlantInterface, models: ControlModels, twin: Path | None, first: tuple[ControlTask, LoopResult]
) -> Path:
    """Write the folder ``controller`` of a run; the header comes last.

    Args:
        run: run folder.
        plant: plant of the loops.
        models: models of the controller.
        twin: run folder of its twin.
        first: task and result of the first loop.

    Raises:
        EdpError: the twin cannot be read, or the folder not be written.
    """
    folder, (task, result) = make_folder(run / KEPT), first
    ticks = min(GOLDEN_TICKS, result.recording.samples)
    recorded = result.recording.values[:ticks]
    names = [channel.name for channel in result.recording.channels]
    arrays = {
        "observed": recorded[:, : len(plant.channels)],
        "levers": recorded[:, [names.index(channel.name) for channel in LEVERS]],
        "strokes": task.reference.strokes,
        "tip": task.reference.tip,
    }
    if models.valve_map is not None:
        arrays |= {"map_levers": models.valve_map.levers, "map_speeds": models.valve_map.speeds}
    if twin is not None:
        # A controller plans in free air, and estimates what soil does.
        save_twin(replace(load_twin(twin), ground=None), folder / TWIN)
    machine = MACHINE_FILE.to_dict(plant.geometry.machine)
    write_bytes(folder / MACHINE, tomli_w.dumps(machine).encode())
    entry = write_arrays(folder, "arrays", save_arrays({k: np.ascontiguousarray(v) for k, v in arrays.items()}))
    header = {
        "schema": SCHEMA,
        "edp": __version__,
        "rate_hz": plant.rate_hz,
        "source": plant.source,
        "channels": [channel_to_dict(channel) for channel in plant.channels],
        "twin": twin is not None,
        "arrays": entry,
    }
    write_json(folder / HEADER, add_plugins(header))
    remove_old_arrays(folder, ("arrays",), (entry["file"],))
    return folder


def load_kept(run: str | Path) -> KeptController:
    """Load the controller of a run folder.

    Raises:
        StorageError: not a run of edp loop run, or one of an earlier version that kept no controller.
        BundleError: the stored controller is damaged.
        ConfigError: the settings or the machine cannot be.
    """
    path = Path(run)
    folder = path / KEPT
    if not is_file_at(folder / HEADER):
        raise StorageError(missing_text(path, "control", "a run of edp loop run, or is one of an earlier version"))
    with convert_damage(folder):
        header = sealed_header(folder / HEADER, "controller", (SCHEMA,), "run edp loop run again")
        channels = tuple(channel_from_dict(entry) for entry in header["channels"])
        arrays = load_arrays(read_arrays(folder, header["arrays"]))
        rules = ARRAYS | (MAP if {*MAP} & {*arrays} else {})
        arrays = checked_arrays(arrays, rules, "its arrays", {"channels": len(channels)})
        valve_map = _valve_map(arrays)
    machine = load_machine(str(folder / MACHINE))
    commands = tuple(TABLE_A1[name] for name in PILOTS)
    nominal = NominalMachine(machine)
    geometry = TipGeometry(machine)
    plant = PlantInterface(channels, float(header["rate_hz"]), geometry, commands, nominal.commands, "the plant")
    twin = load_twin(folder / TWIN) if header["twin"] is True else None
    experiment = load_control_experiment(path / "config.toml")
    models = ControlModels(valve_map, None if twin is None else twin.twin)
    golden = {name: arrays[name] for name in ARRAYS}
    return KeptController(experiment, plant, models, twin, **golden)


def _valve_map(arrays: Mapping[str, Array]) -> ValveMap | None:
    """Return the valve map of checked arrays, if present."""
    if "map_levers" not in arrays:
        return None
    levers, speeds = arrays["map_levers"], arrays["map_speeds"]
    if levers.shape[2] < 2 or not (np.diff(speeds, axis=2) >= 0.0).all():
        raise ValueError(f"its valve map has {levers.shape[2]} points; at least two of rising speeds must hold")
    return ValveMap(levers, speeds)
