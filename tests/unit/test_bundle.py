import errno
import hashlib
import json
import os
from dataclasses import replace

import numpy as np
import pytest
import torch

from edp.errors import BundleError, StorageError
from edp.networks.outputs import OUTPUTS
from edp.networks.predictor import Predictor, build_model
from edp.networks.running import stream_intervals, stream_predictions
from edp.settings.provenance import Provenance
from edp.signals import Channel, Kind
from edp.training.bundle import (
    ADAPTED_SCHEMA,
    HASH,
    HEADER,
    Bundle,
    content_digest,
    load_bundle,
    make_bundle,
    save_bundle,
)


def network(tiny, model, seed=1):
    predictor = build_model(tiny.task, model, tiny.scaler(), seed).eval()
    with torch.no_grad():
        for parameter in predictor.parameters():
            parameter.add_(0.1)
    return predictor


@pytest.fixture
def folder(tmp_path, tiny, tiny_bypass):
    return save_bundle(
        make_bundle(network(tiny, tiny_bypass), tiny, Provenance(seed=1), {"score": 0.5}), tmp_path / "b"
    )


def predictions(predictor, tiny):
    return stream_predictions(predictor, tiny.test)[0]


def test_a_round_trip_predicts_the_same_bits(folder, tiny, tiny_bypass):
    loaded = load_bundle(folder)
    wanted = predictions(network(tiny, tiny_bypass), tiny)
    np.testing.assert_array_equal(predictions(loaded.predictor, tiny), wanted)
    assert isinstance(loaded.predictor, Predictor)
    assert loaded.task == tiny.task
    assert loaded.predictor.spec == tiny_bypass
    assert loaded.inputs == tiny.inputs
    assert loaded.target_kinds == tiny.target_kinds
    assert loaded.descriptions == tiny.descriptions
    assert (loaded.provenance, loaded.scores) == (Provenance(seed=1), {"score": 0.5})


def test_every_structure_survives_a_round_trip(structure, predictor_of, tmp_path, tiny):
    predictor = predictor_of(structure, dtype=torch.float32)
    inputs = tuple(Channel(name, Kind.GENERIC) for name in predictor.task.inputs)
    save_bundle(Bundle(predictor, inputs, (Kind.VELOCITY,) * 2, ("", "")), tmp_path)
    loaded = load_bundle(tmp_path).predictor
    assert (loaded.task, loaded.spec) == (predictor.task, predictor.spec)
    x = torch.randn(1, 15, predictor.front.inputs)
    with torch.no_grad():
        found = loaded.predict(x, loaded.initial_state(1, x))[0]
        assert torch.equal(found, predictor.predict(x, predictor.initial_state(1, x))[0])


@pytest.mark.parametrize("output", [name for name in OUTPUTS if OUTPUTS[name]().coverages])
def test_calibrated_intervals_survive_a_round_trip(output, tmp_path, tiny, tiny_model):
    predictor = network(tiny, replace(tiny_model, output=OUTPUTS[output]()))
    predictor.output.stretch.uniform_(0.5, 2.0)
    loaded = load_bundle(save_bundle(make_bundle(predictor, tiny), tmp_path)).predictor
    wanted, found = (stream_intervals(net, tiny.test)[0] for net in (predictor, loaded))
    np.testing.assert_array_equal(found, wanted)
    assert loaded.spec.output == predictor.spec.output


def test_a_bundle_from_before_outputs_had_kinds_says_points(folder):
    header = json.loads((folder / HEADER).read_text())
    assert header["model"].pop("output") == {"kind": "point"}
    edit(folder, model=header["model"])
    assert load_bundle(folder).predictor.spec.output == OUTPUTS["point"]()


def test_a_run_folder_opens_its_bundle(tmp_path, tiny, tiny_model):
    save_bundle(make_bundle(network(tiny, tiny_model), tiny), tmp_path / "bundle")
    assert load_bundle(tmp_path).task == tiny.task


def test_saving_again_replaces_header_and_weights(folder, tiny, tiny_bypass):
    other = network(tiny, tiny_bypass, seed=2)
    save_bundle(make_bundle(other, tiny), folder)
    assert len(list(folder.iterdir())) == 2
    np.testing.assert_array_equal(predictions(load_bundle(folder).predictor, tiny), predictions(other, tiny))


def edit(folder, **changes):
    header = json.loads((folder / HEADER).read_text()) | changes
    (folder / HEADER).write_text(json.dumps(header | {HASH: content_digest(header)}))


def test_a_newer_schema_is_refused(folder):
    edit(folder, schema=ADAPTED_SCHEMA + 1)
    with pytest.raises(BundleError, match=rf"schema {ADAPTED_SCHEMA + 1}.*install a newer EDP"):
        load_bundle(folder)


def test_an_older_schema_is_refused(folder):
    edit(folder, schema=1)
    with pytest.raises(BundleError, match=r"schema 1, .*train again"):
        load_bundle(folder)


@pytest.mark.parametrize("schema", [None, "1", 0])
def test_what_is_no_schema_is_refused(schema, folder):
    edit(folder, schema=schema)
    with pytest.raises(BundleError, match="not that of a bundle"):
        load_bundle(folder)


@pytest.mark.parametrize("share", [0.0, 0.5, 0.999])
def test_truncated_weights_are_refused(share, folder):
    weights = next(folder.glob("weights-*"))
    data = weights.read_bytes()
    weights.write_bytes(data[: int(share * len(data))])
    with pytest.raises(BundleError, match="do not match their digest"):
        load_bundle(folder)


def test_weights_that_match_their_digest_but_are_none_are_refused(folder):
    weights = next(folder.glob("weights-*"))
    weights.write_bytes(b"nonsense")
    digest = hashlib.blake2b(b"nonsense", digest_size=16).hexdigest()
    edit(folder, weights={"file": weights.name, "blake2b": digest})
    with pytest.raises(BundleError, match="is damaged"):
        load_bundle(folder)


def test_missing_weights_a_missing_header_and_half_a_header_are_refused(folder, tmp_path):
    next(folder.glob("weights-*")).unlink()
    with pytest.raises(BundleError, match="lacks its weights"):
        load_bundle(folder)
    (folder / HEADER).write_text((folder / HEADER).read_text()[:100])
    with pytest.raises(BundleError, match="not valid JSON"):
        load_bundle(folder)
    with pytest.raises(BundleError, match=r"has no bundle\.json"):
        load_bundle(tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("part", "value"),
    [
        ("model", {}),
        ("task", {"features": 3}),
        ("inputs", [{"name": "a"}]),
        ("weights", None),
        ("outputs", [{"kind": "colour", "description": ""}]),
    ],
)
def test_headers_that_are_not_understood_are_refused(part, value, folder):
    edit(folder, **{part: value})
    with pytest.raises(BundleError):
        load_bundle(folder)


def test_a_path_out_of_the_bundle_is_not_followed(folder, tmp_path):
    weights = next(folder.glob("weights-*"))
    outside = tmp_path / weights.name
    weights.rename(outside)
    header = json.loads((folder / HEADER).read_text())
    edit(folder, weights=header["weights"] | {"file": f"../{weights.name}"})
    with pytest.raises(BundleError, match="lacks its weights"):
        load_bundle(folder)


@pytest.mark.parametrize("write", [1, 2])
def test_a_full_disk_leaves_the_old_bundle(write, folder, tiny, tiny_bypass, monkeypatch):
    before, writes = predictions(load_bundle(folder).predictor, tiny), []

    def full(handle):
        writes.append(handle)
        if len(writes) == write:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(StorageError, match="No space left on device; free space"):
        save_bundle(make_bundle(network(tiny, tiny_bypass, seed=2), tiny), folder)
    np.testing.assert_array_equal(predictions(load_bundle(folder).predictor, tiny), before)
    assert not list(folder.glob("*.tmp")) + list(folder.glob(".*.tmp"))
    monkeypatch.undo()
    save_bundle(make_bundle(network(tiny, tiny_bypass, seed=2), tiny), folder)
    assert len(list(folder.iterdir())) == 2
