"""The thesis's parameter and multiply-accumulate counts (Tables B.1, 4.8, 4.9), and the counter itself."""

from itertools import pairwise

import numpy as np
import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from edp.data.features import FG2
from edp.data.scaling import Scaler
from edp.data.task import TargetMode, Task
from edp.evaluation.footprint import footprint
from edp.networks.activations import Identity, ScaledTanh
from edp.networks.backbones import HybridSpec
from edp.networks.blocks import AttentionBridge, CylinderGate, MultiScaleTcn, TemporalDifference
from edp.networks.cells import LayerNormLstmCell, LstmCell
from edp.networks.heads import MlpHead
from edp.networks.predictor import ModelSpec, build_model

W = 50


def network(channels, kernel, head, blocks, activation=None, cell=None):
    """A hybrid network whose LSTM is as wide as its first level, in double precision."""
    spec = ModelSpec(
        backbone=HybridSpec(channels=channels, kernel=kernel, units=channels[0], cell=cell or LstmCell()),
        head=head,
        activation=activation or Identity(),
        blocks=blocks,
        window=W,
    )
    task = Task(FG2, ("CylVels_1", "CylVels_2", "CylVels_3"), (10,), TargetMode.DELTA, 100.0)
    scaler = Scaler(np.zeros(30), np.ones(30), np.zeros((1, 3)), np.ones((1, 3)))
    return build_model(task, spec, scaler, seed=0).double().eval()


DIFFERENCE, SCALES = (TemporalDifference(),), (MultiScaleTcn(),)
# Network; parameters, those left after folding, MACs per window in M and per tick in k, to the digits known.
GOLDEN = {
    "Table B.1": (
        ((256, 128, 64, 32), 3, MlpHead(hidden=64, layers=2), (*SCALES, CylinderGate()), ScaledTanh()),
        (1_376_775, 1_374_852, "62.88", "1379"),
    ),
    "teacher": (((256,), 5, MlpHead(hidden=128), DIFFERENCE, ScaledTanh()), (1_197_319, 1_196_804, "45.198", "1206")),
    "A_u64": (((64,), 5, MlpHead(hidden=32), DIFFERENCE), (84_292, 84_164, "3.257", "86.6")),
    "A_u32": (((32,), 5, MlpHead(hidden=16), DIFFERENCE), (24_228, 24_164, "0.958", "25.4")),
    "teacher P4": (((128, 64, 32), 7, MlpHead(hidden=64), SCALES), (677_572, 676_676, "31.281", "680.5")),
    "P4 A_u64": (((64, 32), 7, MlpHead(hidden=32), SCALES), (181_956, 181_572, "8.409", "183.6")),
    "P4 A_u32": (((32, 16), 7, MlpHead(hidden=16), SCALES), (53_604, 53_412, "2.486", "54.4")),
}


def layer_size(graph, name):
    return sum(values.size for layer, _, values in graph.tensors() if layer == name)


BRIDGED = (*SCALES, AttentionBridge(), *DIFFERENCE)
# The k = 1 rows of phase 5: layer-norm LSTM and bridge; parameters, those left after folding, and the MACs printed.
PHASE_5 = {
    "teacher P5": (((128, 64, 32), MlpHead(hidden=32, layers=2), ScaledTanh()), (703_527, 702_628, "26.488")),
    "P5 A_u64": (((64, 32), MlpHead(hidden=16, layers=2), Identity()), (213_972, 213_588, "6.834")),
    "P5 A_u32": (((32, 16), MlpHead(hidden=8, layers=2), Identity()), (61_996, 61_804, "2.093")),
}


@pytest.mark.parametrize("name", PHASE_5)
def test_phase_5_counts_are_those_of_the_thesis(name):
    """The printed MACs take the matrices of recurrent layer and bridge once, where a window needs them W times."""
    (channels, head, activation), (parameters, folded, macs) = PHASE_5[name]
    rows = network(channels, 7, head, BRIDGED, activation, LayerNormLstmCell()).costs()
    assert sum(row.parameters for row in rows) == parameters
    assert parameters - sum(row.foldable for row in rows) == folded
    spans = [row for row in rows if row.part.startswith(("convolution", "residual"))]
    others = sum(row.per_column for row in rows) - sum(row.per_column for row in spans)
    scores = 2 * W * 2 * channels[-1]
    once = others - scores + sum(row.per_prediction for row in rows)
    assert digits((W * sum(row.per_column for row in spans) + once) / 1e6, macs) == macs


def digits(value, printed):
    """`value` with as many decimals as `printed` has."""
    return f"{value:.{len(printed.partition('.')[2])}f}"


@pytest.mark.parametrize("name", GOLDEN)
def test_counts_are_those_of_the_thesis(name):
    made, (parameters, folded, window, tick) = GOLDEN[name]
    rows = network(*made).costs()
    assert sum(row.parameters for row in rows) == parameters
    assert parameters - sum(row.foldable for row in rows) == folded
    per_window = sum(W * row.per_column + row.per_prediction for row in rows)
    per_tick = sum(row.per_column + row.per_prediction + row.pooling for row in rows)
    assert digits(per_window / 1e6, window) == window
    assert digits(per_tick / 1e3, tick) == tick


def counted(predictor, x):
    """MACs of matrix products and convolutions by module, as PyTorch's dispatcher sees them; half its flops.

    Double precision keeps the LSTM off the fused kernels, which the dispatcher cannot look into. Element-wise work
    (gates, activations, softmax, scaling, biases) has no matrix product and is counted by neither side.
    """
    with torch.no_grad(), FlopCounterMode(display=False) as counter:
        predictor(x, predictor.initial_state(len(x), x))
    return {name: sum(flops.values()) // 2 for name, flops in counter.get_flop_counts().items()}


# The k = 10 rows of phase 5 as printed, in M: their profiler did not know the zoneout LSTM (Table 4.9).
WITHOUT_RECURRENCE = {"teacher": 18.984, "A_u32": 0.549}


@pytest.mark.parametrize("name", WITHOUT_RECURRENCE)
def test_the_thesis_left_the_recurrent_layer_out(name):
    rows = [row for row in network(*GOLDEN[name][0]).costs() if "lstm" not in row.part.lower()]
    counted = sum(W * row.per_column + row.per_prediction for row in rows) / 1e6
    assert counted == pytest.approx(WITHOUT_RECURRENCE[name], abs=1e-3)


@pytest.mark.parametrize("name", GOLDEN)
def test_counts_are_those_of_the_layer_arithmetic(name):
    """Sums over layers written out by hand: temporal blocks, LSTM with two biases, pooling, heads, gate, amplitudes."""
    channels, kernel, head, blocks, *activation = GOLDEN[name][0]
    branches = 2 if SCALES[0] in blocks else 1
    units, inputs, outputs = channels[0], 30, 3
    parameters = macs = 0
    for into, out in zip((inputs, *channels), channels, strict=False):
        path = into * out if into != out else 0
        macs += branches * ((into + out) * out * kernel + path)
        parameters += branches * ((into + out) * out * kernel + 4 * out + (path + out if path else 0))
    read = branches * channels[-1]
    macs += 4 * (read + units) * units
    parameters += 4 * (read + units + 2) * units + units + 1
    wide = units * (3 if DIFFERENCE[0] in blocks else 2)
    sizes = [wide, *[head.hidden] * head.layers, 1]
    heads = outputs * sum(into * out for into, out in pairwise(sizes))
    parameters += heads + outputs * sum(sizes[1:]) + (outputs if activation else 0)
    if CylinderGate() in blocks:
        parameters += 2 * outputs * wide
    made = footprint(network(*GOLDEN[name][0]))
    assert (made.parameters, made.macs_window) == (parameters, W * macs + heads)
    assert made.macs_tick == macs + heads + (W + 1) * units


@pytest.mark.parametrize("name", GOLDEN)
def test_the_exported_layers_count_the_same(name):
    predictor = network(*GOLDEN[name][0])
    counted = footprint(predictor)
    graph = predictor.graph()
    assert graph.macs == counted.macs_tick
    # Weight norm is folded; each gate of the recurrent layer keeps one of two biases.
    biases = 4 * predictor.spec.backbone.units
    outside = sum(layer_size(graph, name) for name in ("front.scaled", "prediction.decoded"))
    assert graph.parameters - outside <= counted.parameters - biases
    assert graph.parameters - outside >= counted.parameters_folded - biases


@pytest.mark.parametrize("name", GOLDEN)
def test_the_counter_agrees_with_the_operations_that_run(name):
    predictor = network(*GOLDEN[name][0])
    rows = predictor.costs()
    x = torch.zeros(1, 1, 24, dtype=torch.float64)
    tick = counted(predictor, x)["Global"]
    assert tick == sum(row.per_column + row.per_prediction + row.pooling for row in rows)
    window = counted(predictor, torch.zeros(1, W, 24, dtype=torch.float64))
    # The thesis's windowed figure runs the heads once and leaves pooling out; a stream runs both at every tick.
    backbone = window["Predictor.backbone"] - window["Predictor.backbone.pooling"]
    heads = window["Predictor.heads"] // W
    assert backbone + heads == sum(W * row.per_column + row.per_prediction for row in rows)
