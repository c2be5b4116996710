"""One task many times side by side as an environment of Gymnasium."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.control.geometry import AXES
from edp.control.learning.episodes import TaskEpisodes
from edp.control.learning.single import check_options, check_render, finite_actions
from edp.control.learning.spec import LearningSpec, learning_spec
from edp.errors import ConfigError
from edp.settings.bounds import shown
from edp.sim.environment.library import gymnasium
from edp.sim.environment.start import check_mask, check_seed

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Rows = NDArray[np.float32]
AutoresetMode = gymnasium.vector.AutoresetMode
MOST_LANES = 65_536


class VectorTaskEnvironment(gymnasium.vector.VectorEnv[Rows, Rows, NDArray[Any]]):
    """`TaskEnvironment` side by side, each with its own reference: one call of the plant a tick.

    On the simulator each gives the bits of the single environment with its seed; on a twin, whose lanes are one batch,
    the same to rounding.

    Args:
        num_envs: how many.
        settings: what is to be done, and on what.
        autoreset_mode: what happens to an episode that has ended: a reset at the next step (the usual), in the same
            step, or none, so that `reset` has to be called with the option ``reset_mask``.
        render_mode: None; there is nothing to render.
        changes: settings of a `LearningSpec` laid over these.

    Attributes:
        settings: see `LearningSpec`.
        names: of the values of an observation, in their order.
        rate_hz: ticks per second.

    Raises:
        EdpError: a setting is unknown or out of range, or the plant cannot be used.
    """

    def __init__(
        self,
        num_envs: int = 1,
        settings: LearningSpec | None = None,
        autoreset_mode: Any = AutoresetMode.NEXT_STEP,
        render_mode: None = None,
        **changes: Any,
    ) -> None:
        check_render(render_mode)
        if not 1 <= num_envs <= MOST_LANES:
            raise ConfigError(f"task environment: num_envs = {num_envs}; give 1 to {MOST_LANES}")
        try:
            self._mode = AutoresetMode(autoreset_mode)
        except ValueError as error:
            modes = ", ".join(entry.value for entry in AutoresetMode)
            raise ConfigError(
                f"task environment: autoreset_mode = {autoreset_mode!r}; choose one of {modes}"
            ) from error
        self.metadata = {"render_modes": [], "autoreset_mode": self._mode}
        self.num_envs, self.settings, self.render_mode = num_envs, learning_spec(settings, changes), None
        self._episodes = TaskEpisodes(self.settings, num_envs)
        self.plant, self.names = self._episodes.plant, self._episodes.features.names
        self.rate_hz = self.plant.rate_hz
        self.single_observation_space, self.single_action_space = self._episodes.spaces
        self.observation_space, self.action_space = (
            gymnasium.vector.utils.batch_space(space, num_envs) for space in self._episodes.spaces
        )
        self._generators = [np.random.default_rng() for _ in range(num_envs)]
        self._begun, self._ended = np.zeros(num_envs, dtype=np.bool_), np.zeros(num_envs, dtype=np.bool_)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, object] | None = None
    ) -> tuple[Rows, dict[str, object]]:
        """Begin episodes.

        Args:
            seed: of the first, the others count on; or one for each; None draws them.
            options: ``reset_mask``, shape (num_envs,), resets these alone.

        Returns:
            Observations, shape (num_envs, value), and what began, as arrays beside masks such as ``_seed``.

        Raises:
            ConfigError: an option or the number of seeds is not possible.
        """
        options = dict(options or {})
        mask = check_mask(self.num_envs, options.pop("reset_mask", None))
        check_options(options)
        seeds = [None] * self.num_envs if seed is None else seed
        if isinstance(seeds, int | np.integer):
            seeds = [int(seeds) + lane for lane in range(self.num_envs)]
        if len(seeds) != self.num_envs:
            raise ConfigError(f"reset: {len(seeds)} seeds for {self.num_envs} lanes; give one for each, or one")
        infos = self._begin(mask, seeds)
        return self._episodes.observation(), infos | {"position_m": self._episodes.position_m.copy()}

    def step(self, actions: Any) -> tuple[Rows, Array, Bools, Bools, dict[str, object]]:
        """Hold actions, shape (num_envs, 3), for `hold` ticks.

        Raises:
            ConfigError: they are not finite or of another shape, or an episode has ended or not begun.
            SimulationError: a plant's state became non-finite.
        """
        asked = finite_actions(actions, (self.num_envs, AXES))
        resets = self._mode is AutoresetMode.NEXT_STEP
        stuck = ~self._begun if resets else ~self._begun | self._ended
        if stuck.any():
            raise ConfigError(f"episodes {shown(np.flatnonzero(stuck).tolist())} are not under way; call reset() first")
        again = self._ended.copy()
        rewards, lost, truncated = self._episodes.act(asked, ~again)
        self._ended = lost | truncated
        infos: dict[str, object] = {}
        for lane in np.flatnonzero(self._ended).tolist():
            infos = self._add_info(infos, {"score": dict(self._episodes.score(lane))}, lane)
        if again.any():
            # An episode that is reset in this step ignores its action.
            infos = self._begin(again, [None] * self.num_envs, infos)
        position = self._episodes.position_m.copy()
        if self._mode is AutoresetMode.SAME_STEP and self._ended.any():
            infos = self._next_at_once(self._ended.copy(), infos)
        return self._episodes.observation(), rewards, lost, truncated, infos | {"position_m": position}

    def _begin(
        self, mask: Bools, seeds: Sequence[int | None], infos: dict[str, object] | None = None
    ) -> dict[str, object]:
        """Begin the masked episodes; returns what began."""
        infos = infos or {}
        for lane in np.flatnonzero(mask).tolist():
            seed = check_seed(seeds[lane])
            if seed is not None:
                self._generators[lane] = gymnasium.utils.seeding.np_random(seed)[0]
            facts = self._episodes.begin(lane, seed, self._generators[lane])
            infos = self._add_info(infos, facts, lane)
            self._begun[lane], self._ended[lane] = True, False
        return infos

    def _next_at_once(self, ended: Bools, infos: dict[str, object]) -> dict[str, object]:
        """Begin the next episodes in the step in which the last ones ended, and keep what these showed last."""
        last = np.full(self.num_envs, None, dtype=object)
        rows = self._episodes.observation()
        for lane in np.flatnonzero(ended).tolist():
            last[lane] = rows[lane].copy()
        closing = {key: infos.pop(key) for key in ("score", "_score")}
        infos = self._begin(ended, [None] * self.num_envs, infos)
        infos |= {"final_obs": last, "_final_obs": ended, "final_info": closing, "_final_info": ended.copy()}
        return infos
