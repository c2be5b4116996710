"""Batch of a model as a plant, without a simulator: what twins and FMUs have in common."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.control.geometry import AXES, TipGeometry
from edp.control.plant import PILOTS, STROKES, VELOCITIES
from edp.errors import ConfigError, closest
from edp.signals import Channel
from edp.sim.environment.batch import Bools, Index, Infos, Options, PlantBatch, StepOutcome, check_finite
from edp.sim.environment.library import gymnasium
from edp.sim.environment.single import ExcavatorEnv, SingleEnvironment
from edp.sim.environment.spec import EnvironmentSpec

Array = NDArray[np.float64]
Rows = NDArray[np.float32]
OPTIONS = ("strokes", "material")
"""Options of a reset. ``material`` must be empty unless the twin includes a ground."""
MIDDLE = (0.5, 0.5, 0.5)
TIP = ("TipX", "TipY", "TipAngle")


class ModelBatch(PlantBatch):
    """Plants whose levers become nominal pilot pressures, which a model outputs without noise.

    An observation holds the outputs, then the pilot pressures. A learned model says nothing of the pressures of a pose
    in steady state, and its prefix must be measured: both are those of a simulated machine.

    Args:
        answers: channels of the model's outputs; the strokes are among them.
        commands: channels of the model's inputs, of those that levers command.
        machine: name or file of the machine whose kinematics, nominal commands and pressures in steady state are used.
        rate_hz: sampling rate in Hz.
        prefix: number of samples in steady state before an episode.
        duration_s: length of an episode.
        count: number of plants.

    Attributes:
        machine: parameter set of the machine.
        commands: nominal pilot pressures (Pa) of levers.
        noun: name of the plant in messages of a reset.

    Raises:
        ConfigError: there is no such machine or channel.
    """

    noun: str

    def __init__(
        self,
        answers: tuple[Channel, ...],
        commands: tuple[Channel, ...],
        machine: str,
        rate_hz: float,
        prefix: int,
        duration_s: float,
        count: int,
    ) -> None:
        super().__init__((*answers, *commands), count)
        self.observed[:] = 0.0
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (len(self.channels),), np.float32)
        rest = EnvironmentSpec(
            machine=machine,
            duration_s=(prefix + 2) / rate_hz,
            rate_hz=rate_hz,
            sensor_noise=False,
            observed=tuple(channel.name for channel in self.channels),
        )
        self._rest, self._prefix, self.rate_hz = ExcavatorEnv(rest), prefix, rate_hz
        self.machine, self.commands = self._rest.machine, self._rest.commands
        self._geometry = TipGeometry(self.machine)
        names = [channel.name for channel in answers]
        self._strokes = np.array([names.index(name) for name in STROKES])
        self._columns = np.array([PILOTS.index(channel.name) for channel in commands])
        self._ticks, self.tick = round(duration_s * rate_hz), np.zeros(count, np.int64)

    def begin(self, index: int, seed: int | None, rng: np.random.Generator, options: Options) -> Infos:
        """Begin an episode in steady state at ``strokes`` (fractions of full stroke), without random values.

        Raises:
            ConfigError: an option is unknown, or a soil where there is no ground.
        """
        for name in options:
            if name not in OPTIONS:
                raise ConfigError(f"reset of {self.noun}: option '{name}' is unknown{closest(name, OPTIONS)}")
        self._choose_soil(options.get("material"))
        self.tick[index], self.ended[index] = 0, False
        self.observed[index] = self._start(index, options.get("strokes") or MIDDLE)
        return {}

    def step(self, actions: Array, active: Bools | None = None) -> StepOutcome:
        """Hold lever positions, shape (count, 3), for one tick; plants that are not active may move as well.

        Raises:
            ConfigError: the levers are not finite.
            SimulationError: the model fails.
        """
        check_finite(actions)
        pilots = self._pilots(actions)
        self.tick += 1
        answers = self._answer(pilots, active)
        self.observed = np.concatenate([answers, pilots], axis=1).astype(np.float32)
        np.greater_equal(self.tick, self._ticks, out=self.ended)
        return self._outcome

    def truth(self, index: Index) -> Mapping[str, object]:
        """Return strokes and tip for one plant or for all plants."""
        strokes = self.observed[index][..., self._strokes].astype(float)
        values = np.concatenate([strokes, self._geometry.tip(strokes)], axis=-1).T
        return dict(zip((*STROKES, *TIP), values.tolist() if values.ndim == 1 else values, strict=True))

    def _rest_rows(self, shares: Any) -> Rows:
        """Return steady rows at strokes (fractions of full), the prefix and one more, shape (tick, channel)."""
        rows = [self._rest.reset(seed=0, options={"strokes": tuple(map(float, shares))})[0]]
        rows += [self._rest.step(np.zeros(AXES))[0] for _ in range(self._prefix)]
        return np.array(rows, np.float32)

    def _pilots(self, levers: Array) -> Rows:
        """Return inputs of the model, shape (..., command), of levers, shape (..., 3)."""
        pressures = self.commands(np.clip(levers, -1.0, 1.0))
        return np.asarray(pressures[..., self._columns], np.float32)

    def _choose_soil(self, material: Any) -> None:
        """Take note of the soil of an episode.

        Raises:
            ConfigError: the model knows no soil.
        """
        if material:
            raise ConfigError(
                f"reset: material = '{material}'; {self.noun} knows no soil: choose another task, or material = ''"
            )

    @abstractmethod
    def _start(self, index: int, shares: Any) -> Rows:
        """Begin at strokes (fractions of full) and return the first observation, shape (channel,)."""

    @abstractmethod
    def _answer(self, pilots: Rows, active: Bools | None) -> Array | Rows:
        """Return the outputs one tick later, shape (count, output)."""


class ModelEnvironment(SingleEnvironment):
    """An environment whose machine is a model.

    Args:
        batch: batch of one plant.

    Attributes:
        channels: channels of an observation, in order.
        machine: parameter set of the machine.
        commands: nominal pilot pressures (Pa) of levers.
        source: name of the plant in messages.
    """

    _batch: ModelBatch

    def __init__(self, batch: ModelBatch) -> None:
        super().__init__(batch)
        self.channels, self.source = batch.channels, batch.source
        self.machine, self.commands = batch.machine, batch.commands


def check_plant_channels(what: str, commands: Sequence[str], answers: Sequence[str], change: str) -> None:
    """Raise an error unless the plant is an excavator of Table A.1.

    Args:
        what: the plant, for the message.
        commands: names of what commands it.
        answers: names of what it outputs.
        change: advice for the message.

    Raises:
        ConfigError: names the first channel that lacks, or that is none of a lever's pilot pressures.
    """
    lacking = [name for name in (*STROKES, *VELOCITIES) if name not in answers]
    strange = [name for name in commands if name not in PILOTS]
    if lacking or strange:
        fault = f"has no {lacking[0]}" if lacking else f"is commanded by '{strange[0]}'{closest(strange[0], PILOTS)}"
        raise ConfigError(
            f"{what} {fault}; a plant in closed loop answers the velocities and strokes of an excavator to the "
            f"pilot pressures of Table A.1: {change}"
        )
