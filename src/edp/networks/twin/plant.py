"""A twin as exported forms know it: a predictor one tick ahead that also reads which of its ports are measured."""

from __future__ import annotations

from copy import deepcopy
from typing import NoReturn

import numpy as np
import torch
from torch import Tensor

from edp.data.features import FeatureSet
from edp.data.scaling import Scaler
from edp.data.task import TargetMode, Task
from edp.data.twin_channels import TwinChannels
from edp.errors import ExportError
from edp.ir import Graph
from edp.ir.reference import Reference
from edp.ir.w8a16 import Formats, quantise
from edp.networks.frontend import FrontEnd, TargetTransform
from edp.networks.integer import IntegerPredictor
from edp.networks.outputs import Point
from edp.networks.predictor import Predictor
from edp.networks.streaming import State, Streaming
from edp.networks.twin.base import Twin
from edp.networks.twin.lowering import MEASURED
from edp.signals import Channel, Kind

FLAG = "_measured"
"""Suffix of the name of a flag, after the name of its output."""


class TwinPlant(Predictor):
    """Machine one sample later from commands, measured values and flags, in SI units; it cannot be trained.

    In single precision it runs the twin itself, in double precision the twin's layer graph. After a reset it starts in
    steady state at the means of the training data, so that a stream without measurements has an initial state.

    Args:
        twin: the plant model.
        title: one-line description.
    """

    def __init__(self, twin: Twin, title: str) -> None:
        Streaming.__init__(self)  # there is no backbone and no head to build
        channels, scales = twin.channels, twin.scales
        self.twin, self._title = twin, title
        self.task, self.inputs = _task(channels), plant_inputs(channels)
        flags = np.ones(len(channels.answers), np.float32)
        offset = np.concatenate([scales.command_offset, scales.answer_offset, 0.0 * flags], dtype=np.float64)
        width = np.concatenate([scales.command_width, scales.answer_width, flags], dtype=np.float64)
        zero, unit = (values.astype(np.float64)[None] for values in (scales.answer_offset, scales.answer_width))
        scaler = Scaler(offset, width, zero, unit)
        self.front, self.code = FrontEnd(self.task, scaler), TargetTransform(self.task, scaler)
        self.output, self.physics = Point().build(1, len(channels.answers)), None
        self.float().eval()

    @property
    def title(self) -> str:
        return self._title

    @property
    def window(self) -> int:
        return self.twin.prefix_ticks

    @property
    def required(self) -> int:
        return self.sizes[0]

    def initial_state(self, batch: int, like: Tensor) -> State:
        """State at reset for `batch` streams."""
        if like.dtype == torch.float64:
            return [Reference(self.graph()) for _ in range(batch)]
        means = (self.twin.scales.command_offset, self.twin.scales.answer_offset)
        command, answer = (np.repeat(mean[None], batch, axis=0) for mean in means)
        return self.twin.initial_state(command, answer)

    def predict(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        """Return outputs in SI units, ``(batch, time, 1, output)``, and the next state."""
        rows = x.detach().cpu().numpy()
        if x.dtype == torch.float64:
            new = deepcopy(state)
            lanes = zip(new, rows, strict=True)
            answers = np.array([[one.results(row)["prediction"] for row in lane] for one, lane in lanes])
            return torch.from_numpy(answers)[:, :, None], new
        commands, measured, flags = np.split(rows, np.cumsum(self.sizes[:2]), axis=2)
        fed = np.where(flags > MEASURED, measured, np.float32(np.nan))
        answers, new = self.twin.rollout(commands, state, fed)
        return torch.from_numpy(answers)[:, :, None], new

    def predict_with_intervals(self, x: Tensor, state: State) -> tuple[Tensor, Tensor | None, State]:
        """Return the result of `predict`, without intervals."""
        answers, new = self.predict(x, state)
        return answers, None, new

    def forward_features(self, x: Tensor, state: State) -> NoReturn:
        """Raise an error: a twin has no hidden features.

        Raises:
            ExportError: always.
        """
        raise ExportError("a twin gives answers only; train it with edp twin, look into it with edp rollout")

    def graph(self) -> Graph:
        """Return the layer graph of the twin.

        Raises:
            ExportError: its formulation has no such form.
        """
        return self.twin.graph()

    @property
    def sizes(self) -> tuple[int, int, int]:
        """Commands, measured values, flags."""
        answers = len(self.twin.channels.answers)
        return len(self.twin.channels.commands), answers, answers


class IntegerTwinPlant(IntegerPredictor, TwinPlant):
    """The same whose cell computes in W8A16; ports, integration, end stops and bounds stay in single precision.

    Args:
        source: the float plant.
        chosen: formats of its values.

    Raises:
        ExportError: its formulation has no integer form.
    """

    def __init__(self, source: TwinPlant, chosen: Formats) -> None:
        integers = quantise(source.graph(), chosen)
        TwinPlant.__init__(self, source.twin, source.title)
        self.formats, self.integers = chosen, integers


def plant_inputs(channels: TwinChannels) -> tuple[Channel, ...]:
    """Return the inputs of each sample: commands, measured outputs, and a flag for each of these."""
    names = {channel.name for channel in channels.commands + channels.answers}
    flags = []
    for answer in channels.answers:
        name = answer.name + FLAG
        # A log may have a channel of that name.
        while name in names:
            name += "_"
        names.add(name)
        text = f"1: {answer.name} is read as measured; 0: its own last answer is read"
        flags.append(Channel(name, Kind.RATIO, text))
    return channels.commands + channels.answers + tuple(flags)


def _task(channels: TwinChannels) -> Task:
    inputs = FeatureSet("plant", tuple(channel.name for channel in plant_inputs(channels)))
    names = tuple(channel.name for channel in channels.answers)
    return Task(inputs, names, (1,), TargetMode.ABSOLUTE, channels.rate_hz)
