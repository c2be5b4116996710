"""Blocks against the thesis's equations written out tick by tick: bridge, squeeze-excitation, pooling, mixing, skip."""

import math

import numpy as np
import pytest
import torch

from edp.data.features import FeatureSet
from edp.data.scaling import Scaler
from edp.data.task import TargetMode, Task
from edp.errors import ConfigError
from edp.networks.backbones import HybridSpec
from edp.networks.blocks import BLOCKS
from edp.networks.blocks.base import OutputSpace
from edp.networks.heads import HEADS, MlpHead
from edp.networks.predictor import ModelSpec, build_model
from edp.networks.trailing import StreamingTrailingMean


@pytest.fixture(autouse=True)
def seed():
    torch.manual_seed(6)


def run(module, x, state=None):
    module = module.double().eval()
    with torch.no_grad():
        return module(x, module.initial_state(len(x), x) if state is None else state)[0]


def draw(*shape):
    return torch.randn(*shape, dtype=torch.float64)


def shaken(module):
    """Weights off their starting values, so that biases and norms take part."""
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.add_(0.3 * torch.randn(parameter.shape))
    return module.double()


def norm(x, layer):
    return (x - x.mean()) / torch.sqrt(((x - x.mean()) ** 2).mean() + 1e-5) * layer.weight + layer.bias


def gelu(x):
    return x * 0.5 * (1 + torch.erf(x / math.sqrt(2)))


@pytest.mark.long
@pytest.mark.parametrize(("window", "ticks", "heads"), [(1, 6, 2), (5, 3, 1), (5, 14, 2), (40, 200, 4)])
def test_the_bridge_is_eq_3_10_and_3_11_over_the_trailing_window(window, ticks, heads):
    width = 8
    bridge, r = shaken(BLOCKS["attention_bridge"](heads=heads).build(width, window)), draw(2, ticks, width)
    found = run(bridge, r)
    with torch.no_grad():
        for b in range(2):
            rows = [bridge.project(norm(r[b, t], bridge.norm_attention)) for t in range(ticks)]
            for t in {0, 1, ticks // 2, ticks - 1}:
                past, gathered = range(max(0, t - window + 1), t + 1), []
                for head in range(heads):
                    at = slice(head * width // heads, (head + 1) * width // heads)
                    q = rows[t][:width][at]
                    scores = [q @ rows[s][width : 2 * width][at] / math.sqrt(width / heads) for s in past]
                    shares = [math.exp(score) for score in scores]
                    values = [rows[s][2 * width :][at] for s in past]
                    total = sum(shares)
                    gathered.append(sum(share / total * value for share, value in zip(shares, values, strict=True)))
                middle = r[b, t] + bridge.gather(torch.cat(gathered))
                wanted = middle + bridge.narrow(gelu(bridge.widen(norm(middle, bridge.norm_feed))))
                torch.testing.assert_close(found[b, t], wanted, rtol=0, atol=1e-11)


def test_the_last_tick_of_the_bridge_is_that_of_self_attention_over_the_whole_window():
    """The thesis's form: every row of the window attends to every row. PyTorch's layer is the judge."""
    width, window, heads = 8, 12, 4
    bridge, r = shaken(BLOCKS["attention_bridge"](heads=heads).build(width, window)), draw(3, window, width)
    judge = torch.nn.TransformerEncoderLayer(
        width, heads, 2 * width, dropout=0.0, activation="gelu", batch_first=True, norm_first=True
    ).double()
    pairs = {
        "self_attn.in_proj_weight": bridge.project.weight,
        "self_attn.in_proj_bias": bridge.project.bias,
        "self_attn.out_proj.weight": bridge.gather.weight,
        "self_attn.out_proj.bias": bridge.gather.bias,
        "linear1.weight": bridge.widen.weight,
        "linear1.bias": bridge.widen.bias,
        "linear2.weight": bridge.narrow.weight,
        "linear2.bias": bridge.narrow.bias,
        "norm1.weight": bridge.norm_attention.weight,
        "norm1.bias": bridge.norm_attention.bias,
        "norm2.weight": bridge.norm_feed.weight,
        "norm2.bias": bridge.norm_feed.bias,
    }
    judge.load_state_dict(pairs)
    assert sum(p.numel() for p in judge.parameters()) == sum(p.numel() for p in bridge.parameters())
    whole = run(bridge, r)
    with torch.no_grad():
        wanted = judge.train()(r)
    torch.testing.assert_close(whole[:, -1], wanted[:, -1], rtol=0, atol=1e-11)
    assert not torch.allclose(whole[:, 0], wanted[:, 0], atol=1e-3)


def test_heads_that_do_not_divide_the_channels_are_refused():
    with pytest.raises(ConfigError, match=r"heads = 4 do not divide the 6 channels.*\[1, 2, 3, 6\]"):
        BLOCKS["attention_bridge"](heads=4).build(6, 10)


def trailing(x, window):
    """Mean over the last `window` rows, tick by tick."""
    return torch.stack([x[:, max(0, t - window + 1) : t + 1].mean(dim=1) for t in range(x.shape[1])], dim=1)


@pytest.mark.parametrize("window", [1, 2, 7, 50])
@pytest.mark.parametrize("ticks", [1, 6, 7, 8, 133])
def test_the_trailing_mean_is_the_mean_of_the_last_ticks(window, ticks):
    x = draw(2, ticks, 3)
    torch.testing.assert_close(run(StreamingTrailingMean(3, window), x), trailing(x, window), rtol=0, atol=1e-13)


def test_the_trailing_mean_stays_exact_over_hours():
    """Three hours at 100 Hz in single precision: a far offset and a burst of huge values leave no trace behind."""
    layer = StreamingTrailingMean(1, 50)
    x = torch.sin(torch.arange(5_000, dtype=torch.float32) / 30)[None, :, None] + 100.0
    state = layer.initial_state(1, x)
    burst = x.clone()
    burst[:, 100:110] = 1e12
    for piece in [burst] + [x] * 215:
        y, state = layer(piece, state)
    wanted = trailing(torch.cat([x, x], dim=1).double(), 50)[:, 5_000:]
    assert (y.double() - wanted).abs().max() < 2e-5  # one rounding of 100 is 4e-6


@pytest.mark.parametrize(("reduction", "bottleneck"), [(2, 3), (4, 1), (8, 1)])
def test_squeeze_excitation_is_eq_3_17_and_3_18_over_the_trailing_window(reduction, bottleneck):
    block, u = BLOCKS["squeeze_excitation"](reduction=reduction).build(6, 5), draw(2, 17, 6)
    found = run(block, u)
    w1, w2 = block.squeeze.weight.detach(), block.excite.weight.detach()
    assert w1.shape == (bottleneck, 6)
    assert sum(parameter.numel() for parameter in block.parameters()) == 2 * 6 * bottleneck
    for t in range(17):
        z = u[:, max(0, t - 4) : t + 1].mean(dim=1)
        s = 1 / (1 + torch.exp(-torch.clamp(z @ w1.T, min=0) @ w2.T))
        torch.testing.assert_close(found[:, t], s * u[:, t], rtol=0, atol=1e-12)


@pytest.mark.parametrize("width", [1, 6, 7])
def test_global_average_pooling_is_eq_3_19_projected_to_half(width):
    spec, h = BLOCKS["global_average_pooling"](), draw(2, 17, width)
    block = spec.build(width, 5)
    found = run(block, h)
    assert found.shape[-1] == spec.extra(width) == max(1, width // 2)
    wanted = trailing(h, 5) @ block.project.weight.T.detach() + block.project.bias.detach()
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-12)


def test_cross_cylinder_attention_is_eq_3_23():
    layer, c = shaken(BLOCKS["cross_cylinder_attention"]().build(5, 3)), draw(2, 4, 3, 5)
    found = run(layer, c)
    with torch.no_grad():
        for b in range(2):
            for t in range(4):
                rows = [layer.project(c[b, t, i]) for i in range(3)]
                for i in range(3):
                    shares = [math.exp(rows[i][:5] @ rows[j][5:10] / math.sqrt(5)) for j in range(3)]
                    mixed = sum(share * row[10:] for share, row in zip(shares, rows, strict=True)) / sum(shares)
                    wanted = norm(c[b, t, i] + layer.gather(mixed), layer.norm)
                    torch.testing.assert_close(found[b, t, i], wanted, rtol=0, atol=1e-12)


@pytest.mark.parametrize("gate", [(), (BLOCKS["cylinder_gate"](),)])
@pytest.mark.parametrize("head", [name for name in HEADS if name != "linear"])
def test_cross_cylinder_attention_sits_between_the_hidden_and_the_last_layer_of_the_heads(gate, head):
    task = Task(FeatureSet("two", ("a", "b")), ("a", "b"), (1, 3), TargetMode.DELTA, 100.0)
    blank = Scaler(np.zeros(2), np.ones(2), np.zeros((2, 2)), np.ones((2, 2)))
    spec = ModelSpec(
        backbone=HybridSpec(channels=(4,), units=3),
        head=HEADS[head](hidden=4),
        blocks=(*gate, BLOCKS["cross_cylinder_attention"]()),
    )
    heads = shaken(build_model(task, spec, blank, 0)).heads
    x = draw(2, 5, 2, 6) if gate else draw(2, 5, 6)
    with torch.no_grad():
        hidden = []
        for c in range(2):
            u = (x[:, :, c] if gate else x) @ heads.weights[0][c] + heads.biases[0][c]
            hidden.append(torch.relu(u) if head == "mlp" else u[..., :4] * torch.sigmoid(u[..., 4:]))
        mixed = run(heads.mix, torch.stack(hidden, dim=2))
        wanted = torch.stack([mixed[:, :, c] @ heads.weights[1][c] + heads.biases[1][c] for c in range(2)], dim=-1)
    torch.testing.assert_close(run(heads, x), wanted, rtol=0, atol=1e-12)


@pytest.mark.parametrize("layers", [1, 2])
def test_the_glu_head_is_eq_3_27(layers):
    heads, x = HEADS["glu"](hidden=5, layers=layers).build(4, 3, 2), draw(2, 6, 4)
    found = run(heads, x)
    with torch.no_grad():
        for c in range(3):
            u = x @ heads.weights[0][c] + heads.biases[0][c]
            assert u.shape[-1] == 10
            y = u[..., :5] / (1 + torch.exp(-u[..., 5:]))
            for layer in range(1, layers):
                y = torch.clamp(y @ heads.weights[layer][c] + heads.biases[layer][c], min=0)
            y = y @ heads.weights[-1][c] + heads.biases[-1][c]
            torch.testing.assert_close(found[..., c], y, rtol=0, atol=1e-12)


def test_the_velocity_skip_adds_the_present_value_in_si_units():
    """Eq. 3.24: with silent heads the prediction is the present value, whatever the scaling of both ends."""
    features = FeatureSet("three", ("lever", "v_2", "v_1"))
    task = Task(features, ("v_1", "v_2"), (1, 4), TargetMode.ABSOLUTE, 100.0)
    rng = np.random.default_rng(0)
    scaler = Scaler(
        rng.normal(size=3), rng.uniform(0.5, 2, 3), rng.normal(size=(2, 2)), rng.uniform(0.5, 2, size=(2, 2))
    )
    spec = ModelSpec(
        backbone=HybridSpec(channels=(4,), units=3), head=MlpHead(hidden=4), blocks=(BLOCKS["velocity_skip"](),)
    )
    predictor, x = build_model(task, spec, scaler, 0).double().eval(), draw(2, 9, 3)
    plain = build_model(task, ModelSpec(backbone=spec.backbone, head=spec.head), scaler, 0).double().eval()
    with torch.no_grad():
        learned = plain(x, plain.initial_state(2, x))[0]
        found = predictor.predict(x, predictor.initial_state(2, x))[0]
        now = x[:, :, None, [2, 1]]
        # The scaler's numbers are kept in single precision.
        torch.testing.assert_close(found, now + learned * predictor.code.width, rtol=0, atol=1e-6)


def test_the_velocity_skip_needs_every_target_among_the_features():
    with pytest.raises(ConfigError, match="1 of 2 targets are not features"):
        BLOCKS["velocity_skip"]().build(OutputSpace(3, 1, 2, (0, None), torch.ones(1, 2), torch.zeros(1, 2)))


@pytest.mark.parametrize("form", ["diagonal", "linear"])
def test_the_cylinder_gate_is_open_at_the_start(form):
    """Bias 4: sigmoid(4) = 0.982 (eq. 3.21, 3.22)."""
    gate = BLOCKS["cylinder_gate"](form=form).build(16, 3)
    bias = gate.bias if form == "diagonal" else gate.gate.bias
    assert torch.equal(bias, torch.full_like(bias, 4.0))
    share = run(gate, torch.zeros(1, 1, 16, dtype=torch.float64) + 1e-9) / 1e-9
    torch.testing.assert_close(share, torch.full_like(share, 0.98201379), rtol=0, atol=1e-6)


def test_the_trailing_mean_has_the_same_bits_however_a_stream_is_cut():
    layer, x = StreamingTrailingMean(2, 13), torch.randn(1, 90, 2)
    whole, _ = layer(x, layer.initial_state(1, x))
    state, pieces = layer.initial_state(1, x), []
    for piece in x.split((1, 1, 40, 7, 41), dim=1):
        y, state = layer(piece, state)
        pieces.append(y)
    assert torch.equal(torch.cat(pieces, dim=1), whole)
