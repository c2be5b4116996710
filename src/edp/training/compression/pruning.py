"""Structured pruning: a narrower network of the same parts that keeps the most important features of a trained one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace

import torch
from torch import Tensor, nn

from edp.data.series import Series
from edp.errors import ConfigError
from edp.networks.backbones import CommitteeSpec, RecurrentBackbone
from edp.networks.blocks import BLOCKS, CylinderGate, MultiScaleTcn, TemporalDifference
from edp.networks.blocks.base import BlockSlot
from edp.networks.cells import CELLS
from edp.networks.convolution import CausalConv, ConvolutionStack, TemporalBlock
from edp.networks.heads import HEADS, Heads
from edp.networks.initial import INITIAL_STATES, ZeroState
from edp.networks.predictor import ModelSpec, Predictor
from edp.training.bundle import blank_scaler
from edp.training.compression.taylor import FeatureImportance, importance

GATES = {"lstm": 4, "gru": 3, "min_gru": 2}
"""Recurrent layers that can be pruned, and how many rows of their matrices belong to a unit."""


def prune(predictor: Predictor, model: ModelSpec, series: Sequence[Series]) -> Predictor:
    """Create a network with the specs `model` from the most important features of `predictor`; fine-tune it afterwards.

    Channels of each convolution, units of each recurrent layer and hidden features of each head are kept by what they
    contribute on `series` (`importance`). Levels whose residual path has no weights keep the same channels.

    Args:
        predictor: a trained network.
        model: its own specs with smaller widths, for example ``student(predictor.spec, units, levels=all of them)``.
        series: data with truth, usually those it was trained on.

    Raises:
        ConfigError: a part that cannot be pruned, or specs that are not narrower ones of the same network.
    """
    check_pruning(predictor.spec, model)
    small = Predictor(predictor.task, model, blank_scaler(predictor.task)).eval()
    importances = importance(predictor, series)
    with torch.no_grad():
        # These parts have no width to prune: they are copied whole.
        for name in ("front", "code", "output", "activation", "bypass", "physics"):
            part = getattr(small, name)
            if part is not None:
                part.load_state_dict(getattr(predictor, name).state_dict())
        features = torch.arange(len(predictor.task.features.features))
        kept_features = _backbone(predictor.backbone, small.backbone, features, importances)
        if small.gate is not None:
            for own, its in zip(small.gate.parameters(), predictor.gate.parameters(), strict=True):  # type: ignore[union-attr]
                own.copy_(its[:, kept_features])
        _heads(predictor.heads, small.heads, kept_features, importances.hidden)
    return small


def _backbone(big: nn.Module, small: nn.Module, input_features: Tensor, importances: FeatureImportance) -> Tensor:
    """Copy the selected weights, and return the selected features of the representation."""
    if isinstance(big, ConvolutionStack) and isinstance(small, ConvolutionStack):
        return _stack(big, small, input_features, importances)
    if not isinstance(big, RecurrentBackbone) or not isinstance(small, RecurrentBackbone):
        pairs = list(zip(_children(big, "branches"), _children(small, "branches"), strict=True))
        return _side_by_side(
            [(_backbone(one, other, input_features, importances), _width(one)) for one, other in pairs]
        )
    if big.encoder is not None and small.encoder is not None:
        input_features = _backbone(big.encoder, small.encoder, input_features, importances)
    units = input_features
    for layer, narrow in zip(_children(big.recurrent, "layers"), _children(small.recurrent, "layers"), strict=True):
        units = _best(importances.sites[layer], _units(narrow))
        _recurrent(layer, narrow, input_features, units)
        input_features = units
    small.pooling.score.weight.copy_(big.pooling.score.weight[:, units])
    small.pooling.score.bias.copy_(big.pooling.score.bias)
    # Pooled states, last states and their differences keep the same units, side by side.
    return _side_by_side([(units, big.pooling.units)] * (2 + len(big.extras)))


def _stack(
    big: ConvolutionStack, small: ConvolutionStack, input_features: Tensor, importances: FeatureImportance
) -> Tensor:
    pairs = list(zip(big._blocks(), small._blocks(), strict=True))
    for index, (block, narrow) in enumerate(pairs):
        if block.shortcut is None and narrow.shortcut is None:
            out = input_features
        else:
            total = importances.sites[block].clone()
            # Residual sums tie channels of following blocks together: they are chosen by their joint importance.
            for later, other in pairs[index + 1 :]:  # what follows without weights on its path keeps the same channels
                if later.shortcut is not None or other.shortcut is not None:
                    break
                total += importances.sites[later]
            # Channels inside a block are free: nothing but its second convolution reads them.
            out = _best(total, len(narrow.second.bias))
        inner = _best(importances.sites[block.first], len(narrow.first.bias))
        _convolution(block.first, narrow.first, input_features, inner)
        _convolution(block.second, narrow.second, inner, out)
        _shortcut(block, narrow, input_features, out)
        input_features = out
    return input_features


def _convolution(big: CausalConv, small: CausalConv, input_features: Tensor, out: Tensor) -> None:
    weight = big.weight()[out][:, input_features]
    norm = weight.flatten(1).norm(dim=1)
    small.gain.copy_(norm)
    # A direction of length zero would divide by zero; with a gain of zero any other one gives the same weights.
    small.direction.copy_(torch.where(norm[:, None, None] > 0, weight, torch.ones_like(weight)))
    small.bias.copy_(big.bias[out])


def _shortcut(big: TemporalBlock, small: TemporalBlock, input_features: Tensor, out: Tensor) -> None:
    if small.shortcut is None:
        return
    if big.shortcut is None:  # channels passed on as they were: ones where a channel is kept on both sides
        small.shortcut.weight.copy_((out[:, None] == input_features[None, :]).to(small.shortcut.weight))
        small.shortcut.bias.zero_()
    else:
        small.shortcut.weight.copy_(big.shortcut.weight[out][:, input_features])
        small.shortcut.bias.copy_(big.shortcut.bias[out])


def _recurrent(big: nn.Module, small: nn.Module, input_features: Tensor, units: Tensor) -> None:
    """Copy matrices with one row per unit and gate; state matrices have one column per unit, others one per input."""
    full = _units(big)
    for (name, its), own in zip(big.named_parameters(), small.parameters(), strict=True):
        # Gates lie one behind the other: a unit has a row in each of them.
        rows = torch.cat([units + gate * full for gate in range(its.shape[0] // full)])
        own.copy_(its[rows] if its.ndim == 1 else its[rows][:, units if "_hh" in name else input_features])


def _heads(big: Heads, small: Heads, input_features: Tensor, importances: Sequence[Tensor]) -> None:
    """Copy the heads; each output selects its own hidden features."""
    for output in range(big.outputs):
        into = input_features
        for layer in range(len(big.weights)):
            if layer < len(big.units):
                best = _best(importances[layer][output], small.widths[layer + 1])
                factor = big.units[layer].factor
                # A gated unit reads two halves; a feature is kept in both or in none.
                out = torch.cat([best + half * big.widths[layer + 1] for half in range(factor)])
            else:
                best = out = torch.arange(big.weights[layer].shape[2])
            small.weights[layer][output].copy_(big.weights[layer][output][into][:, out])
            small.biases[layer][output].copy_(big.biases[layer][output][out])
            into = best


def _best(importances: Tensor, count: int) -> Tensor:
    """Return the `count` most important features, in their order."""
    # Sorted and stable: the order of features stays, and ties give the same network everywhere.
    return torch.sort(torch.argsort(importances, descending=True, stable=True)[:count]).values


def _side_by_side(parts: Sequence[tuple[Tensor, int]]) -> Tensor:
    """Return the positions of selected features in a concatenation of parts with the given full widths."""
    starts = [sum(width for _, width in parts[:index]) for index in range(len(parts))]
    return torch.cat([part_features + start for (part_features, _), start in zip(parts, starts, strict=True)])


def _children(module: nn.Module, name: str) -> list[nn.Module]:
    return list(getattr(module, name))


def _width(stack: nn.Module) -> int:
    return len(stack._blocks()[-1].second.bias)  # type: ignore[operator]


def _units(layer: nn.Module) -> int:
    return int(layer.cell.hidden_size if hasattr(layer, "cell") else layer.units)  # type: ignore[union-attr, arg-type]


def check_pruning(big: ModelSpec, small: ModelSpec) -> None:
    """Raise an error for networks that cannot be pruned, and for specs that are not narrower versions.

    Raises:
        ConfigError: every reason.
    """
    reasons = []
    if isinstance(big.backbone, CommitteeSpec):
        reasons.append("the backbone 'committee'")
    # By its settings: a head without hidden features may still have an attribute of that name.
    if "hidden" not in {part.name for part in fields(big.head)}:  # type: ignore[arg-type]
        reasons.append(f"the head '{HEADS.name_of(big.head)}'")
    cell = getattr(big.backbone, "cell", None)
    if cell is not None and CELLS.name_of(cell) not in GATES:
        reasons.append(f"a recurrent layer '{CELLS.name_of(cell)}' (those of {', '.join(GATES)} can be pruned)")
    initial = getattr(big.backbone, "initial", None)
    if initial is not None and not isinstance(initial, ZeroState):
        reasons.append(f"the initial state '{INITIAL_STATES.name_of(initial)}' (only 'zero' can)")
    for block in big.blocks:
        gate = isinstance(block, CylinderGate) and block.form == "diagonal"
        beside = getattr(block, "slot", None) is BlockSlot.BYPASS
        if not gate and not beside and not isinstance(block, MultiScaleTcn | TemporalDifference):
            reasons.append(f"the block '{BLOCKS.name_of(block)}'")
    if reasons:
        raise ConfigError(f"pruning: no rule for {'; '.join(reasons)}; distil a student instead")
    reasons += _differences(big, small)
    if reasons:
        raise ConfigError(f"pruning: {'; '.join(reasons)}; give the network's own specs with smaller widths")


def _differences(big: ModelSpec, small: ModelSpec) -> list[str]:
    names = [name for name in ("units", "channels") if hasattr(big.backbone, name)]
    if type(big.backbone) is not type(small.backbone):
        return ["another backbone"]
    same = {name: getattr(big.backbone, name) for name in names}
    widened = replace(
        small,
        backbone=replace(small.backbone, **same),  # type: ignore[type-var]
        head=replace(small.head, hidden=big.head.hidden),  # type: ignore[type-var]
    )
    if widened != big:
        return ["the specs differ in more than widths"]
    pairs = [("head.hidden", (big.head.hidden,), (small.head.hidden,))]
    for name in names:
        full, narrow = getattr(big.backbone, name), getattr(small.backbone, name)
        pairs.append((name, full, narrow) if name == "channels" else (name, (full,), (narrow,)))
    differences = []
    for name, full, narrow in pairs:
        if len(full) != len(narrow) or any(n > f for f, n in zip(full, narrow, strict=False)):
            differences.append(f"{name} = {narrow} is not narrower than {full}, level by level")
    return differences
