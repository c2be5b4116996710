"""Gymnasium environments with a single episode, such as the simulated machine."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError
from edp.signals import Channel
from edp.sim.environment.batch import EpisodeBatch, Infos, Options, check_render, check_seed, checked_actions
from edp.sim.environment.library import gymnasium
from edp.sim.environment.model import NominalMachine
from edp.sim.environment.simulator import SimulatorBatch
from edp.sim.environment.spec import EnvironmentSpec, settings_of
from edp.sim.episodes.episodes import Moment
from edp.sim.machine import layout as at
from edp.sim.machine.machine import Machine
from edp.storage.reading import Table

Array = NDArray[np.float64]
Observation = NDArray[np.float32]
ACTION = (at.AXES,)


class SingleEnvironment(gymnasium.Env[Observation, Observation]):
    """An environment that is a batch of one episode.

    Args:
        batch: batch of one episode.
    """

    metadata = {"render_modes": []}  # noqa: RUF012  as Gymnasium declares it
    render_mode = None

    def __init__(self, batch: EpisodeBatch) -> None:
        self._batch, self.rate_hz = batch, batch.rate_hz
        self.observation_space, self.action_space = batch.observation_space, batch.action_space
        # Why there is no step now; empty while an episode is under way.
        self._idle = "has not begun"

    def reset(self, *, seed: int | None = None, options: Options | None = None) -> tuple[Observation, Table]:
        """Begin an episode.

        Args:
            seed: seed of all random values in the episode; None continues with the environment's generator.
            options: settings for this episode alone.

        Returns:
            The first observation, and what began.

        Raises:
            ConfigError: an option is unknown or out of range.
        """
        seed = check_seed(seed)
        super().reset(seed=seed)
        facts = self._batch.begin(0, seed, self.np_random, options or {})
        self._idle = ""
        return self._batch.observation(0), {**facts, **self._batch.info(0)}

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, Infos]:
        """Hold an action, shape (3,), for one step.

        Raises:
            ConfigError: the action is not three finite numbers, or no episode is under way.
            SimulationError: the state became non-finite.
        """
        if self._idle:
            raise ConfigError(f"the episode {self._idle}; call reset() before step()")
        batch = self._batch
        rewards, terminated, truncated = batch.step(checked_actions(action, ACTION)[None])
        failed, over, info = terminated.item(0), truncated.item(0), batch.info(0)
        if failed or over:
            self._idle = "has ended"
            info |= batch.summary(0)
        return batch.observation(0), rewards.item(0), failed, over, info


class ExcavatorEnv(SingleEnvironment):
    """An excavator front under lever commands; observations are what its sensors show, in SI units.

    The action contains the lever positions of boom, arm and bucket, -1 to 1, extension positive; larger values are
    clipped. The pilot pressures in observation k result from action k - 1. The reward is 0, because a task defines it.
    Episodes do not terminate; they are truncated at `duration_s`.

    `reset` accepts the options of `edp.sim.environment.start`. Its seed determines initial pose, noise, soil and random
    machine; a scenario with this seed begins equally. The info of `reset` contains ``seed``, ``machine``, ``mass_t`` of
    a random machine, ``material`` and ``truth``; the info of `step` contains ``truth``.

    Args:
        settings: settings of the machine and its observations.
        render_mode: None; there is nothing to render.
        changes: settings of an `EnvironmentSpec` laid over these.

    Attributes:
        settings: see `EnvironmentSpec`.
        channels: name, unit and kind of each value of an observation.
        rate_hz: ticks per second.

    Raises:
        ConfigError: a setting is unknown or out of range.
    """

    _batch: SimulatorBatch

    def __init__(self, settings: EnvironmentSpec | None = None, render_mode: None = None, **changes: Any) -> None:
        check_render("environment", render_mode)
        self.settings = settings_of(settings, changes)
        super().__init__(SimulatorBatch([self.settings]))
        self.channels: tuple[Channel, ...] = self.settings.channels

    @property
    def model(self) -> NominalMachine:
        """Nominal machine of the present episode, or of the next episode before the first reset."""
        return self._batch.models[0]

    @property
    def machine(self) -> Machine:
        """The parameter set of `model`."""
        return self.model.machine

    def commands(self, levers: Any) -> Array:
        """See `NominalMachine.commands`."""
        return self.model.commands(levers)

    def tip(self, strokes: Any) -> Array:
        """See `NominalMachine.tip`."""
        return self.model.tip(strokes)

    def strokes(self, poses: Any) -> Array:
        """See `NominalMachine.strokes`."""
        return self.model.strokes(poses)

    def snapshot(self) -> Moment:
        """Return an exact snapshot of plant, sensors and counters, which later steps do not change.

        Raises:
            ConfigError: no episode has begun.
        """
        return self._batch.episodes.moment(0)

    def restore(self, snapshot: Moment) -> Observation:
        """Restore a snapshot of this or another environment; the following steps give identical bits.

        Returns:
            The observation at the restored time.

        Raises:
            ConfigError: the snapshot belongs to an environment with other channels.
        """
        self._batch.restore(0, snapshot)
        self._idle = "has ended" if self._batch.ended[0] else ""
        return self._batch.observation(0)

    def branch(self, seed: int) -> None:
        """Draw new random values for sensors and soil; the present state is unchanged.

        Raises:
            ConfigError: no episode has begun.
        """
        self._batch.episodes.redraw(0, np.random.SeedSequence(seed))
