"""The simulator as a batch of plants: one compiled call a tick."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError
from edp.signals import KINDS
from edp.sim.environment.batch import Bools, Index, Infos, Options, PlantBatch, StepOutcome
from edp.sim.environment.library import gymnasium
from edp.sim.environment.model import NominalMachine
from edp.sim.environment.spec import EnvironmentSpec
from edp.sim.environment.start import MAX_SEED, episode_start
from edp.sim.environment.truth import Truth
from edp.sim.episodes.episodes import Episodes, Moment
from edp.sim.machine.machine import Machine

Array = NDArray[np.float64]


class SimulatorBatch(PlantBatch):
    """Simulated excavator fronts, each with its own machine, soil and seed.

    Args:
        settings: settings of each machine, with equal channels and sample rates.

    Attributes:
        models: nominal machine of each current episode, or of the next episode before the first reset.
        episodes: state of all episodes.
    """

    source = "the simulator"

    def __init__(self, settings: Sequence[EnvironmentSpec]) -> None:
        first = settings[0]
        super().__init__(first.channels, len(settings))
        limits = np.array([KINDS[channel.kind].plausible for channel in self.channels], dtype=np.float32)
        self.observation_space = gymnasium.spaces.Box(limits[:, 0], limits[:, 1], dtype=np.float32)
        self._settings, self.rate_hz = settings, first.rate_hz
        # Equal settings share a model until a reset changes the machine of one.
        models = {id(each): NominalMachine(each.scenario(0).load()) for each in settings}
        self.models = [models[id(each)] for each in settings]
        self.episodes = Episodes(self.count, first.columns)
        rows = self.episodes.new_out()[1]
        # Episodes that have not begun have no observation.
        rows[:] = np.nan
        self._present = self.observed, rows, self.ended
        self._pilots, self._in_soil = np.zeros(self.count), False

    @property
    def machine(self) -> Machine:
        """Parameter set of the first machine."""
        return self.models[0].machine

    def commands(self, levers: Array) -> Array:
        """Return the nominal pilot pressures of the first machine, see `NominalMachine.commands`."""
        return self.models[0].commands(levers)

    def begin(self, index: int, seed: int | None, rng: np.random.Generator, options: Options) -> Infos:
        """Begin an episode; see `edp.sim.environment.start` for the options."""
        seed = int(rng.integers(MAX_SEED)) if seed is None else seed
        start, facts = episode_start(self._settings[index], seed, options)
        self.episodes.begin(index, start, self._present)
        self._enter(index)
        return facts

    def step(self, actions: Array, active: Bools | None = None) -> StepOutcome:
        """Hold lever positions, shape (count, 3), for one tick, see `EpisodeBatch.step`."""
        self.episodes.step(actions, self._present, active)
        return self._outcome

    def truth(self, index: Index) -> Truth:
        """Return the noise-free channels of one machine or of all machines."""
        episodes, row = self.episodes, self._present[1][index].copy()
        # A sum is a copy of one value or of many.
        pilots = self._pilots[index] + 0.0
        return Truth(row, pilots, self._in_soil, episodes.most_faults, episodes.shares())

    def restore(self, index: int, snapshot: Moment) -> None:
        """Restore one machine to a snapshot, see `ExcavatorEnv.restore`."""
        self.episodes.go_to(index, snapshot)
        self.episodes.show(index, self._present)
        self._enter(index)

    def _enter(self, index: int) -> None:
        """Take note of an episode's machine and soil."""
        starts = self.episodes.starts
        start = starts[index]
        if start is None:
            raise ConfigError(f"episode {index} has not begun; reset it first")
        if start.machine is not self.models[index].machine:
            self.models[index] = NominalMachine(start.machine)
        self._pilots[index] = start.machine.valves.pilot_pressure
        self._in_soil = any(each is not None and bool(each.scenario.material) for each in starts)
