"""One machine as an environment of Gymnasium."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError, closest
from edp.signals import Channel
from edp.sim.environment.library import gymnasium
from edp.sim.environment.spec import EnvironmentSpec
from edp.sim.environment.start import MOST_SEED, episode_start
from edp.sim.environment.truth import Truth
from edp.sim.episodes.episodes import Episodes, EpisodeStart, Moment
from edp.sim.machine import layout as at
from edp.sim.machine.machine import Machine
from edp.sim.machine.parameters import pack
from edp.sim.physics import pose, valve
from edp.sim.simulate import rehearse

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

    Raises:
        ConfigError: a setting is unknown or out of range.
    """

    metadata = {"render_modes": []}  # noqa: RUF012  as Gymnasium declares it

    def __init__(self, settings: EnvironmentSpec | None = None, render_mode: None = None, **changes: Any) -> None:
        if render_mode is not None:
            raise ConfigError(f"environment: render_mode = {render_mode!r}; there is nothing to render, leave it out")
        self.settings = settings_of(settings, changes)
        rehearse()
        self.channels: tuple[Channel, ...] = self.settings.channels
        self.rate_hz, self.render_mode = self.settings.rate_hz, None
        self.observation_space = observation_space(len(self.channels))
        self.action_space = action_space()
        self._episodes = Episodes(1, self.settings.columns)
        self._levers, self._out = np.zeros((1, at.AXES)), np.zeros((1, len(self.channels)), np.float32)
        self._machine: Machine | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: of start, noise, soil and drawn machine; the scenario of the same seed begins alike. None goes on with
                the environment's own generator.
            options: settings for this episode alone, see `edp.sim.environment.start`.

        Returns:
            The first observation, and what began: seed, machine, material, and the truth.

        Raises:
            ConfigError: an option is unknown or out of range.
        """
        super().reset(seed=seed)
        if seed is None:
            seed = int(self.np_random.integers(MOST_SEED))
        start, facts = episode_start(self.settings, seed, options)
        observation = self._episodes.begin(0, start)
        self._enter(start)
        return observation, {**facts, "truth": self._truth()}

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Hold lever positions, shape (3,), for one tick.

        Raises:
            ConfigError: they are not three finite numbers, or the environment was not reset.
            SimulationError: the state became non-finite.
        """
        if self._machine is None:
            raise ConfigError("the environment has no episode under way; call reset() before step()")
        levers = np.asarray(action, dtype=float)
        if levers.shape != (at.AXES,):
            raise ConfigError(f"levers of shape {levers.shape}; give three positions: boom, arm and bucket")
        if self._ended:
            raise ConfigError("the episode has ended; call reset() before the next step()")
        self._levers[0] = levers
        out = np.empty_like(self._out)
        self._episodes.step(self._levers, out)
        self._ended = bool(self._episodes.ended()[0])
        return out[0], 0.0, False, self._ended, {"truth": self._truth()}

    def commands(self, levers: Any) -> Array:
        """Nominal pilot pressures (Pa) of lever positions: the last 12 channels of Table A.1, shape (..., 12).

        Args:
            levers: shape (..., 3).
        """
        machine = self.machine
        positions = np.asarray(levers, dtype=float)
        out = np.empty((positions.size // at.AXES, 2 * at.SPOOLS))
        rows = np.ascontiguousarray(positions.reshape(-1, at.AXES))
        axes, plant = self.kinematics.axes, self.kinematics.plant
        valve.fill_pilots(rows, machine.valves.pilot_pressure, axes, plant, np.empty(at.SPOOLS), out)
        return out.reshape(*positions.shape[:-1], 2 * at.SPOOLS)

    def tip(self, strokes: Any) -> Array:
        """Tip x, y (m from the boom foot) and attitude (rad) at strokes (m from closed), both of shape (..., 3)."""
        return self.kinematics.poses(strokes)

    def strokes(self, poses: Any) -> Array:
        """Strokes (m from closed) that put the tip at poses, both of shape (..., 3); NaN where it cannot be."""
        return self.kinematics.strokes(poses)

    @property
    def machine(self) -> Machine:
        """The machine of the present episode, or of the next one where none has begun."""
        return self._machine or self.settings.scenario(0).load()

    @property
    def kinematics(self) -> pose.Kinematics:
        """Of `machine`."""
        if self._kinematics is None:
            self._kinematics = pose.Kinematics(*pack(self.machine))
        return self._kinematics

    def snapshot(self) -> Moment:
        """This moment of plant, sensors and counters, exactly; nothing that follows changes it.

        Raises:
            ConfigError: no episode has begun.
        """
        return self._episodes.moment(0)

    def restore(self, snapshot: Moment) -> None:
        """Go to a moment: what follows gives the same bits as it gave then."""
        if snapshot.memory.shape[0] == 0:
            raise ConfigError("the snapshot is empty")
        self._episodes.go_to(0, snapshot)
        self._enter(snapshot.start)

    def branch(self, seed: int) -> None:
        """Give sensors and soil fresh randomness from here on; the present stays as it is."""
        self._episodes.redraw(0, np.random.SeedSequence(seed))

    _machine: Machine | None = None
    _kinematics: pose.Kinematics | None = None
    _ended = True

    def _enter(self, start: EpisodeStart) -> None:
        if start.machine is not self._machine:
            self._machine, self._kinematics = start.machine, None
        self._ended = bool(self._episodes.ended()[0])

    def _truth(self) -> Truth:
        return Truth(self._episodes.row(0), self.machine.valves.pilot_pressure)


def settings_of(settings: EnvironmentSpec | None, changes: dict[str, Any]) -> EnvironmentSpec:
    """Settings with changes laid over them.

    Raises:
        ConfigError: a change names no setting (the closest is offered), or is out of range.
    """
    names = [entry.name for entry in fields(EnvironmentSpec)]
    for name in changes:
        if name not in names:
            raise ConfigError(f"environment: setting '{name}' is unknown{closest(name, names)}")
    return replace(settings or EnvironmentSpec(), **changes)


def observation_space(width: int) -> Any:
    """Any numbers: channels have units and no bounds of their own."""
    return gymnasium.spaces.Box(-np.inf, np.inf, (width,), np.float32)


def action_space() -> Any:
    """Lever positions of boom, arm and bucket."""
    return gymnasium.spaces.Box(-1.0, 1.0, (at.AXES,), np.float32)
