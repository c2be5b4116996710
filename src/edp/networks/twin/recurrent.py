"""Recurrent network with feedback ports: it reads commands and machine state, and outputs the state change."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from edp.data.series import Series
from edp.data.twin_channels import TwinChannels
from edp.errors import ConfigError
from edp.ir import Builder
from edp.ir.layers import BinaryOperation, Dense, ScaleShift
from edp.ir.memory import Gru
from edp.networks.twin.base import PREFIX, TWINS, Twin, TwinRunner, TwinState, list_solved_columns
from edp.networks.twin.recurrent_cell import Bounds, TwinNetwork, buffers
from edp.networks.twin.scales import Array, TwinScales
from edp.networks.twin.static_map import StaticMap, StaticTwin
from edp.networks.twin.steps import BranchResults, run_branches, run_forward
from edp.settings.bounds import MAX_UNITS, check_bounds, integer

PIECE = 256
"""Number of samples per block of a simulation without gradients. Intermediate results are kept for one block only."""
MAP = "map_"
"""Prefix for the names of the static map's parameters within the twin."""
MAX_MEMBERS = 32
MEMBER_SEED = 1000
"""Seed increment between members, chosen so that seeds of different runs rarely coincide."""


@TWINS.register("recurrent")
@dataclass(frozen=True, kw_only=True)
class Recurrent:
    """GRU with feedback ports, trained with the free-run error (`edp.training.free_run`).

    Several members are trained separately, and the twin outputs the mean of their changes. Since they read the same
    ports, they form one network with zero weights between members.

    Attributes:
        units: total number of hidden units of all members.
        members: networks whose changes are averaged.
        valve_map: whether velocities and pressures are also pulled to the outputs of a static map (`StaticMap`) of the
            commands. The strength of the pull is trained. Without training, the twin equals the static map.
        prefix_ticks: measured ticks before a free run, in which its memory forms.

    Raises:
        ConfigError: a value out of range, or units that members cannot share.
    """

    units: int = 96
    members: int = 1
    valve_map: bool = False
    prefix_ticks: int = 30

    def __post_init__(self) -> None:
        bounds = {"units": integer(1, MAX_UNITS), "members": integer(1, MAX_MEMBERS), "prefix_ticks": PREFIX}
        check_bounds("recurrent twin", self, **bounds)
        if self.units % self.members:
            raise ConfigError(
                f"recurrent twin: {self.units} units and {self.members} members; a whole number of units for each "
                "member must hold"
            )

    def start(self, channels: TwinChannels, scales: TwinScales, train: Sequence[Series], seed: int) -> RecurrentTwin:
        """Return an untrained twin with weights given by the seed."""
        static = self.static_map(channels, scales, train)
        seeds = [member_seed(seed, i) for i in range(self.members)]
        return averaged([self.member(channels, scales, static, one) for one in seeds])

    def static_map(self, channels: TwinChannels, scales: TwinScales, train: Sequence[Series]) -> StaticTwin | None:
        """Return the static map towards which the twin is pulled, fitted to the training segments.

        None without a map.
        """
        return self._map_spec.start(channels, scales, train, 0) if self.valve_map else None

    def member(self, channels: TwinChannels, scales: TwinScales, static: StaticTwin | None, seed: int) -> RecurrentTwin:
        """Return an untrained member with a fitted map."""
        network = self.alone()._network(channels)
        # Outputs that start at zero change would make the first free runs stand still.
        network.draw(seed, 0.1)
        return RecurrentTwin(channels, scales, self.prefix_ticks, network, static)

    def alone(self) -> Recurrent:
        """Return the options of a single member."""
        return replace(self, units=self.units // self.members, members=1)

    def shapes(self, channels: TwinChannels) -> dict[str, tuple[int, ...]]:
        """Return the array shapes of the network and of the map."""
        with torch.device("meta"):  # a header says how wide it is: no memory before that is checked
            network = self._network(channels)
        shapes = {name: tuple(weight.shape) for name, weight in network.named_parameters()}
        return shapes | {MAP + name: shape for name, shape in self._map_shapes(channels).items()}

    def build(self, channels: TwinChannels, scales: TwinScales, arrays: Mapping[str, Array]) -> RecurrentTwin:
        """Build the twin with these weights."""
        network = self._network(channels)
        network.load_state_dict({name: torch.from_numpy(np.array(arrays[name])) for name in network.state_dict()})
        numbers = {name: arrays[MAP + name] for name in self._map_shapes(channels)}
        static = self._map_spec.build(channels, scales, numbers) if numbers else None
        return RecurrentTwin(channels, scales, self.prefix_ticks, network, static, self.members)

    def _network(self, channels: TwinChannels) -> TwinNetwork:
        pulled = len(list_solved_columns(channels)) if self.valve_map else 0
        return TwinNetwork(len(channels.commands), len(channels.answers), self.units, pulled)

    @property
    def _map_spec(self) -> StaticMap:
        return StaticMap(prefix_ticks=self.prefix_ticks)

    def _map_shapes(self, channels: TwinChannels) -> dict[str, tuple[int, ...]]:
        return self._map_spec.shapes(channels) if self.valve_map else {}


class RecurrentTwin(Twin):
    """The network in SI units, without gradients.

    State: ``answer`` scaled, ``h`` ``(batch, units)``, and with a static map the ``commands`` of its delay.

    Args:
        channels: commands and outputs of the twin.
        scales: scales of commands and outputs, and bounds of the outputs.
        prefix_ticks: least number of measured ticks before a free run.
        network: the cell.
        static: the map to which its outputs are pulled; None where the network has no pull.
        members: networks that it is the average of.
    """

    def __init__(
        self,
        channels: TwinChannels,
        scales: TwinScales,
        prefix_ticks: int,
        network: TwinNetwork,
        static: StaticTwin | None = None,
        members: int = 1,
    ) -> None:
        super().__init__(channels, scales, prefix_ticks)
        self.network, self.static, self.bounds = network, static, Bounds.from_scales(channels, scales)
        self.members = members

    def initial_state(self, command: Array, measured: Array) -> TwinState:
        state = {"answer": self.scaled(measured), "h": np.zeros((len(measured), self.network.units), np.float32)}
        if self.static is not None:
            state["commands"] = self.static.initial_state(command, measured)["commands"]
        return state

    def drive(self, commands: Array) -> Array:
        """Return the scaled commands; with a static map, followed by its scaled outputs."""
        if self.static is None:
            return self.scale_commands(commands)
        return np.concatenate([self.scale_commands(commands), self._scale_map(self.static.along(commands))], axis=1)

    def free_run(self, commands: Tensor, measured: Tensor, port: Tensor) -> Tensor:
        """Simulate scaled outputs ``(time, batch, output)`` from measured starts, with gradients by the weights.

        Args:
            commands: result of `drive` ``(time, batch, number)``.
            measured: scaled ``(time, batch, output)``, any finite number where `port` is 0.
            port: 1 if a port reads the measured value, which is required in the first sample; else 0.
        """
        count = len(self.channels.commands)
        mapped = None if self.static is None else commands[..., count:]
        start = (measured[0], torch.zeros(measured.shape[1], self.network.units))
        answers, _ = self.network(commands[..., :count], measured, port, start, self.bounds, mapped)
        return torch.as_tensor(answers)

    def _run(self, commands: Array, measured: Array, state: TwinState) -> tuple[Array, TwinState]:
        network, batch, bounds = self.network, len(commands), self.bounds
        weights = tuple(weight.detach().numpy() for weight in (*network.looped, network.pulls(bounds)))
        command_weight, bias = network.command_weight.detach().numpy(), network.bias.detach().numpy()
        pieces, after = [], dict(state)
        for at in range(0, commands.shape[1], PIECE):
            piece = commands[:, at : at + PIECE]
            read = np.ascontiguousarray(self.scaled(measured[:, at : at + PIECE]).swapaxes(0, 1))
            port = np.isfinite(read).astype(np.float32)
            saved = buffers(len(read), batch, read.shape[2], network.units)
            # A product a tick, so that a chunk and its single ticks round alike.
            rows = self.scale_commands(piece).swapaxes(0, 1)
            projected = np.stack([row @ command_weight.T for row in rows]) + bias
            mapped = np.zeros((0, 0, 0), np.float32)
            if self.static is not None:
                solved, after["commands"] = self.static.mapped(piece, after["commands"])
                mapped = np.ascontiguousarray(self._scale_map(solved).swapaxes(0, 1))
            inputs = (projected, np.nan_to_num(read), port, mapped)
            run_forward(inputs, weights, bounds.arrays, bounds.velocities, (after["answer"], after["h"]), saved)
            pieces.append(saved[0].swapaxes(0, 1))
            after["answer"], after["h"] = saved[0][-1].copy(), saved[5][-1].copy()
        answers = np.concatenate(pieces, axis=1) * self.scales.answer_width + self.scales.answer_offset
        return np.asarray(answers, dtype=np.float32), after

    def branches(self, commands: Array, state: TwinState, measured: Array, first: NDArray[np.int64]) -> Array:
        return self.runner().branches(commands, state, measured, first)

    def runner(self) -> RecurrentRunner:
        return RecurrentRunner(self)

    def map_along(self, commands: Array, state: TwinState) -> tuple[Array, Array]:
        """Return the scaled outputs of the static map for commands ``(tick, run, command)``, and its next memory.

        Args:
            commands: SI units.
            state: state of one machine, used for all runs.
        """
        if self.static is None:
            return np.zeros((0, 0, 0), np.float32), np.zeros((0, 0, 0), np.float32)
        lanes = np.ascontiguousarray(commands.swapaxes(0, 1))
        solved, memory = self.static.mapped(lanes, np.repeat(state["commands"], len(lanes), axis=0))
        return np.ascontiguousarray(self._scale_map(solved).swapaxes(0, 1)), memory[:1]

    def _scale_map(self, solved: Array) -> Array:
        """Scale map outputs ``(..., all but strokes)`` to ``(..., output)``, zero for strokes."""
        columns, scales = list_solved_columns(self.channels), self.scales
        answers = np.zeros((*solved.shape[:-1], len(self.channels.answers)), np.float32)
        answers[..., columns] = (solved - scales.answer_offset[columns]) / scales.answer_width[columns]
        return answers

    def lower(self, build: Builder, commands: str, fed: str) -> str:
        network, solved = self.network, list_solved_columns(self.channels)
        arrays = {name: weight.detach().numpy() for name, weight in network.named_parameters()}
        read = build.join("read", commands, fed)
        h = build.join("memories", *(self._add_memory(build, read, rows) for rows in self.member_rows()))
        unit = self.bounds.change[solved]
        weight, bias = unit[:, None] * arrays["out_weight"].T[solved], unit * arrays["out_bias"][solved]
        change = build.add(Dense, "change", h, weight=weight, bias=bias)
        before = build.pick("before", fed, solved)
        if self.static is not None:
            with build.inside("map"):
                mapped = self.static.lower(build, commands, fed)
            pull, zero = network.pulls(self.bounds).detach().numpy()[solved], np.zeros(len(solved))
            # Two products and no difference: a number that is far from both has no digits to lose.
            near = build.add(ScaleShift, "pulled", mapped, gain=pull, shift=zero)
            rest = build.add(ScaleShift, "kept", before, gain=1.0 - pull, shift=zero)
            before = build.combine("pulled_before", BinaryOperation.ADD, rest, near)
        return build.combine("proposed", BinaryOperation.ADD, before, change)

    def _add_memory(self, build: Builder, read: str, rows: slice) -> str:
        """Add the memory of a member with these rows of h."""
        network = self.network
        arrays = {name: weight.detach().numpy() for name, weight in network.named_parameters()}
        gates = np.concatenate([np.arange(network.units)[rows] + gate * network.units for gate in range(3)])
        own = arrays["inner_bias"][rows]
        weight_x = np.concatenate([arrays["command_weight"], arrays["feedback_weight"].T], axis=1)
        # The commands' part has the gates' biases; the inner bias is that of n alone.
        return build.add(
            Gru,
            "memory" if rows == slice(0, network.units) else f"memory_{rows.start}",
            read,
            weight_x=weight_x[gates],
            weight_h=arrays["h_weight"].T[gates][:, rows],
            bias_x=arrays["bias"][gates],
            bias_h=np.concatenate([np.zeros(2 * len(own), np.float32), own]),
        )

    def member_rows(self) -> list[slice]:
        """Return the rows of h of each member; a single range if members are connected by fine-tuning."""
        units, weight = self.network.units, self.network.h_weight.detach().numpy()
        width = units // self.members
        rows = [slice(first, first + width) for first in range(0, units, width)]
        between = weight.reshape(units, 3, units).copy()
        for own in rows:
            between[own, :, own] = 0.0
        return [slice(0, units)] if between.any() else rows

    def arrays(self) -> dict[str, Array]:
        weights = {name: weight.detach().numpy().copy() for name, weight in self.network.named_parameters()}
        numbers = {} if self.static is None else self.static.numbers
        return self.scales.arrays() | weights | {MAP + name: values for name, values in numbers.items()}


class RecurrentRunner(TwinRunner):
    """Runner with weights for SI commands and scaled outputs in contiguous memory; see `TwinRunner`."""

    def __init__(self, twin: RecurrentTwin) -> None:
        super().__init__(twin)
        self._twin, scales, bounds, count = twin, twin.scales, twin.bounds, len(twin.channels.commands)
        weights = {name: weight.detach().numpy() for name, weight in twin.network.named_parameters()}
        # In double precision, since an offset may be many widths from zero.
        by_command = weights["command_weight"].astype(np.float64) / scales.command_width
        arrays = (
            np.concatenate([by_command.T, weights["feedback_weight"]]),
            weights["bias"] - by_command @ scales.command_offset.astype(np.float64),
            weights["h_weight"],
            weights["inner_bias"],
            weights["out_weight"] * bounds.change,
            weights["out_bias"] * bounds.change,
            twin.network.pulls(bounds).detach().numpy(),
            scales.answer_offset,
            scales.answer_width,
        )
        self._weights = tuple(np.array(array, dtype=np.float32, order="C") for array in arrays)
        self._sizes = (count, len(scales.low), twin.network.units)

    def branches(self, commands: Array, state: TwinState, measured: Array, first: NDArray[np.int64]) -> Array:
        rows = np.ascontiguousarray(np.asarray(commands, np.float32).swapaxes(0, 1))
        return self._run(rows, state, measured, first)[0]

    def step(self, command: Array, state: TwinState, measured: Array) -> TwinState:
        rows = np.ascontiguousarray(command, dtype=np.float32).reshape(1, 1, -1)
        _, after = self._run(rows, state, measured, np.zeros(1, np.int64))
        return after

    def _run(self, rows: Array, state: TwinState, measured: Array, first: NDArray[np.int64]) -> tuple[Array, TwinState]:
        """Simulate ``(run, tick, output)`` for commands ``(tick, run, command)``.

        Also return the final state of run 0.
        """
        twin, (_, count, units) = self._twin, self._sizes
        mapped, memory = twin.map_along(rows, state)
        read = twin.scaled(measured)
        start = (np.where(np.isfinite(read), read, state["answer"][0]), state["h"][0])
        answers, h = np.empty((rows.shape[1], len(rows), count), np.float32), np.empty(units, np.float32)
        bounds = twin.bounds
        run_branches(
            (rows, mapped), self._weights, bounds.arrays, bounds.velocities, start, first, BranchResults(answers, h)
        )
        after = {"answer": twin.scaled(answers[0, -1])[None], "h": h[None]}
        return answers, after if twin.static is None else after | {"commands": memory}


def member_seed(seed: int, which: int) -> int:
    """Seed of a member of a twin with this seed; the first one has the twin's own."""
    return seed + MEMBER_SEED * which


def averaged(twins: Sequence[RecurrentTwin]) -> RecurrentTwin:
    """Return a twin whose state change is the mean of the state changes of equally wide twins.

    All twins read the same ports, and the outputs are linear in h. The mean is therefore one network that contains the
    gates of all twins in parallel; its output weights are those of the twins divided by their number.

    Args:
        twins: at least one twin; all or none with a static map, and the maps with equal corners and delay.
    """
    first, count = twins[0], len(twins)
    if count == 1:
        return first
    units, pulled = first.network.units, 0 if first.network.pull is None else len(first.network.pull)
    total = count * units
    network = TwinNetwork(len(first.channels.commands), len(first.channels.answers), total, pulled)
    with torch.no_grad():
        for weight in network.parameters():
            weight.zero_()
        for i, member in enumerate(twin.network for twin in twins):
            own = slice(i * units, (i + 1) * units)
            for gate in range(3):
                at = slice(gate * total + own.start, gate * total + own.stop)
                theirs = slice(gate * units, (gate + 1) * units)
                network.command_weight[at], network.bias[at] = member.command_weight[theirs], member.bias[theirs]
                network.feedback_weight[:, at] = member.feedback_weight[:, theirs]
                network.h_weight[own, at] = member.h_weight[:, theirs]
            network.inner_bias[own] = member.inner_bias
            network.out_weight[own] = member.out_weight / count
            network.out_bias.add_(member.out_bias / count)
            if network.pull is not None and member.pull is not None:
                network.pull.add_(member.pull.clamp(0.0, 1.0) / count)
    return RecurrentTwin(first.channels, first.scales, first.prefix_ticks, network, _mean_map(twins), count)


def _mean_map(twins: Sequence[RecurrentTwin]) -> StaticTwin | None:
    """Return the mean of the members' maps, weighted by how strongly each member is pulled to its own."""
    maps = [twin.static for twin in twins if twin.static is not None]
    if not maps:
        return None
    pulls = [np.zeros(0) if twin.network.pull is None else twin.network.pull.detach().numpy() for twin in twins]
    shares = np.clip(np.stack(pulls), 0.0, 1.0).astype(np.float64)
    total = shares.sum(axis=0)
    # Without any pull the map has no effect, but its parameters must be defined.
    weights = np.where(total > 0.0, shares / np.where(total > 0.0, total, 1.0), 1.0 / len(maps))
    return StaticTwin.mean(maps, weights.astype(np.float32))
