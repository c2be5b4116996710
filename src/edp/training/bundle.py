"""Bundles: trained predictors on disk as safetensors and JSON; loading does not execute code."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
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
from edp.errors import BundleError, EdpError, brief
from edp.ir.rls import Adaptation
from edp.ir.w8a16 import Formats
from edp.ir.w8a16.quantise import weights_of
from edp.networks.integer import IntegerPredictor
from edp.networks.plain import model_from_dict, model_to_dict, task_from_dict, task_to_dict, unknown_parts
from edp.networks.predictor import Predictor
from edp.registry import missing_parts, origins_in
from edp.settings.bounds import above
from edp.settings.provenance import Provenance
from edp.settings.tree import Table
from edp.signals import Channel, Kind
from edp.storage import make_folder, object_with, read_bytes, write_bytes, write_json
from edp.storage.arrays import POSITIVE, ArrayRule, checked_arrays
from edp.storage.headers import ARRAYS_BYTES, read_header
from edp.storage.paths import entries_of, is_entry_at
from edp.storage.runs import missing_text
from edp.storage.seals import HASH, content_digest, digest_of_bytes

SCHEMA = 8
INTEGER_SCHEMA = 9
"""Of an integer bundle, which older versions would read as one in float32."""
ADAPTED_SCHEMA = 10
"""Of a bundle with an adaptation, which older versions would leave out; its network may be an integer one."""
UNHASHED = {2: SCHEMA, 3: INTEGER_SCHEMA, 4: ADAPTED_SCHEMA}
"""Schemas from before the header had a hash, and what they became."""
REWORDED = {5: SCHEMA, 6: INTEGER_SCHEMA, 7: ADAPTED_SCHEMA}
"""Schemas with the keys `lesson` for ``strategy`` and `rest` for ``dead_zone``, and what they became."""
HEADER, PLUGINS = "bundle.json", "plugins"
ARRAYS = ("weights", "integers", "adaptation")
"""Beginnings of the names of a bundle's files of arrays."""
SCALES = ("front.width", "code.width")
"""Weights of a predictor that scale its inputs and targets."""
RATE, MAX_BITS, MOST_TEXT = above(0.0, 1e6), 64, 4096
"""Bounds of the ticks in a second, of the fraction of a number, and of a name or description."""


@dataclass(frozen=True, eq=False)
class Bundle:
    """Trained predictor with its channels, provenance and scores.

    Attributes:
        predictor: the network with its scaler, in evaluation mode.
        inputs: the channels to feed at each tick, in order, SI units.
        target_kinds: kind of each target.
        descriptions: description of each target.
        provenance: data digest, environment, settings, training time.
        scores: held-out scores of the network, by horizon and target; empty before evaluation.
        adaptation: settings of the on-board correction, if there is one.
    """

    predictor: Predictor
    inputs: tuple[Channel, ...]
    target_kinds: tuple[Kind, ...]
    descriptions: tuple[str, ...]
    provenance: Provenance = field(default_factory=Provenance)
    scores: Table = field(default_factory=dict)
    adaptation: Adaptation | None = None

    @property
    def task(self) -> Task:
        """Task of the predictor: inputs and targets."""
        return self.predictor.task


def make_bundle(
    predictor: Predictor, data: Prepared, provenance: Provenance | None = None, scores: Table | None = None
) -> Bundle:
    """Create a bundle of a predictor trained with `data`."""
    return Bundle(
        predictor, data.inputs, data.target_kinds, data.descriptions, provenance or Provenance(), scores or {}
    )


def weights_digest(predictor: Predictor) -> str:
    # Weights and formats together decide what an integer network computes; one without the other is another network.
    """Return content address of the weights of a predictor, and of their integer form."""
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
    integer = isinstance(predictor, IntegerPredictor)
    if form != "float32" and not integer:
        raise BundleError(
            f"a network in {form} cannot be saved as a bundle, which would be read as one in float32; save the network "
            "that it was made of, and quantise that after loading"
        )
    path = make_folder(folder)  # an old bundle stays valid until the header is renamed
    data = _weights_bytes(bundle.predictor)
    digest = digest_of_bytes(data)
    # Names by content: a reader of the old header never finds new weights under the old name.
    weights = f"weights-{digest[:12]}.safetensors"
    write_bytes(path / weights, data)
    task = bundle.task
    header: dict[str, object] = {
        "schema": INTEGER_SCHEMA if integer else SCHEMA,
        "edp": __version__,
        "task": task_to_dict(task),
        "model": model_to_dict(bundle.predictor.spec),
        "inputs": [channel_to_dict(channel) for channel in bundle.inputs],
        "outputs": [
            {"name": name, "kind": str(kind), "description": text}
            for name, kind, text in zip(task.targets, bundle.target_kinds, bundle.descriptions, strict=True)
        ],
        "weights": {"file": weights, "blake2b": digest},
        "provenance": bundle.provenance.to_table(),
        "scores": dict(bundle.scores),
    }
    referenced = {weights}
    if isinstance(predictor, IntegerPredictor):
        entry = write_arrays(path, "integers", _integers_bytes(predictor))
        referenced.add(entry["file"])
        header |= {"number_format": form, "formats": dict(predictor.formats.fracs), "integers": entry}
    if bundle.adaptation is not None:
        entry = write_arrays(path, "adaptation", save_arrays(bundle.adaptation.arrays()))
        referenced.add(entry["file"])
        header |= {"schema": ADAPTED_SCHEMA, "adaptation": bundle.adaptation.to_dict() | {"arrays": entry}}
    # The header comes last: it is what makes the new files count.
    write_json(path / HEADER, add_plugins(header))
    remove_old_arrays(path, ARRAYS, referenced)
    return path


def _integers_bytes(predictor: IntegerPredictor) -> bytes:
    tensors = {name: torch.from_numpy(np.ascontiguousarray(x)) for name, x in weights_of(predictor.integers).items()}
    return save(tensors)


def write_arrays(path: Path, what: str, data: bytes) -> dict[str, str]:
    """Write arrays next to the weights; return file name and digest."""
    digest = digest_of_bytes(data)
    file = f"{what}-{digest[:12]}.safetensors"
    write_bytes(path / file, data)
    return {"file": file, "blake2b": digest}


def remove_old_arrays(path: Path, beginnings: Iterable[str], current: Container[str]) -> None:
    """Remove files of arrays that a new header no longer names; a kill before that leaves spare files."""
    for beginning in beginnings:
        for old in entries_of(path, f"{beginning}-*.safetensors"):
            if old.name not in current:
                old.unlink(missing_ok=True)


def load_bundle(folder: str | Path) -> Bundle:
    """Read a bundle; schema, the hashes of header and weights, sizes and ranges are checked before it is built.

    Raises:
        BundleError: not a bundle, another schema, damaged weights or header, values that cannot be, or parts that this
            version does not know.
    """
    path = _bundle_folder(folder)
    with convert_damage(path):
        header = _read_header(path)
        _check_schema(header, path)
        check_hash(header, path / HEADER)
        if unknown := unknown_parts(header["model"]):
            raise BundleError(f"bundle '{path}': {'; '.join(unknown)}")
        return _assemble(header, path)


def sealed_header(file: Path, what: str, readable: Sequence[int], again: str) -> Table:
    """Return the header of a model after a check of its schema, hash and rate.

    Args:
        file: path of the header.
        what: kind of the model, for the message.
        readable: schemas that are read, rising.
        again: advice for another schema.

    Raises:
        BundleError: another schema, or it was damaged or changed.
    """
    header = read_header(file, ("schema",))
    schema = header["schema"]
    # 1.0 and true equal 1 in Python; neither is a schema.
    if type(schema) is not int or schema not in readable:
        span = " to ".join(dict.fromkeys((str(readable[0]), str(readable[-1]))))
        raise BundleError(
            f"{what} '{file.parent}' has schema {str(schema)[:40]}, this EDP ({__version__}) reads {span}; install a "
            f"newer one, or {again}"
        )
    check_hash(header, file)
    _check_rate(header["rate_hz"])
    return header


def add_plugins(header: Mapping[str, object]) -> dict[str, object]:
    """Return a header with the plug-ins whose parts it names."""
    plugins = origins_in(header)
    return {**header, PLUGINS: plugins} if plugins else dict(header)


def check_hash(header: Mapping[str, object], file: Path) -> None:
    """Raise BundleError if the hash does not match the header or a plug-in part is not registered.

    Raises:
        BundleError: one of both; the message names the package of a part.
    """
    # The hash protects against damage and stray edits, not against an attacker: it has no key.
    if header.get(HASH) != content_digest(header):
        raise BundleError(f"'{file}' does not match its hash: it was cut off or changed by hand; restore the bundle")
    built = {key: value for key, value in header.items() if key not in ("provenance", "scores")}
    if missing := missing_parts(header.get(PLUGINS), built):
        raise BundleError(f"'{file}': {'; '.join(missing)}")


def upgrade_bundle(folder: str | Path) -> Path:
    """Give a bundle of an earlier version the keys of this one.

    Where its header had no hash, the caller vouches for its content.

    Raises:
        BundleError: not a bundle of an earlier version, or a damaged one; it is left as it is.
    """
    path = _bundle_folder(folder)
    with convert_damage(path):
        header = _read_header(path)
        schema = header["schema"]
        if schema not in UNHASHED | REWORDED:
            raise BundleError(f"bundle '{path}' has schema {schema}; there is nothing to upgrade")
        if schema in REWORDED:
            check_hash(header, path / HEADER)
        upgraded = _convert_keys(header) | {"schema": (UNHASHED | REWORDED)[schema]}
        # The content is assembled once, so that damage is not sealed under a new hash.
        _assemble(upgraded, path)
    write_json(path / HEADER, add_plugins(upgraded))
    return path


def _convert_keys(header: Table) -> dict[str, object]:
    """Convert the keys of an earlier header to this version."""
    reworded = {**header, "provenance": _rename_key(header["provenance"], "lesson", "strategy")}
    if "adaptation" in header:
        entry = header["adaptation"]
        reworded["adaptation"] = {**entry, "spec": _rename_key(entry["spec"], "rest", "dead_zone")}
    return reworded


def _rename_key(table: Mapping[str, object], old: str, new: str) -> dict[str, object]:
    return {new if key == old else key: value for key, value in table.items()}


def _bundle_folder(folder: str | Path) -> Path:
    path = Path(folder)
    # Both the run folder and the bundle in it are accepted.
    path = path / "bundle" if is_entry_at(path / "bundle" / HEADER) else path
    if is_entry_at(path / "twin" / "twin.json"):
        raise BundleError(
            f"'{path}' holds a twin, not a network that predicts; edp rollout runs it, edp.load_twin loads it"
        )
    if not is_entry_at(path / HEADER):
        raise BundleError(missing_text(path, "network", "a bundle"))
    return path


@contextlib.contextmanager
def convert_damage(path: Path) -> Iterator[None]:
    """Convert errors in a file of a bundle to one message that names the bundle."""
    # A damaged file can raise any of these deep in a parser; a bug elsewhere keeps its own type.
    kinds = (EdpError, LookupError, AttributeError, TypeError, ValueError, ArithmeticError, RuntimeError)
    try:
        yield
    except BundleError as error:
        if str(path) in str(error):
            raise
        raise BundleError(f"bundle '{path}' is damaged: {brief(error)}; restore it or train again") from error
    except (*kinds, SafetensorError) as error:
        cause = f"it lacks {brief(error)}" if isinstance(error, KeyError) else brief(error)
        raise BundleError(f"bundle '{path}' is damaged: {cause}; restore it or train again") from error


def _read_header(path: Path) -> dict[str, object]:
    header = read_header(path / HEADER)
    if not isinstance(header, dict) or "schema" not in header:
        header = {"schema": None}
    return header


def _assemble(header: Table, path: Path) -> Bundle:
    """Build the bundle from a header and its files."""
    spec, task = model_from_dict(header["model"]), task_from_dict(header["task"])
    inputs = tuple(channel_from_dict(entry) for entry in header["inputs"])
    kinds = tuple(Kind(c["kind"]) for c in header["outputs"])
    texts = tuple(checked_text(c["description"]) for c in header["outputs"])
    _check_channels(header, task, inputs)
    predictor = Predictor(task, spec, blank_scaler(task))
    # Weights are loaded on top of placeholders: nothing in the file decides the structure.
    _fill(predictor, load(read_arrays(path, header["weights"])))
    if header["schema"] == INTEGER_SCHEMA or "number_format" in header:
        integers = {name: x.numpy() for name, x in load(read_arrays(path, header["integers"])).items()}
        predictor = IntegerPredictor(predictor, Formats(_formats(header["formats"]), integers))
    adaptation = _adaptation(header["adaptation"], task, path) if header["schema"] == ADAPTED_SCHEMA else None
    provenance = Provenance.from_table(object_with(header["provenance"], (), "its provenance"), "its provenance")
    scores = object_with(header["scores"], (), "its scores")
    return Bundle(predictor.eval(), inputs, kinds, texts, provenance, scores, adaptation)


def _check_channels(header: Table, task: Task, inputs: Sequence[Channel]) -> None:
    """Check that the listed channels equal the channels of the task, in order."""
    # Order is meaning: swapped columns would give plausible and wrong predictions.
    if [channel.name for channel in inputs] != list(task.inputs):
        raise ValueError("its inputs are not those of its task")
    if [entry["name"] for entry in header["outputs"]] != list(task.targets):
        raise ValueError("its outputs are not the targets of its task")
    _check_rate(task.rate_hz)


def channel_to_dict(channel: Channel) -> dict[str, str]:
    """Convert a channel to JSON types."""
    return {"name": channel.name, "kind": str(channel.kind), "unit": channel.unit, "description": channel.description}


def channel_from_dict(entry: Table) -> Channel:
    """Create a channel from the result of `channel_to_dict`; entries of earlier versions have no unit.

    Raises:
        ValueError: an unknown kind, or another unit than that of the kind.
        TypeError: the name or description is no text.
    """
    channel = Channel(checked_text(entry["name"]), Kind(entry["kind"]), checked_text(entry["description"]))
    unit = entry.get("unit", channel.unit)
    if unit != channel.unit:
        raise ValueError(f"channel '{channel.name[:80]}' is in {str(unit)[:20]}, {channel.unit} must hold")
    return channel


def checked_text(value: object) -> str:
    """Return a text of a header after a check.

    Raises:
        TypeError: something else, or a text of more than `MOST_TEXT` characters.
    """
    if not isinstance(value, str) or len(value) > MOST_TEXT:
        raise TypeError(f"{str(value)[:40]!r} stands where a text must be")
    return value


def _check_rate(rate_hz: object) -> None:
    """Raise ValueError if a sampling rate (Hz) is not above 0 and at most 1e6."""
    if not RATE.holds(rate_hz):
        raise ValueError(f"its rate_hz is {str(rate_hz)[:40]}; {RATE.rule('rate_hz')} must hold")


def _formats(plain: Any) -> dict[str, int]:
    formats = object_with(plain, (), "its formats")
    # A bool is an int in Python; JSON's true is no format.
    wrong = [name for name, frac in formats.items() if isinstance(frac, bool) or not isinstance(frac, int)]
    wrong += [name for name, frac in formats.items() if name not in wrong and abs(frac) > MAX_BITS]
    if wrong:
        raise ValueError(f"the format of '{wrong[0][:40]}' is no integer of at most {MAX_BITS} bits")
    return formats


def _fill(predictor: Predictor, tensors: Mapping[str, torch.Tensor]) -> None:
    """Load weights into a network after a check of names, shapes, types, finiteness and positive widths."""
    # A missing weight would keep a random start, an additional one belongs to another network.
    # Widths divide and multiply; zero or negative ones would turn predictions over without an error.
    rules = {
        name: ArrayRule(
            tuple(tensor.shape), tensor.numpy().dtype, POSITIVE if name in SCALES else -np.inf, is_exact=True
        )
        for name, tensor in predictor.state_dict().items()
    }
    checked_arrays({name: tensor.numpy() for name, tensor in tensors.items()}, rules, "its weights")
    predictor.load_state_dict(dict(tensors))


def _adaptation(entry: Table, task: Task, path: Path) -> Adaptation:
    adaptation = Adaptation.from_dict(entry, load_arrays(read_arrays(path, entry["arrays"])))
    if (len(adaptation.offset), len(adaptation.columns), adaptation.horizons) != (
        len(task.inputs),
        len(task.targets),
        task.horizons,
    ):
        raise ValueError("its adaptation belongs to another task")
    if adaptation.rate_hz != task.rate_hz:
        raise ValueError("its adaptation belongs to a task of another rate")
    return adaptation


def _check_schema(header: Table, path: Path) -> None:
    schema = header["schema"]
    # 1.0 and true equal 1 in Python; neither is a schema.
    if schema in (SCHEMA, INTEGER_SCHEMA, ADAPTED_SCHEMA) and not isinstance(schema, bool | float):
        return
    integer = isinstance(schema, int) and not isinstance(schema, bool)
    if integer and schema > ADAPTED_SCHEMA:
        advice = "install a newer EDP"
    elif integer and schema in UNHASHED:
        advice = (
            "its header has no hash yet: train again, or, where you know that nobody changed it, call "
            "edp.training.upgrade_bundle with the folder"
        )
    elif integer and schema in REWORDED:
        advice = "call edp.training.upgrade_bundle with the folder, which renames keys and leaves the network as it is"
    else:
        advice = "train again" if integer and 0 < schema < SCHEMA else "the header is not that of a bundle"
    raise BundleError(
        f"bundle '{path}' has schema {str(schema)[:40]}, this version of EDP ({__version__}) reads {SCHEMA} to "
        f"{ADAPTED_SCHEMA}; {advice}"
    )


def read_arrays(path: Path, entry: Mapping[str, str]) -> bytes:
    """Read a file of arrays named in a header, and check its digest."""
    file = path / Path(checked_text(entry["file"])).name  # never a path out of the bundle
    if not is_entry_at(file):
        raise BundleError(f"bundle '{path}' lacks its weights '{file.name}'; restore the bundle")
    data = read_bytes(file, ARRAYS_BYTES, f"weights '{file}'", BundleError)
    if digest_of_bytes(data) != entry["blake2b"]:
        raise BundleError(f"weights '{file}' do not match their digest: cut off or changed; restore the bundle")
    return data


def blank_scaler(task: Task) -> Scaler:
    """Return a placeholder scaler of the right shape; the weights file holds the fitted values."""
    features, shape = len(task.features.features), (len(task.horizons), len(task.targets))
    return Scaler(np.zeros(features), np.ones(features), np.zeros(shape), np.ones(shape))
