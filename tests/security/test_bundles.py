"""A stranger's or a damaged bundle is refused with one message, before its sizes are taken for memory."""

import hashlib
import json
import os

import numpy as np
import pytest
import torch
from safetensors.numpy import save as save_arrays
from safetensors.torch import load, save

from edp.data.features import FeatureSet
from edp.data.task import TargetMode, Task
from edp.errors import BundleError
from edp.networks.backbones import CommitteeSpec, HybridSpec, TcnSpec
from edp.networks.heads import MlpHead
from edp.networks.predictor import ModelSpec, build_model
from edp.settings.provenance import Provenance
from edp.signals import Channel, Kind
from edp.training.bundle import (
    HASH,
    HEADER,
    REWORDED,
    SCHEMA,
    UNHASHED,
    Bundle,
    blank_scaler,
    content_digest,
    load_bundle,
    save_bundle,
    upgrade_bundle,
    weights_digest,
)

NAMES = ("lever", "pressure", "speed")


def bundle_of(backbone):
    task = Task(FeatureSet("own", NAMES), ("speed",), (1, 5), TargetMode.DELTA, 100.0)
    spec = ModelSpec(backbone=backbone, head=MlpHead(hidden=4), window=8)
    predictor = build_model(task, spec, blank_scaler(task), seed=1).eval()
    kinds = (Kind.CONTROL, Kind.PRESSURE, Kind.VELOCITY) if hasattr(Kind, "CONTROL") else (Kind.GENERIC,) * 3
    inputs = tuple(Channel(name, kind) for name, kind in zip(NAMES, kinds, strict=True))
    return Bundle(
        predictor, inputs, (Kind.VELOCITY,), ("how fast",), Provenance(seconds=1.0, more={"by": {10: "a", 9: "b"}}), {}
    )


@pytest.fixture
def folder(tmp_path):
    return save_bundle(bundle_of(HybridSpec(channels=(4,), kernel=2, units=4)), tmp_path / "bundle")


def header_of(folder):
    return json.loads((folder / HEADER).read_text())


def changed(folder, change, hashed):
    """Change a header in place; with `hashed` the hash is made to fit, as somebody who means it would do."""
    header = header_of(folder)
    change(header)
    (folder / HEADER).write_text(json.dumps(header | ({HASH: content_digest(header)} if hashed else {})))


def refused(folder, match):
    with pytest.raises(BundleError, match=match) as caught:
        load_bundle(folder)
    assert len(str(caught.value)) < 1000


def swap(header):
    header["inputs"][0], header["inputs"][1] = header["inputs"][1], header["inputs"][0]


def swap_everywhere(header):
    swap(header)
    channels = header["task"]["features"]["channels"]
    channels[0], channels[1] = channels[1], channels[0]


def put(*path_and_value):
    *path, last, value = path_and_value

    def change(header):
        for part in path:
            header = header[part]
        header[last] = value

    return change


SLIPS = {
    "inputs swapped": swap,
    "inputs and channels swapped": swap_everywhere,
    "kind": put("outputs", 0, "kind", "pressure"),
    "rate": put("task", "rate_hz", 50.0),
    "rate negative": put("task", "rate_hz", -100.0),
    "window": put("model", "window", 9),
    "horizons": put("task", "horizons", [1, 6]),
    "target renamed": put("outputs", 0, "name", "other"),
    "mode": put("task", "mode", "absolute"),
    "provenance": put("provenance", "seconds", 2.0),
    "scores": put("scores", {"1": 0.0}),
    "no hash": lambda header: header.pop(HASH),
}


def test_a_whole_bundle_loads(folder):
    loaded = load_bundle(folder)
    assert loaded.task.inputs == NAMES
    assert loaded.provenance.to_table() == {"seconds": 1.0, "by": {"10": "a", "9": "b"}}


@pytest.mark.parametrize("slip", SLIPS)
def test_any_change_of_the_header_is_seen(folder, slip):
    changed(folder, SLIPS[slip], hashed=False)
    refused(folder, "does not match its hash")


MEANT = {
    "inputs swapped": swap,
    "unit": put("inputs", 0, "unit", "furlong"),
    "rate 0": put("task", "rate_hz", 0),
    "rate negative": put("task", "rate_hz", -100.0),
    "rate NaN": put("task", "rate_hz", "nan"),
    "rate infinite": put("task", "rate_hz", "inf"),
    "rate huge": put("task", "rate_hz", 1e300),
    "rate a list": put("task", "rate_hz", []),
    "window 0": put("model", "window", 0),
    "window huge": put("model", "window", 10**12),
    "window a text": put("model", "window", "8"),
    "window none": put("model", "window", None),
    "units huge": put("model", "backbone", "units", 10**9),
    "units negative": put("model", "backbone", "units", -4),
    "units other": put("model", "backbone", "units", 5),
    "units a list": put("model", "backbone", "units", [4]),
    "kernel huge": put("model", "backbone", "kernel", 10**9),
    "channels many": put("model", "backbone", "channels", [4] * 100_000),
    "channels wide": put("model", "backbone", "channels", [10**9]),
    "head huge": put("model", "head", "hidden", 10**12),
    "horizons": put("task", "horizons", [10**12]),
    "horizons many": put("task", "horizons", list(range(1, 100_001))),
    "horizons a text": put("task", "horizons", "15"),
    "no horizons": put("task", "horizons", []),
    "unknown block": put("model", "blocks", [{"kind": "nothing"}]),
    "blocks many": put("model", "blocks", [{"kind": "squeeze_excitation", "reduction": 2}] * 10_000),
    "blocks a number": put("model", "blocks", 7),
    "model a list": put("model", []),
    "task none": put("task", None),
    "inputs many": put("inputs", [{"name": "a", "kind": "generic", "unit": "1", "description": ""}] * 100_000),
    "channel names many": put("task", "features", "channels", [str(n) for n in range(100_000)]),
    "input a number": put("inputs", 0, 5),
    "name a number": put("inputs", 0, "name", 5),
    "description a list": put("outputs", 0, "description", []),
    "weights none": put("weights", None),
    "weights a number": put("weights", "file", 5),
    "weights of elsewhere": put("weights", "file", "/dev/zero"),
    "provenance a list": put("provenance", []),
    "scores none": put("scores", None),
    "number format without integers": put("number_format", "w8a16"),
    "schema true": put("schema", True),
    "schema 5.0": put("schema", 5.0),
    "schema of another kind": put("schema", 7),
}


@pytest.mark.parametrize("attack", MEANT)
def test_values_that_cannot_be_are_refused_though_the_hash_fits(folder, attack):
    changed(folder, MEANT[attack], hashed=True)
    refused(folder, "bundle")


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir, lambda path: path.symlink_to("/dev/zero")])
@pytest.mark.parametrize("which", ["header", "weights"])
def test_a_pipe_folder_or_device_is_not_read(folder, which, make):
    file = folder / HEADER if which == "header" else next(folder.glob("weights-*"))
    file.unlink()
    make(file)
    refused(folder, "a regular file must be there")


def test_a_header_without_end_is_refused_by_its_size(folder):
    with (folder / HEADER).open("ab") as stream:
        stream.truncate(10**10)
    refused(folder, "at most 67,108,864")


def test_weights_without_end_are_refused_by_their_size(folder):
    with next(folder.glob("weights-*")).open("ab") as stream:
        stream.truncate(10**12)
    refused(folder, "at most 1,073,741,824")


def reweighted(folder, change):
    """Change the weights in place; hashes are made to fit."""
    file = next(folder.glob("weights-*"))
    tensors = load(file.read_bytes())
    change(tensors)
    data = save(tensors)
    file.write_bytes(data)
    changed(folder, put("weights", "blake2b", hashlib.blake2b(data, digest_size=16).hexdigest()), hashed=True)


def first(tensors, ending):
    return next(name for name in tensors if name.endswith(ending))


def spoil(ending, value):
    def change(tensors):
        tensors[first(tensors, ending)].view(-1)[0] = value

    return change


def resize(ending, shape):
    def change(tensors):
        name = first(tensors, ending)
        tensors[name] = torch.zeros(shape, dtype=tensors[name].dtype)

    return change


def replace(change_one):
    def change(tensors):
        name = first(tensors, "front.width")
        tensors[name] = change_one(tensors[name])

    return change


@pytest.mark.parametrize(
    "change",
    [
        spoil("weight", float("nan")),
        spoil("weight", float("inf")),
        spoil("front.offset", float("nan")),
        spoil("front.width", 0.0),
        spoil("code.width", -1.0),
        replace(lambda one: one.double()),
        replace(lambda one: one[:-1].clone()),
        replace(lambda one: torch.zeros(0)),
        lambda tensors: tensors.pop(first(tensors, "front.width")),
        lambda tensors: tensors.update(more=torch.ones(1)),
    ],
)
def test_weights_that_are_not_those_of_the_header_are_refused(folder, change):
    reweighted(folder, change)
    refused(folder, "its weights: array '.*: got .*, expected")


@pytest.fixture
def folder_with_trees(tmp_path):
    return save_bundle(bundle_of(CommitteeSpec(lags=(1,), members=1, units=2, trees=2, tree_depth=2)), tmp_path)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (spoil("trees.feature", 6), "a node reads column 6; 0 to 5 must hold"),
        (spoil("trees.feature", -1), "a node reads column -1; 0 to 5 must hold"),
        (spoil("trees.feature", 2**40), "a node reads column 1099511627776; 0 to 5"),
        (spoil("trees.threshold", float("nan")), "threshold': got nan at"),
        (spoil("trees.leaf", float("inf")), "leaf': got inf at"),
        (resize("trees.threshold", (2, 2, 7)), r"threshold': got .* \(2, 2, 7\), expected .* \(2, 2, 3\)"),
        (resize("trees.leaf", (2, 1, 4)), r"leaf': got .* \(2, 1, 4\), expected .* \(2, 2, 4\)"),
    ],
)
def test_tables_of_trees_that_cannot_be_are_refused(folder_with_trees, change, match):
    assert load_bundle(folder_with_trees).predictor.backbone.trees.depth == 2
    reweighted(folder_with_trees, change)
    refused(folder_with_trees, match)


@pytest.mark.parametrize(("key", "value"), [("trees", 2001), ("trees", -1), ("tree_depth", 9), ("tree_depth", 0)])
def test_trees_beyond_their_bounds_are_refused(folder_with_trees, key, value):
    changed(folder_with_trees, put("model", "backbone", key, value), hashed=True)
    refused(folder_with_trees, f"{key} = {value}; integers, .* must hold")


def test_a_safetensors_header_that_lies_is_refused(folder):
    file = next(folder.glob("weights-*"))
    for data in (
        (1 << 60).to_bytes(8, "little") + b"{}",
        (2).to_bytes(8, "little") + b"{}",
        b"",
        save_arrays({"a": np.ones(3, np.float32)})[:-1],
    ):
        file.write_bytes(data)
        digest = hashlib.blake2b(data, digest_size=16).hexdigest()
        changed(folder, put("weights", "blake2b", digest), hashed=True)
        refused(folder, "is damaged")


def test_a_network_that_its_weights_cannot_fill_is_refused(tmp_path):
    folder = save_bundle(bundle_of(TcnSpec(channels=(4, 4), kernel=3)), tmp_path)
    changed(folder, put("model", "backbone", "channels", [400, 400]), hashed=True)
    refused(folder, "its weights: array '.*: got .*, expected")


@pytest.mark.parametrize("schema", UNHASHED)
def test_a_bundle_from_before_the_hash_is_upgraded_when_asked(folder, schema):
    def older(header):
        header.pop(HASH)
        header["schema"] = schema

    whole = load_bundle(folder)
    changed(folder, older, hashed=False)
    before = (folder / HEADER).read_bytes()
    refused(folder, rf"schema {schema}, .*upgrade_bundle")
    if UNHASHED[schema] != SCHEMA:  # says that it has integers or an adaptation, and has none
        with pytest.raises(BundleError, match="it lacks"):
            upgrade_bundle(folder)
        assert (folder / HEADER).read_bytes() == before
        return
    upgrade_bundle(folder)
    assert load_bundle(folder).task == whole.task
    with pytest.raises(BundleError, match="nothing to upgrade"):
        upgrade_bundle(folder)


@pytest.mark.parametrize("schema", REWORDED)
def test_a_bundle_of_the_former_words_says_how_it_is_upgraded(folder, schema):
    def older(header):
        header["schema"] = schema
        header["provenance"] = {"seconds": 1.0, "lesson": {"kind": "few"}, "by": {"lesson": "of another kind"}}

    weights = weights_digest(load_bundle(folder).predictor)
    changed(folder, older, hashed=True)
    refused(folder, rf"schema {schema}, .*upgrade_bundle with the folder, which renames keys")
    before = (folder / HEADER).read_bytes()
    if REWORDED[schema] != SCHEMA:  # says that it has integers or an adaptation, and has none
        with pytest.raises(BundleError, match="it lacks"):
            upgrade_bundle(folder)
        assert (folder / HEADER).read_bytes() == before
        return
    upgrade_bundle(folder)
    bundle = load_bundle(folder)
    assert weights_digest(bundle.predictor) == weights
    assert bundle.provenance.to_table() == {
        "seconds": 1.0,
        "strategy": {"kind": "few"},
        "by": {"lesson": "of another kind"},
    }
    with pytest.raises(BundleError, match="nothing to upgrade"):
        upgrade_bundle(folder)


def test_a_bundle_of_the_former_words_that_was_edited_is_not_upgraded(folder):
    changed(folder, put("schema", 5), hashed=True)
    changed(folder, put("provenance", "lesson", {}), hashed=False)
    header = header_of(folder)
    (folder / HEADER).write_text(json.dumps(header | {HASH: "0" * 32}))
    before = (folder / HEADER).read_bytes()
    with pytest.raises(BundleError, match="does not match its hash"):
        upgrade_bundle(folder)
    assert (folder / HEADER).read_bytes() == before
