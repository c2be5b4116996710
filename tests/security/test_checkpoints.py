"""A checkpoint that a disk or somebody changed is refused; nothing is gone on from it."""

import json
import os

import pytest
import torch
from safetensors.torch import load, load_file, save

from edp.errors import StorageError
from edp.training import checkpoint
from edp.training.checkpoint import FILE, TrainingPosition, Weights, load_checkpoint, save_checkpoint

KEY = "0123456789abcdef"


@pytest.fixture
def file(tmp_path):
    layer = torch.nn.Linear(3, 2)
    optimizer = torch.optim.Adam(layer.parameters())
    layer(torch.ones(1, 3)).sum().backward()
    optimizer.step()
    progress = TrainingPosition(epoch=2, best_score=float("inf"), history=[{"epoch": 1, "loss": float("nan")}])
    path = tmp_path / FILE
    groups = [{name: one.detach().clone() for name, one in layer.named_parameters()} for _ in range(3)]
    save_checkpoint(path, KEY, progress, Weights(*groups, torch.ones(2)), optimizer)
    return path


def test_a_checkpoint_comes_back_and_is_plain_safetensors(file):
    progress, weights, optimizer = load_checkpoint(file, KEY)
    assert progress.epoch == 2
    assert progress.best_score == float("inf")
    assert torch.equal(weights.current["weight"], load_file(file)["current/weight"])
    assert optimizer["state"][0]["step"] == 1


def test_any_flipped_bit_is_refused(file):
    data = file.read_bytes()
    assert len(data) > 1000
    for place in range(0, len(data), 7):
        for bit in (0, 7):
            changed = bytearray(data)
            changed[place] ^= 1 << bit
            file.write_bytes(changed)
            with pytest.raises(StorageError, match=r"checkpoint .*is damaged .*remove it to train from the start"):
                load_checkpoint(file, KEY)
    file.write_bytes(data)
    assert load_checkpoint(file, KEY) is not None


def test_the_sign_of_one_weight_is_refused(file):
    data = bytearray(file.read_bytes())
    data[-1] ^= 0x80
    file.write_bytes(data)
    with pytest.raises(StorageError, match="its checksum does not fit"):
        load_checkpoint(file, KEY)


def test_one_without_a_checksum_is_refused(file):
    header = {"key": KEY, "progress": {}, "optimizer": {}}
    file.write_bytes(save({"running": torch.ones(2)}, metadata={"edp": json.dumps(header)}))
    with pytest.raises(StorageError, match="no checksum: cut off, or written by an earlier version"):
        load_checkpoint(file, KEY)


@pytest.mark.parametrize(
    "header",
    [
        "null",
        "[" * 100_000 + "]" * 100_000,
        '{"key": "KEY"}',
        '{"key": "KEY", "progress": {"epoch": 1}, "optimizer": 5}',
        '{"key": "KEY", "progress": {"schedule": {}}, "optimizer": {"state": {"a": 1}}}',
        '{"key": "KEY", "progress": {"schedule": {}}, "optimizer": {"state": {"0": {"tensor": "x", "stride": []}}}}',
        '{"key": "KEY", "progress": {"schedule": {}},'
        ' "optimizer": {"state": {"0": {"tensor": "running", "stride": [1000000000000]}}}}',
    ],
)
def test_a_hostile_header_with_the_right_checksum_is_refused(file, header):
    tensors = load(file.read_bytes())
    metadata = {"edp": header.replace("KEY", KEY), "blake2b": checkpoint.BLANK}
    file.write_bytes(checkpoint._insert_digest(save(tensors, metadata=metadata)))
    with pytest.raises(StorageError, match="is damaged"):
        load_checkpoint(file, KEY)


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir, lambda path: path.symlink_to("/dev/zero")])
def test_what_is_no_file_is_refused(tmp_path, make):
    make(tmp_path / FILE)
    with pytest.raises(StorageError, match=r"checkpoint .*a regular file must be there"):
        load_checkpoint(tmp_path / FILE, KEY)
