"""Make a trained network smaller: students, distillation, pruning, dynamic INT8, quantisation-aware training."""

from edp.evaluation.compression import CompressedRow, CompressionResult
from edp.evaluation.controller import ResourceUsage
from edp.training.compression.distillation import Distillation, DistillationSpec, SoftmaxDivergence
from edp.training.compression.int8 import Quantised, dynamic_int8
from edp.training.compression.pruning import prune
from edp.training.compression.qat import QuantisationAware, RoundingSpec
from edp.training.compression.rounding import NetworkRounding, weight_levels
from edp.training.compression.taylor import FeatureImportance, importance
from edp.workflows.compression.bench import Bench, CompressionRequest, tuning
from edp.workflows.compression.distil import DISTIL_SETTINGS, DistilRequest, DistilSpec, distil
from edp.workflows.compression.formats import FORMATS, Deployed, deploy, resource_usage
from edp.workflows.compression.searching import (
    CompressionSearchRequest,
    CompressionSearchSpec,
    search,
)
from edp.workflows.compression.variants import VARIANTS, CompressedCandidate

__all__ = [
    "DISTIL_SETTINGS",
    "FORMATS",
    "VARIANTS",
    "Bench",
    "CompressedCandidate",
    "CompressedRow",
    "CompressionRequest",
    "CompressionResult",
    "CompressionSearchRequest",
    "CompressionSearchSpec",
    "Deployed",
    "DistilRequest",
    "DistilSpec",
    "Distillation",
    "DistillationSpec",
    "FeatureImportance",
    "NetworkRounding",
    "QuantisationAware",
    "Quantised",
    "ResourceUsage",
    "RoundingSpec",
    "SoftmaxDivergence",
    "deploy",
    "distil",
    "dynamic_int8",
    "importance",
    "prune",
    "resource_usage",
    "search",
    "tuning",
    "weight_levels",
]
