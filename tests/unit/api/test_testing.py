"""The contracts that ship: they pass parts that hold them, and name what a broken one breaks."""

import dataclasses
import json
import subprocess
import sys
from typing import ClassVar

import numpy as np
import pytest
import torch
from torch import nn

import edp
from edp.config.experiment import load_experiment, plain_tree
from edp.errors import ConfigError, DataError, ExportError
from edp.export import TARGETS
from edp.logs.formats.base import RawLog, RawSignal, holds_truth_apart
from edp.networks.blocks import BLOCKS
from edp.networks.blocks.base import BlockSlot
from edp.networks.losses import LOSSES
from edp.networks.losses.base import Penalty
from edp.networks.streaming import Cost, Streaming
from edp.registry import Registry
from edp.signals import Kind
from edp.workflows.search.modules import MODULES, add_modules, fitting


def entered(monkeypatch, registry: Registry, name: str, part: object) -> object:
    """A part of a third party, registered for one test."""
    monkeypatch.setitem(registry._parts, name, part)
    return part


class Gain(Streaming):
    """Channels times a weight each."""

    def __init__(self, width):
        super().__init__()
        self.weight = nn.Parameter(torch.ones(width))

    def initial_state(self, batch, like):
        return ()

    def forward(self, x, state):
        return x * self.weight, ()

    def costs(self):
        width = len(self.weight)
        return [Cost("gain", width, width_in=width, width_out=width)]

    def lower(self, build, x):
        from edp.ir.layers import ScaleShift

        return build.add(ScaleShift, "gain", x, gain=self.weight, shift=torch.zeros_like(self.weight))


class PeeksAhead(Gain):
    def forward(self, x, state):
        return (x + torch.cat([x[:, 1:], x[:, -1:]], dim=1)) * self.weight, ()


class MeetsNeighbours(Gain):
    def forward(self, x, state):
        return x * self.weight + 0.1 * x.mean(dim=0, keepdim=True), ()


class Miscounts(Gain):
    def costs(self):
        return [Cost("gain", 1, width_in=1, width_out=1)]


class Silent(Gain):
    def forward(self, x, state):
        return torch.tanh(x) * self.weight, ()


class Unreached(Gain):
    def forward(self, x, state):
        return x * self.weight.detach(), ()


def block_of(module):
    @dataclasses.dataclass(frozen=True)
    class GainSpec:
        strength: float = 1.0
        slot: ClassVar[BlockSlot] = BlockSlot.CHANNELS
        space: ClassVar[dict[str, object]] = {"strength": [1.0, 2.0]}

        def build(self, width, window):
            return module(width)

    return GainSpec


def test_a_sound_block_of_a_third_party_passes(monkeypatch):
    edp.testing.check_block(entered(monkeypatch, BLOCKS, "gain", block_of(Gain)))
    # A search screens it, with its options, and nothing but the registration told it so.
    assert MODULES["gain"].options == {"strength": [1.0, 2.0]}
    settings = plain_tree(load_experiment(None, "quick", ["model.blocks=[]"]))
    assert fitting(settings)[-1] == "gain"
    assert add_modules(settings, ["gain"])["model"]["blocks"] == [{"kind": "gain"}]


@pytest.mark.parametrize(
    ("module", "message"),
    [
        (PeeksAhead, "a later tick changes an earlier prediction"),
        (MeetsNeighbours, "(streams of a batch|a stream remembers)"),
        (Miscounts, "the parts count .* parameters, the network has"),
        (Silent, "declared operations differ.*tanh is not declared"),
        (Unreached, r"the error does not reach 'backbone.*weight'"),
    ],
)
def test_a_broken_block_is_told_by_what_it_breaks(monkeypatch, module, message):
    block = entered(monkeypatch, BLOCKS, "gain", block_of(module))
    with pytest.raises(edp.testing.ContractError, match=f"block 'gain' .*: {message}"):
        edp.testing.check_block(block)


def test_a_block_is_registered_frozen_and_has_defaults(monkeypatch):
    with pytest.raises(ConfigError, match="not a registered block"):
        edp.testing.check_block(block_of(Gain))

    @dataclasses.dataclass
    class Thawed:
        slot: ClassVar[BlockSlot] = BlockSlot.CHANNELS
        space: ClassVar[dict[str, object]] = {}
        strength: float = 1.0

    with pytest.raises(edp.testing.ContractError, match="is not frozen"):
        edp.testing.check_block(entered(monkeypatch, BLOCKS, "gain", Thawed))


def test_a_space_names_options_that_exist(monkeypatch):
    block = block_of(Gain)
    block.space = {"strenght": [1.0]}
    with pytest.raises(edp.testing.ContractError, match="its space names 'strenght', which is no option of it"):
        edp.testing.check_block(entered(monkeypatch, BLOCKS, "gain", block))


@pytest.mark.parametrize("sound", [True, False])
def test_a_loss_is_least_at_a_perfect_prediction(monkeypatch, sound):
    @dataclasses.dataclass(frozen=True)
    class Quartic(Penalty):
        def penalty(self, error):
            return error.square().square() if sound else (error - 0.3).square()

    loss = entered(monkeypatch, LOSSES, "quartic", Quartic)
    if sound:
        edp.testing.check_loss(loss)
    else:
        with pytest.raises(edp.testing.ContractError, match=r"loss 'quartic', .*: an error of .* less loss"):
            edp.testing.check_loss(loss)


class PlainText:
    """A format of a third party: a header in JSON, then numbers."""

    name, suffixes, content = "plain", (".plain",), "text"

    def __init__(self, digits=9, crash=False):
        self.digits, self.crash = digits, crash

    def claims(self, head):
        return head.startswith(b'{"plain"')

    def write(self, recording, path, options):
        facts = {"plain": recording.name, "rate": recording.rate_hz, "rows": recording.samples}
        facts["channels"] = [(c.name, str(c.kind)) for c in recording.channels]
        rows = "\n".join(" ".join(f"{x:.{self.digits}g}" for x in row) for row in recording.values)
        path.write_text(f"{json.dumps(facts)}\n{rows}\n")

    def read(self, path, signal_map):
        try:
            header, *rows = path.read_text().splitlines()
            facts = json.loads(header)
            values = np.array([[float(x) for x in row.split()] for row in rows])
            if values.shape != (facts["rows"], len(facts["channels"])):
                raise ValueError("rows are missing")
        except ValueError as error:
            if self.crash:
                raise
            raise DataError(f"'{path}' is damaged: {error}") from error
        signals = {
            name: RawSignal(name, lambda i=i: values[:, i], len(values), kind=Kind(kind))
            for i, (name, kind) in enumerate(facts["channels"])
        }
        return RawLog(path, signals, rate_hz=facts["rate"], name=facts["plain"])


def test_a_sound_format_of_a_third_party_passes():
    edp.testing.check_log_format(PlainText())
    assert not holds_truth_apart(PlainText())


@pytest.mark.parametrize(
    ("form", "message"),
    [
        (PlainText(digits=4), "values are not those that were written"),
        (PlainText(crash=True), "answers a file that is cut off after 0 of .* bytes with ValueError"),
    ],
)
def test_a_broken_format_is_told_by_what_it_breaks(form, message):
    with pytest.raises(edp.testing.ContractError, match=message):
        edp.testing.check_log_format(form)


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("sound", ""),
        ("untidy", "leaves files behind a refusal"),
        ("unnamed", "takes the name ''"),
        ("empty", "is empty"),
    ],
)
def test_an_export_target_writes_or_refuses_and_checks_names(monkeypatch, how, message):
    class WeightsTarget:
        def write(self, bundle, name, folder):
            folder.mkdir(parents=True, exist_ok=True)
            file = folder / "weights.txt"
            if how == "untidy":
                file.write_text("")
                raise ExportError("not this one")
            if how != "unnamed" and (not name.isidentifier() or not name.islower() or len(name) > 40):
                raise ExportError(f"the name {name!r} cannot be")
            file.write_text("" if how == "empty" else str(bundle.predictor.graph().parameters))
            return [file]

    target = entered(monkeypatch, TARGETS, "weights", WeightsTarget)
    if not message:
        edp.testing.check_export_target(target)
    else:
        with pytest.raises(edp.testing.ContractError, match=message):
            edp.testing.check_export_target(target)


def test_the_contracts_need_no_test_runner():
    program = "import sys, edp; edp.testing.check_block; sys.exit('pytest' in sys.modules)"
    subprocess.run([sys.executable, "-c", program], check=True)
