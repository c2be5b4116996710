"""Tasks as environments of Gymnasium, one or many side by side."""

from __future__ import annotations

from typing import Any

from edp.control.learning.episodes import TaskEpisodes
from edp.control.learning.spec import LearningSpec, learning_spec
from edp.sim.environment.batch import ALL, AutoresetMode, Infos, check_render, checked_mode
from edp.sim.environment.single import SingleEnvironment
from edp.sim.environment.vector import VectorEnvironment


class TaskEnvironment(SingleEnvironment):
    """A reference of the bucket tip to follow, on the simulator, a twin or an FMU.

    The observation is `names`, in numbers of about one; the action three numbers from -1 to 1: the levers, or with a
    base controller a correction of its levers. An action holds for `hold` ticks. Levers keep the limits of the task,
    whatever is asked. Reward and end: see `RewardWeights` and `LearningSpec`.

    `reset` takes no options; its seed is that of the reference, as that of a loop of ``edp loop run``, and of the
    sensors, and None draws one of `seeds`. It says ``seed``, length in ``seconds`` and ``position_m``; each step says
    ``position_m``, the last one the figures of the episode as ``score`` as well. An episode terminates where the tip is
    lost.

    Args:
        settings: task and plant.
        render_mode: None; there is nothing to render.
        changes: settings of a `LearningSpec` laid over these.

    Attributes:
        settings: see `LearningSpec`.
        plant: interface of the plant for controllers.
        names: names of the values of an observation, in order.
        rate_hz: ticks per second.

    Raises:
        EdpError: a setting is unknown or out of range, or the plant cannot be used.
    """

    def __init__(self, settings: LearningSpec | None = None, render_mode: None = None, **changes: Any) -> None:
        check_render("task environment", render_mode)
        self.settings = learning_spec(settings, changes)
        episodes = TaskEpisodes(self.settings, 1)
        super().__init__(episodes)
        self.plant, self.names = episodes.plant, episodes.features.names


class VectorTaskEnvironment(VectorEnvironment):
    """`TaskEnvironment` side by side, each with its own reference: one call of the plant a tick.

    On the simulator each gives the bits of the single environment with its seed; on a twin, whose plants are one batch,
    the same to rounding.

    Args:
        num_envs: number of environments.
        settings: settings, see `TaskEnvironment`, which also describes the attributes.
        autoreset_mode: see `edp.sim.environment.VectorExcavatorEnv`.
        render_mode: None; there is nothing to render.
        changes: settings of a `LearningSpec` laid over these.

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
        check_render("task environment", render_mode)
        mode = checked_mode("task environment", num_envs, autoreset_mode)
        self.settings = learning_spec(settings, changes)
        episodes = TaskEpisodes(self.settings, num_envs)
        super().__init__(episodes, mode)
        self.plant, self.names = episodes.plant, episodes.features.names

    def _restart(self, infos: Infos) -> Infos:
        # Where the last episodes ended, not where the next ones begin.
        return self._batch.info(ALL) | super()._restart(infos)
