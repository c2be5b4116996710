"""Where a calibration gets scores from: the form of a source, and synthetic worlds whose truth is known.

A source of real trainings has the same two methods: it trains the baseline and `modules` copies of it (an exact null)
on the sessions that a run is not judged on, and returns their errors on those that it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from edp.stats.metrics import COMPOSITE_WEIGHTS

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
METRICS = tuple(COMPOSITE_WEIGHTS)


class Source(Protocol):
    """Scores of a baseline and modules, drawn or trained.

    Attributes:
        name: for the tables.
        sessions: development sessions.
        modules: registered modules.
        designs: how many draws of folds studies take turns with; 0 for one of its own each.
    """

    @property
    def name(self) -> str: ...

    @property
    def sessions(self) -> int: ...

    @property
    def modules(self) -> int: ...

    @property
    def designs(self) -> int: ...

    def scores(self, tested: Mask, splits: NDArray[np.int64], effects: Array, repetition: int) -> Array:
        """Errors of one study, ``(metric, 1 + module, run, session)`` in the order of `METRICS`.

        Args:
            tested: ``(run, session)``, on what each run is judged; it trains on the rest. Other cells are not read.
            splits: ``(run,)``; runs of one number share a training set and differ by their seeds only.
            effects: ``(module,)``, true change of the error, as a share; zero under the null.
            repetition: number of the study; another one has other sessions, seeds and modules.
        """
        ...


@dataclass(frozen=True, kw_only=True)
class World:
    """A synthetic world. All standard deviations are shares of the baseline's mean error.

    Attributes:
        name: for the tables.
        difficulty: of a session, for every arm alike.
        training: of a training set, for every arm alike.
        seed: of a run's initial weights.
        common: share of the seed's variance that the arms have in common (common random numbers).
        module_session: of a module's effect between sessions; its mean over all thinkable sessions is the effect.
        module_training: of a module's effect between training sets.
        overlap: share of that variance that each training session brings along, so that training sets share it as
            they share sessions; the rest is each set's own. No procedure can see what all sets have in common.
        cell: of the rest.
        shared: share of every variance that the four metrics have in common.
        sessions, modules: their numbers; the thesis's by default.
        designs: see `Source`.
    """

    name: str
    difficulty: float = 0.20
    training: float = 0.04
    seed: float
    common: float = 0.38
    module_session: float
    module_training: float
    overlap: float = 0.0
    cell: float = 0.02
    shared: float = 0.8
    sessions: int = 25
    modules: int = 14
    designs: int = 0

    def scores(self, tested: Mask, splits: NDArray[np.int64], effects: Array, repetition: int) -> Array:
        """See `Source`."""
        rng = np.random.default_rng([20_26, repetition])
        arms, (runs, sessions) = 1 + self.modules, tested.shape
        first = np.unique(splits, return_index=True)[1]
        trained = ~tested[first]
        weight = (trained / np.sqrt(trained.sum(axis=1, keepdims=True))).T  # (session, split), unit variance each
        is_module = np.r_[0.0, np.ones(self.modules)][:, None, None]
        own, together = np.sqrt(1.0 - self.common), np.sqrt(self.common)
        relative = 1.0 + np.r_[0.0, effects][:, None, None] + self._draw(rng, (arms, runs, sessions), self.cell)
        relative = relative + is_module * self._draw(rng, (arms, 1, sessions), self.module_session)
        relative = relative + own * self._draw(rng, (arms, runs, 1), self.seed)
        relative = relative + together * self._draw(rng, (1, runs, 1), self.seed)
        relative = relative + self.training * self._by_split(rng, 1, weight, 1.0)[:, :, splits]
        effect = self._by_split(rng, arms, weight, self.overlap)
        relative = relative + is_module * self.module_training * effect[:, :, splits]
        level = 1.0 + self.difficulty * rng.standard_normal(sessions)
        return np.asarray(np.maximum(level, 0.2) * np.maximum(relative, 0.05))

    def _by_split(self, rng: np.random.Generator, arms: int, weight: Array, overlap: float) -> Array:
        """Effects of training sets with variance one, ``(metric, arm, split, 1)``."""
        sessions, sets = weight.shape
        shared = (self._draw(rng, (arms, 1, sessions), 1.0) @ weight).swapaxes(-1, -2)
        return np.asarray(np.sqrt(overlap) * shared + np.sqrt(1.0 - overlap) * self._draw(rng, (arms, sets, 1), 1.0))

    def _draw(self, rng: np.random.Generator, shape: tuple[int, ...], deviation: float) -> Array:
        """Normal draws for each metric, ``(metric, *shape)``, partly common to all."""
        common, own = rng.standard_normal(shape), rng.standard_normal((len(METRICS), *shape))
        return np.asarray(deviation * (np.sqrt(self.shared) * common + np.sqrt(1.0 - self.shared) * own))


# Seed and split spreads are those of the Hybrid on FG2 in Table 4.3 (2.2 and 9.4 %, 0.8 and 7 % of its error); what
# a module does differently from session to session is not in the thesis and taken as large, middling and dominant.
WORLDS = {
    world.name: world
    for world in (
        World(name="k = 1", seed=0.022, module_session=0.04, module_training=0.01),
        World(name="k = 10", seed=0.008, difficulty=0.15, module_session=0.02, module_training=0.005),
        World(name="sessions decide", seed=0.01, module_session=0.08, module_training=0.01),
    )
}
STRESS = World(name="training sets decide", seed=0.022, module_session=0.02, module_training=0.01, overlap=1.0)
"""A module's effect that comes with the training sessions: all training sets share most of it, so no split of the
same sessions shows it as a variance."""
