"""The minimal GRU: a gated recurrence without a matrix in the loop, so that all ticks run at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from edp.ir import Builder
from edp.ir.layers import Dense
from edp.ir.memory import MinGru as MinGruLayer
from edp.networks.cells.base import CELLS
from edp.networks.cells.scan import linear_scan
from edp.networks.streaming import Cost, Operation, State, Streaming, parameters_of


@CELLS.register("min_gru")
@dataclass(frozen=True, kw_only=True)
class MinGruCell:
    """Minimal GRU (Feng et al. 2024, arXiv 2410.01201): gate and candidate see the input only.

    ``z = sigmoid(W_z x + b_z)``, ``h = (1 - z) h_before + z (W_h x + b_h)``. h stays within the range of the
    candidates, however long the stream.
    """

    family: ClassVar[str] = "gru"
    zoneout: ClassVar[bool] = False

    def build(self, width_in: int, units: int, zoneout: float) -> Streaming:
        """Return one layer."""
        return StreamingMinGru(width_in, units)


class StreamingMinGru(Streaming):
    """Minimal GRU layer; the state is h ``(batch, units)``, zero at reset."""

    operations = frozenset({Operation.LINEAR, Operation.SIGMOID})

    def __init__(self, width_in: int, units: int) -> None:
        super().__init__()
        self.width_in, self.units = width_in, units
        self.gate_and_candidate = nn.Linear(width_in, 2 * units)
        with torch.no_grad():
            # Memories of 2 to 50 ticks at the start: mean gates of 1/2 to 1/50.
            gate = 1.0 / torch.logspace(0.3, 1.7, units)
            # The logit of the mean gate: the sigmoid of this bias gives it back.
            self.gate_and_candidate.bias[:units] = (gate / (1 - gate)).log()

    def initial_state(self, batch: int, like: Tensor) -> State:
        return like.new_zeros(batch, self.units)

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        gate, candidate = self.gate_and_candidate(x.transpose(0, 1)).chunk(2, dim=-1)
        z = torch.sigmoid(gate)
        h = linear_scan(1 - z, z * candidate, state)
        return h.transpose(0, 1), h[-1]

    def lower(self, build: Builder, x: str) -> str:
        both = self.gate_and_candidate
        mapped = build.add(Dense, "gate_and_candidate", x, weight=both.weight, bias=both.bias)
        return build.add(MinGruLayer, "minimal_gru", mapped, units=self.units)

    def costs(self) -> list[Cost]:
        width, units = self.width_in, self.units
        name = f"minimal GRU {width}->{units}"
        return [Cost(name, parameters_of(self), per_column=2 * units * width, width_in=width, width_out=units)]
