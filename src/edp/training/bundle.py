"""Bundles: a trained predictor on disk as safetensors and JSON; loading one executes nothing."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.numpy import load as load_arrays
from safetensors.numpy import save as save_arrays
from safetensors.torch import load, save

from edp import __version__
from edp.data.prepared import Prepared
from edp.data.scaling import Scaler
from edp.data.task import Task
from edp.errors import BundleError, ConfigError, StorageError
from edp.integer import Formats
from edp.integer.quantise import weights_of
from edp.models.integer import IntegerPredictor
from edp.models.plain import model_from_plain, model_to_plain, task_from_plain, task_to_plain
from edp.models.predictor import Predictor
from edp.onboard import Adaptation
from edp.signals import Channel, Kind
from edp.storage import make_folder, read_json, write_bytes, write_json

SCHEMA = 2
INTEGER_SCHEMA = 3
"""Of a bundle in whole numbers, which older versions would read as one in float32."""
ADAPTED_SCHEMA = 4
"""Of a bundle with an adaptation, which older versions would leave out; its network may be in whole numbers."""
HEADER = "bundle.json"
ARRAYS = ("weights", "integers", "adaptation")
"""Beginnings of the names of a bundle's files of arrays."""


@dataclass(frozen=True, eq=False)
class Bundle:
    """A trained predictor with what a user of it must know.

    Attributes:
        predictor: the network with its scaler, in evaluation mode.
        inputs: the channels to feed at each tick, in order, SI units.
        target_kinds: kind of each target.
        descriptions: description of each target.
        provenance: data digest, environment, settings, training time.
        scores: held-out scores of the network, by horizon and target; empty before evaluation.
        adaptation: how its predictions are corrected on board, where they are.
    """

    predictor: Predictor
    inputs: tuple[Channel, ...]
    target_kinds: tuple[Kind, ...]
    descriptions: tuple[str, ...]
    provenance: Mapping[str, Any] = field(default_factory=dict)
    scores: Mapping[str, Any] = field(default_factory=dict)
    adaptation: Adaptation | None = None

    @property
    def task(self) -> Task:
        """What the predictor reads and predicts."""
        return self.predictor.task


def make_bundle(
    predictor: Predictor, data: Prepared, provenance: Mapping[str, Any], scores: Mapping[str, Any] | None = None
) -> Bundle:
    """A bundle of a predictor trained on `data`."""
    return Bundle(predictor, data.inputs, data.target_kinds, data.descriptions, provenance, scores or {})


def weights_digest(predictor: Predictor) -> str:
    """Content address of the weights of a predictor, and of what they became in whole numbers."""
    state = hashlib.blake2b(_weights_bytes(predictor), digest_size=16)
    if isinstance(predictor, IntegerPredictor):
        state.update(repr(sorted(predictor.formats.fracs.items())).encode() + _integers_bytes(predictor))
    return state.hexdigest()


def _weights_bytes(predictor: Predictor) -> bytes:
    return save({name: tensor.detach().cpu().contiguous() for name, tensor in predictor.state_dict().items()})


def save_bundle(bundle: Bundle, folder: str | Path) -> Path:
    """Write a bundle; the header is renamed into place last, so a reader sees the old bundle or the new one.

    Raises:
        StorageError: the folder cannot be written.
        BundleError: the network computes with other numbers, which a bundle would not tell.
    """
    predictor, form = bundle.predictor, bundle.predictor.number_format
    whole = isinstance(predictor, IntegerPredictor)
    if form != "float32" and not whole:
        raise BundleError(
            f"a network in {form} cannot be saved as a bundle, which would be read as one in float32; save the network "
            "that it was made of, and quantise that after loading"
        )
    path = make_folder(folder)
    data = _weights_bytes(bundle.predictor)
    digest = hashlib.blake2b(data, digest_size=16).hexdigest()
    weights = f"weights-{digest[:12]}.safetensors"
    write_bytes(path / weights, data)
    task = bundle.task
    header: dict[str, Any] = {
        "schema": INTEGER_SCHEMA if whole else SCHEMA,
        "edp": __version__,
        "task": task_to_plain(task),
        "model": model_to_plain(bundle.predictor.spec),
        "inputs": [
            {"name": c.name, "kind": str(c.kind), "unit": c.unit, "description": c.description} for c in bundle.inputs
        ],
        "outputs": [
            {"name": name, "kind": str(kind), "description": text}
            for name, kind, text in zip(task.targets, bundle.target_kinds, bundle.descriptions, strict=True)
        ],
        "weights": {"file": weights, "blake2b": digest},
        "provenance": dict(bundle.provenance),
        "scores": dict(bundle.scores),
    }
    kept = {weights}
    if isinstance(predictor, IntegerPredictor):
        entry = _write_arrays(path, "integers", _integers_bytes(predictor))
        kept.add(entry["file"])
        header |= {"number_format": form, "formats": dict(predictor.formats.fracs), "integers": entry}
    if bundle.adaptation is not None:
        entry = _write_arrays(path, "adaptation", save_arrays(bundle.adaptation.arrays()))
        kept.add(entry["file"])
        header |= {"schema": ADAPTED_SCHEMA, "adaptation": bundle.adaptation.to_plain() | {"arrays": entry}}
    write_json(path / HEADER, header)
    for old in (
        found for what in ("weights", "integers", "adaptation") for found in path.glob(f"{what}-*.safetensors")
    ):
        if old.name not in kept:
            old.unlink(missing_ok=True)
    return path


def _integers_bytes(predictor: IntegerPredictor) -> bytes:
    held = {name: torch.from_numpy(np.ascontiguousarray(x)) for name, x in weights_of(predictor.integers).items()}
    return save(held)


def _write_arrays(path: Path, what: str, data: bytes) -> dict[str, str]:
    """Write arrays beside the weights; returns file and digest."""
    digest = hashlib.blake2b(data, digest_size=16).hexdigest()
    file = f"{what}-{digest[:12]}.safetensors"
    write_bytes(path / file, data)
    return {"file": file, "blake2b": digest}


def load_bundle(folder: str | Path) -> Bundle:
    """Read a bundle, check its schema and the digest of its weights.

    Raises:
        BundleError: not a bundle, a newer schema, damaged weights, or parts that this version does not know.
    """
    path = Path(folder)
    path = path / "bundle" if (path / "bundle" / HEADER).is_file() else path
    if not (path / HEADER).is_file():
        raise BundleError(f"'{path}' is not a bundle: it has no {HEADER}; give the folder that edp train wrote")
    try:
        header = read_json(path / HEADER)
        _check_schema(header, path)
        spec, task = model_from_plain(header["model"]), task_from_plain(header["task"])
        data = _weights(path, header["weights"])
        inputs = tuple(Channel(c["name"], Kind(c["kind"]), c["description"]) for c in header["inputs"])
        kinds = tuple(Kind(c["kind"]) for c in header["outputs"])
        texts = tuple(c["description"] for c in header["outputs"])
        predictor = Predictor(task, spec, blank_scaler(task))
        predictor.load_state_dict(load(data))
        if header["schema"] == INTEGER_SCHEMA or "number_format" in header:
            integers = {name: x.numpy() for name, x in load(_weights(path, header["integers"])).items()}
            predictor = IntegerPredictor(predictor, Formats(header["formats"], integers))
        adaptation = _adaptation(header["adaptation"], task, path) if header["schema"] == ADAPTED_SCHEMA else None
        return Bundle(predictor.eval(), inputs, kinds, texts, header["provenance"], header["scores"], adaptation)
    except (KeyError, TypeError, ValueError, RuntimeError, SafetensorError, StorageError) as error:
        raise BundleError(f"bundle '{path}' is damaged: {error}; restore it or train again") from error


def _adaptation(entry: Mapping[str, Any], task: Task, path: Path) -> Adaptation:
    try:
        found = Adaptation.from_plain(entry, load_arrays(_weights(path, entry["arrays"])))
    except ConfigError as error:
        raise ValueError(str(error)) from error
    if (len(found.offset), len(found.columns), found.horizons) != (len(task.inputs), len(task.targets), task.horizons):
        raise ValueError("its adaptation belongs to another task")
    return found


def _check_schema(header: Any, path: Path) -> None:
    schema = header.get("schema") if isinstance(header, dict) else None
    if schema not in (SCHEMA, INTEGER_SCHEMA, ADAPTED_SCHEMA):
        newer = isinstance(schema, int) and schema > ADAPTED_SCHEMA
        older = isinstance(schema, int) and 0 < schema < SCHEMA
        raise BundleError(
            f"bundle '{path}' has schema {schema}, this version of EDP ({__version__}) reads {SCHEMA} to "
            f"{ADAPTED_SCHEMA}; "
            + ("install a newer EDP" if newer else "train again" if older else "the header is not that of a bundle")
        )


def _weights(path: Path, entry: Mapping[str, str]) -> bytes:
    file = path / Path(entry["file"]).name  # never a path out of the bundle
    try:
        data = file.read_bytes()
    except OSError as error:
        raise BundleError(f"bundle '{path}' lacks its weights '{file.name}': {error.strerror}") from error
    if hashlib.blake2b(data, digest_size=16).hexdigest() != entry["blake2b"]:
        raise BundleError(f"weights '{file}' do not match their digest: cut off or changed; restore the bundle")
    return data


def blank_scaler(task: Task) -> Scaler:
    """Placeholders of the right shape; the weights file holds the fitted numbers."""
    features, shape = len(task.features.features), (len(task.horizons), len(task.targets))
    return Scaler(np.zeros(features), np.ones(features), np.zeros(shape), np.ones(shape))
