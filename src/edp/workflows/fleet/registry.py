"""Registry of networks on disk: bundles and fleets of deltas with their lineage: data, base, evaluation.

A folder with ``entries/ID.json`` and ``files/ID``; an identifier is the content address of what it is of. Nothing in it
is ever overwritten: the same network enters once, and another one has another identifier.
"""

from __future__ import annotations

import hashlib
import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from edp import __version__
from edp.errors import ConfigError, EdpError, StorageError, closest
from edp.evaluation.fleet_file import FleetFile
from edp.evaluation.scores_file import MEAN, ScoresFile, metric
from edp.networks.predictor import describe
from edp.settings.provenance import DataPart, Provenance, read_provenance
from edp.settings.results import ResultFile
from edp.storage import (
    check_writable,
    hold,
    make_folder,
    read_bytes,
    release,
    write_bytes,
    write_json,
)
from edp.storage.folders import check_kind
from edp.storage.paths import entries_of, is_file_at, is_folder_at
from edp.training import Bundle, load_bundle, save_bundle
from edp.training.bundle import weights_digest
from edp.training.delta import MOST_BYTES, read_delta
from edp.workflows.fleet.personal import read_fleet

ENTRIES, FILES, LOCK = "entries", "files", ".lock"
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
IDENTIFIER = re.compile(r"[0-9a-f]{32}")
PART = re.compile(r"\[\d+:\d+\]$")
"""Ticks of a recording behind its name, where a part holds some of it."""
SCORES = "scores.json"


@dataclass(frozen=True, kw_only=True)
class RegistryEntry(ResultFile):
    """A network, or the deltas of a fleet, in a registry.

    Attributes:
        id: content address of the weights, or of all deltas.
        kind: ``network`` or ``fleet``.
        name: name from the user. Of several entries with one name the latest is used.
        label: description in words.
        base: identifier of the network that it was trained on from; empty for one that began at random.
        data: origin, hash, number and hours of its recordings; for a fleet also its machines.
        judge: errors of the network and of the best baseline by horizon, how they were evaluated and on what; empty
            where nobody evaluated it.
        added: time of entry.
        edp: version that entered it.

    Raises:
        ConfigError: an identifier that is none.
    """

    NAME = "entries/ID.json"
    SCHEMA = 1
    WHAT = "entry"
    ADVICE = "restore it from a copy of the registry"

    id: str
    kind: Literal["network", "fleet"]
    name: str
    label: str
    base: str
    data: Mapping[str, object]
    judge: Mapping[str, object]
    added: str
    edp: str

    def __post_init__(self) -> None:
        # A base names the next file that is read; a path in its place would lead out of the registry.
        for name in (self.id, *filter(None, [self.base])):
            if not IDENTIFIER.fullmatch(name):
                raise ConfigError(f"entry: '{name[:40]}' is no identifier")


def add_to_registry(registry: str | Path, source: str | Path, name: str) -> RegistryEntry:
    """Enter a run, a bundle, or the folder of `edp train finetune --fleet`.

    Args:
        registry: folder; made where absent.
        source: path of the entry, whose files are copied.
        name: letters, digits, dots, dashes and underscores.

    Returns:
        The entry; the earlier one, under its earlier name, where the same network is there already.

    Raises:
        ConfigError: a name that is none.
        EdpError: a source that is no network and no fleet, or a registry that cannot be written.
    """
    if not NAME.fullmatch(name):
        raise ConfigError(f"'{name}' is no name of an entry; give up to 64 letters, digits, dots, dashes, underscores")
    folder = Path(source)
    check_kind(registry, "registry", what="edp registry add")
    top = check_writable(registry)
    lock = hold(top / LOCK)
    try:
        if is_file_at(folder / FleetFile.NAME):
            return _add_fleet(top, folder, name)
        return _add_network(top, folder, name)
    finally:
        release(top / LOCK, lock)


def _add_network(top: Path, folder: Path, name: str) -> RegistryEntry:
    bundle = load_bundle(folder)
    digest = weights_digest(bundle.predictor)
    if _is_there(top, digest):
        return read_entry(top, digest)
    entry = RegistryEntry(
        id=digest,
        kind="network",
        name=name,
        label=describe(bundle.predictor.spec),
        base=_base_of(bundle.provenance),
        data=_data_of(bundle.provenance),
        judge=_judge_of(folder, bundle),
        added=time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        edp=__version__,
    )
    save_bundle(bundle, make_folder(top / FILES) / digest)
    return _write_entry(top, entry)


def _add_fleet(top: Path, folder: Path, name: str) -> RegistryEntry:
    content = read_fleet(folder)
    names = [row.delta for row in content.machines if row.delta is not None]
    files = {name: read_bytes(folder / name, MOST_BYTES) for name in names}
    for file in files:
        if read_delta(folder / file).base != content.base:
            raise StorageError(f"'{folder / file}' is a delta of another network than '{folder / FleetFile.NAME}' says")
    state = hashlib.blake2b(digest_size=16)
    for file in sorted(files):
        state.update(f"{file}\0".encode() + files[file])
    digest = state.hexdigest()
    if _is_there(top, digest):
        return read_entry(top, digest)
    errors = list(content.errors.values())
    judge = {} if not errors else {
        "judged": "ends of the machines' recordings, which did not train",
        "unit": content.unit,
        "horizon": content.horizon,
        **{part: sum(getattr(one, part) for one in errors) / len(errors) for part in ("before", "full", "delta")},
    }  # fmt: skip
    entry = RegistryEntry(
        id=digest,
        kind="fleet",
        name=name,
        label=f"{len(files)} deltas, {sum(map(len, files.values())) / 1024:,.0f} kB, method {content.method}",
        base=content.base,
        data={"source": content.store, "machines": [row.machine for row in content.machines]},
        judge=judge,
        added=time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        edp=__version__,
    )
    target = make_folder(top / FILES / digest)
    for file, data in files.items():
        make_folder((target / file).parent)
        write_bytes(target / file, data)
    content.write(target)
    return _write_entry(top, entry)


def _is_there(top: Path, digest: str) -> bool:
    return is_file_at(top / ENTRIES / f"{digest}.json")


def _write_entry(top: Path, entry: RegistryEntry) -> RegistryEntry:
    """Write an entry after all its files."""
    write_json(make_folder(top / ENTRIES) / f"{entry.id}.json", entry.to_table())
    return entry


def _base_of(provenance: Provenance) -> str:
    """Return the content address of the initial weights of a training."""
    strategy = provenance.more.get("strategy")
    if not isinstance(strategy, Mapping):
        return ""
    source = strategy.get("source")
    weights = source.get("weights") if isinstance(source, Mapping) else strategy.get("start")
    return str(weights or "")


def _data_of(provenance: Provenance) -> dict[str, object]:
    data = provenance.data
    if data is None:
        return {}
    parts = [part for part in (data.train, data.validation, data.test) if part is not None]
    return {
        "source": data.source or "",
        "digest": data.digest or "",
        "recordings": _recordings(parts),
        "hours": round(sum(part.hours for part in parts), 4),
    }


def _recordings(parts: Sequence[DataPart]) -> int:
    """Count the recordings in these parts; one that is cut by time is in several parts."""
    names = {PART.sub("", name) for part in parts for name in part.names}
    return len(names) or sum(part.recordings for part in parts)


def _judge_of(folder: Path, bundle: Bundle) -> dict[str, object]:
    """Return the errors of the run's own test part and the best baseline's, from ``scores.json``."""
    file = folder / SCORES
    if not is_file_at(file):
        return {}
    scores = ScoresFile.from_file(file)
    errors = {
        name: {horizon: metric(entry[MEAN], "mae") for horizon, entry in model.overall.items()}
        for name, model in scores.models.items()
    }
    best = {}
    for horizon in errors.get("network", {}):
        others = {name: by[horizon] for name, by in errors.items() if name != "network" and horizon in by}
        best[horizon] = min(others.items(), key=lambda pair: pair[1]) if others else None
    provenance = read_provenance(folder) if is_file_at(folder / "provenance.json") else Provenance()
    test = provenance.origin.test
    return {
        "judged": "test recordings of the run",
        "recordings": test and test.recordings,
        "hours": test and test.hours,
        "skip": scores.task.skip,
        "unit": sorted({target.unit for target in scores.targets}),
        "mae": errors.get("network", {}),
        "best_baseline": {horizon: None if pair is None else list(pair) for horizon, pair in best.items()},
        "key": scores.key or "",
    }


def list_registry(registry: str | Path) -> tuple[list[RegistryEntry], list[str]]:
    """Return the entries, oldest first, and the faults of damaged ones.

    Raises:
        ConfigError: no registry.
    """
    top = Path(registry)
    if not is_folder_at(top / ENTRIES):
        raise ConfigError(f"'{registry}' is no registry; `edp registry add {registry} RUN --name NAME` makes one")
    entries, damaged = [], []
    for file in entries_of(top / ENTRIES, "*.json"):
        try:
            entries.append(read_entry(top, file.stem))
        except EdpError as error:
            damaged.append(str(error))
    return sorted(entries, key=lambda entry: (entry.added, entry.id)), damaged


def read_entry(registry: str | Path, digest: str) -> RegistryEntry:
    """Return an entry by its identifier.

    Raises:
        StorageError: missing or damaged.
    """
    if not IDENTIFIER.fullmatch(digest):
        raise StorageError(f"'{digest[:40]}' is no identifier of an entry in '{registry}'")
    file = Path(registry, ENTRIES, f"{digest}.json")
    entry = RegistryEntry.from_file(file)
    if entry.id != digest:
        raise StorageError(f"'{file}' is damaged: it is no entry of '{digest}'; {RegistryEntry.ADVICE}")
    return entry


def find_entry(registry: str | Path, asked: str) -> RegistryEntry:
    """Find an entry by its name, the latest of several, or by the start of its identifier.

    Raises:
        ConfigError: no entry has the name, or several identifiers begin with the text.
    """
    entries, _ = list_registry(registry)
    named = [entry for entry in entries if entry.name == asked]
    if named:
        return named[-1]
    begun = [entry for entry in entries if len(asked) >= 4 and entry.id.startswith(asked)]
    if len(begun) == 1:
        return begun[0]
    if begun:
        raise ConfigError(f"'{asked}' begins {len(begun)} identifiers; give more of it")
    raise ConfigError(f"'{registry}' has no entry '{asked}'{closest(asked, {entry.name for entry in entries})}")


def lineage(registry: str | Path, entry: RegistryEntry) -> list[RegistryEntry | str]:
    """Return the ancestors of an entry: its base, the base of its base, ...; the identifier of an unknown ancestor."""
    steps: list[RegistryEntry | str] = []
    seen = {entry.id}
    while entry.base:
        if entry.base in seen or not _is_there(Path(registry), entry.base):
            steps.append(entry.base)
            break
        entry = read_entry(registry, entry.base)
        seen.add(entry.id)
        steps.append(entry)
    return steps


def check_entry(registry: str | Path, entry: RegistryEntry) -> None:
    """Hold the files of an entry to its identifier.

    Raises:
        EdpError: they are missing, damaged, or others.
    """
    folder = Path(registry, FILES, entry.id)
    if entry.kind == "network":
        if weights_digest(load_bundle(folder).predictor) != entry.id:
            raise StorageError(f"'{folder}' holds another network than its entry; restore it")
        return
    state = hashlib.blake2b(digest_size=16)
    for file in entries_of(folder / "deltas", "*.delta"):
        state.update(f"deltas/{file.name}\0".encode() + read_bytes(file, MOST_BYTES))
    if state.hexdigest() != entry.id:
        raise StorageError(f"'{folder}' holds other deltas than its entry; restore it")
