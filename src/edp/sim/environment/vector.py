"""Many machines as one environment of Gymnasium: one compiled call a tick."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError
from edp.settings.bounds import shown
from edp.signals import Channel
from edp.sim.environment.library import gymnasium
from edp.sim.environment.model import NominalMachine
from edp.sim.environment.single import spaces
from edp.sim.environment.spec import EnvironmentSpec, settings_of
from edp.sim.environment.start import MOST_SEED, check_mask, check_seed, episode_start
from edp.sim.environment.truth import Truth
from edp.sim.episodes.episodes import Episodes, Moment
from edp.sim.machine import layout as at

Array = NDArray[np.float64]
AutoresetMode = gymnasium.vector.AutoresetMode
Bools = NDArray[np.bool_]
MOST_MACHINES = 65_536


class VectorExcavatorEnv(gymnasium.vector.VectorEnv[NDArray[np.float32], NDArray[np.float32], NDArray[Any]]):
    """Excavator fronts side by side, each with its own machine, soil and seed; the same bits as `ExcavatorEnv`.

    Args:
        num_envs: how many.
        settings: what is simulated and shown, for all or one for each; they differ in machine and soil only.
        autoreset_mode: what happens to an episode that has ended: a reset at the next step (the usual), in the same
            step, or none, so that `reset` has to be called with the option ``reset_mask``.
        render_mode: None; there is nothing to render.
        changes: settings of an `EnvironmentSpec` laid over all of these.

    Attributes:
        settings: of each machine.
        channels: name, unit and kind of each value of an observation.
        rate_hz: ticks per second.
        models: the nominal machine of each episode.

    Raises:
        ConfigError: a setting is unknown or out of range, or those of the machines cannot go side by side.
    """

    def __init__(
        self,
        num_envs: int = 1,
        settings: EnvironmentSpec | Sequence[EnvironmentSpec] | None = None,
        autoreset_mode: Any = AutoresetMode.NEXT_STEP,
        render_mode: None = None,
        **changes: Any,
    ) -> None:
        if render_mode is not None:
            raise ConfigError(f"environment: render_mode = {render_mode!r}; there is nothing to render, leave it out")
        if not 1 <= num_envs <= MOST_MACHINES:
            raise ConfigError(f"environment: num_envs = {num_envs}; give 1 to {MOST_MACHINES}")
        self.num_envs, self.settings = num_envs, _side_by_side(num_envs, settings, changes)
        try:
            mode = AutoresetMode(autoreset_mode)
        except ValueError as error:
            modes = ", ".join(entry.value for entry in AutoresetMode)
            raise ConfigError(f"environment: autoreset_mode = {autoreset_mode!r}; choose one of {modes}") from error
        self.metadata = {"render_modes": [], "autoreset_mode": mode}
        self.channels: tuple[Channel, ...] = self.settings[0].channels
        self.rate_hz, self.render_mode = self.settings[0].rate_hz, None
        self.single_observation_space, self.single_action_space = spaces(self.channels)
        self.observation_space, self.action_space = (
            gymnasium.vector.utils.batch_space(space, num_envs)
            for space in (self.single_observation_space, self.single_action_space)
        )
        self.models = [NominalMachine(each.scenario(0).load()) for each in self.settings]
        self._mode = mode
        self._episodes = Episodes(num_envs, self.settings[0].columns)
        self._levers, self._pilots = np.zeros((num_envs, at.AXES)), np.zeros(num_envs)
        self._generators = [np.random.default_rng() for _ in range(num_envs)]
        self._begun, self._in_soil = np.zeros(num_envs, dtype=np.bool_), False
        self._present = self._episodes.new_out()
        for array in self._present[:2]:
            # What has not begun shows nothing.
            array[:] = np.nan

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, object] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, object]]:
        """Begin episodes.

        Args:
            seed: of the first, the others count on; or one for each; None goes on with the generators of each.
            options: as those of `ExcavatorEnv`, for all; ``reset_mask``, shape (num_envs,), resets these alone.

        Returns:
            Observations, shape (num_envs, channel), and what began, as arrays beside masks such as ``_machine``.

        Raises:
            ConfigError: an option or the number of seeds is not possible.
        """
        options = dict(options or {})
        mask = check_mask(self.num_envs, options.pop("reset_mask", None))
        seeds = [None] * self.num_envs if seed is None else seed
        if isinstance(seeds, int | np.integer):
            seeds = [int(seeds) + i for i in range(self.num_envs)]
        if len(seeds) != self.num_envs:
            raise ConfigError(f"reset: {len(seeds)} seeds for {self.num_envs} machines; give one for each, or one")
        infos = self._begin(mask, seeds, options)
        return self._present[0].copy(), {**infos, "truth": self._truth()}

    def step(self, actions: Any) -> tuple[NDArray[np.float32], Array, Bools, Bools, dict[str, object]]:
        """Hold lever positions, shape (num_envs, 3), for one tick.

        Raises:
            ConfigError: they are not finite or of another shape, or an episode has ended or not begun.
            SimulationError: a state became non-finite.
        """
        levers = np.asarray(actions, dtype=float)
        if levers.shape != self._levers.shape:
            raise ConfigError(f"levers of shape {levers.shape}; give shape {self._levers.shape}: boom, arm, bucket")
        self._levers[:] = levers
        ended = self._present[2].copy()
        resets = self._mode is AutoresetMode.NEXT_STEP
        stuck = ~self._begun if resets else ~self._begun | ended
        if stuck.any():
            raise ConfigError(f"episodes {shown(np.flatnonzero(stuck).tolist())} are not under way; call reset() first")
        infos: dict[str, object] = {}
        if resets and ended.any():
            # An episode that is reset in this step ignores its levers.
            self._episodes.step(self._levers, self._present, ~ended)
            infos = self._begin(ended, [None] * self.num_envs, {})
        else:
            self._episodes.step(self._levers, self._present)
        truncated = self._present[2].copy()
        if self._mode is AutoresetMode.SAME_STEP and truncated.any():
            infos = self._next_at_once(truncated)
        infos["truth"] = self._truth()
        never = np.zeros(self.num_envs, dtype=np.bool_)
        return self._present[0].copy(), np.zeros(self.num_envs), never, truncated, infos

    def snapshot(self, index: int) -> Moment:
        """Return a snapshot of one machine; `ExcavatorEnv.restore` accepts it, too.

        Raises:
            ConfigError: no episode has begun there.
        """
        return self._episodes.moment(index)

    def restore(self, index: int, snapshot: Moment) -> NDArray[np.float32]:
        """Restore one machine to a snapshot of this or another environment.

        Returns:
            Its observation of that moment, shape (channel,).

        Raises:
            ConfigError: the snapshot is of an environment that shows other channels.
        """
        self._episodes.go_to(index, snapshot)
        self._episodes.show(index, self._present)
        self._enter(index)
        observation: NDArray[np.float32] = self._present[0][index].copy()
        return observation

    def _begin(self, mask: Bools, seeds: Sequence[int | None], options: dict[str, object]) -> dict[str, object]:
        """Begin the masked episodes; returns what began."""
        infos: dict[str, object] = {}
        for index in np.flatnonzero(mask).tolist():
            seed = check_seed(seeds[index])
            if seed is not None:
                self._generators[index] = gymnasium.utils.seeding.np_random(seed)[0]
            else:
                seed = int(self._generators[index].integers(MOST_SEED))
            start, facts = episode_start(self.settings[index], seed, options)
            self._episodes.begin(index, start, self._present)
            self._enter(index)
            infos = self._add_info(infos, facts, index)
        return infos

    def _next_at_once(self, truncated: Bools) -> dict[str, object]:
        """Begin the next episodes in the step in which the last ones ended, and keep what these showed last."""
        last_observations = np.full(self.num_envs, None, dtype=object)
        for index in np.flatnonzero(truncated).tolist():
            last_observations[index] = self._present[0][index].copy()
        last_truth = self._truth()
        infos = self._begin(truncated, [None] * self.num_envs, {})
        infos["final_obs"], infos["_final_obs"] = last_observations, truncated.copy()
        infos["final_info"], infos["_final_info"] = {"truth": last_truth}, truncated.copy()
        return infos

    def _enter(self, index: int) -> None:
        """Take note of an episode's machine and soil."""
        start = self._episodes.starts[index]
        if start is None:
            raise ConfigError(f"episode {index} has not begun; reset it first")
        if start.machine is not self.models[index].machine:
            self.models[index] = NominalMachine(start.machine)
        self._pilots[index], self._begun[index] = start.machine.valves.pilot_pressure, True
        starts = self._episodes.starts
        self._in_soil = any(each is not None and bool(each.scenario.material) for each in starts)

    def _truth(self) -> Truth:
        pilots, episodes = self._pilots.copy(), self._episodes
        return Truth(self._present[1].copy(), pilots, self._in_soil, episodes.most_faults, episodes.shares())


def _side_by_side(
    count: int, settings: EnvironmentSpec | Sequence[EnvironmentSpec] | None, changes: dict[str, object]
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
