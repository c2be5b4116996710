"""Velocity models for controllers: k-step-ahead velocities for candidate commands, from a predictor or a twin."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from edp.control.plant import PILOTS, VELOCITIES
from edp.errors import ConfigError, closest
from edp.networks.streaming import map_state
from edp.networks.twin import Twin
from edp.training.bundle import Bundle

Array = NDArray[np.float64]
NEAR = 0.25
"""Maximum relative difference between a predictor's horizon and the requested time."""


class VelocityModel(ABC):
    """Velocities of the three cylinders ahead, under commands that begin now and stay.

    Attributes:
        reads: measured channels of a row, commands not among them.
        ticks: prediction horizon in samples.
    """

    reads: tuple[str, ...]
    ticks: int

    @abstractmethod
    def begin(self, measured: Array, command: Array) -> None:
        """Initialise the memory in steady state for this row of `reads` and this command of `PILOTS`, (12,)."""

    @abstractmethod
    def ahead(self, measured: Array, commands: Array) -> Array:
        """Return the velocities (m/s), shape (candidate, 3), of candidate commands (Pa), shape (candidate, 12).

        Memory stays.

        The first candidate is the one that a model may be made linear about.
        """

    @abstractmethod
    def advance(self, measured: Array, command: Array) -> None:
        """Let a tick pass in which this row was measured and this command given."""


class PredictorAhead(VelocityModel):
    """Velocity model from a k-step-ahead predictor; its output for present commands assumes their usual continuation.

    Args:
        bundle: it must read pilot pressures and predict the velocities.
        ticks: prediction horizon in samples; the nearest horizon of the predictor is used.

    Raises:
        ConfigError: other targets, no commands, or no horizon near `ticks`.
    """

    def __init__(self, bundle: Bundle, ticks: int) -> None:
        task = bundle.task
        lacking = [name for name in VELOCITIES if name not in task.targets]
        names = [channel.name for channel in bundle.inputs]
        if lacking or not any(name in PILOTS for name in names):
            what = (
                f"does not predict '{lacking[0]}'{closest(lacking[0], task.targets)}" if lacking else "reads no pilot"
            )
            raise ConfigError(
                f"the predictor {what}; an inversion needs velocities by pilot pressures: train it on both"
            )
        self.ticks = min(task.horizons, key=lambda horizon: abs(horizon - ticks))
        if abs(self.ticks - ticks) > NEAR * ticks:
            raise ConfigError(
                f"the predictor looks {self.ticks} ticks ahead, the inversion {ticks}; train one with "
                f"task.horizons = [{ticks}], or set controller.lead_s"
            )
        self._predictor, self._horizon = bundle.predictor, task.horizons.index(self.ticks)
        self._targets = [task.targets.index(name) for name in VELOCITIES]
        self.reads = tuple(name for name in names if name not in PILOTS)
        self._measured = [n for n, name in enumerate(names) if name not in PILOTS]
        self._commands = [n for n, name in enumerate(names) if name in PILOTS]
        self._pilots = [PILOTS.index(names[n]) for n in self._commands]
        self._width, self._state = len(names), None

    def begin(self, measured: Array, command: Array) -> None:
        """Fill the predictor's window with one row."""
        rows = self._rows(measured, command[None])
        with _one_thread():
            start = self._predictor.initial_state(1, rows)
            _, self._state = self._predictor.predict(rows.expand(1, self._predictor.window, self._width), start)

    def ahead(self, measured: Array, commands: Array) -> Array:
        """Return the predictions; each candidate is one batch entry with one step."""
        rows = self._rows(measured, commands)
        with _one_thread():
            lanes = map_state(lambda tensor: tensor.expand(len(rows), *tensor.shape[1:]).contiguous(), self._state)
            answers, _ = self._predictor.predict(rows, lanes)
        return np.asarray(answers[:, -1, self._horizon, self._targets].numpy(), float)

    def advance(self, measured: Array, command: Array) -> None:
        """Advance by one step with the applied command."""
        with _one_thread():
            _, self._state = self._predictor.predict(self._rows(measured, command[None]), self._state)

    def _rows(self, measured: Array, commands: Array) -> torch.Tensor:
        """Return the inputs, shape (candidate, 1, input)."""
        rows = np.empty((len(commands), 1, self._width), np.float32)
        rows[:, 0, self._measured] = measured
        rows[:, 0, self._commands] = commands[:, self._pilots]
        return torch.from_numpy(rows)


class TwinAhead(VelocityModel):
    """Velocity model from a twin, which simulates the commands from the present measurement.

    What the plant does not measure, such as pump pressures, is a free port of the twin: it reads its own last output.

    Args:
        twin: twin with the channels of Table A.1.
        ticks: prediction horizon in samples.
        measured: names of the channels that the plant measures.

    Raises:
        ConfigError: it outputs other velocities, or other commands drive it.
    """

    def __init__(self, twin: Twin, ticks: int, measured: Collection[str]) -> None:
        names = [channel.name for channel in twin.channels.answers]
        for name, options in [(v, names) for v in VELOCITIES] + [(c.name, PILOTS) for c in twin.channels.commands]:
            if name not in options:
                raise ConfigError(f"the twin is not one of an excavator's levers: '{name}'{closest(name, options)}")
        self.twin, self.ticks, self._runner = twin, ticks, twin.runner()
        self.reads = tuple(name for name in names if name in measured)
        self._ports = [names.index(name) for name in self.reads]
        self._velocities = [names.index(name) for name in VELOCITIES]
        self._pilots = [PILOTS.index(channel.name) for channel in twin.channels.commands]
        self._state: Any = None

    def begin(self, measured: Array, command: Array) -> None:
        """Initialise the memory by a steady prefix; free ports start from the training means."""
        ticks = max(self.twin.prefix_ticks, 1)
        rows = np.repeat(self._row(measured)[None, None], ticks, axis=1)
        rows[0, 0] = np.where(np.isfinite(rows[0, 0]), rows[0, 0], self.twin.scales.answer_offset)
        commands = np.repeat(np.asarray(command[self._pilots], np.float32)[None, None], ticks, axis=1)
        self._state = self.twin.reset(commands, rows)

    def ahead(self, measured: Array, commands: Array) -> Array:
        """Return the predictions. Candidates are runs; the first sample reads the measurement, later ones run free."""
        lasting = np.repeat(commands[:, None, self._pilots], self.ticks, axis=1).astype(np.float32)
        first = np.zeros(len(commands), np.int64)
        answers = self._runner.neighbours(lasting, self._state, self._row(measured), first)
        return np.asarray(answers[:, -1, self._velocities], float)

    def advance(self, measured: Array, command: Array) -> None:
        """Advance by one sample with the measured values."""
        pilots = np.asarray(command[self._pilots], np.float32)
        self._state = self._runner.step(pilots, self._state, self._row(measured))

    def _row(self, measured: Array) -> NDArray[np.float32]:
        """Return the values of all ports, NaN where one is free."""
        row = np.full(len(self.twin.channels.answers), np.nan, np.float32)
        row[self._ports] = measured
        return row


@contextmanager
def _one_thread() -> Iterator[None]:
    """Return the PyTorch on one thread, on which the few rows of a tick are fastest; the caller's number comes back."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.inference_mode():
            yield
    finally:
        torch.set_num_threads(before)
