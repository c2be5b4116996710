"""Network in addition to a grey box: it corrects the changes that the equations do not explain."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from edp.data.twin_channels import TwinChannels
from edp.errors import ConfigError
from edp.ir import Builder
from edp.ir.layers import BinaryOperation, Dense, ScaleShift
from edp.ir.memory import Gru
from edp.networks.twin.base import TWINS, TwinRunner, TwinState, list_solved_columns
from edp.networks.twin.grey.correction import Cell, RunTrace, run_back
from edp.networks.twin.greybox import Doubles, GreyBox, GreyTwin
from edp.networks.twin.recurrent_cell import CellWeights, weight_gradients
from edp.networks.twin.scales import Array, TwinScales
from edp.settings.bounds import (
    MAX_BATCH,
    MAX_NAMES,
    MAX_UNITS,
    MAX_UPDATES,
    above,
    check_bounds,
    check_count,
    integer,
)


@TWINS.register("residual")
@dataclass(frozen=True, kw_only=True)
class Residual(GreyBox):
    """A grey box, fitted first, and a GRU that reads commands, ports and the grey box's change, and adds to it.

    Attributes:
        units: width of the network's memory.
        batch: free runs side by side in an update of the network.
        lengths_s: lengths of the free runs, stage after stage.
        updates: updates of each stage.
        validate_every: updates from one validation to the next.

    Raises:
        ConfigError: a value out of range, or stages that do not fit one another.
    """

    units: int = 64
    batch: int = 32
    lengths_s: tuple[float, ...] = (0.3, 1.0, 3.0)
    updates: tuple[int, ...] = (300, 700, 150)
    validate_every: int = 50

    def __post_init__(self) -> None:
        super().__post_init__()
        count = integer(1, MAX_UPDATES)
        bounds = {"units": integer(1, MAX_UNITS), "batch": integer(1, MAX_BATCH), "lengths_s": above(0.0, 600.0)}
        check_bounds("residual twin", self, updates=count, validate_every=count, **bounds)
        check_count("residual twin", "lengths_s", self.lengths_s, MAX_NAMES, least=1)
        if len(self.lengths_s) != len(self.updates):
            raise ConfigError(
                f"residual twin: {len(self.lengths_s)} lengths_s and {len(self.updates)} updates; one number of "
                "updates for each length must hold"
            )

    def shapes(self, channels: TwinChannels) -> dict[str, tuple[int, ...]]:
        """Return the array shapes of the grey box and of the network."""
        with torch.device("meta"):  # a header says how wide it is: no memory before that is checked
            network = _network(channels, self.units)
        return super().shapes(channels) | {name: tuple(weight.shape) for name, weight in network.named_parameters()}

    def build(self, channels: TwinChannels, scales: TwinScales, arrays: Mapping[str, Array]) -> ResidualTwin:
        """Build the twin with these parameters and weights."""
        network = _network(channels, self.units)
        network.load_state_dict({name: torch.from_numpy(np.array(arrays[name])) for name in network.state_dict()})
        return ResidualTwin(super().build(channels, scales, arrays), network)

    def _network(self, channels: TwinChannels, seed: int) -> dict[str, Array]:
        network = _network(channels, self.units)
        # Answers of zero: an untrained network leaves its grey box alone, and training begins there.
        network.draw(seed, 0.0)
        return {name: weight.detach().numpy() for name, weight in network.named_parameters()}


def _network(channels: TwinChannels, units: int) -> CellWeights:
    """Return the network, which reads ports and the changes of all outputs except strokes, which are integrals."""
    solved = len(list_solved_columns(channels))
    return CellWeights(len(channels.commands), len(channels.answers) + solved, solved, units)


class ResidualTwin(GreyTwin):
    """State: the grey-box state, and ``h`` of the network ``(batch, units)``."""

    def __init__(self, grey: GreyTwin, network: CellWeights) -> None:
        parts = (grey.table, grey.wiring)
        super().__init__(grey.channels, grey.scales, grey.spec, parts, grey.numbers, grey.full)
        self.network = network

    def with_parameters(self, numbers: Doubles) -> ResidualTwin:
        """Return the elements and network with other grey-box parameters, rounded to the stored precision."""
        return ResidualTwin(super().with_parameters(numbers), self.network)

    def with_stretches(self, stretches: int) -> ResidualTwin:
        """Return the machine and network with subdivided opening curves."""
        return ResidualTwin(super().with_stretches(stretches), self.network)

    def drop_network(self) -> ResidualTwin:
        """Return the grey box with a network whose output is zero."""
        network = _network(self.channels, self.network.units)
        network.load_state_dict(self.network.state_dict())
        with torch.no_grad():
            network.out_weight.zero_()
            network.out_bias.zero_()
        return ResidualTwin(self, network)

    def initial_state(self, command: Array, measured: Array) -> TwinState:
        h = np.zeros((len(measured), self.network.units), np.float32)
        return super().initial_state(command, measured) | {"h": h}

    def cell(self, projected: Array, h: Array) -> Cell:
        """Return the network for compiled code, in units of the grey box; see `edp.networks.twin.grey.correction.Cell`.

        Args:
            projected: the commands' part of the gates ``(tick, run, 3 units)``.
            h: ``(run, units)``; a run moves it.
        """
        solved = np.array(list_solved_columns(self.channels), dtype=np.int64)
        read, state, inner_bias, out, out_bias = (weight.detach().numpy() for weight in self.network.looped)
        scales, units = self.scales, self.units
        offset, per_width = scales.answer_offset / units, units / scales.answer_width
        change = (scales.change_width / units)[solved]
        return Cell(
            projected, h, read, state, inner_bias, out, out_bias, offset, per_width, change, solved
        )  # fmt: skip

    def _run(self, commands: Array, measured: Array, state: TwinState) -> tuple[Array, TwinState]:
        command_weight, bias = (w.detach().numpy() for w in (self.network.command_weight, self.network.bias))
        # A product a tick, so that a chunk and its single ticks round alike.
        projected = np.stack([row @ command_weight.T for row in self.scale_commands(commands).swapaxes(0, 1)]) + bias
        h = state["h"].copy()
        answers, after = self.answered(commands, measured, state, self.cell(projected, h))
        return answers, after | {"h": h}

    def free_run(self, commands: Tensor, measured: Tensor, port: Tensor) -> Tensor:
        """Simulate scaled outputs ``(time, batch, output)`` from measured starts, with gradients by the weights.

        Args:
            commands: scaled ``(time, batch, command)``.
            measured: scaled ``(time, batch, output)``, any finite number where `port` is 0.
            port: 1 where a port reads what was measured; all of the first tick.
        """
        network, scales = self.network, self.scales
        projected = nn.functional.linear(commands, network.command_weight, network.bias)
        inputs = (commands.numpy() * scales.command_width + scales.command_offset).swapaxes(0, 1)
        fed = measured.numpy() * scales.answer_width + scales.answer_offset
        fed = np.where(port.numpy() > 0, fed, np.float32(np.nan)).swapaxes(0, 1)
        result = _Corrected.apply(projected, *network.looped, self, inputs, fed, port.numpy())  # type: ignore[no-untyped-call]
        return torch.as_tensor(result)

    def runner(self) -> TwinRunner:
        # That of the grey box knows nothing of the network.
        return TwinRunner(self)

    def lower(self, build: Builder, commands: str, fed: str) -> str:
        solved, scales = list_solved_columns(self.channels), self.scales
        arrays = {name: weight.detach().numpy() for name, weight in self.network.named_parameters()}
        grey, before = super().lower(build, commands, fed), build.pick("before", fed, solved)
        unit = (scales.change_width / scales.answer_width)[solved]
        own = build.combine("own_change", BinaryOperation.SUBTRACT, grey, before)
        change = build.add(ScaleShift, "scaled_change", own, gain=1.0 / unit, shift=np.zeros(len(solved)))
        inner = arrays["inner_bias"]
        h = build.add(
            Gru,
            "memory",
            build.join("read", commands, fed, change),
            weight_x=np.concatenate([arrays["command_weight"], arrays["feedback_weight"].T], axis=1),
            weight_h=arrays["h_weight"].T,
            bias_x=arrays["bias"],
            bias_h=np.concatenate([np.zeros(2 * len(inner), np.float32), inner]),
        )
        weight, bias = unit[:, None] * arrays["out_weight"].T, unit * arrays["out_bias"]
        correction = build.add(Dense, "correction", h, weight=weight, bias=bias)
        return build.combine("corrected", BinaryOperation.ADD, grey, correction)

    def arrays(self) -> dict[str, Array]:
        weights = {name: weight.detach().numpy().copy() for name, weight in self.network.named_parameters()}
        return super().arrays() | weights


class _Corrected(torch.autograd.Function):
    """A free run of grey box and network, with the exact adjoint through both (`run_back`)."""

    @staticmethod
    def forward(ctx: Any, projected: Tensor, *rest: Any) -> Tensor:
        twin, commands, fed, port = rest[5:]
        lanes, ticks, answers = fed.shape
        units, sizes = twin.network.units, twin.sizes
        h = np.zeros((lanes, units), np.float32)
        solved = len(list_solved_columns(twin.channels))
        trace = RunTrace(
            read=np.zeros((ticks, lanes, answers + solved), np.float32),
            free=np.zeros((ticks, lanes, answers), np.float32),
            gates=np.zeros((ticks, lanes, 3 * units), np.float32),
            inner_sum=np.zeros((ticks, lanes, units), np.float32),
            state=np.zeros((ticks + 1, lanes, units), np.float32),
            slopes=np.zeros((ticks, lanes, sum(sizes), sum(sizes)), np.float32),
            counts=np.zeros((ticks, lanes), np.float32),
        )
        ctx.cell = twin.cell(np.ascontiguousarray(projected.detach().numpy()), h)
        state = twin.initial_state(np.ascontiguousarray(commands[:, 0]), np.ascontiguousarray(fed[:, 0]))
        values, _ = twin.answered(np.ascontiguousarray(commands), np.ascontiguousarray(fed), state, ctx.cell, trace)
        ctx.trace, ctx.port, ctx.twin = trace, np.ascontiguousarray(port), twin
        return torch.from_numpy(np.ascontiguousarray(twin.scaled(values).swapaxes(0, 1)))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_answers: Tensor) -> tuple[Tensor | None, ...]:
        twin, trace, cell = ctx.twin, ctx.trace, ctx.cell
        by_gates, by_inner = np.empty_like(trace.gates), np.empty_like(trace.inner_sum)
        by_out = np.empty((*trace.gates.shape[:2], len(cell.solved)), np.float32)
        incoming = np.ascontiguousarray(grad_answers.numpy())
        actuators, nodes = len(twin.wiring.columns), twin.wiring.nodes
        sizes = (actuators, nodes, 0.5 / twin.channels.rate_hz)
        run_back(incoming, ctx.port, cell, twin.wiring.ports, sizes, trace, (by_gates, by_inner, by_out))
        by_weights = weight_gradients(trace.read, trace.state, by_gates, by_inner, by_out)
        return (torch.from_numpy(by_gates), *by_weights, None, None, None, None)
