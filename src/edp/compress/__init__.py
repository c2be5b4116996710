"""Make a trained network smaller: students, distillation, pruning, dynamic INT8, quantisation-aware training."""

from edp.compress.distillation import (
    Distillation,
    DistillationSpec,
    SoftmaxDivergence,
    continue_from,
    unlabelled,
)
from edp.compress.int8 import Quantised, dynamic_int8
from edp.compress.pruning import prune
from edp.compress.qat import QuantisationAware, RoundingSpec
from edp.compress.rounding import Rounding, matrices_of, weight_levels
from edp.compress.students import student, width_of
from edp.compress.taylor import Importance, importance

__all__ = [
    "Distillation",
    "DistillationSpec",
    "Importance",
    "QuantisationAware",
    "Quantised",
    "Rounding",
    "RoundingSpec",
    "SoftmaxDivergence",
    "continue_from",
    "dynamic_int8",
    "importance",
    "matrices_of",
    "prune",
    "student",
    "unlabelled",
    "weight_levels",
    "width_of",
]
