"""Simulated data sets on disk: settings, disk space check, and resumable writing."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

from edp import __version__
from edp.errors import BusyError, ConfigError, EdpError, StorageError, closest
from edp.logs import LAYOUTS, WriteOptions, known_suffixes, read_recording, write_recording
from edp.signals import EXTRA_CHANNELS, GROUND_CHANNELS, MOTOR_CHANNELS, TABLE_A1
from edp.sim.excitation import EXCITATIONS
from edp.sim.plan import DataSetSpec, simulate_many
from edp.sim.predictability import LimitJob, LimitSpec, find_limit, plan_limit
from edp.sim.scenario import Scenario, plain
from edp.sim.scenario_file import read_scenario_file, scenario_changes
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
from edp.storage.paths import is_entry_at, is_there
from edp.wording import typed

MANIFEST = "data_set.json"
LIMIT = "limit.json"
LOCK = ".lock"
BYTES_PER_VALUE = {".parquet": 3.0, ".csv": 10.0, ".mat": 3.0}
"""Room a logged value takes, rounded up; measured on M22: 1.7, 8.0 and 2.1."""


@dataclass(frozen=True, kw_only=True)
class SimulationOrder(DataSetSpec):
    """A simulated data set and how it is written.

    Attributes:
        suffix: ending of the logs, which settles their format.
        layout: layout of MAT files, a name in `edp.logs.LAYOUTS`; empty for the plain one.
        truth: where the channels go that only a simulation knows, see `edp.logs.WriteOptions`; empty for ``apart``
            in a layout that was asked for, else ``with`` the others.
    """

    suffix: str = ".parquet"
    layout: str = ""
    truth: str = ""

    @staticmethod
    def of(
        scenario: str | Path | None = None,
        note: Callable[[str], None] | None = None,
        overrides: Sequence[str] = (),
        **changes: Any,
    ) -> SimulationOrder:
        """Create the order of a scenario file, or the default one; overrides and `changes` replace its values.

        Overrides are ``key.path=value`` in the keys of the file; `changes` that are not None go before them.

        What a change makes void in the file goes with it, and `note` is called with a sentence that says so: a layout
        of MAT files once another format is asked for, a family once a machine is.

        Raises:
            ConfigError: a key or value that cannot be; file, key, value and bound are named.
        """
        values: dict[str, Any] = {}
        if scenario is not None:
            values = _flat(*read_scenario_file(scenario))
        stated_changes = _flat(*scenario_changes(overrides))
        stated_changes |= {key: value for key, value in changes.items() if value is not None}
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
        if self.suffix not in known_suffixes():
            hint = closest(self.suffix, known_suffixes())
            raise ConfigError(f"there is no log format for the ending '{self.suffix}'{hint}")
        if self.layout:
            LAYOUTS[self.layout]
            if self.suffix != ".mat":
                raise ConfigError(f"layout '{self.layout}' is one of MAT files, not of '{self.suffix}'; ask for mat")
        truth = self.truth or ("apart" if self.layout else "with")
        return WriteOptions(mat_layout=self.layout or WriteOptions.mat_layout, truth=truth)


def _flat(values: dict[str, Any], files: dict[str, str]) -> dict[str, Any]:
    """Values of a data set and of how it is written, by the attributes of an order."""
    suffix = {"suffix": suffix_of(files["format"])} if "format" in files else {}
    return values | {key: value for key, value in files.items() if key != "format"} | suffix


def _leave_out(values: dict[str, Any], changes: dict[str, Any]) -> Iterator[str]:
    """Remove values of a file that the given ones make invalid; yields a message for each."""
    suffix = changes.get("suffix", ".mat")
    if suffix != ".mat" and values.get("layout") and "layout" not in changes:
        yield f"layout '{values.pop('layout')}' is one of MAT files, and format {suffix[1:]} was asked for"
    if "machine" in changes and values.get("family"):
        yield f"family of {values.pop('family')} machines, and machine {changes['machine']} was asked for"
    if not changes.get("family", values.get("family", 0)):
        values.pop("masses", None)
        values.pop("scatter", None)


def suffix_of(form: str) -> str:
    """``parquet`` or ``.parquet`` to ``.parquet``."""
    return f".{form.lstrip('.')}"


class Simulated(Protocol):
    """Description of a finished recording, or of the scenario of a skipped one."""

    @property
    def name(self) -> str:
        """Its name."""
        ...

    @property
    def duration_s(self) -> float:
        """Its length."""
        ...


Elsewhere = Callable[[Sequence[Scenario], Path, Callable[[Simulated], None]], None]
"""Writes the logs of scenarios into a folder and tells of each that is there."""


def simulate_data_set(
    out: str | Path,
    order: SimulationOrder | None = None,
    workers: int = 0,
    on_done: Callable[[Simulated, bool], None] | None = None,
    elsewhere: Elsewhere | None = None,
) -> list[Path]:
    """Simulate a data set into a folder, one log per recording. Existing logs of the same order are kept.

    Args:
        out: folder; it may hold nothing but an earlier part of the same data set.
        order: what to simulate; an hour of machine M22 by default.
        workers: processes; 0 for one a core.
        on_done: called with each recording and whether it was there already.
        elsewhere: writes the logs that are missing, in place of processes of this machine.

    Raises:
        BusyError: another process simulates into the folder.
        StorageError: the folder holds another data set, cannot be written, or its disk has not room enough.
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
        # Before the manifest: a refused order leaves the folder unbound.
        check_room(folder, missing, suffix)
        if not bound:
            write_json(folder / MANIFEST, identity)
        absent = {scenario.name for scenario in missing}
        for scenario in plan:
            if on_done is not None and scenario.name not in absent:
                # Read, so that a damaged one is told; a coordinator of others' work stays light.
                on_done(
                    scenario if elsewhere is not None else read_recording(folder / f"{scenario.name}{suffix}"), True
                )

        def wrote(simulated: Simulated) -> None:
            check()
            if on_done is not None:
                on_done(simulated, False)

        if elsewhere is not None:
            elsewhere(missing, folder, wrote)
            return paths
        count = workers or os.cpu_count() or 1
        for recording in simulate_many(missing, min(count, max(1, len(missing)))):
            # Before each log: a lock that was taken over means that another process writes here.
            check()
            write_recording(recording, folder / f"{recording.name}{suffix}", files)
            wrote(recording)
    return paths


def _bound(folder: Path, identity: dict[str, Any]) -> bool:
    """Return whether a folder belongs to this order; False if it belongs to none."""
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
    workers: int = 0,
    on_done: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Estimate the predictability limit of a simulated data set, and write it to ``limit.json`` next to its logs.

    A limit that is there already from the same order and settings is kept.

    Args:
        folder: the folder of the data set.
        order: what was simulated into it.
        spec: moments, branches and horizons.
        workers: processes; 0 for one a core.
        on_done: called with how many recordings are done, and of how many.

    Raises:
        ConfigError: the recordings are too short.
        StorageError: the folder cannot be written.
    """
    spec = spec or LimitSpec()
    plan = order.scenarios()
    key = _digest([identity_of(plan, WriteOptions()), asdict(spec)])
    target = make_folder(folder) / LIMIT
    if is_entry_at(target):
        stored_limit = read_json(target)
        if isinstance(stored_limit, dict) and stored_limit.get("key") == key:
            return stored_limit
    check_writable(target.parent)
    jobs, done = len(plan_limit(plan, spec)), 0

    def count(job: LimitJob) -> None:
        nonlocal done
        done += 1
        if on_done is not None:
            on_done(done, jobs)

    limit = find_limit(plan, spec, min(workers or os.cpu_count() or 1, jobs), count) | {"key": key}
    write_json(target, limit)
    return limit


def _digest(value: Any) -> str:
    return hashlib.blake2b(json.dumps(value, sort_keys=True).encode(), digest_size=12).hexdigest()


def identity_of(plan: Sequence[Scenario], files: WriteOptions, suffix: str = ".parquet") -> dict[str, Any]:
    """Return the identity of a simulated data set in JSON types."""
    identity: dict[str, Any] = {"schema": 1, "edp": __version__, "plan": [plain(entry) for entry in plan]}
    # Only what departs from the usual: folders without these options keep their identity.
    if files != WriteOptions():
        identity["files"] = asdict(files)
    if suffix != ".parquet":
        identity["suffix"] = suffix
    plain_identity: dict[str, Any] = json.loads(json.dumps(identity))
    return plain_identity


def bytes_needed(plan: Sequence[Scenario], suffix: str) -> int:
    """Room that the logs of a plan take, rounded up."""
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
