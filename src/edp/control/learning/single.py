"""One task as an environment of Gymnasium."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.control.geometry import AXES
from edp.control.learning.episodes import TaskEpisodes
from edp.control.learning.spec import LearningSpec, learning_spec
from edp.errors import ConfigError
from edp.sim.environment.library import gymnasium
from edp.sim.environment.start import check_seed

Row = NDArray[np.float32]


class TaskEnvironment(gymnasium.Env[Row, Row]):
    """A reference of the bucket tip to follow, on the simulator, a twin or an FMU.

    The observation is `names`, in numbers of about one; the action three numbers from -1 to 1: the levers, or with a
    base controller a correction of its levers. Levers keep the limits of the task, whatever is asked. Reward and end:
    see `RewardWeights` and `LearningSpec`.

    Args:
        settings: what is to be done, and on what.
        render_mode: None; there is nothing to render.
        changes: settings of a `LearningSpec` laid over these.

    Attributes:
        settings: see `LearningSpec`.
        names: of the values of an observation, in their order.
        rate_hz: ticks per second.

    Raises:
        EdpError: a setting is unknown or out of range, or the plant cannot be used.
    """

    metadata = {"render_modes": []}  # noqa: RUF012  as Gymnasium declares it

    def __init__(self, settings: LearningSpec | None = None, render_mode: None = None, **changes: Any) -> None:
        check_render(render_mode)
        self.settings, self.render_mode = learning_spec(settings, changes), None
        self._episodes = TaskEpisodes(self.settings, 1)
        self.plant, self.names = self._episodes.plant, self._episodes.features.names
        self.rate_hz = self.plant.rate_hz
        self.observation_space, self.action_space = self._episodes.spaces
        self._under_way = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, object] | None = None
    ) -> tuple[Row, dict[str, object]]:
        """Begin an episode.

        Args:
            seed: of the reference, as that of a loop of ``edp control``, and of the sensors; None draws one of `seeds`.
            options: none.

        Returns:
            The first observation, and its ``seed``, length in ``seconds`` and ``position_m``.

        Raises:
            ConfigError: the seed has no reference that the machine can do, or an option came.
        """
        check_options(options)
        seed = check_seed(seed)
        super().reset(seed=seed)
        facts = self._episodes.begin(0, seed, self.np_random)
        self._under_way = True
        return self._episodes.observation()[0], facts | {"position_m": float(self._episodes.position_m[0])}

    def step(self, action: Any) -> tuple[Row, float, bool, bool, dict[str, object]]:
        """Hold an action, shape (3,), for `hold` ticks.

        Returns:
            Observation, reward, whether the tip was lost, whether the reference ended, and ``position_m``, at the end
            with the figures of the episode as ``score``.

        Raises:
            ConfigError: the action is not three finite numbers, or no episode is under way.
            SimulationError: the plant's state became non-finite.
        """
        if not self._under_way:
            raise ConfigError("no episode is under way; call reset() before step()")
        asked = finite_actions(action, (AXES,))
        rewards, lost, truncated = self._episodes.act(asked[None], np.ones(1, dtype=np.bool_))
        self._under_way = not bool(lost[0] or truncated[0])
        info: dict[str, object] = {"position_m": float(self._episodes.position_m[0])}
        if not self._under_way:
            info["score"] = dict(self._episodes.score(0))
        return self._episodes.observation()[0], float(rewards[0]), bool(lost[0]), bool(truncated[0]), info


def finite_actions(actions: Any, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Actions of a shape.

    Raises:
        ConfigError: another shape, or one that is not finite.
    """
    array = np.asarray(actions, dtype=float)
    if array.shape != shape:
        raise ConfigError(f"actions of shape {array.shape} came; give shape {shape}: boom, arm and bucket")
    if not np.isfinite(array).all():
        raise ConfigError(f"an action is not finite: {array.tolist()}; give numbers from -1 to 1")
    return array


def check_render(mode: Any) -> None:
    """Refuse a mode of rendering.

    Raises:
        ConfigError: there is one.
    """
    if mode is not None:
        raise ConfigError(f"task environment: render_mode = {mode!r}; there is nothing to render, leave it out")


def check_options(options: dict[str, object] | None) -> None:
    """Raise an error for options of a reset, since an episode follows from its seed.

    Raises:
        ConfigError: there is one.
    """
    if options:
        raise ConfigError(f"reset of a task: option '{next(iter(options))}' is unknown; there is none")
