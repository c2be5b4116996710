"""A diagonal linear state space with a gated output: damped rotations driven by the input."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
import torch.nn.functional as functional
from torch import Tensor, nn

from edp.ir import Builder
from edp.ir.layers import Dense, Glu
from edp.ir.memory import Rotation
from edp.networks.cells.base import CELLS
from edp.networks.cells.scan import linear_scan
from edp.networks.streaming import Cost, Operation, State, Streaming, parameters_of
from edp.settings.bounds import MAX_UNITS, check_bounds, integer

MEMORY = (2.0, 200.0)  # time constants at the start, in ticks
FASTEST = math.pi / 5  # largest rotation per tick at the start: a tenth of the sampling rate


@CELLS.register("diagonal_ssm")
@dataclass(frozen=True, kw_only=True)
class DiagonalSsmCell:
    """Linear recurrent unit (Orvieto et al. 2023, arXiv 2303.06349) with a gated linear unit behind it.

    ``h = lambda h_before + sqrt(1 - |lambda|^2) B x`` with complex ``lambda = exp(-exp(rate) + i angle)``, always
    inside the unit circle; the output is ``GLU(C [Re h ; Im h] + b)``.

    Attributes:
        states: complex states, each a damped rotation of its own.

    Raises:
        ConfigError: fewer than one state.
    """

    family: ClassVar[str] = "state space"
    zoneout: ClassVar[bool] = False
    states: int = 64

    def __post_init__(self) -> None:
        check_bounds("diagonal_ssm", self, states=integer(1, MAX_UNITS))

    def build(self, width_in: int, units: int, zoneout: float) -> Streaming:
        """Return one layer."""
        return DiagonalSsm(width_in, units, self.states)


class DiagonalSsm(Streaming):
    """Diagonal state space layer; the state is h, real and imaginary part, ``(batch, state, 2)``, zero at reset."""

    # Exponential, root and sine make the factors, constants once trained.
    operations = frozenset({Operation.LINEAR, Operation.GLU, Operation.EXP, Operation.SQRT, Operation.SINE})

    def __init__(self, width_in: int, units: int, states: int) -> None:
        super().__init__()
        self.width_in, self.units, self.states = width_in, units, states
        low, high = (math.log(value) for value in MEMORY)
        # Time constants are spread evenly in the logarithm; the shuffle keeps them independent of the order of the
        # angles.
        self.rate = nn.Parameter(-torch.linspace(low, high, states)[torch.randperm(states)])
        self.angle = nn.Parameter(FASTEST * torch.rand(states))
        self.into = nn.Linear(width_in, 2 * states, bias=False)
        self.out = nn.Linear(2 * states, 2 * units)

    def initial_state(self, batch: int, like: Tensor) -> State:
        return like.new_zeros(batch, self.states, 2)

    def factor(self) -> tuple[Tensor, Tensor]:
        """Return lambda as ``(state, 2)`` and the input scale ``(state, 1)``; both are constants once trained."""
        # training.
        decay = torch.exp(self.rate)
        size = torch.exp(-decay)
        turn = torch.stack([torch.cos(self.angle), torch.sin(self.angle)], dim=-1)
        # 1 - |lambda|^2 = -expm1(-2 decay): exact where lambda is close to the unit circle.
        # The scale keeps the variance of the state independent of its time constant (Orvieto et al. 2023).
        return size.unsqueeze(-1) * turn, torch.sqrt(-torch.expm1(-2 * decay)).unsqueeze(-1)

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        factor, scale = self.factor()
        # Time first: the scan walks over contiguous rows.
        driven = self.into(x.transpose(0, 1)).unflatten(-1, (self.states, 2)) * scale
        h = torch.view_as_real(
            linear_scan(torch.view_as_complex(factor), torch.view_as_complex(driven), torch.view_as_complex(state))
        )
        y = functional.glu(self.out(h.flatten(-2)), dim=-1)
        return y.transpose(0, 1), h[-1]

    def lower(self, build: Builder, x: str) -> str:
        factor, scale = self.factor()
        # The scale folds into the matrix once; a tick of the exported code then costs no extra products.
        weight = (self.into.weight.unflatten(0, (self.states, 2)) * scale.unsqueeze(-1)).flatten(0, 1)
        driven = build.add(Dense, "drive", x, weight=weight, bias=weight.new_zeros(2 * self.states))
        h = build.add(Rotation, "rotation", driven, factor=factor)
        both = build.add(Dense, "out", h, weight=self.out.weight, bias=self.out.bias)
        return build.add(Glu, "gated", both, rows=1, size=2 * self.units)

    def costs(self) -> list[Cost]:
        states, units = 2 * self.states, self.units
        # The two parameters of a state are its rate and its angle.
        rows = parameters_of(self.into) + 2 * self.states
        return [
            Cost(
                f"state space {self.width_in}->{self.states} complex",
                rows,
                per_column=states * self.width_in,
                width_in=self.width_in,
                width_out=states,
            ),
            Cost(
                f"gated output {states}->{units}",
                parameters_of(self.out),
                per_column=2 * units * states,
                width_in=states,
                width_out=units,
            ),
        ]
