"""Gymnasium environments with many parallel episodes, such as simulated machines."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError
from edp.settings.bounds import shown
from edp.signals import Channel
from edp.sim.environment.batch import (
    ALL,
    AutoresetMode,
    Bools,
    EpisodeBatch,
    Infos,
    Options,
    check_mask,
    check_render,
    checked_actions,
    checked_mode,
    checked_seeds,
)
from edp.sim.environment.library import gymnasium
from edp.sim.environment.model import NominalMachine
from edp.sim.environment.simulator import SimulatorBatch
from edp.sim.environment.spec import EnvironmentSpec, settings_of
from edp.sim.episodes.episodes import Moment
from edp.sim.machine import layout as at

Array = NDArray[np.float64]
Observations = NDArray[np.float32]


class VectorEnvironment(gymnasium.vector.VectorEnv[Observations, Observations, NDArray[Any]]):
    """Environments that are a batch of episodes.

    Args:
        batch: batch of the episodes.
        mode: treatment of an episode that has ended, see `checked_mode`.
    """

    def __init__(self, batch: EpisodeBatch, mode: Any) -> None:
        self._batch, self._mode, self.num_envs, self.rate_hz = batch, mode, batch.count, batch.rate_hz
        self.metadata, self.render_mode = {"render_modes": [], "autoreset_mode": mode}, None
        self.single_observation_space, self.single_action_space = batch.observation_space, batch.action_space
        self.observation_space, self.action_space = (
            gymnasium.vector.utils.batch_space(space, batch.count)
            for space in (batch.observation_space, batch.action_space)
        )
        self._generators = [np.random.default_rng() for _ in range(batch.count)]
        self._begun, self._ended = np.zeros(batch.count, np.bool_), np.zeros(batch.count, np.bool_)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Options | None = None
    ) -> tuple[Observations, Infos]:
        """Begin episodes.

        Args:
            seed: seed of the first episode, with consecutive seeds for the others; or one seed per episode; None
                continues with the generator of each episode.
            options: options for all environments, as for a single environment; ``reset_mask``, shape (num_envs,),
                selects the environments to reset.

        Returns:
            Observations, shape (num_envs, value), and infos about the start as arrays, with masks such as ``_seed``.

        Raises:
            ConfigError: an option or the number of seeds is not possible.
        """
        options = dict(options or {})
        mask = check_mask(self.num_envs, options.pop("reset_mask", None))
        infos = self._begin(mask, checked_seeds(self.num_envs, seed), options, {})
        return self._batch.observation(ALL), {**infos, **self._batch.info(ALL)}

    def step(self, actions: Any) -> tuple[Observations, Array, Bools, Bools, Infos]:
        """Hold actions, shape (num_envs, 3), for one step.

        Raises:
            ConfigError: they are not finite or of another shape, or an episode has ended or not begun.
            SimulationError: a state became non-finite.
        """
        asked = checked_actions(actions, (self.num_envs, at.AXES))
        again, restarts = self._ended, bool(self._ended.any())
        if not self._begun.all() or (restarts and self._mode is not AutoresetMode.NEXT_STEP):
            stuck = ~self._begun if self._mode is AutoresetMode.NEXT_STEP else ~self._begun | again
            raise ConfigError(f"episodes {shown(np.flatnonzero(stuck).tolist())} are not under way; call reset() first")
        # An episode that is reset in this step ignores its action.
        active = ~again if restarts else None
        outcome = self._batch.step(asked, active)
        rewards, terminated, truncated = outcome.rewards.copy(), outcome.terminated.copy(), outcome.truncated.copy()
        if active is not None:
            terminated &= active
            truncated &= active
        self._ended = terminated | truncated
        infos: Infos = {}
        ended = np.flatnonzero(self._ended).tolist()
        for index in ended:
            infos = self._add_info(infos, self._batch.summary(index), index)
        if restarts:
            infos = self._begin(again, [None] * self.num_envs, {}, infos)
        if ended and self._mode is AutoresetMode.SAME_STEP:
            infos = self._restart(infos)
        return self._batch.observation(ALL), rewards, terminated, truncated, {**self._batch.info(ALL), **infos}

    def _begin(self, mask: Bools, seeds: Sequence[int | None], options: Options, infos: Infos) -> Infos:
        """Begin the masked episodes; return infos about their start."""
        for index in np.flatnonzero(mask).tolist():
            seed = seeds[index]
            if seed is not None:
                self._generators[index] = gymnasium.utils.seeding.np_random(seed)[0]
            facts = self._batch.begin(index, seed, self._generators[index], options)
            self._begun[index], self._ended[index] = True, False
            infos = self._add_info(infos, facts, index)
        return infos

    def _restart(self, infos: Infos) -> Infos:
        """Begin the next episodes in the step in which the last ones ended; return infos with their last views."""
        ended, rows = self._ended.copy(), self._batch.observation(ALL)
        last = np.full(self.num_envs, None, dtype=object)
        for index in np.flatnonzero(ended).tolist():
            last[index] = rows[index]
        final = {**infos, **self._batch.info(ALL)}
        infos = self._begin(ended, [None] * self.num_envs, {}, {})
        return infos | {"final_obs": last, "_final_obs": ended, "final_info": final, "_final_info": ended.copy()}


class VectorExcavatorEnv(VectorEnvironment):
    """Excavator fronts side by side, each with its own machine, soil and seed; the same bits as `ExcavatorEnv`.

    Args:
        num_envs: number of environments.
        settings: settings for all environments, or one per environment; they may differ only in machine and soil.
        autoreset_mode: treatment of an episode that has ended: reset at the next step (default), reset in the same
            step, or no reset. Without automatic reset, call `reset` with the option ``reset_mask``.
        render_mode: None; there is nothing to render.
        changes: settings of an `EnvironmentSpec` laid over all of these.

    Attributes:
        settings: settings of each machine.
        channels: name, unit and kind of each value of an observation.
        rate_hz: ticks per second.

    Raises:
        ConfigError: a setting is unknown or out of range, or those of the machines cannot go side by side.
    """

    _batch: SimulatorBatch

    def __init__(
        self,
        num_envs: int = 1,
        settings: EnvironmentSpec | Sequence[EnvironmentSpec] | None = None,
        autoreset_mode: Any = AutoresetMode.NEXT_STEP,
        render_mode: None = None,
        **changes: Any,
    ) -> None:
        check_render("environment", render_mode)
        mode = checked_mode("environment", num_envs, autoreset_mode)
        self.settings = _side_by_side(num_envs, settings, changes)
        super().__init__(SimulatorBatch(self.settings), mode)
        self.channels: tuple[Channel, ...] = self._batch.channels

    @property
    def models(self) -> list[NominalMachine]:
        """The nominal machine of each episode."""
        return self._batch.models

    def snapshot(self, index: int) -> Moment:
        """Return a snapshot of one machine, see `ExcavatorEnv.snapshot`."""
        return self._batch.episodes.moment(index)

    def restore(self, index: int, snapshot: Moment) -> Observations:
        """Restore one machine to a snapshot, also of another environment, see `ExcavatorEnv.restore`."""
        self._batch.restore(index, snapshot)
        self._begun[index], self._ended[index] = True, self._batch.ended[index]
        return self._batch.observation(index)


def _side_by_side(
    count: int, settings: EnvironmentSpec | Sequence[EnvironmentSpec] | None, changes: Infos
) -> list[EnvironmentSpec]:
    """Return the settings of each machine.

    Raises:
        ConfigError: their number, channels or rates do not fit.
    """
    each = [settings] * count if settings is None or isinstance(settings, EnvironmentSpec) else list(settings)
    if len(each) != count:
        raise ConfigError(f"environment: {len(each)} settings for num_envs = {count}; give one for each, or one")
    # Equal settings are checked once.
    checked = {id(entry): settings_of(entry, changes) for entry in each}
    every = [checked[id(entry)] for entry in each]
    for entry in every:
        if (entry.observed, entry.rate_hz) != (every[0].observed, every[0].rate_hz):
            raise ConfigError("environment: machines side by side differ in observed or rate_hz; give them the same")
    return every
