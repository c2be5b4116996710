"""One machine as an environment of Gymnasium."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError
from edp.signals import KINDS, Channel
from edp.sim.environment.library import gymnasium
from edp.sim.environment.model import NominalMachine
from edp.sim.environment.spec import EnvironmentSpec, settings_of
from edp.sim.environment.start import MOST_SEED, check_seed, episode_start
from edp.sim.environment.truth import Truth
from edp.sim.episodes.episodes import Episodes, EpisodeStart, Moment
from edp.sim.machine import layout as at
from edp.sim.machine.machine import Machine
from edp.storage.reading import Table

Array = NDArray[np.float64]
Observation = NDArray[np.float32]


class ExcavatorEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """An excavator front under lever commands; observations are what its sensors show, in SI units.

    The action is the lever positions of boom, arm and bucket, -1 to 1, extension positive; beyond, they stand at the
    end. The observation at tick k shows pilot pressures as the lever of tick k - 1 left them. The reward is 0: what is
    wanted of the machine is a task's affair. Episodes do not terminate; they are truncated at `duration_s`.

    Args:
        settings: what is simulated and shown.
        render_mode: None; there is nothing to render.
        changes: settings of an `EnvironmentSpec` laid over these.

    Attributes:
        settings: see `EnvironmentSpec`.
        channels: name, unit and kind of each value of an observation.
        rate_hz: ticks per second.
        model: the nominal machine of the present episode, or of the next one where none has begun.

    Raises:
        ConfigError: a setting is unknown or out of range.
    """

    metadata = {"render_modes": []}  # noqa: RUF012  as Gymnasium declares it

    def __init__(self, settings: EnvironmentSpec | None = None, render_mode: None = None, **changes: Any) -> None:
        if render_mode is not None:
            raise ConfigError(f"environment: render_mode = {render_mode!r}; there is nothing to render, leave it out")
        self.settings = settings_of(settings, changes)
        self.channels: tuple[Channel, ...] = self.settings.channels
        self.rate_hz, self.render_mode = self.settings.rate_hz, None
        self.observation_space, self.action_space = spaces(self.channels)
        self.model = NominalMachine(self.settings.scenario(0).load())
        self._episodes = Episodes(1, self.settings.columns)
        self._levers = np.zeros((1, at.AXES))
        self._begun, self._ended, self._in_soil = False, False, False

    def reset(self, *, seed: int | None = None, options: Table | None = None) -> tuple[Observation, Table]:
        """Begin an episode.

        Args:
            seed: of start, noise, soil and drawn machine; the scenario of the same seed begins alike. None goes on with
                the environment's own generator.
            options: settings for this episode alone, see `edp.sim.environment.start`.

        Returns:
            The first observation, and what began: ``seed``, ``machine``, ``mass_t`` of a drawn machine, ``material``
            and ``truth``.

        Raises:
            ConfigError: an option is unknown or out of range.
        """
        seed = check_seed(seed)
        super().reset(seed=seed)
        if seed is None:
            seed = int(self.np_random.integers(MOST_SEED))
        start, facts = episode_start(self.settings, seed, options)
        out = self._episodes.new_out()
        self._episodes.begin(0, start, out)
        self._enter(start)
        return out[0][0], {**facts, "truth": self._truth(out[1][0])}

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, object]]:
        """Hold lever positions, shape (3,), for one tick.

        Raises:
            ConfigError: they are not three finite numbers, or no episode is under way.
            SimulationError: the state became non-finite.
        """
        if not self._begun or self._ended:
            what = "has ended" if self._begun else "has not begun"
            raise ConfigError(f"the episode {what}; call reset() before step()")
        levers = np.asarray(action, dtype=float)
        if levers.shape != (at.AXES,):
            raise ConfigError(f"levers of shape {levers.shape}; give three positions: boom, arm and bucket")
        # Copied: compiled code takes neither strides nor arrays that may not be written.
        self._levers[0] = levers
        out = self._episodes.new_out()
        self._episodes.step(self._levers, out)
        self._ended = bool(out[2][0])
        return out[0][0], 0.0, False, self._ended, {"truth": self._truth(out[1][0])}

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
        return self._episodes.moment(0)

    def restore(self, snapshot: Moment) -> Observation:
        """Go to a moment, of this environment or of another: what follows gives the same bits as it gave then.

        Returns:
            The observation of that moment.

        Raises:
            ConfigError: the snapshot is of an environment that shows other channels.
        """
        self._episodes.go_to(0, snapshot)
        self._enter(snapshot.start)
        out = self._episodes.new_out()
        self._episodes.show(0, out)
        observation: Observation = out[0][0]
        return observation

    def branch(self, seed: int) -> None:
        """Give sensors and soil new random numbers from now on; the present state stays.

        Raises:
            ConfigError: no episode has begun.
        """
        self._episodes.redraw(0, np.random.SeedSequence(seed))

    def _enter(self, start: EpisodeStart) -> None:
        if start.machine is not self.model.machine:
            self.model = NominalMachine(start.machine)
        self._begun, self._ended = True, self._episodes.ended(0)
        self._in_soil = bool(start.scenario.material)

    def _truth(self, row: Array) -> Truth:
        pilot_pressure, episodes = self.model.machine.valves.pilot_pressure, self._episodes
        return Truth(row, pilot_pressure, self._in_soil, episodes.most_faults, episodes.shares())


def spaces(channels: tuple[Channel, ...]) -> tuple[Any, Any]:
    """Return the spaces of observations, within the plausibility limits of each channel's kind, and of levers."""
    limits = np.array([KINDS[channel.kind].plausible for channel in channels], dtype=np.float32)
    observations = gymnasium.spaces.Box(limits[:, 0], limits[:, 1], dtype=np.float32)
    return observations, gymnasium.spaces.Box(-1.0, 1.0, (at.AXES,), np.float32)
