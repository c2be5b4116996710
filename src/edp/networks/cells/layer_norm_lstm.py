"""The LSTM layer with layer normalisation of its gates, with or without zoneout."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
import torch.nn.functional as functional
from torch import Tensor, nn

from edp.ir import Builder
from edp.ir.memory import LayerNormLstm as LayerNormLstmLayer
from edp.networks.cells.base import CELLS
from edp.networks.cells.lstm import lstm_costs, zoneout_share
from edp.networks.cells.lstm_steps import EPSILON, lstm_steps, output_first
from edp.networks.streaming import Cost, Operation, State, Streaming, parameters_of


@CELLS.register("layer_norm_lstm")
@dataclass(frozen=True, kw_only=True)
class LayerNormLstmCell:
    """LSTM with layer norms inside (Ba et al. 2016, arXiv 1607.06450, eq. 20 to 22; thesis 3.2.4.1).

    The gates read ``norm(W x) + norm(U h) + b``, with each norm over all 4 D values and with gain and shift;
    ``h = o tanh(norm(c))``. These are 22 D parameters in addition to the matrices, as in the thesis's parameter counts.
    """

    family: ClassVar[str] = "lstm"
    zoneout: ClassVar[bool] = True

    def build(self, width_in: int, units: int, zoneout: float) -> Streaming:
        """Return one layer."""
        return StreamingLayerNormLstm(width_in, units, zoneout)


class StreamingLayerNormLstm(Streaming):
    """Layer-norm LSTM layer; the state is ``(h, c)``, each ``(batch, units)``, zero at reset."""

    operations = frozenset({Operation.LINEAR, Operation.SIGMOID, Operation.TANH, Operation.LAYER_NORM})
    matrices = (("weight_ih", (0,)), ("weight_hh", (0,)))

    def __init__(self, width_in: int, units: int, zoneout: float) -> None:
        super().__init__()
        self.width_in, self.units, self.rate = width_in, units, zoneout
        # The uniform bound of PyTorch's LSTM; the norms rescale the sums anyway.
        bound = 1.0 / math.sqrt(units)
        self.weight_ih = nn.Parameter(torch.empty(4 * units, width_in).uniform_(-bound, bound))
        self.weight_hh = nn.Parameter(torch.empty(4 * units, units).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.zeros(4 * units))
        self.norm_gain_ih, self.norm_gain_hh = (nn.Parameter(torch.ones(4 * units)) for _ in range(2))
        self.norm_shift_ih, self.norm_shift_hh = (nn.Parameter(torch.zeros(4 * units)) for _ in range(2))
        self.norm_gain_c, self.norm_shift_c = nn.Parameter(torch.ones(units)), nn.Parameter(torch.zeros(units))
        with torch.no_grad():
            self.bias[units : 2 * units] = 1.0  # an open forget gate carries gradients through the first epochs

    def initial_state(self, batch: int, like: Tensor) -> State:
        zeros = like.new_zeros(batch, self.units)
        return zeros, zeros.clone()

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        # Rows of all ticks are normalised at once; a norm over 4 D does not notice the order of the gates.
        rows = x.transpose(0, 1) @ output_first(self.weight_ih).t()
        # Both shifts and the bias are added to the same sums: one addition for all ticks outside the loop.
        shift = output_first(self.norm_shift_ih + self.norm_shift_hh + self.bias)
        projected = functional.layer_norm(rows, rows.shape[2:], output_first(self.norm_gain_ih), shift, EPSILON)
        share = zoneout_share(projected, self.units, self.rate, self.training)
        norm = (output_first(self.norm_gain_hh), self.norm_gain_c, self.norm_shift_c)
        y, state = lstm_steps(projected, output_first(self.weight_hh), norm, state, share)
        return y.transpose(0, 1), state

    def lower(self, build: Builder, x: str) -> str:
        return build.add(
            LayerNormLstmLayer,
            "lstm",
            x,
            weight_x=self.weight_ih,
            weight_h=self.weight_hh,
            bias=self.bias + self.norm_shift_ih + self.norm_shift_hh,
            gain_x=self.norm_gain_ih,
            gain_h=self.norm_gain_hh,
            gain_c=self.norm_gain_c,
            shift_c=self.norm_shift_c,
            epsilon=EPSILON,
            # Evaluation takes the expected share of the new state, as dropout does with its mean.
            share=1.0 - self.rate,
        )

    def costs(self) -> list[Cost]:
        name = "layer-norm LSTM with zoneout" if self.rate else "layer-norm LSTM"
        return lstm_costs(name, self.width_in, self.units, parameters_of(self))
