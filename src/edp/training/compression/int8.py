"""Dynamic INT8 (thesis 3.3.7): 8-bit weights in linear layers, inputs quantised again at every sample."""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from edp.networks.convolution import TemporalBlock
from edp.networks.heads import GatedUnit, Heads
from edp.networks.predictor import Predictor
from edp.networks.streaming import parameters_of
from edp.training.compression.rounding import weight_levels


@dataclass(frozen=True, eq=False)
class Quantised:
    """Network with rounded arithmetic, and its storage size.

    Attributes:
        predictor: network for evaluation and streaming; it cannot be saved as a bundle.
        weight_bytes: parameters as stored: one byte for each quantised weight, four for the others; as in Table 4.9
            scales are left out.
        largest_error: largest change of a weight, by layer.
    """

    predictor: Predictor
    weight_bytes: int
    largest_error: dict[str, float]


def dynamic_int8(predictor: Predictor) -> Quantised:
    """Quantise the linear layers of a network after training, as the thesis's variant B_LPTQ does.

    Linear layers are those of the heads, of attention pooling and of blocks; convolutions (the 1x1 ones of residual
    paths too) and the matrices of LSTM and GRU stay as they are. Weights have a symmetric scale for each output of
    their layer. What a layer reads is rounded to 256 levels between its least and largest value, zero included, at each
    tick by itself: so a stream, a chunk and a window see the same numbers.
    """
    quantised = copy.deepcopy(predictor).eval()
    # Shortcuts are 1x1 convolutions, which PyTorch's dynamic quantisation leaves alone.
    convolutions = {part.shortcut for part in quantised.modules() if isinstance(part, TemporalBlock)}
    errors: dict[str, float] = {}
    count = 0
    with torch.no_grad():
        for name, part in quantised.named_modules():
            if isinstance(part, nn.Linear) and part not in convolutions:
                errors[name] = _round_weight(part.weight, dim=1)
                count += part.weight.numel()
                part.register_forward_pre_hook(_round_input)
            elif isinstance(part, Heads):
                for layer, weight in enumerate(part.weights):
                    errors[f"{name}.weights.{layer}"] = _round_weight(weight, dim=1)
                    count += weight.numel()
                _round_heads(part)
    quantised.number_format = "dynamic int8"
    # A rounded weight takes one byte instead of four.
    return Quantised(quantised, 4 * parameters_of(quantised) - 3 * count, errors)


def _round_heads(heads: Heads) -> None:
    """Round the inputs of each head layer: the representation, then the output of each non-linearity or the mix."""
    heads.register_forward_pre_hook(_round_input)
    units = [_round_outputs(unit) for unit in heads.units]
    if heads.mix is not None:
        # With a block across the outputs, that block's result is what the last layer reads.
        units[-1] = heads.units[-1]
        heads.mix.register_forward_hook(lambda module, arguments, result: (round_tick(result[0]), result[1]))
    heads.units = tuple(units)


def _round_outputs(unit: GatedUnit) -> GatedUnit:
    return replace(unit, apply=lambda x: round_tick(unit.apply(x)))


def _round_input(module: nn.Module, arguments: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    return (round_tick(arguments[0]), *arguments[1:])


def _round_weight(weight: Tensor, dim: int) -> float:
    """Round in place to 255 levels, symmetric about zero, with a scale for each slice along `dim`; largest change."""
    levels, steps = weight_levels(weight, [axis for axis in range(weight.ndim) if axis != dim])
    rounded = levels * steps
    error = float((rounded - weight).abs().max())
    weight.copy_(rounded)
    return error


def round_tick(x: Tensor) -> Tensor:
    """Round each tick's features ``(..., feature)`` to 256 levels from the least to the largest, zero among them."""
    # Zero is always a level, so that padding and inactive units stay exact.
    low, high = x.amin(dim=-1, keepdim=True).clamp(max=0.0), x.amax(dim=-1, keepdim=True).clamp(min=0.0)
    # A tick of zeros has no range.
    scale = ((high - low) / 255).clamp(min=1e-30)
    zero = (low / scale).round()
    return ((x / scale).round().clamp(min=zero, max=zero + 255)) * scale
