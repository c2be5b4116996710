"""Monitors on disk as JSON and safetensors, like network bundles; loading does not execute code."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import load as load_arrays
from safetensors.numpy import save as save_arrays

from edp import __version__
from edp.errors import BundleError
from edp.monitor.calibration import AlarmLimit
from edp.monitor.chain import MonitorChain
from edp.monitor.diagnosis.signatures import load_dictionary, remove_dictionary, save_dictionary
from edp.monitor.monitor import Monitor
from edp.monitor.residuals.base import RESIDUALS, ResidualSource, SourceParts
from edp.storage import make_folder, object_with, write_json
from edp.storage.arrays import ArrayRule, arrays_under, checked_arrays
from edp.storage.headers import read_header
from edp.storage.paths import entries_of, is_entry_at, is_folder_at, is_link_at, is_there
from edp.storage.reading import Table
from edp.storage.seals import HASH
from edp.training.bundle import HEADER as BUNDLE_HEADER
from edp.training.bundle import (
    Bundle,
    add_plugins,
    channel_from_dict,
    channel_to_dict,
    checked_text,
    convert_damage,
    load_bundle,
    read_arrays,
    remove_old_arrays,
    save_bundle,
    sealed_header,
    write_arrays,
)
from edp.training.twin_bundle import HEADER as TWIN_HEADER
from edp.training.twin_bundle import TwinBundle, load_twin, save_twin

SCHEMA = 1
HEADER = "monitor.json"
NETWORKS = "networks"
"""Folder of the models for residuals. Each is a bundle or a twin."""
_FOLDER = re.compile(r"[a-z0-9]{1,32}-[a-z0-9]{1,32}")
MOST_CHANNELS, MAX_SOURCES, MAX_NETWORKS = 2_000, 64, 256
ARRAYS = {
    "session_means": ArrayRule((2, "channels")),
    "scatter": ArrayRule(("summaries",), low=0.0),
}
"""Array rules of the monitor file, in addition to the arrays of the chain (``chain.``) and of the sources
(``source.0.``, ...).
"""
LIMIT = ("limit", "alarms", "hours", "promised_hours", "low_hours", "high_hours")


def save_monitor(monitor: Monitor, folder: str | Path) -> Path:
    """Write a monitor; the header is renamed into place last, so a reader sees the old monitor or the new one.

    Raises:
        StorageError: the folder cannot be written.
    """
    path = make_folder(folder)
    arrays: Table = {f"chain.{name}": values for name, values in monitor.chain.arrays().items()}
    arrays["session_means"] = monitor.session_means
    if monitor.scatter is not None:
        arrays["scatter"] = monitor.scatter
    sources, written = [], set()
    for index, source in enumerate(monitor.sources):
        parts = source.parts()
        arrays |= {f"source.{index}.{name}": values for name, values in parts.arrays.items()}
        networks = {name: write_network(path, bundle) for name, bundle in parts.bundles.items()}
        written |= {entry["folder"] for entry in networks.values()}
        sources.append({"kind": kind_of(source), "plain": dict(parts.plain), "networks": networks})
    entry = write_arrays(path, "monitor", save_arrays({k: np.ascontiguousarray(v) for k, v in arrays.items()}))
    facts = asdict(monitor.limit)
    # JSON has no infinity; null says that no false alarm was counted.
    facts["high_hours"] = None if np.isinf(facts["high_hours"]) else facts["high_hours"]
    header = {
        "schema": SCHEMA,
        "edp": __version__,
        "rate_hz": monitor.rate_hz,
        "channels": [channel_to_dict(channel) for channel in monitor.channels],
        "sources": sources,
        "chain": monitor.chain.to_dict(),
        "limit": facts,
        "arrays": entry,
        "provenance": dict(monitor.provenance),
    }
    if monitor.diagnosis is None:
        remove_dictionary(path)
    else:
        save_dictionary(monitor.diagnosis, path)
    write_json(path / HEADER, add_plugins(header))
    _remove_old(path, entry["file"], written)
    return path


def kind_of(source: ResidualSource) -> str:
    """Return the name of a source in the registry of residuals."""
    return next(name for name, spec in RESIDUALS.items() if spec.source is type(source))


def write_network(path: Path, bundle: Bundle | TwinBundle) -> dict[str, str]:
    """Write a network into a folder that its own header names, and return the entry that finds it."""
    kind = "twin" if isinstance(bundle, TwinBundle) else "bundle"
    # Several processes may write networks of one monitor.
    draft = make_folder(path / NETWORKS / f"{kind}-draft{os.getpid()}")
    shutil.rmtree(draft)
    if isinstance(bundle, TwinBundle):
        save_twin(bundle, draft)
    else:
        save_bundle(bundle, draft)
    digest = str(read_header(draft / (TWIN_HEADER if kind == "twin" else BUNDLE_HEADER))[HASH])
    folder = f"{kind}-{digest}"
    if is_there(path / NETWORKS / folder):
        # Equal content has an equal name: what is there is this network.
        shutil.rmtree(draft)
    else:
        draft.rename(path / NETWORKS / folder)
    return {"folder": folder, HASH: digest}


def _remove_old(path: Path, arrays: str, networks: set[str]) -> None:
    """Remove the files of an earlier monitor. A kill before that leaves extra files but a valid monitor."""
    remove_old_arrays(path, ("monitor",), (arrays,))
    for folder in entries_of(path / NETWORKS, "*"):
        if folder.name not in networks and _FOLDER.fullmatch(folder.name) and not is_link_at(folder):
            shutil.rmtree(folder, ignore_errors=True)


def load_monitor(folder: str | Path) -> Monitor:
    """Read a monitor; schema, hashes, shapes and ranges are checked before it is built.

    Raises:
        BundleError: not a monitor, another schema, damaged numbers, or parts that this version does not know.
        StorageError: its dictionary is damaged, or of another monitor.
    """
    path = Path(folder)
    if not is_entry_at(path / HEADER):
        raise BundleError(f"'{path}' is not a monitor: it has no {HEADER}; give the folder that edp monitor fit wrote")
    with convert_damage(path):
        header = sealed_header(path / HEADER, "monitor", (SCHEMA,), "fit it again")
        monitor = _assembled(header, path)
    return replace(monitor, diagnosis=load_dictionary(path, monitor.summary_names))


def _assembled(header: Table, path: Path) -> Monitor:
    entries = header["channels"]
    if not isinstance(entries, list) or not 1 <= len(entries) <= MOST_CHANNELS:
        raise ValueError(f"it has no list of 1 to {MOST_CHANNELS:,} channels")
    channels = tuple(channel_from_dict(entry) for entry in entries)
    names = [channel.name for channel in channels]
    if len(set(names)) < len(names):
        raise ValueError("a channel stands twice")
    arrays = load_arrays(read_arrays(path, header["arrays"]))
    sources = _sources(header["sources"], arrays, path)
    chain = MonitorChain.from_dict(object_with(header["chain"], (), "its chain"), arrays_under(arrays, "chain."))
    _check_fit(sources, chain, names)
    own = {name: values for name, values in arrays.items() if not name.startswith(("chain.", "source."))}
    # Files of earlier versions have no scatter of healthy session means.
    rules = {name: rule for name, rule in ARRAYS.items() if name in own or name != "scatter"}
    sizes = {"channels": len(channels), "summaries": chain.summaries.width}
    own = checked_arrays(own, rules, "its sessions", sizes)
    means, scatter = own["session_means"], own.get("scatter")
    if not (means[1] > 0.0).all():
        raise ValueError("the means of its sessions have a width that is not above 0")
    provenance = object_with(header["provenance"], (), "its provenance")
    limit = _limit(object_with(header["limit"], LIMIT, "its limit"))
    return Monitor(channels, float(header["rate_hz"]), sources, chain, limit, means, None, provenance, scatter)


def _check_fit(sources: tuple[ResidualSource, ...], chain: MonitorChain, names: list[str]) -> None:
    """Refuse parts that do not belong together."""
    if chain.summaries.residuals != sum(len(source.names) for source in sources):
        raise ValueError("its chain is for another number of residuals than its sources give")
    if len(chain.summaries.centre) != len(names):
        raise ValueError("its chain is for another number of channels")
    for source in sources:
        unknown = [name for name in source.inputs if name not in names]
        if unknown:
            raise ValueError(f"a source reads '{unknown[0][:80]}', which is none of its channels")


def _sources(entries: Any, arrays: Table, path: Path) -> tuple[ResidualSource, ...]:
    if not isinstance(entries, list) or not 1 <= len(entries) <= MAX_SOURCES:
        raise ValueError(f"it has no list of 1 to {MAX_SOURCES} sources of residuals")
    sources = []
    for index, entry in enumerate(entries):
        spec = RESIDUALS[checked_text(entry["kind"])]
        networks = object_with(entry["networks"], (), "its networks")
        if len(networks) > MAX_NETWORKS:
            raise ValueError(f"a source has {len(networks)} networks; at most {MAX_NETWORKS} must hold")
        bundles = {name: read_network(path, value) for name, value in networks.items()}
        plain = object_with(entry["plain"], (), "a source")
        sources.append(spec.source.from_parts(SourceParts(plain, arrays_under(arrays, f"source.{index}."), bundles)))
    return tuple(sources)


def read_network(path: Path, entry: Mapping[str, Any]) -> Bundle | TwinBundle:
    """Return the network of an entry.

    Raises:
        BundleError: the network is missing or damaged.
        ValueError: an entry that names no network of the monitor.
    """
    folder = checked_text(entry["folder"])
    # Never a path out of the monitor.
    if not _FOLDER.fullmatch(folder):
        raise ValueError(f"'{folder[:80]}' is no folder of a network")
    where = path / NETWORKS / folder
    if not is_folder_at(where):
        raise BundleError(f"monitor '{path}' lacks its network '{folder}'; restore the monitor")
    twin = folder.startswith("twin-")
    network = load_twin(where) if twin else load_bundle(where)
    stated = read_header(where / (TWIN_HEADER if twin else BUNDLE_HEADER))[HASH]
    if stated != entry[HASH]:
        raise ValueError(f"its network '{folder}' is another one than its header names")
    return network


def _limit(entry: Table) -> AlarmLimit:
    count = entry["alarms"]
    if isinstance(count, bool) or not isinstance(count, int) or not 0 <= count < 2**53:
        raise ValueError(f"alarms of its limit is {str(count)[:40]}; a count must hold")
    values = {name: np.inf if entry[name] is None else entry[name] for name in LIMIT if name != "alarms"}
    for name, value in values.items():
        if isinstance(value, bool) or not isinstance(value, int | float) or np.isnan(value):
            raise ValueError(f"{name} of its limit is {str(value)[:40]}; a number must hold")
    return AlarmLimit(alarms=count, **values)
