"""Codes of machines: one network over many of them, and the numbers that say which one it is."""

import dataclasses

import numpy as np
import pytest
import torch

from edp.data.chunks import ChunkSampler
from edp.errors import ConfigError
from edp.ir.builder import Builder
from edp.networks.backbones import GruSpec
from edp.networks.blocks.machine_code import MachineCode
from edp.networks.predictor import build_model
from edp.networks.running import mean_error
from edp.training import load_bundle
from edp.training.delta import delta_of
from edp.training.pretraining.methods.codes import WithCodes, find_coded_block
from edp.workflows.pretraining import Pretrain, pretrain
from edp.workflows.transfer import FinetuneRequest, FinetuneSpec, finetune

pytestmark = pytest.mark.processes


@pytest.fixture(scope="module")
def fleet(machines, experiment, tmp_path_factory):
    folder = tmp_path_factory.mktemp("codes") / "run"
    training = dataclasses.replace(experiment.training, epochs=4, updates=60)
    split = dataclasses.replace(experiment.split, validation=("press-2",), test=("press-4",))
    backbone = dataclasses.replace(experiment.model.backbone, channels=(10,), units=10)
    model = dataclasses.replace(experiment.model, backbone=backbone, blocks=(MachineCode(size=2),))
    order = Pretrain(method="codes")
    pretrain(machines, dataclasses.replace(experiment, training=training, split=split, model=model), order, folder)
    return folder


def test_a_code_alone_learns_and_makes_an_unseen_machine_better(fleet, machines, tmp_path):
    spec = FinetuneSpec(single_phase_epochs=15, batch=4, check_signs=False)
    logs = dataclasses.replace(machines, path=machines.path / "press4_0.parquet")
    finetune(fleet, logs, FinetuneRequest(spec=spec, method="code"), tmp_path / "own")
    base, own = load_bundle(fleet).predictor, load_bundle(tmp_path / "own").predictor
    before, after = base.state_dict(), own.state_dict()
    assert [name for name in before if not torch.equal(before[name], after[name])] == [
        name for name in before if name.endswith("machine_code")
    ]
    other = [base.task.series(recording) for recording in machines.read() if recording.name == "press4_1"]
    assert mean_error(own, other) < 0.9 * mean_error(base, other)
    assert len(delta_of(base, own).to_bytes()) < 1500


def test_a_bundle_holds_the_network_without_the_codes_of_the_machines_that_trained(fleet):
    network = load_bundle(fleet).predictor
    assert any(isinstance(block, MachineCode) for block in network.spec.blocks)
    assert not any("table" in name for name in network.state_dict())
    assert not find_coded_block(network).machine_code.any()


def test_a_source_without_a_code_is_refused(machines, experiment, tmp_path):
    pretrain(machines, experiment, Pretrain(), tmp_path / "joint")
    with pytest.raises(ConfigError, match="reads the code of a machine"):
        finetune(tmp_path / "joint", machines, FinetuneRequest(method="code"), tmp_path / "own")


def test_a_network_without_a_place_for_the_code_is_refused(machines, experiment, tmp_path):
    gru = dataclasses.replace(experiment.model, backbone=GruSpec(units=4))
    with pytest.raises(ConfigError, match="machine_code"):
        pretrain(machines, dataclasses.replace(experiment, model=gru), Pretrain(method="codes"), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_the_block_is_gains_and_shifts_of_its_code_and_its_layer_holds_them():
    torch.manual_seed(0)
    block, x = MachineCode(size=3).build(5, 10), torch.randn(2, 7, 5)
    assert torch.equal(block(x, ())[0], x)
    with torch.no_grad():
        block.machine_code.normal_()
    gain, shift = block.scale_map @ block.machine_code, block.shift_map @ block.machine_code
    torch.testing.assert_close(block(x, ())[0], x * (1 + gain) + shift)
    codes = torch.randn(2, 3)
    block.lanes = codes
    torch.testing.assert_close(block(x, ())[0][1], x[1] * (1 + block.scale_map @ codes[1]) + block.shift_map @ codes[1])
    build = Builder(5)
    with torch.no_grad():
        block.lower(build, "input")
    layer = build.layers[-1]
    found = layer.tensors()
    np.testing.assert_allclose(found["gain"], 1 + gain.detach().numpy(), rtol=1e-6)
    np.testing.assert_allclose(found["shift"], shift.detach().numpy(), rtol=1e-6)


def test_a_stream_has_the_code_of_its_machine_or_none_from_its_start_to_its_end(prepared_machines, experiment):
    data, strategy = prepared_machines, WithCodes()
    network = build_model(
        data.task, dataclasses.replace(experiment.model, blocks=(MachineCode(size=2),)), data.scaler(), 0
    )
    series = strategy.series(data.task, data.train)
    assert [part.machine for part in series] == [part.machine for part in data.train]
    strategy.begin(network, experiment.training)
    block, seen = find_coded_block(network), set()
    table = block.table.detach().view(strategy.machines, -1)
    sampler = ChunkSampler(
        series, data.task.horizons, dataclasses.replace(experiment.training.chunks, reset_after_chunks=3), 0
    )
    unknown = None
    for batch in (batch for number in range(40) for batch in sampler.epoch(number)):
        numbers, reset = torch.from_numpy(batch.strategy_columns), torch.from_numpy(batch.reset)
        assert (numbers == numbers[:, :1]).all()
        strategy.tell(network, numbers, reset)
        without = (block.lanes == 0).all(dim=1)
        own = numbers[:, 0, 0].long()
        assert torch.equal(block.lanes[~without].detach(), table[own[~without]])
        if unknown is not None:
            assert torch.equal(without[~reset], unknown[~reset])
        unknown, seen = without, seen | {*without.tolist()}
    assert seen == {True, False}
