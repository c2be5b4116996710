"""Make a trained network smaller: students, distillation, pruning, dynamic INT8, quantisation-aware training."""

from edp.compress.bench import Bench, Order, tuning
from edp.compress.distillation import (
    Distillation,
    DistillationSpec,
    SoftmaxDivergence,
    continue_from,
    unlabelled,
)
from edp.compress.formats import FORMATS, Deployed, Taken, deploy, taken
from edp.compress.int8 import Quantised, dynamic_int8
from edp.compress.pruning import prune
from edp.compress.qat import QuantisationAware, RoundingSpec
from edp.compress.rounding import Rounding, matrices_of, weight_levels
from edp.compress.students import student, width_of
from edp.compress.taylor import Importance, importance
from edp.compress.variants import VARIANTS, Candidate

__all__ = [
    "FORMATS",
    "VARIANTS",
    "Bench",
    "Candidate",
    "Deployed",
    "Distillation",
    "DistillationSpec",
    "Importance",
    "Order",
    "QuantisationAware",
    "Quantised",
    "Rounding",
    "RoundingSpec",
    "SoftmaxDivergence",
    "Taken",
    "continue_from",
    "deploy",
    "dynamic_int8",
    "importance",
    "matrices_of",
    "prune",
    "student",
    "taken",
    "tuning",
    "unlabelled",
    "weight_levels",
    "width_of",
]
