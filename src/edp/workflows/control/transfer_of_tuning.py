"""Does tuning on a model carry over? Costs of the same gains on a model and on the plant (question O4)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import spearmanr

from edp.control.controllers import ControllerSpec
from edp.errors import ConfigError
from edp.settings.bounds import check_bounds, integer
from edp.workflows.control.bench import ControlBench
from edp.workflows.control.tune_gains import set_gains

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TransferSpec:
    """Number of random settings.

    Attributes:
        settings: uniformly from what the controller says is worth trying.
        seed: random seed of the settings.
    """

    settings: int = 80
    seed: int = 0

    def __post_init__(self) -> None:
        # Two costs have a rank correlation of one whatever they are.
        check_bounds("transfer of a tuning", self, settings=integer(3, 100_000), seed=integer(0, 2**31))


@dataclass(frozen=True, eq=False)
class TuningTransfer:
    """Costs of the same settings on a model and on the plant, mm, shape (settings,).

    Attributes:
        on_model: position errors of the tip on the model.
        on_plant: costs on the plant, mm, shape (settings,).
    """

    on_model: Array
    on_plant: Array

    @property
    def rank_correlation(self) -> float:
        """Return Spearman's rank correlation; 0 if a score is constant."""
        if np.ptp(self.on_model) == 0.0 or np.ptp(self.on_plant) == 0.0:
            return 0.0
        return float(spearmanr(self.on_model, self.on_plant).statistic)

    @property
    def regret(self) -> float:
        """Cost on the plant of the setting that the model calls best, over the least cost on the plant."""
        return float(self.on_plant[int(np.argmin(self.on_model))] / self.on_plant.min())


def draw_settings(controller: ControllerSpec, spec: TransferSpec) -> list[ControllerSpec]:
    """Return controllers with gains sampled uniformly from their space.

    Raises:
        ConfigError: it has no gains to vary.
    """
    if not controller.space:
        raise ConfigError("the controller has no gains to vary; give another one")
    rng = np.random.default_rng(spec.seed)
    rows = [{name: rng.uniform(*ends) for name, ends in controller.space.items()} for _ in range(spec.settings)]
    return [set_gains(controller, row) for row in rows]


def costs_of(bench: ControlBench, settings: list[ControllerSpec]) -> Array:
    """Return the position error (rms, mean over the loops, mm) of each setting on a bench, shape (settings,)."""
    return np.array([bench.cost(setting) for setting in settings])
