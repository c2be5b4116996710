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
from edp.settings.bounds import above
from edp.settings.provenance import Provenance
from edp.settings.tree import SettingsTree, Table
from edp.signals import Channel, Kind
from edp.storage import make_folder, object_with, write_json
from edp.storage.headers import read_header
from edp.storage.memory import check_setting
from edp.storage.paths import entries_of, is_entry_at
from edp.storage.runs import missing_text
from edp.storage.seals import HASH
from edp.training.bundle import Bundle, add_plugins, check_hash, convert_damage, read_arrays, write_arrays

SCHEMA = 2
GROUNDED = 3
"""Of a twin with a ground: an EDP that knows of none must not run it without."""
READABLE = (1, SCHEMA, GROUNDED)
"""Schema 1 had no intervals."""
HEADER = "twin.json"
PARTS = ("commands", "velocities", "strokes", "pressures")
RATE = above(0.0, 1e6)
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
        intervals: of free runs, where they were calibrated.
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
        "twin": _TREE.plain(bundle.spec, "twin"),
        "rate_hz": channels.rate_hz,
        "channels": {part: [_plain(channel) for channel in getattr(channels, part)] for part in PARTS},
        "weights": entry,
        "intervals": None if bundle.intervals is None else bundle.intervals.to_plain(),
        "provenance": bundle.provenance.to_table(),
        "scores": dict(bundle.scores),
    }
    if bundle.ground is not None:
        header["ground"] = {"kind": GROUNDS.name_of(bundle.ground), **bundle.ground.plain()}
    write_json(path / HEADER, add_plugins(header))
    # Old files go only after the rename; a kill in between leaves spare files, not a broken twin.
    for old in entries_of(path, "weights-*.safetensors"):
        if old.name != entry["file"]:
            old.unlink(missing_ok=True)
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
        header = read_header(path / HEADER, ("schema",))
        schema = header["schema"]
        if isinstance(schema, bool) or schema not in READABLE:
            raise BundleError(
                f"twin '{path}' has schema {str(schema)[:40]}, this EDP ({__version__}) reads 1 to {GROUNDED}; "
                "install a newer one, or train again"
            )
        check_hash(header, path / HEADER)
        return _assemble(header, path)


def _assemble(header: Table, path: Path) -> TwinBundle:
    parts = {part: tuple(_channel(entry) for entry in header["channels"][part]) for part in PARTS}
    if not RATE.holds(header["rate_hz"]):
        raise ValueError(f"its rate_hz is {str(header['rate_hz'])[:40]}; {RATE.rule('rate_hz')} must hold")
    channels = TwinChannels(**parts, rate_hz=float(header["rate_hz"]))
    spec = _TREE.build(_Form, {"twin": header["twin"]}, f"'{path / HEADER}'").twin
    expected = {**TwinScales.shapes(channels), **spec.shapes(channels)}
    numbers = sum(int(np.prod(shape)) for shape in expected.values())
    check_setting(8 * numbers, f"a twin of {numbers:,} numbers", "the header may be damaged")
    arrays = load_arrays(read_arrays(path, header["weights"]))
    other = sorted({*expected} ^ {*arrays})
    if other:
        raise ValueError(f"its weights are not those of its header: '{other[0][:80]}' is in one of them only")
    for name, values in sorted(arrays.items()):
        if values.shape != expected[name] or values.dtype != np.float32:
            raise ValueError(f"'{name[:80]}' is {values.shape} {values.dtype}, not {expected[name]} float32")
        if not np.isfinite(values).all():
            raise ValueError(f"'{name[:80]}' holds a number that is not finite")
    provenance = Provenance.from_table(object_with(header["provenance"], (), "its provenance"), "its provenance")
    scores = object_with(header["scores"], (), "its scores")
    widths = header.get("intervals") if header["schema"] > 1 else None
    intervals = None if widths is None else FreeRunIntervals.from_plain(widths, channels)
    twin = spec.build(channels, TwinScales.of(arrays), arrays)
    return TwinBundle(spec, twin, provenance, scores, intervals, _ground(header, twin))


def _ground(header: Table, twin: Twin) -> GroundLaw | None:
    """Read the ground law of a header, if it has one."""
    if header["schema"] < GROUNDED:
        return None
    plain = object_with(header["ground"], ("kind",), "its ground")
    try:
        check_grounded(twin)
        return GROUNDS[str(plain["kind"])[:80]].of(plain)
    except ConfigError as error:
        raise ValueError(f"its ground: {error}") from None


def _plain(channel: Channel) -> dict[str, str]:
    return {"name": channel.name, "kind": str(channel.kind), "unit": channel.unit, "description": channel.description}


def _channel(entry: Table) -> Channel:
    texts = [entry["name"], entry["description"]]
    if not all(isinstance(text, str) for text in texts):
        raise TypeError("the name or description of a channel is no text")
    channel = Channel(entry["name"], Kind(entry["kind"]), entry["description"])
    if entry["unit"] != channel.unit:
        raise ValueError(f"channel '{channel.name[:80]}' is in {str(entry['unit'])[:20]}, {channel.unit} must hold")
    return channel
