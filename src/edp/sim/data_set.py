"""Simulated data sets on disk: settings, disk space check, and resumable writing."""

from __future__ import annotations

import contextlib
import hashlib
import json
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from edp import __version__
from edp.errors import BusyError, ConfigError, EdpError, StorageError, closest
from edp.jobs import Workers
from edp.jobs.workers import UNITS, WorkUnit, forget_units
from edp.logs import LAYOUTS, WriteOptions, list_suffixes, read_recording, write_recording
from edp.progress import SILENT, Progress
from edp.signals import EXTRA_CHANNELS, GROUND_CHANNELS, MOTOR_CHANNELS, TABLE_A1
from edp.sim.excitation import EXCITATIONS
from edp.sim.limit_file import LimitFile
from edp.sim.plan import DataSetSpec, machine_hash, scenario_of_unit
from edp.sim.predictability import LimitSpec, find_limit
from edp.sim.scenario import Scenario, scenario_to_dict
from edp.sim.scenario_file import read_scenario_file, scenario_changes
from edp.sim.simulate import simulate
from edp.storage import (
    check_held,
    check_writable,
    hold,
    make_folder,
    read_json,
    release,
    remove_unfinished,
    write_json,
)
from edp.storage.ledger import TrainingIdentity
from edp.storage.paths import full_path, is_entry_at, is_folder_at, is_there
from edp.wording import typed

MANIFEST = "data_set.json"
LOCK = ".lock"
ONE_PER_CORE = Workers(count=0)
BYTES_PER_VALUE = {".parquet": 3.0, ".csv": 10.0, ".mat": 3.0}
"""Upper estimate of the bytes per logged value, by format. Measured on M22: 1.7, 8.0 and 2.1 bytes."""


@dataclass(frozen=True, kw_only=True)
class SimulationOrder(DataSetSpec):
    """A simulated data set and how it is written.

    Attributes:
        suffix: ending of the logs, which settles their format.
        layout: layout of MAT files, a name in `edp.logs.LAYOUTS`; empty for the plain one.
        truth: place of the channels that only a simulation provides, see `edp.logs.WriteOptions`. Empty means ``apart``
            for a requested layout, else ``with``.
    """

    suffix: str = ".parquet"
    layout: str = ""
    truth: str = ""

    @staticmethod
    def from_scenario(
        scenario: str | Path | None = None,
        note: Callable[[str], None] | None = None,
        overrides: Sequence[str] = (),
        **changes: object,
    ) -> SimulationOrder:
        """Return the data set of a scenario file, or the default one, with overrides and `changes` applied.

        Overrides have the form ``key.path=value`` with keys of the file. `changes` that are not None take precedence.

        Settings of the file that a change makes invalid are removed, and `note` is called with a message: the layout of
        MAT files if another format is requested, a family if a machine is requested.

        Raises:
            ConfigError: a key or value that cannot be; file, key, value and bound are named.
        """
        values: dict[str, Any] = {}
        if scenario is not None:
            values = read_scenario_file(scenario)
        stated_changes = scenario_changes(overrides) | {
            key: value for key, value in changes.items() if value is not None
        }
        if stated_changes.get("family") and "machine" in stated_changes:
            raise ConfigError(
                f"machine = {stated_changes['machine']} and family = {stated_changes['family']}: a family takes "
                "the machine's place; "
                "give one of the two"
            )
        for text in _leave_out(values, stated_changes):
            if note is not None:
                note(f"{text}; the scenario file's is left out")
        values |= stated_changes
        try:
            order = SimulationOrder(**values)
            order.files()
        except EdpError as error:
            raise ConfigError(str(error) if scenario is None else f"scenario file {scenario}: {error}") from error
        return order

    def files(self) -> WriteOptions:
        """Return the write options of the logs.

        Raises:
            EdpError: an ending without a format, an unknown layout, or one of another format.
        """
        if self.suffix not in list_suffixes():
            hint = closest(self.suffix, list_suffixes())
            raise ConfigError(f"there is no log format for the ending '{self.suffix}'{hint}")
        if self.layout:
            LAYOUTS[self.layout]
            if self.suffix != ".mat":
                raise ConfigError(f"layout '{self.layout}' is one of MAT files, not of '{self.suffix}'; ask for mat")
        truth = self.truth or ("apart" if self.layout else "with")
        return WriteOptions(mat_layout=self.layout or WriteOptions.mat_layout, truth=truth)


def _leave_out(values: dict[str, object], changes: Mapping[str, object]) -> Iterator[str]:
    """Remove values of a file that the given ones make invalid; yields a message for each."""
    suffix = str(changes.get("suffix", ".mat"))
    if suffix != ".mat" and values.get("layout") and "layout" not in changes:
        yield f"layout '{values.pop('layout')}' is one of MAT files, and format {suffix[1:]} was asked for"
    if "machine" in changes and values.get("family"):
        yield f"family of {values.pop('family')} machines, and machine {changes['machine']} was asked for"
    if not changes.get("family", values.get("family", 0)):
        values.pop("masses", None)
        values.pop("scatter", None)


def simulate_data_set(
    out: str | Path,
    order: SimulationOrder | None = None,
    workers: Workers = ONE_PER_CORE,
    on_done: Callable[[Scenario, bool], None] | None = None,
) -> list[Path]:
    """Simulate a data set into a folder, one log per recording. Existing logs of the same order are reused.

    Logs do not depend on the worker, because each scenario has its own seed.

    Args:
        out: folder; it must be empty or contain an earlier part of the same data set.
        order: data set to simulate; by default one hour of machine M22.
        workers: who simulates; nodes see the folder under the same path.
        on_done: called with the scenario of each log and whether the log was there already.

    Raises:
        BusyError: another process simulates into the folder.
        StorageError: the folder holds another data set, cannot be written, its disk has not room enough, or nodes do
            not see it.
        ConfigError: an ending without a format, or a number out of range.
    """
    order = order or SimulationOrder()
    suffix, files = order.suffix, order.files()
    plan = order.scenarios()
    folder = make_folder(out)
    identity = identity_of(plan, files, suffix)
    paths = [folder / f"{scenario.name}{suffix}" for scenario in plan]
    with _alone(folder) as check:
        bound = _bound(folder, identity)
        missing = [scenario for scenario, path in zip(plan, paths, strict=True) if not is_there(path)]
        # Check before the manifest is written, so that a rejected data set does not bind the folder.
        check_room(folder, missing, suffix)
        if not bound:
            write_json(folder / MANIFEST, identity)
        absent = {scenario.name for scenario in missing}
        for scenario, path in zip(plan, paths, strict=True):
            if on_done is not None and scenario.name not in absent:
                # Read, so that a damaged log is reported; the coordinator of a cluster stays light.
                if not workers.cluster:
                    read_recording(path)
                on_done(scenario, True)
        for index, _ in workers.map([_unit(scenario, folder, order) for scenario in missing]):
            scenario = missing[index]
            if not is_there(folder / f"{scenario.name}{suffix}"):
                raise StorageError(
                    f"'{scenario.name}' was written on another node, and is not in '{full_path(folder)}' here; give a "
                    "folder that all nodes see under the same path"
                )
            if on_done is not None:
                on_done(scenario, False)
            # Before the next log: a lock that was taken over means that another process writes here.
            check()
    return paths


def _unit(scenario: Scenario, folder: Path, order: SimulationOrder) -> WorkUnit:
    arguments = {"scenario": scenario_to_dict(scenario), "suffix": order.suffix, "files": asdict(order.files())}
    where = {"folder": str(full_path(folder))}
    label = f"recording '{scenario.name}'"
    return WorkUnit(f"{__name__}:write_log", label, arguments, machine_hash(scenario), where)


def write_log(identity: TrainingIdentity, where: Mapping[str, str]) -> dict[str, str]:
    """Simulate a recording and write its log, unless the log is there: the folder is bound to one order."""
    scenario = scenario_of_unit(identity.config["scenario"], identity.data)
    folder = Path(where["folder"])
    if not is_folder_at(folder):
        raise StorageError(f"'{folder}' is not on this node; give a folder that all nodes see under the same path")
    path = folder / f"{scenario.name}{identity.config['suffix']}"
    if not is_there(path):
        write_recording(simulate(scenario), path, WriteOptions(**identity.config["files"]))
    return {"name": scenario.name}


def _bound(folder: Path, identity: Mapping[str, object]) -> bool:
    """Return whether a folder belongs to this order; False for an unmarked folder."""
    manifest = folder / MANIFEST
    if not is_entry_at(manifest):
        return False
    if read_json(manifest) != identity:
        raise StorageError(f"'{folder}' holds another simulated data set; nothing was changed: choose another folder")
    return True


@contextlib.contextmanager
def _alone(folder: Path) -> Iterator[Callable[[], None]]:
    """Hold a folder of logs; yields what sees that it is still held. Nothing of it stays.

    Raises:
        BusyError: another process simulates into it.
    """
    file = folder / LOCK
    try:
        lock = hold(file)
    except BusyError as error:
        holder = str(error).rpartition("process ")[2]
        raise BusyError(f"process {holder} simulates into '{folder}'; wait for it, or choose another folder") from None
    try:
        remove_unfinished(folder)
        yield lambda: check_held(file, lock)
    finally:
        release(file, lock)


def find_data_set_limit(
    folder: str | Path,
    order: SimulationOrder,
    spec: LimitSpec | None = None,
    workers: Workers = ONE_PER_CORE,
    progress: Progress = SILENT,
) -> LimitFile:
    """Estimate the predictability limit of a simulated data set, and write it to ``limit.json`` next to its logs.

    An existing limit of the same data set and settings is reused.

    Args:
        folder: the folder of the data set.
        order: data set that was simulated.
        spec: moments, branches and horizons.
        workers: who simulates; recordings that are done are not done again after a stop.
        progress: receiver of the progress; its units are recordings.

    Raises:
        ConfigError: the recordings are too short.
        StorageError: the folder cannot be written.
    """
    spec = spec or LimitSpec()
    plan = order.scenarios()
    identity = json.dumps([identity_of(plan, WriteOptions()), asdict(spec)], sort_keys=True)
    key = hashlib.blake2b(identity.encode(), digest_size=12).hexdigest()
    top = make_folder(folder)
    if is_entry_at(top / LimitFile.NAME):
        stored_limit = LimitFile.read(top)
        if stored_limit.key == key:
            return stored_limit
    check_writable(top)
    units = top / UNITS
    limit = replace(find_limit(plan, spec, workers, progress, units), key=key)
    limit.write(top)
    forget_units(units)
    return limit


def identity_of(plan: Sequence[Scenario], files: WriteOptions, suffix: str = ".parquet") -> dict[str, object]:
    """Return the identity of a simulated data set in JSON types."""
    identity: dict[str, object] = {"schema": 1, "edp": __version__, "plan": [scenario_to_dict(entry) for entry in plan]}
    # Include only values that differ from the defaults, so that existing folders keep their identity.
    if files != WriteOptions():
        identity["files"] = asdict(files)
    if suffix != ".parquet":
        identity["suffix"] = suffix
    return dict(json.loads(json.dumps(identity)))


def bytes_needed(plan: Sequence[Scenario], suffix: str) -> int:
    """Return the disk space in bytes that the logs of a plan need, rounded up."""
    usual = len(TABLE_A1) + len(EXTRA_CHANNELS)
    values = sum(s.samples * (usual + _further_channels(s)) for s in plan)
    return int(values * BYTES_PER_VALUE.get(suffix, max(BYTES_PER_VALUE.values())))


def _further_channels(scenario: Scenario) -> int:
    ground = len(GROUND_CHANNELS) if scenario.material else 0
    motors = len(MOTOR_CHANNELS) if EXCITATIONS[scenario.excitation].swings else 0
    return ground + motors + len(scenario.faults)


def check_room(folder: Path, plan: Sequence[Scenario], suffix: str) -> None:
    """Refuse a plan whose logs would not fit on the disk of `folder`.

    Raises:
        StorageError: not room enough.
    """
    needed, free = bytes_needed(plan, suffix), shutil.disk_usage(folder).free
    if needed > free:
        minutes = sum(s.duration_s for s in plan) / 60.0
        raise StorageError(
            f"minutes: {typed(minutes)} min as {suffix} need about {needed / 1e9:,.1f} GB, but the disk of "
            f"'{folder}' has "
            f"{free / 1e9:,.1f} GB free; simulate at most {minutes * free / needed:,.0f} min, or choose another folder"
        )
