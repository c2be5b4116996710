"""Twins on disk as JSON and safetensors, like predictor bundles; loading does not execute code."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from safetensors.numpy import load as load_arrays
from safetensors.numpy import save as save_arrays

from edp import __version__
from edp.data.twin_channels import TwinChannels
from edp.errors import BundleError, ConfigError, ExportError
from edp.networks.twin import TWINS, FreeRunIntervals, Twin, TwinPlant, TwinScales, TwinSpec
from edp.networks.twin.grey.ground import GROUNDS, GroundLaw, check_grounded
from edp.networks.twin.recurrent_cell import CellWeights
from edp.settings.provenance import Provenance
from edp.settings.tree import SettingsTree, Table
from edp.storage import make_folder, object_with, write_json
from edp.storage.arrays import ArrayRule, checked_arrays
from edp.storage.headers import read_header
from edp.storage.memory import check_setting
from edp.storage.paths import is_entry_at
from edp.storage.runs import missing_text
from edp.storage.seals import HASH
from edp.training.bundle import (
    Bundle,
    add_plugins,
    channel_from_dict,
    channel_to_dict,
    check_hash,
    convert_damage,
    read_arrays,
    remove_old_arrays,
    sealed_header,
    write_arrays,
)

SCHEMA = 2
GROUNDED = 3
"""Of a twin with a ground: an EDP that knows of none must not run it without."""
READABLE = (1, SCHEMA, GROUNDED)
"""Schema 1 had no intervals."""
HEADER = "twin.json"
PARTS = ("commands", "velocities", "strokes", "pressures")
STROKES = "full_strokes_m"
"""In the metadata of simulated recordings, and in the provenance of a twin that learned from them."""
OIL_C = "oil_c"
"""Mean temperature of the oil in the logs that a twin learned from, degC, in its provenance where they hold it."""
_TREE = SettingsTree({"twin": TWINS}, what="twin")


@dataclass(frozen=True, kw_only=True)
class _Form:
    twin: TwinSpec


@dataclass(frozen=True, eq=False)
class TwinBundle:
    """Twin with its settings and provenance.

    Attributes:
        spec: the formulation and its options.
        twin: ready to run.
        provenance: data digest, environment, settings, training time.
        scores: held-out scores; empty before they are known.
        intervals: intervals of free runs, if calibrated.
        ground: law of the ground on which loops with a material stand; None: the twin knows free air alone.
    """

    spec: TwinSpec
    twin: Twin
    provenance: Provenance = field(default_factory=Provenance)
    scores: Table = field(default_factory=dict)
    intervals: FreeRunIntervals | None = None
    ground: GroundLaw | None = None

    @property
    def network(self) -> CellWeights:
        """The network of the twin as a PyTorch module (`torch.nn.Module`): the weights with which `twin` runs.

        Inputs and outputs of the module are scaled numbers; `twin` scales, bounds and integrates around it.

        Raises:
            ConfigError: the formulation has no network; its numbers are NumPy arrays (`Twin.arrays`).
        """
        network = getattr(self.twin, "network", None)
        if not isinstance(network, CellWeights):
            kind = TWINS.name_of(self.spec)
            raise ConfigError(
                f"this twin is of kind '{kind}', which has no network: its numbers are NumPy arrays, in twin.arrays(); "
                "kinds with a network are 'recurrent' and 'residual'"
            )
        return network


def plant_bundle(bundle: TwinBundle) -> Bundle:
    """Return a twin for export: see `TwinPlant`.

    Raises:
        ExportError: it has a ground, of which no exported form knows.
    """
    if bundle.ground is not None:
        raise ExportError(
            f"the twin has a ground ('{GROUNDS.name_of(bundle.ground)}'), which exported forms do not have; export the "
            "run in free air that it was started from"
        )
    plant, answers = TwinPlant(bundle.twin, f"{TWINS.name_of(bundle.spec)} twin"), bundle.twin.channels.answers
    kinds, texts = tuple(c.kind for c in answers), tuple(c.description for c in answers)
    return Bundle(plant, plant.inputs, kinds, texts, bundle.provenance, bundle.scores)


def save_twin(bundle: TwinBundle, folder: str | Path) -> Path:
    """Write a twin; the header is renamed into place last, so a reader sees the old twin or the new one.

    Raises:
        StorageError: the folder cannot be written.
    """
    path, channels = make_folder(folder), bundle.twin.channels
    arrays = {name: np.ascontiguousarray(values) for name, values in bundle.twin.arrays().items()}
    entry = write_arrays(path, "weights", save_arrays(arrays))
    header = {
        "schema": SCHEMA if bundle.ground is None else GROUNDED,
        "edp": __version__,
        "twin": _TREE.to_dict(bundle.spec, "twin"),
        "rate_hz": channels.rate_hz,
        "channels": {part: [channel_to_dict(channel) for channel in getattr(channels, part)] for part in PARTS},
        "weights": entry,
        "intervals": None if bundle.intervals is None else bundle.intervals.to_dict(),
        "provenance": bundle.provenance.to_table(),
        "scores": dict(bundle.scores),
    }
    if bundle.ground is not None:
        header["ground"] = {"kind": GROUNDS.name_of(bundle.ground), **bundle.ground.to_dict()}
    write_json(path / HEADER, add_plugins(header))
    remove_old_arrays(path, ("weights",), (entry["file"],))
    return path


def holds_twin(folder: str | Path) -> bool:
    """Return whether a folder, or the bundle in a run folder, is a twin."""
    path = Path(folder)
    return is_entry_at(path / HEADER) or is_entry_at(path / "twin" / HEADER)


def twin_hash(folder: str | Path) -> str:
    """Return the hash of the header of a twin, which contains the hashes of its arrays.

    Args:
        folder: the twin's own, or the run folder around it.

    Raises:
        BundleError: the header was damaged or changed.
    """
    path = _twin_folder(folder)
    with convert_damage(path):
        header = read_header(path / HEADER, (HASH,))
        check_hash(header, path / HEADER)
        return str(header[HASH])


def _twin_folder(folder: str | Path) -> Path:
    path = Path(folder)
    return path / "twin" if is_entry_at(path / "twin" / HEADER) else path


def load_twin(folder: str | Path) -> TwinBundle:
    """Read a twin; schema, hashes, shapes and ranges are checked before it is built.

    Args:
        folder: the twin's own, or the run folder around it.

    Raises:
        BundleError: not a twin, another schema, damaged numbers, or a formulation that this version does not know.
    """
    path = _twin_folder(folder)
    if not is_entry_at(path / HEADER):
        raise BundleError(missing_text(path, "twin", "a twin"))
    with convert_damage(path):
        header = sealed_header(path / HEADER, "twin", READABLE, "train again")
        return _assemble(header, path)


def _assemble(header: Table, path: Path) -> TwinBundle:
    parts = {part: tuple(channel_from_dict(entry) for entry in header["channels"][part]) for part in PARTS}
    channels = TwinChannels(**parts, rate_hz=float(header["rate_hz"]))
    spec = _TREE.build(_Form, {"twin": header["twin"]}, f"'{path / HEADER}'").twin
    expected = {**TwinScales.shapes(channels), **spec.shapes(channels)}
    numbers = sum(int(np.prod(shape)) for shape in expected.values())
    check_setting(8 * numbers, f"a twin of {numbers:,} numbers", "the header may be damaged")
    rules = {name: ArrayRule(shape, np.float32, is_exact=True) for name, shape in expected.items()}
    arrays = checked_arrays(load_arrays(read_arrays(path, header["weights"])), rules, "its weights")
    provenance = Provenance.from_table(object_with(header["provenance"], (), "its provenance"), "its provenance")
    scores = object_with(header["scores"], (), "its scores")
    widths = header.get("intervals") if header["schema"] > 1 else None
    intervals = None if widths is None else FreeRunIntervals.from_dict(widths, channels)
    twin = spec.build(channels, TwinScales.from_arrays(arrays), arrays)
    return TwinBundle(spec, twin, provenance, scores, intervals, _ground(header, twin))


def _ground(header: Table, twin: Twin) -> GroundLaw | None:
    """Read the ground law of a header, if it has one."""
    if header["schema"] < GROUNDED:
        return None
    plain = object_with(header["ground"], ("kind",), "its ground")
    try:
        check_grounded(twin)
        return GROUNDS[str(plain["kind"])[:80]].from_dict(plain)
    except ConfigError as error:
        raise ValueError(f"its ground: {error}") from None
