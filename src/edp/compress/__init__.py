"""Make a trained network smaller: students, distillation, pruning."""

from edp.compress.distillation import (
    Distillation,
    DistillationSpec,
    SoftmaxDivergence,
    continue_from,
    unlabelled,
)
from edp.compress.pruning import prune
from edp.compress.students import student, width_of
from edp.compress.taylor import Importance, importance

__all__ = [
    "Distillation",
    "DistillationSpec",
    "Importance",
    "SoftmaxDivergence",
    "continue_from",
    "importance",
    "prune",
    "student",
    "unlabelled",
    "width_of",
]
