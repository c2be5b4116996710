"""The LSTM layer, with or without zoneout."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from edp.ir import Builder
from edp.ir.memory import Lstm as LstmLayer
from edp.networks.cells.base import CELLS
from edp.networks.cells.lstm_steps import Shares, lstm_steps, output_first
from edp.networks.streaming import Cost, Operation, State, Streaming, parameters_of


@CELLS.register("lstm")
@dataclass(frozen=True, kw_only=True)
class LstmCell:
    """LSTM (eq. 2.2 to 2.7), PyTorch's gate order and two bias vectors."""

    family: ClassVar[str] = "lstm"
    zoneout: ClassVar[bool] = True

    def build(self, width_in: int, units: int, zoneout: float) -> Streaming:
        """Build one layer; without zoneout it is PyTorch's own."""
        return ZoneoutLstm(width_in, units, zoneout) if zoneout else StreamingLstm(width_in, units)


class StreamingLstm(Streaming):
    """LSTM layer; the state is ``(h, c)``, each ``(batch, units)``, zero at reset."""

    operations = frozenset({Operation.LSTM})

    def __init__(self, width_in: int, units: int) -> None:
        super().__init__()
        self.cell = nn.LSTM(width_in, units, batch_first=True)
        with torch.no_grad():
            # A forget gate open at the start carries gradients through the first epochs.
            self.cell.get_parameter("bias_ih_l0")[units : 2 * units].add_(1.0)

    def initial_state(self, batch: int, like: Tensor) -> State:
        zeros = like.new_zeros(batch, self.cell.hidden_size)
        return zeros, zeros.clone()

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        y, (h, c) = self.cell(x, (state[0].unsqueeze(0), state[1].unsqueeze(0)))
        return y, (h.squeeze(0), c.squeeze(0))

    def lower(self, build: Builder, x: str) -> str:
        part = self.cell.get_parameter
        # PyTorch's two biases always act as a sum; an export stores one.
        bias = part("bias_ih_l0") + part("bias_hh_l0")
        weight_x, weight_h = part("weight_ih_l0"), part("weight_hh_l0")
        return build.add(LstmLayer, "lstm", x, weight_x=weight_x, weight_h=weight_h, bias=bias)

    def costs(self) -> list[Cost]:
        return lstm_costs("LSTM", self.cell.input_size, self.cell.hidden_size, parameters_of(self))


class ZoneoutLstm(Streaming):
    """LSTM layer whose units keep their last h and c at random in training (thesis 3.2.4.1).

    Each element of h and of c is kept with probability `rate`, independently at every tick. In evaluation the
    states are blended instead, ``rate * before + (1 - rate) * fresh``: the same code runs on the machine.
    Parameters have the names and layout of PyTorch's LSTM.
    """

    operations = frozenset({Operation.LINEAR, Operation.SIGMOID, Operation.TANH})
    matrices = (("weight_ih_l0", (0,)), ("weight_hh_l0", (0,)))

    def __init__(self, width_in: int, units: int, rate: float) -> None:
        super().__init__()
        self.width_in, self.units, self.rate = width_in, units, rate
        # The bound of PyTorch's LSTM, so that zoneout is the only difference from the plain layer.
        bound = 1.0 / math.sqrt(units)
        self.weight_ih_l0 = nn.Parameter(torch.empty(4 * units, width_in).uniform_(-bound, bound))
        self.weight_hh_l0 = nn.Parameter(torch.empty(4 * units, units).uniform_(-bound, bound))
        self.bias_ih_l0 = nn.Parameter(torch.empty(4 * units).uniform_(-bound, bound))
        self.bias_hh_l0 = nn.Parameter(torch.empty(4 * units).uniform_(-bound, bound))
        with torch.no_grad():
            self.bias_ih_l0[units : 2 * units].add_(1.0)  # as in the plain layer

    def initial_state(self, batch: int, like: Tensor) -> State:
        zeros = like.new_zeros(batch, self.units)
        return zeros, zeros.clone()

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        # The order of registration in `__init__`: input weights, recurrent weights, the two biases.
        weight, recurrent, first, second = (output_first(parameter) for parameter in self.parameters())
        projected = nn.functional.linear(x.transpose(0, 1), weight, first + second)
        share = zoneout_share(projected, self.units, self.rate, self.training)
        y, state = lstm_steps(projected, recurrent, None, state, share)
        return y.transpose(0, 1), state

    def lower(self, build: Builder, x: str) -> str:
        weights = {"weight_x": self.weight_ih_l0, "weight_h": self.weight_hh_l0}
        bias = self.bias_ih_l0 + self.bias_hh_l0
        return build.add(LstmLayer, "lstm", x, **weights, bias=bias, share=1.0 - self.rate)

    def costs(self) -> list[Cost]:
        return lstm_costs("LSTM with zoneout", self.width_in, self.units, parameters_of(self))


def zoneout_share(projected: Tensor, units: int, rate: float, training: bool) -> Shares:
    """Return the fraction of new h and c that a layer takes: random in training, its expectation in evaluation."""
    if not rate or not training:
        return 1.0 - rate
    ticks, batch = projected.shape[:2]
    draws = torch.rand(2, ticks, batch, units, dtype=projected.dtype, device=projected.device)
    # Separate draws for h and c, as in the source of zoneout (Krueger et al. 2016, arXiv 1606.01305).
    update_mask = (draws >= rate).to(projected.dtype)
    return update_mask[0], update_mask[1]


def lstm_costs(name: str, width: int, units: int, parameters: int) -> list[Cost]:
    """Return the cost row of an LSTM layer; element-wise gates and states are not counted."""
    macs = 4 * units * (width + units)
    return [Cost(f"{name} {width}->{units}", parameters, per_column=macs, width_in=width, width_out=units)]
