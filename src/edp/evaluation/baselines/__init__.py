"""Simple predictors that every network is compared with, on the same ticks."""

from edp.evaluation.baselines.base import BASELINES, Baseline, BaselineTask
from edp.evaluation.baselines.boosted_trees import BoostedTrees
from edp.evaluation.baselines.persistence import Persistence
from edp.evaluation.baselines.ridge_arx import RidgeArx
from edp.evaluation.baselines.small_mlp import SmallMlp

__all__ = [
    "BASELINES",
    "Baseline",
    "BaselineTask",
    "BoostedTrees",
    "Persistence",
    "RidgeArx",
    "SmallMlp",
]
