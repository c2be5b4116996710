"""Episodes that step together: common part of the environments of simulator, twin, FMU and tasks."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError
from edp.settings.bounds import shown
from edp.signals import Channel
from edp.sim.environment.library import gymnasium
from edp.sim.episodes.episodes import not_finite
from edp.sim.machine import layout as at

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Index = int | slice
ALL = slice(None)
Infos = dict[str, object]
Options = Mapping[str, object]
AutoresetMode = gymnasium.vector.AutoresetMode
MAX_MACHINES = 65_536


class StepOutcome(NamedTuple):
    """Result of a step, shape (count,) each; the next step may change the arrays in place.

    Attributes:
        rewards: rewards of the step.
        terminated: mask of the episodes that ended by an event.
        truncated: mask of the episodes that reached their maximum length.
    """

    rewards: Array
    terminated: Bools
    truncated: Bools


class EpisodeBatch(ABC):
    """Episodes of one environment, each of which begins by itself; all step in one call.

    Attributes:
        count: number of episodes.
        rate_hz: ticks per second.
        observation_space: observation space of one episode.
        action_space: action space of one episode.
    """

    count: int
    rate_hz: float
    observation_space: Any
    action_space: Any = gymnasium.spaces.Box(-1.0, 1.0, (at.AXES,), np.float32)

    @abstractmethod
    def begin(self, index: int, seed: int | None, rng: np.random.Generator, options: Options) -> Infos:
        """Begin one episode and return its description.

        Args:
            index: index of the episode.
            seed: seed of all random values in the episode; None chooses a random seed.
            rng: random generator for the seed.
            options: options of this episode.

        Raises:
            ConfigError: an option is unknown or out of range.
        """

    @abstractmethod
    def step(self, actions: Array, active: Bools | None = None) -> StepOutcome:
        """Hold actions, shape (count, 3), for one step; `active` names the episodes that step (default: all).

        Raises:
            ConfigError: an action is not finite; no episode has moved.
            SimulationError: a state became non-finite.
        """

    @abstractmethod
    def observation(self, index: Index) -> NDArray[np.float32]:
        """Return a copy of the present observation, (value,) for one episode or (count, value) for all episodes."""

    @abstractmethod
    def info(self, index: Index) -> Infos:
        """Return the true state of one episode, or of all episodes as arrays."""

    def summary(self, index: int) -> Infos:
        """Return the figures of an episode that has ended."""
        return {}


class PlantBatch(EpisodeBatch):
    """Machines side by side; a machine has no reward, and its episodes end by their length.

    Args:
        channels: channels of an observation, in order.
        count: number of machines.

    Attributes:
        channels: name, unit and kind of each value of an observation.
        source: name of the machine in messages.
        observed: current observation, shape (count, channel); NaN before an episode begins.
        ended: mask of the completed episodes, shape (count,).
    """

    source: str

    def __init__(self, channels: tuple[Channel, ...], count: int) -> None:
        self.channels, self.count = channels, count
        self.observed = np.full((count, len(channels)), np.nan, np.float32)
        self.ended = np.zeros(count, np.bool_)
        self._outcome = StepOutcome(np.zeros(count), np.zeros(count, np.bool_), self.ended)

    def observation(self, index: Index) -> NDArray[np.float32]:
        """Return a copy of what one machine measures now, or of all rows."""
        row: NDArray[np.float32] = self.observed[index].copy()
        return row

    def info(self, index: Index) -> Infos:
        """Return the true state of one machine, or of all machines, as ``truth``."""
        return {"truth": self.truth(index)}

    @abstractmethod
    def truth(self, index: Index) -> Mapping[str, object]:
        """Return noise-free values by channel, with strokes and tip, of one machine, or arrays (count,) of all."""


def check_render(what: str, mode: Any) -> None:
    """Refuse a mode of rendering.

    Raises:
        ConfigError: there is one.
    """
    if mode is not None:
        raise ConfigError(f"{what}: render_mode = {mode!r}; there is nothing to render, leave it out")


def checked_mode(what: str, num_envs: int, mode: Any) -> Any:
    """Return the mode of automatic resets of `num_envs` environments side by side.

    Raises:
        ConfigError: there is no such mode, or there are too many or too few environments.
    """
    if not 1 <= num_envs <= MAX_MACHINES:
        raise ConfigError(f"{what}: num_envs = {num_envs}; give 1 to {MAX_MACHINES}")
    try:
        return AutoresetMode(mode)
    except ValueError as error:
        modes = ", ".join(entry.value for entry in AutoresetMode)
        raise ConfigError(f"{what}: autoreset_mode = {mode!r}; choose one of {modes}") from error


def check_mask(count: int, mask: Any) -> Bools:
    """Return the mask of environments that restart, shape ``(count,)``; all of them without a mask.

    Raises:
        ConfigError: another shape or type, or no environment at all.
    """
    if mask is None:
        return np.ones(count, dtype=np.bool_)
    array = np.asarray(mask)
    if array.shape != (count,) or array.dtype != np.bool_ or not array.any():
        raise ConfigError(
            f"reset: reset_mask of shape {array.shape} and type {array.dtype}; give {count} booleans, of which one at "
            "least is True"
        )
    return array


def check_seed(seed: Any) -> int | None:
    """Return a seed checked for Gymnasium.

    Raises:
        ConfigError: it is no whole number, or negative.
    """
    if seed is None:
        return None
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise ConfigError(f"reset: seed = {shown(seed)}; give a whole number that is not negative, or None")
    return int(seed)


def checked_seeds(count: int, seed: Any) -> list[int | None]:
    """Return a seed for each environment: one number counts on from the first, None leaves each to its generator.

    Raises:
        ConfigError: a seed is no whole number, or their number differs.
    """
    if seed is None:
        return [None] * count
    if isinstance(seed, int | np.integer):
        first = check_seed(seed)
        return [None if first is None else first + index for index in range(count)]
    if len(seed) != count:
        raise ConfigError(f"reset: {len(seed)} seeds for {count} machines; give one for each, or one")
    return [check_seed(each) for each in seed]


def checked_actions(actions: Any, shape: tuple[int, ...]) -> Array:
    """Return a copy of actions in double precision.

    Raises:
        ConfigError: they have another shape.
    """
    # Copied: compiled code takes neither strides nor arrays that may not be written.
    array = np.array(actions, dtype=float, order="C")
    if array.shape != shape:
        raise ConfigError(
            f"actions of shape {array.shape}; give three positions: boom, arm and bucket, as shape {shape}"
        )
    return array


def check_finite(actions: Array) -> None:
    """Raise an error for actions, shape (count, 3), that are not finite.

    Raises:
        ConfigError: one is not.
    """
    finite = np.isfinite(actions).all(axis=1)
    if not finite.all():
        raise not_finite(actions, int(np.argmin(finite)))
