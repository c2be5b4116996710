"""Content of a closed-loop run on its controller; the run alone is enough for an export.

The folder ``controller`` of a run holds the settings' machine as a file, the valve map, the twin, what the plant
measures, and a stretch of the first loop with which exported code is compared.
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
from edp.errors import BundleError, StorageError
from edp.settings.bounds import above
from edp.signals import TABLE_A1, Channel, Kind
from edp.sim.environment import NominalMachine
from edp.sim.machine.machine_checks import MACHINE_FILE
from edp.sim.machine.machine_files import load_machine
from edp.storage import make_folder, write_bytes, write_json
from edp.storage.headers import read_header
from edp.storage.paths import entries_of, is_file_at
from edp.storage.reading import Table
from edp.storage.runs import missing_text
from edp.training.bundle import add_plugins, check_hash, convert_damage, read_arrays, write_arrays
from edp.training.twin_bundle import TwinBundle, load_twin, save_twin

KEPT, HEADER, MACHINE, TWIN = "controller", "controller.json", "machine.toml", "twin"
SCHEMA = 1
GOLDEN_TICKS = 150
"""Of the loop that is kept: a second and a half, in which the machine begins to move."""
Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class KeptController:
    """A controller as it ran.

    Attributes:
        experiment: its settings.
        plant: what it saw of the plant.
        models: valve map and twin.
        twin: the twin with its spec; None without one.
        observed: observations of the first ticks of the first loop, shape (ticks, channel).
        levers: what it answered, shape (ticks, 3).
        strokes: of the reference, m, shape (rows, 3).
        tip: of the reference, shape (rows, 3).
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
        plant: that the loops were run on.
        models: that the controller knew.
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
    machine = MACHINE_FILE.plain(plant.geometry.machine)
    write_bytes(folder / MACHINE, tomli_w.dumps(machine).encode())
    header = {
        "schema": SCHEMA,
        "edp": __version__,
        "rate_hz": plant.rate_hz,
        "source": plant.source,
        "channels": [{"name": c.name, "kind": str(c.kind), "description": c.description} for c in plant.channels],
        "twin": twin is not None,
        "arrays": write_arrays(folder, "arrays", save_arrays({k: np.ascontiguousarray(v) for k, v in arrays.items()})),
    }
    write_json(folder / HEADER, add_plugins(header))
    for old in entries_of(folder, "arrays-*.safetensors"):
        if old.name != header["arrays"]["file"]:  # type: ignore[index]
            old.unlink(missing_ok=True)
    return folder


def load_kept(run: str | Path) -> KeptController:
    """Load the controller of a run folder.

    Raises:
        StorageError: not a run of edp control, or one of an earlier version that kept no controller.
        BundleError: what was kept is damaged.
        ConfigError: the settings or the machine cannot be.
    """
    path = Path(run)
    folder = path / KEPT
    if not is_file_at(folder / HEADER):
        raise StorageError(missing_text(path, "control", "a run of edp control, or is one of an earlier version"))
    with convert_damage(folder):
        header = read_header(folder / HEADER, ("schema",))
        if header["schema"] != SCHEMA:
            raise BundleError(
                f"controller '{folder}' has schema {str(header['schema'])[:40]}, this EDP ({__version__}) reads "
                f"{SCHEMA}; install a newer one, or run edp control again"
            )
        check_hash(header, folder / HEADER)
        channels = tuple(_channel(entry) for entry in header["channels"])
        arrays = load_arrays(read_arrays(folder, header["arrays"]))
        valve_map = _check_arrays(arrays, len(channels))
        rate = above(0.0, 1e6)
        if not rate.holds(header["rate_hz"]):
            raise ValueError(f"its rate_hz is {str(header['rate_hz'])[:40]}; {rate.rule('rate_hz')} must hold")
    machine = load_machine(str(folder / MACHINE))
    commands = tuple(TABLE_A1[name] for name in PILOTS)
    nominal = NominalMachine(machine)
    geometry = TipGeometry(machine)
    plant = PlantInterface(channels, float(header["rate_hz"]), geometry, commands, nominal.commands, "the plant")
    twin = load_twin(folder / TWIN) if header["twin"] is True else None
    experiment = load_control_experiment(path / "config.toml")
    models = ControlModels(valve_map, None if twin is None else twin.twin)
    golden = {name: arrays[name].astype(float) for name in ("observed", "levers", "strokes", "tip")}
    return KeptController(experiment, plant, models, twin, **golden)


def _channel(entry: Table) -> Channel:
    if not all(isinstance(entry[key], str) for key in ("name", "description")):
        raise TypeError("the name or description of a channel is no text")
    return Channel(entry["name"], Kind(entry["kind"]), entry["description"])


def _check_arrays(arrays: Mapping[str, Array], channels: int) -> ValveMap | None:
    """Return the valve map if present, after a check of shapes and values of all arrays."""
    ticks, rows = len(arrays["observed"]), len(arrays["strokes"])
    shapes = {"observed": (ticks, channels), "levers": (ticks, AXES), "strokes": (rows, AXES), "tip": (rows, AXES)}
    for name, shape in shapes.items():
        if arrays[name].shape != shape:
            raise ValueError(f"'{name}' has shape {arrays[name].shape}, {shape} must hold")
    for name in ("levers", "strokes", "tip"):
        if not np.isfinite(arrays[name]).all():
            raise ValueError(f"'{name}' holds a number that is not finite")
    if "map_levers" not in arrays:
        return None
    levers, speeds = arrays["map_levers"], arrays["map_speeds"]
    good = levers.shape == speeds.shape and levers.shape[:2] == (AXES, len(SIDES)) and levers.shape[2:] > (1,)
    if not good or not np.isfinite(levers).all() or not (np.diff(speeds, axis=2) >= 0.0).all():
        raise ValueError("its valve map is none: rising speeds (3, 2, points) and as many levers must hold")
    return ValveMap(levers.astype(float), speeds.astype(float))
