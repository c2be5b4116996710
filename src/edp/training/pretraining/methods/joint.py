"""Joint training: all machines alike, states carried for long, so that the network identifies a machine as it runs."""

from __future__ import annotations

from typing import ClassVar

from edp.networks.predictor import Predictor
from edp.training.pretraining.methods.base import PRETRAININGS
from edp.training.pretraining.spec import MetaSpec
from edp.training.strategy import TrainingStrategy
from edp.training.warm_start import WarmStart


@PRETRAININGS.register("joint")
class Joint:
    """Minimise the mean error over all machines."""

    label: ClassVar[str] = "Joint"
    episodic: ClassVar[bool] = False

    def strategy(self, spec: MetaSpec, start: Predictor | None) -> TrainingStrategy | None:
        """Return a warm start from a network; None without a network."""
        return None if start is None else WarmStart(start, unfreeze=False)
