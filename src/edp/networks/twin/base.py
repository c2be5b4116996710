"""Twins: plant models that simulate the machine from commands, with measured outputs or their own as feedback."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from edp.data.series import Series
from edp.data.twin_channels import TwinChannels
from edp.errors import ConfigError, DataError, ExportError
from edp.ir import Builder, Graph
from edp.networks.twin.lowering import add_bounds, plant_graph
from edp.networks.twin.scales import Array, TwinScales
from edp.networks.twin.windows import WindowStart
from edp.registry import Registry
from edp.settings.bounds import MOST_TICKS, integer
from edp.wording import typed

TwinState = dict[str, Array]
"""State of a twin by name; the first dimension is the batch. ``answer`` contains the values that free ports read next.
"""
PREFIX = integer(1, MOST_TICKS)
BEYOND = 0.05
"""Fraction of the stroke by which a measured start may exceed an end stop, to allow for noise and play."""


class Twin(ABC):
    """Causal map from commands and feedback to the state of the machine one sample later.

    Every output is a *feedback port*. In each sample it reads the measured value, or its own last output if the
    measurement is missing (NaN). The same weights act as a filter (all measured), a plant model (none measured) or a
    mixture::

        state = twin.reset(commands[:, :50], measured[:, :50])
        outputs, state = twin.rollout(commands[:, 50:], state)  # outputs[:, t] is the machine after commands[:, 50 + t]

    State is explicit: single samples, chunks and one call over all samples give the same values, and so does a run that
    continues from a stored state. Arrays are float32 in SI units. This module does not need torch.

    Attributes:
        channels: commands and outputs.
        scales: scales of the network, and bounds of the outputs.
        prefix_ticks: minimum number of measured samples before a free-run simulation.
    """

    def __init__(self, channels: TwinChannels, scales: TwinScales, prefix_ticks: int) -> None:
        self.channels, self.scales, self.prefix_ticks = channels, scales, prefix_ticks

    @abstractmethod
    def initial_state(self, command: Array, measured: Array) -> TwinState:
        """Return the steady state of machines for this command ``(batch, command)`` and state ``(batch, output)``."""

    @abstractmethod
    def _run(self, commands: Array, measured: Array, state: TwinState) -> tuple[Array, TwinState]:
        """Return `rollout` of checked arrays, `measured` with NaN at free ports."""

    @abstractmethod
    def arrays(self) -> dict[str, Array]:
        """Return all parameters by name, including scales, for the model file."""

    def lower(self, build: Builder, commands: str, fed: str) -> str:
        """Add the twin's own layers: scaled velocities and pressures before bounds.

        Args:
            build: builder of the layer graph.
            commands: scaled ``(command,)``.
            fed: scaled feedback inputs ``(output,)``.

        Raises:
            ExportError: the formulation has no form as layers; that of this class always.
        """
        raise ExportError(
            f"a twin of class {type(self).__name__} has no form as a list of layers; run it with edp rollout, or train "
            "one of another kind"
        )

    def lower_answers(self, build: Builder, commands: str, fed: str) -> str:
        """Add the twin's own layers and the bounds: all outputs, scaled; arguments and errors as in `lower`."""
        with build.inside("cell"):
            proposed = self.lower(build, commands, fed)
        with build.inside("answers"):
            return add_bounds(build, self, fed, proposed)

    def graph(self) -> Graph:
        """Return one sample as layers with a feedback edge, the basis of exported forms (see `plant_graph`).

        Raises:
            ExportError: the formulation has no such form.
        """
        return plant_graph(self)

    def reset(self, commands: Array, measured: Array) -> TwinState:
        """Return the state after a measured segment.

        Args:
            commands: commands of the prefix, ``(batch, tick, command)``, at least `prefix_ticks` samples.
            measured: ``(batch, tick, output)``; NaN where a sensor is missing, but not at the first tick.

        Raises:
            DataError: too few samples, a port without any measurement, or a start beyond an end stop.
        """
        commands, measured = np.asarray(commands, np.float32), np.asarray(measured, np.float32)
        ticks = commands.shape[1] if commands.ndim == 3 else 0
        if ticks < self.prefix_ticks:
            raise DataError(
                f"a prefix of {ticks} ticks came; the twin needs {self.prefix_ticks} measured ticks "
                f"({typed(self.prefix_ticks / self.channels.rate_hz)} s) before it runs free: give a longer one"
            )
        self._check("measured", measured, (*commands.shape[:2], len(self.channels.answers)))
        self._check_start(measured[:, 0])
        return self.rollout(commands, self.initial_state(commands[:, 0], measured[:, 0]), measured)[1]

    def step(self, command: Array, state: TwinState, measured: Array | None = None) -> tuple[Array, TwinState]:
        """Return one tick: the machine after `command`.

        Args:
            command: ``(batch, command)``.
            state: state of the twin before the command.
            measured: ``(batch, output)``, NaN where a port is free; None frees all.

        Returns:
            Outputs ``(batch, output)``, and the state after them.
        """
        row = None if measured is None else np.asarray(measured)[:, None]
        answers, state = self.rollout(np.asarray(command)[:, None], state, row)
        return answers[:, 0], state

    def rollout(self, commands: Array, state: TwinState, measured: Array | None = None) -> tuple[Array, TwinState]:
        """Simulate many samples: row t of the outputs is the machine one sample after row t of the commands.

        Args:
            commands: ``(batch, tick, command)``.
            state: state of the twin before the first sample.
            measured: ``(batch, tick, output)``, NaN where a port is free; None frees all.

        Returns:
            Outputs ``(batch, tick, output)`` within the bounds of the twin, and the state after them.

        Raises:
            DataError: other shapes, or a command that is missing.
        """
        commands = np.ascontiguousarray(commands, dtype=np.float32)
        batch = len(state["answer"])
        ticks = commands.shape[1] if commands.ndim == 3 else 0
        self._check("commands", commands, (batch, ticks, len(self.channels.commands)))
        gaps = np.argwhere(~np.isfinite(commands))
        if len(gaps):
            lane, tick, which = (int(i) for i in gaps[0])
            raise DataError(
                f"command '{self.channels.commands[which].name}' is missing at tick {tick} of lane {lane}; a twin has "
                "no other source for it: repair the log, or end the run before the gap"
            )
        shape = (batch, ticks, len(self.channels.answers))
        measured = np.full(shape, np.nan, np.float32) if measured is None else np.asarray(measured, np.float32)
        self._check("measured", measured, shape)
        if not ticks:
            return np.empty(shape, np.float32), state
        return self._run(commands, np.where(np.isfinite(measured), measured, np.float32(np.nan)), state)

    def branches(self, commands: Array, state: TwinState, measured: Array, first: NDArray[np.int64]) -> Array:
        """Simulate variants of one run that equal the first run up to a given sample each, for a search over commands.

        Args:
            commands: commands ``(run, tick, command)``; before a run branches off, they equal those of the first run.
            state: state of one machine, a batch of one.
            measured: feedback inputs at the first sample ``(output,)``, NaN for outputs that run free.
            first: sample at which each run branches off the first run ``(run,)``, ascending; 0 for the first run.

        Returns:
            Outputs ``(run, tick, output)``.
        """
        fed = np.full((*commands.shape[:2], len(measured)), np.nan, np.float32)
        fed[:, 0] = measured
        return self.rollout(commands, {name: np.repeat(rows, len(commands), 0) for name, rows in state.items()}, fed)[0]

    def runner(self) -> TwinRunner:
        """Return the twin with its present parameters, ready for one machine sample by sample."""
        return TwinRunner(self)

    def scaled(self, answers: Array) -> Array:
        """Return outputs in SI units as a network reads them."""
        return np.asarray((answers - self.scales.answer_offset) / self.scales.answer_width, dtype=np.float32)

    def scale_commands(self, commands: Array) -> Array:
        """Return the commands in SI units as a network reads them."""
        return np.asarray((commands - self.scales.command_offset) / self.scales.command_width, dtype=np.float32)

    def drive(self, commands: Array) -> Array:
        """Return the inputs of free-run training for commands ``(tick, command)`` in SI units, one row per sample."""
        return self.scale_commands(commands)

    def bounded(self, feedback: Array, velocity: Array, pressure: Array) -> Array:
        """Return outputs ``(batch, output)`` limited to the bounds, SI units.

        A stroke is the integral of its velocity by the trapezoidal rule; at an end stop it stays, and the velocity
        into the stop is zero.

        Args:
            feedback: feedback inputs ``(batch, output)``.
            velocity: proposed velocities ``(batch, velocity)``.
            pressure: proposed pressures.
        """
        count, strokes = len(self.channels.velocities), len(self.channels.strokes)
        low, high = self.scales.low, self.scales.high
        velocity = np.clip(velocity, low[:count], high[:count])
        pressure = np.clip(pressure, low[count + strokes :], high[count + strokes :])
        if not strokes:
            return np.concatenate([velocity, pressure], axis=1, dtype=np.float32)
        ends = slice(count, 2 * count)
        stroke = feedback[:, ends] + (feedback[:, :count] + velocity) * np.float32(0.5 / self.channels.rate_hz)
        velocity = np.where(stroke > high[ends], np.minimum(velocity, 0.0), velocity)
        velocity = np.where(stroke < low[ends], np.maximum(velocity, 0.0), velocity)
        stroke = np.clip(stroke, low[ends], high[ends])
        return np.concatenate([velocity, stroke, pressure], axis=1, dtype=np.float32)

    def _check(self, what: str, values: Array, expected: tuple[int, ...]) -> None:
        if values.shape != expected:
            raise DataError(f"{what} of shape {values.shape} came; {expected} (batch, tick, channel) must hold")

    def _check_start(self, start: Array) -> None:
        """Raise an error for a start with unknown values or beyond the end stops."""
        for which, channel in enumerate(self.channels.answers):
            values = start[:, which]
            if not np.isfinite(values).all():
                raise DataError(
                    f"'{channel.name}' is not measured at the first tick of the prefix; a free port starts from a "
                    "measured value: begin where all channels are measured"
                )
        for lane in np.flatnonzero(~self.is_within_stops(start)):
            beyond = self._measure_excess(start[lane : lane + 1])[0]
            which = int(np.argmax(beyond))
            stroke = self.channels.strokes[which]
            low, high = (ends[len(self.channels.velocities) + which] for ends in (self.scales.low, self.scales.high))
            raise DataError(
                f"'{stroke.name}' starts {typed(beyond[which] * (high - low))} {stroke.unit} beyond an end stop of "
                "the "
                f"twin ({typed(low)} to {typed(high)} {stroke.unit}); check its unit and zero, or train on "
                "recordings that "
                "go there"
            )

    def is_within_stops(self, start: Array) -> NDArray[np.bool_]:
        """Return whether a twin can start at ``(batch, output)``: no stroke is far beyond an end stop."""
        return np.asarray((self._measure_excess(start) <= BEYOND).all(axis=1))

    def _measure_excess(self, start: Array) -> Array:
        return _measure_excess(self.channels, self.scales, start)


class TwinRunner:
    """Twin with fixed parameters for one machine sample by sample; constant data are prepared once.

    Results equal those of the twin's methods up to rounding. It is fast enough for a controller at 100 Hz.

    Args:
        twin: twin to run. Later changes of its parameters may or may not take effect.

    Attributes:
        resistance: additional force against each velocity (N, or N m) that is not part of the load; None if the twin's
            equations have no load.
    """

    def __init__(self, twin: Twin) -> None:
        self.twin = twin
        self.resistance: NDArray[np.float64] | None = None

    def branches(self, commands: Array, state: TwinState, measured: Array, first: NDArray[np.int64]) -> Array:
        """See `Twin.branches`."""
        return self.twin.branches(commands, state, measured, first)

    def neighbours(self, commands: Array, state: TwinState, measured: Array, first: NDArray[np.int64]) -> Array:
        """Return `branches` for commands near the commands of the first run, for the derivatives of a plan.

        If this is much cheaper, the other runs are linearised: the first run is exact, and the others differ little
            from it.
        """
        return self.branches(commands, state, measured, first)

    def step(self, command: Array, state: TwinState, measured: Array) -> TwinState:
        """State after one tick.

        Args:
            command: ``(command,)``, finite.
            state: state before the command, a batch of one; it is not changed.
            measured: ``(output,)``, NaN where a port is free.
        """
        return self.twin.step(command[None], state, measured[None])[1]


class TwinSpec(Protocol):
    """Options of a formulation."""

    @property
    def prefix_ticks(self) -> int:
        """Least number of measured ticks before a free run."""
        ...

    def start(self, channels: TwinChannels, scales: TwinScales, train: Sequence[Series], seed: int) -> Twin:
        """Return a twin for these training segments: fitted, or initialised for free-run training."""
        ...

    def shapes(self, channels: TwinChannels) -> Mapping[str, tuple[int, ...]]:
        """Return the shape of each array, without the scales."""
        ...

    def build(self, channels: TwinChannels, scales: TwinScales, arrays: Mapping[str, Array]) -> Twin:
        """Build the twin with these arrays."""
        ...


TWINS: Registry[type] = Registry("twin")


def list_solved_columns(channels: TwinChannels) -> list[int]:
    """Return the outputs that a regression solves for: all outputs except strokes, which are integrals."""
    velocities, strokes = len(channels.velocities), len(channels.strokes)
    return [i for i in range(len(channels.answers)) if not velocities <= i < velocities + strokes]


def _measure_excess(channels: TwinChannels, scales: TwinScales, start: Array) -> Array:
    """Return the distance of strokes beyond the end stops, as a fraction of the range ``(batch, stroke)``."""
    count, strokes = len(channels.velocities), len(channels.strokes)
    ends = slice(count, count + strokes)
    low, high = scales.low[ends], scales.high[ends]
    return np.asarray(np.maximum(low - start[:, ends], start[:, ends] - high) / (high - low), dtype=np.float32)


def even_starts(twin: Twin, series: Sequence[Series], length: int, each: int) -> list[WindowStart]:
    """Return evenly spaced starts of runs with `length` samples, at most `each` per segment, within the end stops.

    Raises:
        DataError: all of them lie beyond.
    """
    return starts_within(twin.channels, twin.scales, series, length, each)


def starts_within(
    channels: TwinChannels, scales: TwinScales, series: Sequence[Series], length: int, each: int
) -> list[WindowStart]:
    """Return `even_starts` for the channels and scales of a twin that is not trained yet.

    Raises:
        DataError: all of them lie beyond.
    """
    # Starts at the same sample of a segment count as one run.
    runs = [
        WindowStart(part, int(at))
        for part in series
        if part.samples >= length
        for at in np.unique(np.linspace(0, part.samples - length, each).astype(np.int64))
    ]
    usable = [
        run for run in runs if (_measure_excess(channels, scales, run.series.targets[[run.first]]) <= BEYOND).all()
    ]
    if not usable:
        raise DataError(
            f"all {len(runs)} starts lie beyond an end stop of the twin, and its end stops are the ends of the strokes "
            "in the training part; divide the recordings otherwise, or check the zeros of the strokes"
        )
    return usable


def check_length(channels: TwinChannels, prefix_ticks: int, train: Sequence[Series]) -> None:
    """Refuse recordings in which no prefix and free run have room.

    Raises:
        ConfigError: says how long the longest one is.
    """
    longest = max((series.samples for series in train), default=0)
    if longest < prefix_ticks + 2:
        raise ConfigError(
            f"twin: the longest training recording has {longest} ticks; more than prefix_ticks = {prefix_ticks} "
            "must hold: give longer recordings, or set a shorter prefix"
        )
