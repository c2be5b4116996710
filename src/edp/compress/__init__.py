"""Make a trained network smaller: students, distillation, pruning, dynamic INT8."""

from edp.compress.distillation import (
    Distillation,
    DistillationSpec,
    SoftmaxDivergence,
    continue_from,
    unlabelled,
)
from edp.compress.int8 import Quantised, dynamic_int8
from edp.compress.pruning import prune
from edp.compress.students import student, width_of
from edp.compress.taylor import Importance, importance

__all__ = [
    "Distillation",
    "DistillationSpec",
    "Importance",
    "Quantised",
    "SoftmaxDivergence",
    "continue_from",
    "dynamic_int8",
    "importance",
    "prune",
    "student",
    "unlabelled",
    "width_of",
]
